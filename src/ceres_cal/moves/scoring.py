"""How well cameras explain observations that they were not calibrated from: intrinsics held, poses at their best."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import DegenerateError, InputError
from ceres_cal.base.numerical import numerical
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration, Fit
from ceres_cal.calibration.calibrating import Again, solved_from
from ceres_cal.moves.carried import require_same_things
from ceres_cal.moves.poses import PoseSearch, pose_candidates
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights, gather_sights
from ceres_cal.problem.parameters import Estimate, Options, Station, make_layout
from ceres_cal.problem.priors import gather_priors
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.residuals import Residuals, residuals
from ceres_cal.problem.structure import EXACT, Structure, make_structure
from ceres_cal.start.initialise import Start, chained_poses


@dataclass(frozen=True)
class ScorePart:
    """What one camera, or one view, leaves.

    Attributes:
        name: of the camera, or of frame, station and target.
        points, curves: observations that took part. outliers: those that did not.
        points_rms_px, curves_rms_px: root mean square lengths of their residuals; 0 of nothing.
        all_rms_px: the same of points and curves with all outliers in it; infinite where one cannot be shown at all.
    """

    name: str
    points: int
    curves: int
    outliers: int
    points_rms_px: float
    curves_rms_px: float
    all_rms_px: float


@dataclass(frozen=True, eq=False)
class Score:
    """New observations under a calibration's intrinsics.

    Attributes:
        fit: residuals and noise. before: those that the calibration was made with.
        cameras, views: parts by camera and, the worst first, by view.
        estimate: the poses that suit the observations best.
    """

    fit: Fit
    before: Fit
    cameras: tuple[ScorePart, ...]
    views: tuple[ScorePart, ...]
    estimate: Estimate

    @property
    def noise_ratios(self) -> tuple[float, float]:
        """Noise of points and of curves over that of the calibration, px over px; NaN where either has none."""
        pairs = zip(self.fit.noise_px, self.before.noise_px, strict=True)
        ratios = [new / old if new > 0.0 and old > 0.0 else float("nan") for new, old in pairs]
        return ratios[0], ratios[1]


@numerical("the score")
def score(
    calibration: Calibration,
    observations: Observations,
    *,
    options: Options | None = None,
    hold_stations: bool = False,
) -> Score:
    """How well new observations of fields or boards agree with a calibration: poses alone are solved for.

    Targets are taken as the calibration says that they were built. A calibration of another program will do.

    Args:
        options: loss and rejection; those of the calibration by default.
        hold_stations: stations stand where the calibration has them, so that only boards are posed: the poses of a
            rig's cameras, or of a camera over its field, are tested, too.

    Raises:
        InputError: a camera, or a station that is held, which the calibration does not have.
        DegenerateError: naming the sight whose pose the observations do not determine.
        SolutionError: another camera or target than those calibrated, or intrinsics that do not explain them at all.
    """
    observations = calibration.drawn_alike(observations)
    require_same_things(calibration, observations)
    observed = replace(observations, targets={**calibration.targets, **observations.targets})
    given = replace(options or calibration.options, lens=calibration.options.lens, tolerances={}, dimensions=())
    sights = _as_built(observed, calibration)
    known = (
        {name: calibration.estimate.stations[name] for name in _held(calibration, observed)} if hold_stations else {}
    )
    layout = make_layout(observed, given)
    layout = replace(
        layout,
        free={name: np.empty(0, dtype=np.int64) for name in layout.free},
        stations=layout.stations - known.keys(),
    )
    if not layout.size:
        raise InputError("with its stations held nothing is left to be posed: `ceres-cal check` is for that")
    start = Start(_start(calibration, observed, sights, known), calibration.phi_from)
    priors = gather_priors(observed, given, EXACT)
    posed = solved_from(start, observed, Problem(sights, layout, priors, options=given), Again(layout, None, False))
    left = residuals(observed, sights, posed.estimate)
    return Score(
        posed.fit,
        calibration.fit,
        tuple(_by_camera(observed, left, posed)),
        tuple(sorted(_by_view(observed, left, posed), key=lambda part: -part.all_rms_px)),
        posed.estimate,
    )


def _held(calibration: Calibration, observations: Observations) -> list[str]:
    for name in observations.stations:
        if name not in calibration.estimate.stations:
            names = ", ".join(map(repr, calibration.estimate.stations))
            raise InputError(f"station {name!r} is not in the calibration, which has {names}: it cannot be held there")
    return list(observations.stations)


def _as_built(observations: Observations, calibration: Calibration) -> Sights:
    """The sights of targets as the calibration says that they were built."""
    sights = gather_sights(observations)
    built: Structure = make_structure(
        observations.targets, calibration.options.tolerances, calibration.options.dimensions
    )
    built = built.carrying(calibration.estimate.structure)
    return replace(sights, points=built.points(sights), tracks=built.tracks(sights))


def _start(
    calibration: Calibration, observations: Observations, sights: Sights, known: Mapping[str, Station]
) -> Estimate:
    """Every sight's pose under the calibrated lens, chained into stations and placements."""
    stations = {name: Station(camera, Pose.identity()) for name, camera in observations.stations.items()}
    blank = Estimate(calibration.cameras, stations, {}, EXACT)
    numbers, poses = [], []
    for number, key in enumerate(sights.keys):
        old = calibration.estimate.stations.get(key.station)
        before = [old.cam_from_world] if old is not None and key.placement is None else []
        candidates = pose_candidates(PoseSearch(observations, sights[number], blank, (1.0, 1.0)), before)
        if candidates:
            numbers.append(number)
            poses.append(candidates[0].pose.matrix)
    if not poses:
        raise DegenerateError(f"{sights.keys[0]}: its pose cannot be told: show at least four points, not on one line")
    stations, placements = chained_poses(observations, sights, np.array(numbers), np.array(poses), known)
    return Estimate(calibration.cameras, stations, placements, EXACT)


# ---- what is left ---------------------------------------------------------------------------------------------------


def _by_camera(observations: Observations, left: Residuals, posed: Calibration) -> Iterator[ScorePart]:
    cameras = [view.camera for view in observations.views]
    for name in posed.cameras:
        if name in cameras:
            yield _part(name, np.array([camera == name for camera in cameras]), observations, left, posed)


def _by_view(observations: Observations, left: Residuals, posed: Calibration) -> Iterator[ScorePart]:
    for number, view in enumerate(observations.views):
        name = f"frame {view.frame!r} of station {view.station!r}, {view.target}"
        yield _part(name, np.arange(len(observations.views)) == number, observations, left, posed)


def _part(name: str, views: Mask, observations: Observations, left: Residuals, posed: Calibration) -> ScorePart:
    own = views[observations.points.view], views[observations.curves.view]
    kept = posed.inlier_masks(observations)
    inside = [lengths[mine & used] for lengths, mine, used in zip(left.lengths, own, kept, strict=True)]
    every = np.nan_to_num(
        np.concatenate([lengths[mine] for lengths, mine in zip(left.lengths, own, strict=True)]), nan=np.inf
    )
    points, curves = inside
    return ScorePart(
        name, len(points), len(curves), len(every) - len(points) - len(curves), *map(_rms, (*inside, every))
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
