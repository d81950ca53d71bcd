"""The noise of each camera, and of each target that a camera sees, where it differs from that of all together."""

from __future__ import annotations

import numpy as np

from ceres_cal.base import NORMAL_95, Mask, median, mixture_95
from ceres_cal.problem import Estimate, Problem
from ceres_cal.problem.residuals import relative_lengths, residuals
from ceres_cal.robust.noise import LEAST_SCALE, LEAST_SPARE, squares_beside

# Logarithm of the ratio of noise scales up to which sds are right, as far as hundreds of runs can tell.
_ALIKE = float(np.log(1.25))


def noise_of_cameras(problem: Problem, estimate: Estimate, judged: Mask) -> dict[str, float]:
    """The noise of each name in `Observations.noise_names`, as a factor on the stated sigmas of its observations;
    unchanged where all are about equally noisy.

    The noise differs, for example, in a photograph out of focus, in a camera of fewer pixels or with another detector,
    or in a field that was clicked beside boards that were detected. At the mean noise, the noisiest would seem too
    certain and the others too uncertain. The unknowns of a camera are divided among its observations by number of
    equations, those of a pose among the observations that show it. The factor of few observations includes that it is
    hardly known.

    Args:
        problem: weighted by the noise of all together. judged: (N + M,) observations that are not known outliers.
    """
    observations, layout = problem.observations, problem.layout
    views = observations.points.view, observations.curves.view
    every = relative_lengths(observations, residuals(problem.sights, estimate, problem.feet))
    lengths = [length / scale for length, scale in zip(every, problem.weighting.scales, strict=True)]
    kinds = zip(np.split(judged, [len(views[0])]), lengths, strict=True)
    seen = [own & np.isfinite(length) for own, length in kinds]
    counts = [np.bincount(view[own], minlength=len(observations.views)) for view, own in zip(views, seen, strict=True)]
    equations = 2 * counts[0] + counts[1]
    names, cameras = np.array(observations.noise_names), np.array([view.camera for view in observations.views])
    before = np.array([observations.noise.get(name, 1.0) for name in names.tolist()])
    before /= median(np.repeat(before, equations))
    noise, spare = dict[str, float](), 0.0
    for name in dict.fromkeys(names.tolist()):
        own = names == name
        count, shown = int(equations[own].sum()), [observations.views[view] for view in np.flatnonzero(own)]
        if not count:  # all of its observations are left out, or cannot be shown
            continue
        camera, now = shown[0].camera, float(before[own][0])
        poses = len(layout.stations & {view.station for view in shown})
        poses += len(layout.placements & {view.placement for view in shown})
        free = len(layout.free.get(camera, ())) / equations[cameras == camera].sum()
        taken_up, parts = min(free + 6 * poses / count, 1.0), zip(lengths, seen, views, strict=True)
        relative = [now * length[used & own[view]] for length, used, view in parts]
        squares, freedom = squares_beside(relative, taken_up, problem.options.reject_sigma)
        noise[name], spare = _scale_of_few(squares, freedom), spare + freedom
    # What is common to all does not count: the scale of all together, estimated with the next solve, would cancel it.
    # Of fewer equations the stated sigmas are taken: factors of a rig of few clicks grew to 50.
    after = np.array([noise.get(name, np.nan) for name in names.tolist()])
    usual = median(np.repeat(after, equations))
    changes = (np.abs(np.log(one / before))[equations > 0] > _ALIKE for one in (after, after / usual))
    return noise if spare >= LEAST_SPARE and all(map(np.any, changes)) else dict(observations.noise)


def _scale_of_few(squares: float, freedom: float) -> float:
    """The noise scale at which a normal distribution has the 95 % interval of all scales that may be, relative to a
    usual scale. Half of all scales are within `_ALIKE` of the usual one, and the logarithms of the others follow
    Cauchy's distribution.

    Args:
        squares: sum of squared residuals over the usual scale. freedom: their degrees of freedom.
    """
    steps, reach, most = 200, 8.0, 6.0  # of the grid; to either side in standard errors of a scale, and at most
    best = max(float(np.sqrt(squares / freedom)), LEAST_SCALE) if freedom > 0.0 else 1.0
    logs = np.log(best) + min(reach / (2.0 * max(freedom, 1.0)) ** 0.5, most) * np.linspace(-1.0, 1.0, steps + 1)
    likely = -freedom * logs - 0.5 * squares * np.exp(-2.0 * logs) - np.log1p((logs / _ALIKE) ** 2)
    weights = np.exp(likely - likely.max())
    return mixture_95(weights / weights.sum(), np.exp(2.0 * logs)) / NORMAL_95
