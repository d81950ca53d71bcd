"""What a simulation is made from: a scene (who stands where, what is looked at) and what disturbs its observation.

How a photograph of it is taken: light, carpet, paint, what stands about, lens blur and sensor.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.transforms import Pose
from ceres_cal.base.words import did_you_mean
from ceres_cal.problem.parameters import Station
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import SIDES, Target

MOST_THINGS = 100


@dataclass(frozen=True)
class Photography:
    """What a photograph shows besides the targets, and what the camera makes of it.

    Attributes:
        blur_px: standard deviation of the lens's Gaussian point spread (defocus), besides the pixel's own square.
        vignetting: share of the light that is lost in the farthest image corner.
        unevenness: share by which the lamps' light varies over the image.
        shadows: number of people's shadows on the floor. shadow_depth: share of the light that each takes.
        robots: number of robots on the field, balls: number of balls; both hide what is behind them.
        wear: share of the paint that is worn off.
        carpet: brightness of the carpet, paint: of paint and paper, as shares of white.
        carpet_colour, paint_colour: blue, green and red of each, times its brightness.
        sun: light of the sun, times the lamps', in stripes as windows let it in.
        strips: share by which strips of carpet, which meet in seams, differ in brightness.
        glare: share of white that a lamp mirrored by the floor adds where it is brightest.
        carpet_texture: standard deviation of the carpet's brightness, as a share of it.
        exposure: grey level of white in full light.
        read_noise: standard deviation of the sensor's noise in the dark, grey levels.
        shot_noise: variance that each grey level of signal adds, in grey levels squared (photon noise).
        mosaic: whether each of the sensor's pixels sees one colour (red and green in every other row, green and blue in
            the others), the other two filled in from those around.
        motion_px: way of the camera while the shutter is open.
        jpeg_quality: 1 to 100; 0: no compression.

    Raises:
        InputError: on construction: a number that is not in its range.
    """

    blur_px: float = 0.6
    vignetting: float = 0.2
    unevenness: float = 0.1
    shadows: int = 0
    shadow_depth: float = 0.5
    robots: int = 0
    balls: int = 0
    wear: float = 0.0
    carpet: float = 0.2
    paint: float = 0.85
    carpet_colour: tuple[float, float, float] = (0.55, 1.25, 0.65)  # a green one
    paint_colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    carpet_texture: float = 0.05
    exposure: float = 230.0
    read_noise: float = 1.0
    shot_noise: float = 0.01
    sun: float = 0.0
    strips: float = 0.0
    glare: float = 0.0
    motion_px: float = 0.0
    mosaic: bool = False
    jpeg_quality: int = 0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not np.all(np.isfinite(value) & np.greater_equal(value, 0.0)):
                raise InputError(f"photography: {name} must be a number from 0 on, not {value}")
        for name in ("vignetting", "unevenness", "shadow_depth", "wear", "carpet", "paint", "strips"):
            if getattr(self, name) > 1.0:
                raise InputError(f"photography: {name} is a share and at most 1, not {getattr(self, name)}")
        for name in ("shadows", "robots", "balls"):
            if getattr(self, name) > MOST_THINGS:
                raise InputError(f"photography: at most {MOST_THINGS} {name}, not {getattr(self, name)}")
        if self.jpeg_quality > 100:
            raise InputError(f"photography: jpeg_quality is at most 100 (0: none), not {self.jpeg_quality}")


@dataclass(frozen=True)
class ViewPlan:
    """What frames taken at one station show of one target: one view per frame.

    The frames of a plan differ in their noise, outliers, wrong labels and hidden stretches only; many frames in one
    plan are fast, because the target is projected once.

    Attributes:
        frames: names of the frames.
        station: where they are taken.
        target: what they show.
        placement: where the target is; None: it lies in the world.
        points: names of the points looked for; None: all that the target has, crossings of its curves apart.
        curves: names of the curves looked for; None: all that the target has.
        spacing_m: distance along a curve from one curve observation to the next.
        side: which part of the paint is observed: "centre", "left" or "right".
    """

    frames: tuple[str, ...]
    station: str
    target: str
    placement: str | None = None
    points: tuple[str, ...] | None = None
    curves: tuple[str, ...] | None = None
    spacing_m: float = 0.1
    side: str = "centre"


@dataclass(frozen=True)
class Scene:
    """The truth of a simulation: everything that is, and what is looked at.

    Attributes:
        targets: by name.
        cameras: name -> intrinsics; their own pose is not used.
        stations: name -> camera and cam_from_world.
        placements: name -> world_from_target of a movable target.
        views: what is looked at.
        photography: how photographs of it are taken, where it says so.

    Raises:
        InputError: on construction: a name that is not there, a number that cannot be; the line names the place.
    """

    targets: Mapping[str, Target]
    cameras: Mapping[str, Camera]
    stations: Mapping[str, Station]
    placements: Mapping[str, Pose]
    views: tuple[ViewPlan, ...]
    photography: Photography | None = None

    def __post_init__(self) -> None:
        for name, station in self.stations.items():
            _require(station.camera, self.cameras, f"station {name!r} names camera")
            _require_finite(station.cam_from_world, f"station {name!r}")
        for name, pose in self.placements.items():
            _require_finite(pose, f"placement {name!r}")
        if not self.views:
            raise InputError("the scene has no views: say which frames show which target")
        for number, plan in enumerate(self.views):
            self._check_plan(plan, f"view {number}")

    def _check_plan(self, plan: ViewPlan, here: str) -> None:
        if not plan.frames or len(set(plan.frames)) != len(plan.frames):
            raise InputError(f"{here}: give at least one frame, each name once, not {list(plan.frames)}")
        _require(plan.station, self.stations, f"{here} names station")
        _require(plan.target, self.targets, f"{here} names target")
        if plan.placement is not None:
            _require(plan.placement, self.placements, f"{here} names placement")
        target = self.targets[plan.target]
        for kind, chosen, known in (("point", plan.points, target.points), ("curve", plan.curves, target.curves)):
            for name in chosen or ():
                if name not in known:
                    raise InputError(
                        f"{here}: target {plan.target!r} has no {kind} {name!r}: `ceres-cal targets` lists the names"
                    )
            if len(set(chosen or ())) != len(chosen or ()):
                raise InputError(f"{here}: a {kind} is named twice: name each once")
        if not (np.isfinite(plan.spacing_m) and plan.spacing_m > 0.0):
            raise InputError(f"{here}: spacing_m must be a positive number of metres, not {plan.spacing_m}")
        if plan.side not in SIDES:
            raise InputError(f"{here}: side {plan.side!r} is unknown: {', '.join(SIDES)}")

    def camera_at(self, station: str) -> Camera:
        """The camera of a station, at the station's pose."""
        place = self.stations[station]
        return self.cameras[place.camera].at(place.cam_from_world)

    def world_from_target(self, placement: str | None) -> Pose:
        """Where the target of a view lies: its placement, or the world itself."""
        return Pose.identity() if placement is None else self.placements[placement]


@dataclass(frozen=True)
class Disturbance:
    """What disturbs the observations of every frame; nothing does by default.

    Attributes:
        points_sigma_px: standard deviation of each coordinate of the point observations.
        curves_sigma_px: standard deviation of each coordinate of the curve observations, and so of the distance to
            the curve.
        outliers: share of the observations that are moved far, in addition to the noise.
        outlier_spread_px: standard deviation of each coordinate of that move.
        wrong_labels: share of the observations with a wrong name: a point has that of any other point of its target,
            a curve observation that of the curve next to it.
        hidden_stretches: number of stretches of curve per view that are not seen, each somewhere on the curves in view.
        hidden_length_m: length of such a stretch; it ends where its curve does.
        hidden_points: share of the points that are not seen.

    Raises:
        InputError: on construction: a number that is not finite or not in its range.
    """

    points_sigma_px: float = 0.0
    curves_sigma_px: float = 0.0
    outliers: float = 0.0
    outlier_spread_px: float = 20.0
    wrong_labels: float = 0.0
    hidden_stretches: int = 0
    hidden_length_m: float = 0.5
    hidden_points: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"disturbance: {name} must be a number from 0 on, not {value}")
        for name in ("outliers", "wrong_labels", "hidden_points"):
            if getattr(self, name) > 1.0:
                raise InputError(f"disturbance: {name} is a share and at most 1, not {getattr(self, name)}")
        if self.outliers + self.wrong_labels > 1.0:
            raise InputError(
                "disturbance: outliers and wrong_labels are shares of the same observations, at most 1 in all"
            )


def _require(name: str, known: Collection[str], what: str) -> None:
    if name not in known:
        there = f": there are {', '.join(map(repr, known)) or 'none'}"
        raise InputError(f"{what} {name!r}, which is not there{did_you_mean(name, known) or there}")


def _require_finite(pose: Pose, what: str) -> None:
    if not (np.all(np.isfinite(pose.rotation)) and np.all(np.isfinite(pose.translation))):
        raise InputError(f"{what}: its pose has a number that is not finite")
