"""Whether the chosen lens takes out observations that another one explains: then these tell the lens, too.

Where lenses predict alike, a few corners at the rim may be all that tells them apart, and the lens that is wrong there
calls them outliers. By the odds of a mixture of good and bad observations (Aitkin and Wilson, Technometrics 22, 1980)
what is taken out has its price, and so has every coefficient (Schwarz, Annals of Statistics 6, 1978).

The observations that take part in the comparison of lenses, and each kind of lens near its best over them.

The last resort: a lens without a formula, which takes longer than all others. It is chosen where what these leave
behind goes together from place to place, by the mean squares of residuals between cells of the image and within them
(analysis of variance). In one view of a floor it is also a component beside a formula.
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
"""Twice the log-odds of an observation that is taken out: one of a hundred is bad, somewhere within twenty sigmas."""


def explained_by_another(
    seen: InlierRows,
    tried: Sequence[Candidate],
    chosen: Candidate,
    taken_out: tuple[Mask, Mask],
    scales: tuple[float, float],
    *,
    is_alone: bool = True,
) -> bool:
    """Whether another lens explains so much of what the chosen one takes out that it is the likelier one.

    Args:
        taken_out: (N,), (M,) what the chosen one takes out of all observations. scales: of its noise; by a larger one
            another lens would explain what the chosen one leaves no larger, but knows to be no noise.
        is_alone: else what the chosen one explains by itself was taken out for what other cameras say.
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
    """How many equations of what is taken out a lens explains, less those that would be taken out instead."""
    # Sigmas up to which an observation is explained: between it and what is taken out lies what any lens may leave.
    explained = 3.0
    farthest = seen.options.reject_sigma
    points, curves = seen.in_sigmas(seen.solved_near(other).estimate, scales)
    count = 0
    for off, own, equations in ((np.linalg.norm(points, axis=1), out[0], 2), (np.abs(curves), out[1], 1)):
        count += equations * int(np.count_nonzero(own & (off < explained)))
        count -= equations * int(np.count_nonzero(~own & (off > farthest)))
    return count


# What shows any direction and comes near to any lens but for its decentring: the first solve is with it.
_WIDEST = "kannala-brandt"
# Share of its squares: a kind that leaves less is solved instead, for it may have other inliers.
_QUIETER = 0.7
_SOUND_PX = 1.0  # noise beyond which a first solve may have ended in a wrong valley: others are tried from nothing


def compared_kinds(
    observations: Observations,
    options: Options,
    start: Estimate,
    built: Construction = AS_DRAWN,
    *,
    by_most: bool = False,
) -> tuple[InlierRows, list[Kind], float]:
    """The observations that take part, each kind near its best over them, at the noise of the one that explains the
    most, and their share of all.

    Args:
        built: how targets were found to be built; where nothing is given that is found, too.
        by_most: whether most of the observations take part, up to where that takes long.

    Raises:
        CalibrationError: too little to tell lenses apart, or no calibration.
    """
    least_rows, most_rows, share, fewest_frames = 1_000, 12_000, 0.025, 24  # of the observations, how many take part
    every = sorted(kinds(), key=lambda forms: forms[0].lens != _WIDEST)
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
    """The robust solve with the first of these kinds that explains the observations, or with the one that does it best,
    up to where the noise is known well enough.
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
    """Of a typical observation."""
    sights, inliers = end.problem.sights, end.inliers
    sigmas = inliers.point_scale * sights.sigma_px, inliers.curve_scale * sights.curve_sigma_px
    return float(np.exp(np.mean(np.log(np.concatenate(sigmas)))))


# Between cells over within them, from which on residuals go together: in white noise it is 1.0 by 0.17. From half to
# double it decides which observations are asked, seldom what is chosen.
_TOGETHER = 1.5


def may_lack_a_formula(seen: InlierRows, chosen: Candidate, *, by_most: bool) -> bool:
    """Whether a lens without a formula may be chosen: where even the longest lens of the chosen kind leaves what goes
    together, or most of the observations are asked. Within views, too: eight of a lens that no formula has do not agree
    by two sd.
    """
    return by_most or _goes_together(seen, chosen.of)


def last_resort(seen: InlierRows, chosen: Candidate, *, is_asked: bool) -> Iterator[Candidate]:
    """The lenses without a formula, where they are asked for; and where the paper's lens is not as good in a camera's
    only view, of a floor, from a start of their own. There another formula puts the camera elsewhere, and leaves
    nothing that goes together: of a moustache's phi of 313 px it made 186, and places were 10 mm off, 5 sd.

    Not of so few placements that their features are held out one by one: what goes together within each would be
    predicted, too.
    """
    is_one_view = min(len(seen.sights.of_camera(name)) for name in seen.sights.cameras) == 1
    if seen.splits_placements or not (is_asked or (is_one_view and chosen.form.label != PAPER)):
        return
    for forms in without_formula(of_one_view=is_one_view):
        yield from seen.solved(forms, None if is_one_view else chosen.of.estimate).candidates(first=True)


def one_power_more(seen: InlierRows, chosen: Candidate) -> Iterator[Candidate]:
    """The longest lens of a kind that leaves the choice of its powers, with one more: no data say that it is nothing.

    A moustache takes the four of the longest; what they know of a floor was 4 mm off between its lines, 3.8 sd.
    """
    form, options = chosen.form, chosen.form.of(seen.options)
    if form is chosen.of.forms[0] and form.blank.trial_powers and not form.blank.roughness:
        longer = replace(options, powers=(*form.powers, form.powers[-1] + 1))
        yield from seen.kind((Form.among(longer),), is_solved=False).candidates(first=True)


def _goes_together(seen: InlierRows, kind: Kind) -> bool:
    """Whether residuals of a cell do: by their mean square between cells, and within those of more than one; the x and
    y of points and each curve apart.
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
