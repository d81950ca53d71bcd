"""Inputs of a simulation: a scene (where things are, what is observed), and the disturbance of its observations."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from ceres_cal.base import Frozen, InputError, Pose, did_you_mean, field
from ceres_cal.problem.parameters import Station
from ceres_cal.scene import SIDES, Camera, Target


class ViewPlan(Frozen, eq=True):
    """Views of one target in frames taken at one station: one view per frame.

    The frames of a plan differ only in their noise, outliers, wrong labels and hidden stretches. Many frames in one
    plan are fast, because the target is projected once.

    Attributes:
        frames: names of the frames.
        station: where they are taken.
        target: what they show.
        placement: where the target is; None: in the world.
        points: names of the observed points; None: all of the target's points except crossings of its curves.
        curves: names of the observed curves; None: all of the target's curves.
        spacing_m: distance along a curve between curve observations.
        side: part of the paint that is observed: "centre", "left" or "right".
    """

    frames: tuple[str, ...]
    station: str
    target: str
    placement: str | None = None
    points: tuple[str, ...] | None = None
    curves: tuple[str, ...] | None = None
    spacing_m: float = 0.1
    side: str = "centre"


class Scene(Frozen, eq=True):
    """The truth of a simulation: all objects, and what is observed.

    Attributes:
        targets: by name.
        cameras: name -> intrinsics; the cameras' own poses are not used.
        stations: name -> camera and cam_from_world.
        placements: name -> world_from_target of a movable target.
        views: what is observed.
        photography: settings of its photographs by name, if there are any.

    Raises:
        InputError: on construction: an unknown name, an impossible number; the line names the place.
    """

    targets: Mapping[str, Target]
    cameras: Mapping[str, Camera]
    stations: Mapping[str, Station]
    placements: Mapping[str, Pose]
    views: tuple[ViewPlan, ...]
    photography: Mapping[str, Any] = field(default_factory=dict)

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
        """Return the camera of a station, at the station's pose."""
        place = self.stations[station]
        return self.cameras[place.camera].at(place.cam_from_world)

    def world_from_target(self, placement: str | None) -> Pose:
        """Return the pose of a view's target: its placement, or the identity for a target in the world."""
        return Pose.identity() if placement is None else self.placements[placement]


class Disturbance(Frozen, eq=True):
    """Disturbances of the observations of every frame; by default there are none.

    Attributes:
        points_sigma_px: standard deviation of each coordinate of the point observations.
        curves_sigma_px: standard deviation of each coordinate of the curve observations, and so of the distance to the
            curve.
        outliers: share of the observations that are moved far, in addition to the noise.
        outlier_spread_px: standard deviation of each coordinate of that move.
        wrong_labels: share of the observations with a wrong name: a point gets that of any other point of its target, a
            curve observation that of the nearest other curve.
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
