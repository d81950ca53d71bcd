"""The steps, in order: initialise, solve, reject, solve, assess."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.errors import DegenerateError, SolutionError
from ceres_cal.base.threads import at_most, meanwhile, single_threaded_blas
from ceres_cal.base.transforms import Array
from ceres_cal.base.words import bounds_text
from ceres_cal.calibration import Calibration, Fit, Rejected
from ceres_cal.model.parameters import Estimate, Layout, Options, make_layout
from ceres_cal.model.residuals import Residuals, residuals
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Rows, SightKey, Sights, gather_sights
from ceres_cal.scene.camera import Camera
from ceres_cal.solve import Progress, Solution, Weighting, private_placements, settle_placements, solve
from ceres_cal.solve.lost import with_lost_boards_found
from ceres_cal.solve.mirrored import without_mirrored_poses
from ceres_cal.solve.noise import Inliers, judge, start_weights
from ceres_cal.start.baseline import four_point_baseline
from ceres_cal.start.initialise import Start, initialise
from ceres_cal.uncertainty import Posterior, Setting, Uncertainty, assess

_MOST_ROUNDS = 15
_SETTLED_SCALE, _SETTLED_AGAIN = 1e-2, 1e-5  # relative change of a noise scale that is no change
_ENOUGH_PLACEMENTS = 20  # of a camera: with them it is known well enough to place all others
_NO_FIT = 0.015  # of the image diagonal: a median residual beyond it is no calibration
_UNKNOWN = (
    "camera {!r}: its views are too frontal to tell phi, which is {} at 95 %, and its heights go with phi: the floor "
    "is right, what is above it is not: add boards tilted by 20 degrees, or a prior on height_m where it sees the field"
)


def calibrate(
    observations: Observations,
    options: Options | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Calibration:
    """Calibrate every camera, station and placement that the observations show.

    Args:
        progress: called at every iteration of every solve, from this thread.

    Raises:
        DegenerateError: the observations cannot determine the unknowns; the message names the frame or the numbers.
        SolutionError: no usable camera came out.
        InputError: a prior or a fixed number that the camera does not have.
    """
    options = options or Options()
    with single_threaded_blas(), at_most(options.threads):
        sights = gather_sights(observations)
        layout = make_layout(observations, options)
        start = initialise(observations, sights, options)
        return solved_from(start, observations, sights, layout, options, progress)


@dataclass(frozen=True)
class Again:
    """How a calibration is taken up again after an earlier one.

    Attributes:
        known: the layout of everything that is known by a posterior, also where the solve holds it.
        scales: noise scales of points and curves that were seen before.
        assessed: whether the posterior is wanted.
    """

    known: Layout
    scales: tuple[float, float]
    assessed: bool = True


def solved_from(
    start: Start,
    observations: Observations,
    sights: Sights,
    layout: Layout,
    options: Options,
    progress: Callable[[Progress], None] | None = None,
    again: Again | None = None,
) -> Calibration:
    """Solve, reject, solve, assess, from a start.

    Raises:
        CalibrationError: see `calibrate`.
    """
    warnings: tuple[str, ...] = ()
    posterior = None
    digest = meanwhile(lambda: observations.digest)
    if options.closed_form_only:
        settled = _unsolved(observations, sights, four_point_baseline(sights, start.estimate))
    else:
        settled = _settle(observations, sights, start.estimate, layout, options, progress, again)
        _require_fits(settled, sights)
        if again is None or again.assessed:
            settled, posterior = _assess(observations, settled, sights, again.known if again else layout, options)
            warnings = tuple(_unknown(settled, posterior))
        warnings = (*_require_usable(settled, sights), *warnings)
    return Calibration(
        settled.solution.estimate,
        observations.targets,
        _fit(settled, layout),
        _rejected(observations, settled.inliers),
        settled.solution.termination,
        settled.solution.converged,
        settled.rounds,
        settled.solution.history,
        start.phi_from,
        warnings,
        options,
        digest.result(),
        posterior,
    )


@dataclass(frozen=True, eq=False)
class _Settled:
    solution: Solution
    inliers: Inliers
    residuals: Residuals
    rounds: int


def _unsolved(observations: Observations, sights: Sights, estimate: Estimate) -> _Settled:
    found = residuals(observations, sights, estimate)
    solution = Solution(estimate, np.nan, False, "the paper's closed form, nothing was minimised", ())
    return _Settled(solution, start_weights(observations, found), found, 0)


def _settle(
    observations: Observations,
    sights: Sights,
    estimate: Estimate,
    layout: Layout,
    options: Options,
    progress: Callable[[Progress], None] | None,
    again: Again | None,
) -> _Settled:
    """Solve, judge the noise and the outliers, solve again, until nothing changes.

    A start is off by more than the noise, so the first solve rejects nothing that the start can show: a redescending
    loss at the residuals' median keeps gross errors from deciding.
    """

    def judged(at: Estimate, places: Array) -> tuple[Residuals, Inliers]:
        found = residuals(observations, sights, at, places)
        return found, judge(
            observations,
            found,
            layout.unknowns,
            options.reject_sigma,
            estimate_noise=options.noise_scale == "estimate",
            usual=again.scales if again else None,
        )

    found = residuals(observations, sights, estimate)
    everything = start_weights(observations, found)
    # A line painted aside is an outlier to a redescending loss, but not to its tolerance.
    rough = Weighting(
        everything.point_scale,
        everything.curve_scale,
        "huber" if len(estimate.structure.values) else "cauchy",
        loss_scale=1.0,
        precision=1e-3,
    )
    used = sights.used(everything.points, everything.curves)
    if not len(used):
        raise DegenerateError("the observations fix no pose that could show them: add points or lines of the targets")
    few = used.take(_spread(used, layout))
    solution = solve(few, estimate, layout.of(few.keys), rough, options, progress, found.places)
    if len(few) < len(used):
        solution = replace(solution, estimate=settle_placements(used, solution.estimate, layout, rough))
    before, (found, inliers) = everything, judged(solution.estimate, found.places)
    rounds, undecided = 1, frozenset(used.keys)
    while rounds < _MOST_ROUNDS:
        weighting = Weighting(inliers.point_scale, inliers.curve_scale, options.loss, options.loss_scale)
        at_rest = rounds > 1 and inliers.same_as(before, _SETTLED_AGAIN if again else _SETTLED_SCALE)
        estimate = solution.estimate
        if not at_rest:
            used = sights.used(inliers.points, inliers.curves)
        if rounds == 1 or at_rest:
            estimate, changed, undecided = _mended(sights, used, inliers, estimate, layout, weighting, undecided)
            if changed:
                found, inliers = judged(estimate, found.places)
                used = sights.used(inliers.points, inliers.curves)
            elif at_rest:
                break
        else:
            undecided = frozenset(used.keys)  # what was decided about mirrored poses, another lens had decided
        solution = solve(used, estimate, layout, weighting, options, progress, found.places)
        before, (found, inliers) = inliers, judged(solution.estimate, found.places)
        rounds += 1
    return _Settled(solution, inliers, found, rounds)


def _spread(sights: Sights, layout: Layout) -> Rows:
    """Numbers of some sights that tell a camera well enough for a start: of private placements no more than enough."""
    private = private_placements(sights, layout)
    chosen: list[int] = []
    for camera in {key.camera for key in sights.keys}:
        own = [number for number, key in enumerate(sights.keys) if key.camera == camera]
        boards = [number for number in own if sights.keys[number].placement in private]
        chosen += boards[:: max(1, len(boards) // _ENOUGH_PLACEMENTS)]
        chosen += [number for number in own if sights.keys[number].placement not in private]
    return np.array(sorted(chosen), dtype=np.int64)


def _mended(
    sights: Sights,
    used: Sights,
    inliers: Inliers,
    estimate: Estimate,
    layout: Layout,
    weighting: Weighting,
    undecided: frozenset[SightKey],
) -> tuple[Estimate, int, frozenset[SightKey]]:
    """The estimate with lost boards posed again and mirrored poses turned over, how many there were of both, and which
    sights' poses compete still.
    """
    estimate, lost = with_lost_boards_found(sights, inliers, estimate, layout, replace(weighting, loss="cauchy"))
    estimate, turned, undecided = without_mirrored_poses(used, estimate, layout, weighting, undecided)
    return estimate, lost + turned, undecided


def _require_fits(settled: _Settled, sights: Sights) -> None:
    """Raise SolutionError where the solve failed, or its end explains too little."""
    if settled.solution.failed:
        raise SolutionError(f"the solve failed ({settled.solution.termination}): check labels and target dimensions")
    for name, camera in settled.solution.estimate.cameras.items():
        _require_fit(name, camera, settled, sights)


def _require_usable(settled: _Settled, sights: Sights) -> tuple[str, ...]:
    """Warnings about the solution; SolutionError where it must not be used."""
    warnings = []
    for name, camera in settled.solution.estimate.cameras.items():
        if not camera.folds:
            continue
        fold, corner = camera.lens.monotone_radius(camera.phi), camera.corner_radius
        where = f"camera {name!r}: the solved {camera.lens.kind} lens folds {fold:.0f} px from the principal point"
        seen = _of(name, sights.used(settled.inliers.points, settled.inliers.curves)).reach_px(camera)
        # The paper's polynomial can be had without a fold; the others' published models fold in corners nobody saw.
        if camera.lens.kind == "radial" or fold <= seen:
            raise SolutionError(
                f"{where}, inside the image (corner at {corner:.0f} px): "
                "choose fewer or other coefficients, or observe nearer to the corners"
            )
        warnings.append(
            f"{where}: from there to the corner ({corner:.0f} px) pixels have no answer; "
            f"observations reach {seen:.0f} px"
        )
    return (*warnings, *_lost(settled.inliers, sights))


def _assess(
    observations: Observations, settled: _Settled, sights: Sights, layout: Layout, options: Options
) -> tuple[_Settled, Posterior]:
    """What is known of every number, by the observations that took part at the noise that they show.

    Where the observations leave phi so open that their least cost lies at no lens, the estimate is another one.
    """
    inliers, places = settled.inliers, settled.residuals.places
    weighting = Weighting(inliers.point_scale, inliers.curve_scale, options.loss, options.loss_scale)
    used = sights.used(inliers.points, inliers.curves)
    estimate, posterior = assess(
        Setting(used, layout, weighting, options, places), settled.solution.estimate, inliers.freedom
    )
    if estimate is not settled.solution.estimate:
        found = residuals(observations, sights, estimate, places)
        settled = replace(settled, solution=replace(settled.solution, estimate=estimate), residuals=found)
    return settled, posterior


def _unknown(settled: _Settled, posterior: Posterior) -> Iterator[str]:
    """Warnings of cameras whose phi the observations leave open."""
    known = Uncertainty(settled.solution.estimate, posterior, {})
    for name in posterior.profiles:
        verdict = known.verdict("camera", name, "phi")
        if verdict.verdict == "unknown":
            yield _UNKNOWN.format(name, bounds_text(verdict.low, verdict.high, "px"))


def _of(camera: str, sights: Sights) -> Sights:
    return sights.take(np.array([i for i, key in enumerate(sights.keys) if key.camera == camera], dtype=np.int64))


def _require_fit(name: str, camera: Camera, settled: _Settled, sights: Sights) -> None:
    """Raise SolutionError where half of a camera's observations are missed by more than any lens could explain."""
    own = _of(name, sights)
    limit_px = _NO_FIT * float(np.hypot(*camera.image_size))
    points, curves = settled.residuals.lengths
    met = np.count_nonzero(points[own.point_rows] <= limit_px)  # NaN is not
    met += np.count_nonzero(curves[own.curve_rows] <= limit_px)
    if 2 * met < len(own.point_rows) + len(own.curve_rows):
        raise SolutionError(
            f"camera {name!r}: the best solution misses half of its observations by more than {limit_px:.0f} px: "
            "check labels, target dimensions and which lens it is"
        )


def _lost(inliers: Inliers, sights: Sights) -> Iterator[str]:
    """Sights most of whose observations were taken out: they were not understood, whatever the rest says."""
    shares = sights.used_share(inliers.points, inliers.curves)
    for number in np.flatnonzero(shares < 0.5):
        out = f"{100.0 * (1.0 - shares[number]):.0f} % of its observations were taken out"
        yield f"{sights.keys[number]}: {out}: check its labels, do not use its pose"


def _fit(settled: _Settled, layout: Layout) -> Fit:
    points, curves = settled.residuals.lengths
    points, curves = points[settled.inliers.points], curves[settled.inliers.curves]
    return Fit(
        len(points),
        len(curves),
        float(np.sqrt(points @ points / max(len(points), 1))),
        float(np.sqrt(curves @ curves / max(len(curves), 1))),
        settled.inliers.point_scale,
        settled.inliers.curve_scale,
        layout.size,
    )


def _rejected(observations: Observations, inliers: Inliers) -> tuple[Rejected, ...]:
    entries = []
    for kind, mask, sigmas, column in (
        ("point", inliers.points, inliers.point_sigmas, observations.points),
        ("curve", inliers.curves, inliers.curve_sigmas, observations.curves),
    ):
        for row in np.flatnonzero(~mask):
            reason = f"{sigmas[row]:.1f} sigma off" if np.isfinite(sigmas[row]) else "cannot be seen from there"
            frame = observations.views[column.view[row]].frame
            entries.append(Rejected(kind, int(row), frame, observations.feature_name(kind, int(row)), reason))
    return tuple(entries)
