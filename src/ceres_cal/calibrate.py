"""The steps, in order: initialise, solve, reject, solve, assess."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ceres_cal.bundle import Progress, Solution, Weighting, solve
from ceres_cal.calibration import Calibration, Fit, Rejected
from ceres_cal.diagnostics import Inliers, judge, start_weights
from ceres_cal.errors import SolutionError
from ceres_cal.initialise import initialise
from ceres_cal.observations import Observations
from ceres_cal.parameters import Estimate, Layout, Options, make_layout
from ceres_cal.residuals import Residuals, residuals
from ceres_cal.sights import Sights, gather_sights

_MOST_ROUNDS = 15


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
    sights = gather_sights(observations)
    layout = make_layout(observations, options)
    start = initialise(observations, sights, options)
    settled = _settle(observations, sights, start.estimate, layout, options, progress)
    _require_usable(settled.solution)
    return Calibration(
        settled.solution.estimate,
        _fit(settled, layout),
        _rejected(observations, settled.inliers),
        settled.solution.termination,
        settled.solution.converged,
        settled.rounds,
        settled.solution.history,
        start.phi_from,
        options,
        observations.digest,
    )


@dataclass(frozen=True, eq=False)
class _Settled:
    solution: Solution
    inliers: Inliers
    residuals: Residuals
    rounds: int


def _settle(
    observations: Observations,
    sights: Sights,
    estimate: Estimate,
    layout: Layout,
    options: Options,
    progress: Callable[[Progress], None] | None,
) -> _Settled:
    """Solve, judge the noise and the outliers, solve again, until nothing changes.

    A start is off by more than the noise, so the first solve rejects nothing that the start can show: a redescending
    loss at the residuals' median keeps gross errors from deciding.
    """

    def judged(at: Estimate) -> tuple[Residuals, Inliers]:
        found = residuals(observations, sights, at)
        return found, judge(
            observations, found, layout.size, options.reject_sigma, estimate_noise=options.noise_scale == "estimate"
        )

    def solved(at: Estimate, by: Inliers, loss: str, loss_scale: float, precision: float) -> Solution:
        weighting = Weighting(by.point_scale, by.curve_scale, loss, loss_scale, precision)
        return solve(sights.used(by.points, by.curves), at, layout, weighting, options, progress)

    everything = start_weights(observations, residuals(observations, sights, estimate))
    solution = solved(estimate, everything, "cauchy", 1.0, 1e-3)
    found, inliers = judged(solution.estimate)
    for rounds in range(2, _MOST_ROUNDS + 1):
        solution = solved(solution.estimate, inliers, options.loss, options.loss_scale, 1e-12)
        before = inliers
        found, inliers = judged(solution.estimate)
        if inliers.same_as(before):
            break
    return _Settled(solution, inliers, found, rounds)


def _require_usable(solution: Solution) -> None:
    for name, camera in solution.estimate.cameras.items():
        if camera.folds:
            raise SolutionError(
                f"camera {name!r}: the solved {camera.lens.kind} lens folds over at "
                f"{camera.lens.monotone_radius(camera.phi):.0f} px from the principal point, inside the image (corner "
                f"at {camera.corner_radius:.0f} px): choose fewer or other coefficients, or observe nearer to the corners"
            )
    if not solution.converged and not np.isfinite(solution.cost):
        raise SolutionError(f"the solve failed ({solution.termination}): check labels and target dimensions")


def _fit(settled: _Settled, layout: Layout) -> Fit:
    points = settled.residuals.points[settled.inliers.points]
    curves = settled.residuals.curves[settled.inliers.curves]
    return Fit(
        len(points),
        len(curves),
        float(np.sqrt(np.sum(points**2) / max(len(points), 1))),
        float(np.sqrt(np.sum(curves**2) / max(len(curves), 1))),
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
