"""Which lens the data ask for: the simplest of those that predict placements, or lines, as well as any other does.

Some of the observations are solved with each lens, and one linear model is made at the end of each. Leaving out a group
of equations moves the free numbers by (1 - A)^-1 S^T r, with S the group's equations in directions in which everything
is known to one, A = S^T S and r its residuals. What a solve without them would leave of them, r + S (1 - A)^-1 S^T r,
thus follows from the fit of all. Errors that go together within a group make a longer lens predict the others no
better: a criterion that counts observations would take them for a lens.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.errors import CalibrationError, DegenerateError
from ceres_cal.calibration import LensChoice, TriedLens
from ceres_cal.model.equations import Equations, write_equations
from ceres_cal.model.parameters import OF_PIXELS, Estimate, Options, make_layout
from ceres_cal.model.priors import gather_priors
from ceres_cal.model.residuals import residuals
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights, gather_sights
from ceres_cal.observations.thinning import thinned
from ceres_cal.scene.lens import LENSES
from ceres_cal.solve import Problem, RobustSolution, solve, solve_robustly
from ceres_cal.solve.linear_model import LinearModel, equation_weights, make_linear_model
from ceres_cal.solve.noise import Inliers
from ceres_cal.start.initialise import initialise

PAPER = "radial 2,3"
"""The lens that wins ties."""
_LEAST_ROWS, _SHARE = 1_250, 0.025  # of the observations, how many take part
_NOISY = 1.5  # times the least noise: a lens that leaves as much predicts worse, whatever is held out
_PRECISION = 1e-6  # relative change of the cost at which a lens is at its best
_FEWEST_PLACEMENTS = 5  # with fewer the features of each are held out one by one
_RIDGE = 1e-3  # of everything's information: a group that tells a direction alone cannot be left out
# How much worse than the best, in standard errors of the difference, is as good. Of 180 scenes with the paper's lens it
# was recognised in 92 % at 1, in 97 % at 1.5; at 2 the decentring of real sets is missed.
_AS_GOOD = 1.5


def choose_lens(observations: Observations, options: Options) -> tuple[Options, LensChoice]:
    """The options with the lens that the data ask for, one for all cameras, and how it was chosen.

    The paper's lens and the longest of each kind come first: only where the paper's is not as good as the best of them
    are the shorter ones tried.

    Args:
        options: their lens, powers and fixed coefficients are not looked at.

    Raises:
        CalibrationError: no lens makes a calibration.
    """
    total = len(observations.points) + len(observations.curves)
    few = thinned(observations, max(_LEAST_ROWS, int(_SHARE * total)))
    every = list(_every_lens(options))
    longest = {one.lens: one for one in sorted(every, key=coefficients_of)}
    first = [next(one for one in every if label_of(one) == PAPER), *longest.values()]
    sights = gather_sights(few)
    solved = [_solve_roughly(few, sights, one) for one in first]
    reference = _reference(few, sights, solved)
    tried = [_judge(few, one, reference) for one in solved]
    best, chosen = _decide(tried)
    if chosen != 0:
        kinds = [
            one.options.lens for one in tried[1:] if _worse(one, tried[best]) <= _AS_GOOD or (one.failed and one.end)
        ]
        shorter = [one for one in every if one.lens in kinds and one not in first]
        tried += [_judge(few, _solve_roughly(few, sights, one), reference) for one in shorter]
        _, chosen = _decide(tried)
    share = (len(few.points) + len(few.curves)) / total
    return tried[chosen].options, _choice(tried, tried[chosen], share)


# ---- candidates -----------------------------------------------------------------------------------------------------


def candidates(options: Options) -> list[Options]:
    """Options with every sensible lens of the same kind, fewest coefficients first; the given one is among them."""
    lens = options.blank_lens
    if lens.powers:
        powers = sorted({*lens.trial_powers, options.powers}, key=lambda p: (len(p), p))
        if set(lens.names) & set(options.fixed):  # a held coefficient belongs to its own powers alone
            powers = [options.powers]
        return [replace(options, powers=one) for one in powers]
    by_order = sorted(zip(lens.orders, lens.names, strict=True))
    names = [name for _, name in by_order if name not in lens.decentring]
    held = {name: value for name, value in options.fixed.items() if name not in names}
    shorter = []
    for count in range(1, len(names) + 1):
        shorter.append(replace(options, fixed={**held, **dict.fromkeys(names[count:], 0.0)}))
    if all(label_of(one) != label_of(options) for one in shorter):
        shorter.append(options)
    return shorter


def _every_lens(options: Options) -> Iterator[Options]:
    """Every sensible lens of every kind, with decentring terms and without."""
    of_pixels = {name: value for name, value in options.fixed.items() if name in OF_PIXELS}
    for kind, lens in LENSES.items():
        for held in dict.fromkeys(((), lens.decentring)):
            fixed = {**of_pixels, **dict.fromkeys(held, 0.0)}
            yield from candidates(replace(options, lens=kind, powers=(2, 3), fixed=fixed))


def label_of(options: Options) -> str:
    """How a lens is called: "radial 2,3" or "brown k1 k2 p1 p2"."""
    if options.blank_lens.powers:
        return f"{options.lens} {','.join(map(str, options.powers))}"
    return " ".join([options.lens, *(name for name in options.blank_lens.names if name not in options.fixed)])


def coefficients_of(options: Options) -> int:
    """How many coefficients of the lens are free."""
    return len(set(options.blank_lens.names) - set(options.fixed))


# ---- one lens -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Tried:
    """A lens and, once it was judged, its errors of prediction.

    Attributes:
        end: where its rough solve ended; None where it failed. squares: (G,) of each group, in standard deviations.
        rms_px: of all. failed: why there is no answer, "" where there is.
    """

    options: Options
    end: RobustSolution | None = None
    squares: Array | None = None
    rms_px: float = np.nan
    failed: str = ""


def _solve_roughly(observations: Observations, sights: Sights, options: Options) -> _Tried:
    """The solve of a lens from nothing, up to where the noise is known well enough."""
    try:
        start = initialise(observations, sights, options).estimate
        priors = gather_priors(observations, options, start.structure)
        problem = Problem(sights, make_layout(observations, options), priors, options=options)
        return _Tried(options, solve_robustly(problem, observations, start, most_rounds=1))
    except CalibrationError as error:
        return _Tried(options, failed=str(error))


def _reference(observations: Observations, sights: Sights, tried: Sequence[_Tried]) -> RobustSolution:
    """The lens that explains the observations best: all are compared over its inliers, at its noise, from its poses."""
    ends = [one.end for one in tried if one.end is not None]
    if not ends:
        raise DegenerateError(tried[0].failed)
    end = min(ends, key=lambda end: _log_noise(end.inliers))
    return solve_robustly(replace(end.problem, sights=sights), observations, end.solution.estimate, most_rounds=2)


def _log_noise(inliers: Inliers) -> float:
    """Of a typical observation, over the stated."""
    counts = 2 * len(inliers.points), len(inliers.curves)
    return float(np.log([inliers.point_scale, inliers.curve_scale]) @ counts) / sum(counts)


def _judge(observations: Observations, one: _Tried, reference: RobustSolution) -> _Tried:
    """A lens with its errors of prediction, of the reference's inliers and at its noise."""
    if one.end is None:
        return one
    noise = float(np.exp(_log_noise(one.end.inliers) - _log_noise(reference.inliers)))
    if noise > _NOISY:
        return replace(one, end=None, failed=f"leaves {noise:.1f} times the noise of the best")
    try:
        model = _model(observations, one.end, reference)
    except CalibrationError as error:
        return replace(one, failed=str(error))
    group = _groups(model.equations)
    errors = held_out_errors(model, group)
    count = len(np.unique(model.equations.observation))
    rms_px = float(np.linalg.norm(errors / model.weight)) / count**0.5
    return replace(one, squares=np.asarray(np.bincount(group, errors**2), dtype=float), rms_px=rms_px)


def _model(observations: Observations, end: RobustSolution, reference: RobustSolution) -> LinearModel:
    """The linear model of a lens at its best.

    Raises:
        CalibrationError: the lens folds where it must not, or cannot show all of the observations.
    """
    sights = reference.problem.sights
    problem = replace(end.problem, sights=sights, weighting=reference.problem.weighting)
    estimate = replace(end.solution.estimate, placements=reference.solution.estimate.placements)
    solution = solve(problem, estimate, precision=_PRECISION)
    _require_unfolded(problem, solution.estimate)
    there = residuals(observations, sights, solution.estimate, end.residuals.feet)
    points, curves = there.lengths
    if not (np.isfinite(points[sights.point_rows]).all() and np.isfinite(curves[sights.curve_rows]).all()):
        raise DegenerateError("cannot show all that another lens shows")
    equations = write_equations(observations, sights, solution.estimate, there)
    weights = equation_weights(observations, problem.weighting, equations, there).within_sigma
    return make_linear_model(problem, solution.estimate, equations, weights)


def _require_unfolded(problem: Problem, estimate: Estimate) -> None:
    for name, camera in estimate.cameras.items():
        fold = camera.lens.monotone_radius(camera.phi)
        if camera.folds and (not camera.lens.may_fold or fold <= problem.sights.of_camera(name).about(camera).reach_px):
            raise DegenerateError("folds inside the image")


def _groups(equations: Equations) -> Indices:
    """(E,) number of the placement of each equation, or, of what stays where it is, of the feature."""
    placed = np.array([key.placement is not None for key in equations.sights.keys])
    if np.count_nonzero(placed) < _FEWEST_PLACEMENTS:
        placed[:] = False
    feature = 2 * equations.feature + equations.is_curve + 1
    name = equations.sight * (feature.max() + 1) + np.where(placed[equations.sight], 0, feature)
    return np.unique(name, return_inverse=True)[1]


def held_out_errors(model: LinearModel, group: Indices) -> Array:
    """(E,) errors, in standard deviations, of each group (E,) predicted from all others.

    A placement that one group alone shows is posed from it, everything else held.
    """
    errors, bounds, sight = np.zeros(len(group)), model.equations.bounds, model.equations.sight
    order = np.argsort(group, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        basis, left = model.shared[rows], model.left_over[rows]
        if len(rows) < bounds[sight[rows[0]] + 1] - bounds[sight[rows[0]]]:
            basis = np.hstack([basis, model.private[rows]])
        rest = (1.0 + _RIDGE) * np.eye(basis.shape[1]) - basis.T @ basis
        errors[rows] = left + basis @ np.linalg.solve(rest, basis.T @ left)
    return errors


# ---- the choice -----------------------------------------------------------------------------------------------------


def _decide(tried: Sequence[_Tried]) -> tuple[int, int]:
    options = [one.options for one in tried]
    return decide(list(map(label_of, options)), list(map(coefficients_of, options)), [one.squares for one in tried])


def decide(labels: Sequence[str], coefficients: Sequence[int], squares: Sequence[Array | None]) -> tuple[int, int]:
    """Indices of the best lens and of the simplest that is as good; the paper's comes before all others.

    As good is what exceeds the least error by no more than 1.5 standard errors of their difference, group by group (the
    one-standard-error rule of Breiman et al. 1984, paired, and wider because the best of many is the luckiest).

    Args:
        squares: (G,) squared errors by group of each lens; None where there is no answer.

    Raises:
        DegenerateError: no lens has one.
    """
    known = {i: one for i, one in enumerate(squares) if one is not None}
    if not known:
        raise DegenerateError("no lens can be calibrated: check labels and target dimensions")
    totals = {i: float(one.sum()) for i, one in known.items()}
    best = min(totals, key=totals.__getitem__)
    order = sorted(totals, key=lambda i: (labels[i] != PAPER, coefficients[i], totals[i]))
    return best, next(i for i in order if standard_errors(known[i], known[best]) <= _AS_GOOD)


def standard_errors(squares: Array, others: Array) -> float:
    """By how many standard errors of the difference squared errors by group exceed others; 0 of the same."""
    more = squares - others
    error = float(np.sqrt(len(more)) * np.std(more, ddof=1)) if len(more) > 1 else np.inf
    return float(more.sum()) / error if error > 0.0 else 0.0


def _worse(one: _Tried, other: _Tried) -> float:
    """By how many standard errors it predicts worse; infinite where it does not at all."""
    if one.squares is None or other.squares is None:
        return np.inf
    return standard_errors(one.squares, other.squares)


def _choice(tried: Sequence[_Tried], chosen: _Tried, share: float) -> LensChoice:
    def as_told(one: _Tried) -> TriedLens:
        label, count = label_of(one.options), coefficients_of(one.options)
        if one.squares is None:
            return TriedLens(label, count, failed=one.failed)
        return TriedLens(label, count, one.rms_px, _worse(one, chosen))

    order = sorted(tried, key=lambda one: (one is not chosen, one.rms_px if one.squares is not None else np.inf))
    groups = 0 if chosen.squares is None else len(chosen.squares)
    return LensChoice(label_of(chosen.options), tuple(as_told(one) for one in order), groups, share)
