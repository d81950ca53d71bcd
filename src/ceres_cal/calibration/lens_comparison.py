"""Decide whether another lens explains observations that the chosen one rejects; these then inform the choice, too.

Where lenses predict alike, a few corners at the rim may be all that distinguishes them, and a lens that is wrong there
rejects them as outliers. Each rejected observation has its price by the odds of a mixture of good and bad observations
(Aitkin and Wilson, Technometrics 22, 1980), and so has every coefficient (Schwarz, Annals of Statistics 6, 1978).

`compared_kinds` selects the observations that take part in the comparison of lenses, and solves for each kind of lens
near its minimum over them.

The last resort is a lens without a formula, which takes longer than all others. It is chosen where residuals of the
others are correlated from place to place, by the mean squares of residuals between cells of the image and within them
(analysis of variance). In one view of a floor it is also a component beside a lens with a formula.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from ceres_cal.base import CalibrationError, DegenerateError, Mask, Poses, attempt, or_none, replace
from ceres_cal.calibration.lens_forms import PAPER, Form, kinds, without_formula
from ceres_cal.calibration.lens_seen import (
    MOST_ROUNDS,
    Candidate,
    InlierRows,
    Kind,
    profiles_of,
    require_groups,
    seen_through,
)
from ceres_cal.observations import Observations, Sights, gather_sights, thinned
from ceres_cal.posterior.other_lenses import cells_of
from ceres_cal.problem import EXACT, Estimate, Options, problem_of
from ceres_cal.robust.as_built import AS_DRAWN, Construction, estimate_as_built
from ceres_cal.robust.robust import RobustSolution, solve_robustly
from ceres_cal.start.initialise import initialise

PRICE = 13.0
"""Twice the log-odds of a rejected observation: one of a hundred is bad, and lies anywhere within twenty sigmas."""


def explained_by_another(
    seen: InlierRows,
    tried: Sequence[Candidate],
    chosen: Candidate,
    taken_out: tuple[Mask, Mask],
    scales: tuple[float, float],
    *,
    is_alone: bool = True,
) -> bool:
    """Return whether another lens explains so much of what the chosen one rejects that it is the likelier one.

    Args:
        taken_out: (N,), (M,) observations that the chosen lens rejects. scales: its noise scales. With larger ones
            another lens would seem to explain residuals that the chosen one leaves as well, but knows to be no noise.
        is_alone: whether no other camera influenced the rejection. Otherwise rejected observations that the chosen lens
            explains by itself do not count: they were rejected because of other cameras.
    """
    sights = seen.sights
    out = taken_out[0][sights.point_rows], taken_out[1][sights.curve_rows]
    if not (out[0].any() or out[1].any()):
        return False
    price = float(np.log(sights.equations))
    by_itself = 0 if is_alone else max(0, _explained(seen, chosen, out, scales) or 0)
    for other in tried:
        if other is chosen or other.squares is None:
            continue
        explained = (_explained(seen, other, out, scales) or 0) - by_itself
        if PRICE * explained > price * max(other.form.size - chosen.form.size, 0):
            return True
    return False


@or_none  # quiet: a lens that cannot be solved for explains nothing
def _explained(seen: InlierRows, other: Candidate, out: tuple[Mask, Mask], scales: tuple[float, float]) -> int:
    """Return how many rejected equations a lens explains, minus the number that it would reject instead."""
    # Sigmas up to which an observation is explained: any lens may leave residuals between this and the rejection bound.
    explained = 3.0
    farthest = seen.options.reject_sigma
    points, curves = seen.in_sigmas(seen.solved_near(other).estimate, scales)
    count = 0
    for off, own, equations in ((np.linalg.norm(points, axis=1), out[0], 2), (np.abs(curves), out[1], 1)):
        count += equations * int(np.count_nonzero(own & (off < explained)))
        count -= equations * int(np.count_nonzero(~own & (off > farthest)))
    return count


# Kind of the first solve: it shows any direction, and approximates any lens except for its decentring.
_WIDEST = "kannala-brandt"
# Share of the solved kind's squares: a kind that leaves less than this is solved instead, as its inliers may differ.
_QUIETER = 0.7
_SOUND_PX = 1.0  # noise above which the first solve may be in a wrong valley: all kinds get new starts


def compared_kinds(
    observations: Observations,
    options: Options,
    start: Estimate,
    built: Construction = AS_DRAWN,
    *,
    by_most: bool = False,
) -> tuple[InlierRows, list[Kind], float]:
    """Return the inliers that take part, each kind near its minimum over them, and their share of all observations. The
    noise is that of the kind that explains the most.

    Args:
        built: targets as built; where it is empty they are estimated, too.
        by_most: whether most of the observations take part, up to a number that takes long.

    Raises:
        CalibrationError: too few observations to compare lenses, or no calibration.
    """
    least_rows, most_rows, share, fewest_frames = 1_000, 12_000, 0.025, 24  # limits of how many observations take part
    every, observations = sorted(kinds(), key=lambda forms: forms[0].lens != _WIDEST), observations.originals
    most = most_rows if by_most else max(least_rows, int(share * observations.rows))
    few = thinned(observations, most, fewest_frames)
    sights = built.held(gather_sights(few))
    require_groups(sights)
    names = list(dict.fromkeys(key.placement for key in sights.keys if key.placement is not None))
    start = replace(start, placements=Poses.stacked(names, Poses.of(start.placements).of_names(names)))
    tried = every
    while True:
        end, used = _solved(options, sights, start, tried)
        if options.as_built == "estimate" and not built.every:
            built = estimate_as_built(end.problem, end)
            if built.every:
                sights = built.held(sights)
                end, used = _solved(options, sights, replace(end.estimate, structure=EXACT), [used])
        seen = InlierRows(end, options, sights, built)
        compared = [seen.kind(forms, is_solved=forms is used) for forms in every]
        best = min(compared, key=lambda one: one.least)
        least = next(one.least for one in compared if one.forms is used)
        if len(tried) == 1 or best.least > _QUIETER * least:
            return seen, compared, few.rows / observations.rows
        tried = [best.forms]


_Found = tuple[RobustSolution, tuple[Form, ...]]


def _solved(options: Options, sights: Sights, start: Estimate, kinds: Sequence[tuple[Form, ...]]) -> _Found:
    """Solve robustly with the first of these kinds that explains the observations, or else with the one that leaves the
    least noise. The rounds end where the noise is known well enough.
    """

    def solved(own: Options, from_nothing: bool) -> RobustSolution:
        near = initialise(sights, own).estimate if from_nothing else start
        near = seen_through(near, own, profiles_of(near, sights))
        problem = problem_of(sights, own, near)
        end = solve_robustly(problem, near, most_rounds=MOST_ROUNDS if from_nothing else 1)
        require_groups(end.problem.sights)  # all may be outliers where a wrong height is stated
        return end

    failure: CalibrationError | None = None
    found: list[_Found] = []
    for forms, from_nothing in [(kinds[0], False), *((forms, True) for forms in kinds)]:
        # quiet: the next lens is tried, and the failure raised where none is left
        end = attempt(partial(solved, forms[0].of(options), from_nothing))
        if isinstance(end, CalibrationError):
            failure = end
            continue
        if _noise_px(end) < _SOUND_PX:
            return end, forms
        found.append((end, forms))
    if not found:
        raise failure or DegenerateError("there is no lens")
    return min(found, key=lambda one: _noise_px(one[0]))


def _noise_px(end: RobustSolution) -> float:
    """Noise of a typical observation, px (geometric mean)."""
    sights, inliers = end.problem.sights, end.inliers
    sigmas = inliers.point_scale * sights.sigma_px, inliers.curve_scale * sights.curve_sigma_px
    return float(np.exp(np.mean(np.log(np.concatenate(sigmas)))))


# Ratio of the mean squares between cells and within them above which residuals count as correlated; it is 1.0 +- 0.17
# in white noise. From half to double this value it changes which observations take part, seldom the chosen lens.
_TOGETHER = 1.5


def may_lack_a_formula(seen: InlierRows, chosen: Candidate, *, by_most: bool) -> bool:
    """Return whether a lens without a formula may be chosen: where even the longest lens of the chosen kind leaves
    correlated residuals, or where most of the observations take part. Correlation within views counts, too: in eight
    views of a lens that no formula describes, residuals of different views agreed by less than two sd.
    """
    return by_most or _goes_together(seen, chosen.of)


def last_resort(seen: InlierRows, chosen: Candidate, *, is_asked: bool) -> Iterator[Candidate]:
    """Yield the lenses without a formula where they are asked for. They are also tried, with a start of their own,
    where the paper's lens is not as good in a camera's only view of a floor. There another formula may put the camera
    elsewhere and leave no correlated residuals: with a moustache distortion phi came out as 186 instead of 313 px, and
    places were 10 mm off, 5 sd.

    None are tried where placements are so few that their features are held out one by one: errors that are correlated
    within a placement would be predicted, too.
    """
    is_one_view = min(len(seen.sights.of_camera(name)) for name in seen.sights.cameras) == 1
    if seen.splits_placements or not (is_asked or (is_one_view and chosen.form.label != PAPER)):
        return
    for forms in without_formula(of_one_view=is_one_view):
        yield from seen.solved(forms, None if is_one_view else chosen.of.estimate).candidates(first=True)


def one_power_more(seen: InlierRows, chosen: Candidate) -> Iterator[Candidate]:
    """Yield the longest lens of a kind that has powers, with one more: no data say that its coefficient is 0.

    A moustache distortion takes all four powers of the longest lens; with these, places on a floor were 4 mm off
    between its lines, 3.8 sd.
    """
    form, options = chosen.form, chosen.form.of(seen.options)
    if form is chosen.of.forms[0] and form.blank.trial_powers and not form.blank.roughness:
        longer = replace(options, powers=(*form.powers, form.powers[-1] + 1))
        yield from seen.kind((Form.among(longer),), is_solved=False).candidates(first=True)


def _goes_together(seen: InlierRows, kind: Kind) -> bool:
    """Return whether residuals within a cell are correlated, by the mean square between cells and that within cells of
    more than one residual; x and y of points and each curve have separate cells.
    """
    points, curves = seen.in_sigmas(kind.estimate)
    left = np.concatenate([points[:, 0], points[:, 1], curves])
    cell = cells_of(seen.sights, seen.sights.observations.cameras)
    counts = np.bincount(cell)
    seen_in = counts > 0
    counts = counts[seen_in]
    between = np.bincount(cell, left)[seen_in] ** 2 / counts
    freedom = len(left) - len(counts)  # none where each residual is alone in its cell
    return freedom > 0 and float(between.mean()) * freedom > _TOGETHER * float(left @ left - between.sum())
