"""Compare explanations: the same observations with and without a group, such as a line, that may be wrong as a whole.

A line that is misplaced as a whole is not found row by row: the fit moves half of the way towards it, none of its rows
is an outlier, and good rows elsewhere become outliers. So for each curve in each frame, each feature over all frames,
each frame and each placement, the question is whether the rest is better explained without it. The linear model at the
end of all rounds names a few suspects (`Offsets`), a solve without each of them shows what the rest predicts for
it, and the more probable explanation is taken.

A few rows of a few views decide whether a group is wrong: views that stand out, and others taken evenly. So of very
many observations a subset is compared, with all rows of the views that stand out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, distinct, median, medians_known, or_none, replace
from ceres_cal.effects import aside, least_absolute, make_linear_model
from ceres_cal.effects.aside import DOUBTFUL, Explanation, FeatureGroups, ObservationGroups, Offsets, ViewGroups
from ceres_cal.observations.sights import column_of, shown_rows, some_views, thinned_by_key
from ceres_cal.problem import Problem, with_placements_at_best
from ceres_cal.problem.residuals import residuals, write_equations
from ceres_cal.robust.robust import RobustSolution
from ceres_cal.robust.usable import require_fits

# Standard deviations by which a view's mean square residual must exceed the largest that is expected of so many views
# by noise; else no view is suspected. It is 2 to 4 for boards of which one in ten is drawn 3 % too short, 17 for 10 %.
_STANDS_OUT = 2.5


FEWEST = 3  # observations of a group: two numbers describe the offset of a line, and one equation is left over

# Share of inliers in a group below which it is suspected in any case: the rows that are left agree only by chance.
_LEFT = 0.5
# Approximate number of observations in the subset, and least number of views. The free numbers are projected out of the
# few rows that are compared, so a solve only has to end in the right valley.
_MOST_ASKED, _FEWEST_ASKED = 200_000, 200


class Subproblem(Frozen):
    """The subset of observations that is compared, with its problem and the end of its rounds.

    Attributes:
        kinds: the kinds of groups, numbered as among all observations.
    """

    problem: Problem
    end: RobustSolution
    kinds: Sequence[ObservationGroups]

    def of_rows(self, rows: Mask) -> Problem:
        """The problem of the observations given by a mask (n + m,)."""
        points = len(self.problem.observations.points)
        return self.problem.used(rows[:points], rows[points:])

    def without(self, rows: Mask) -> Problem:
        """The problem of the other observations. Placements that they do not show are not free."""
        others = self.of_rows(~rows)
        return replace(others, layout=others.layout.of(others.sights.keys))


Solver = Callable[[Problem, Subproblem], RobustSolution]
"""A function that solves a problem of some observations of a subset, from an estimate that the others did not affect.
"""


def compete(problem: Problem, end: RobustSolution, solver: Solver) -> tuple[RobustSolution, tuple[Explanation, ...]]:
    """The end of all rounds without the groups that are wrong, and the explanations of these and of doubtful groups.

    Args:
        problem: of all the observations. end: the end of its rounds.
    """
    every = Subproblem(problem, end, list(aside.groups_of(problem.sights)))
    if not every.kinds:
        return end, ()
    some = compared_part(every)
    trials, explanations = _Competition(some, solver).decided(), list[Explanation]()
    taking_part = np.ones(problem.observations.rows, dtype=bool)
    for trial in trials:
        groups = every.kinds[some.kinds.index(trial.suspects[0])]
        own = [groups.among([number]) & taking_part for number in trial.suspects[1]]
        explanations += [replace(one, rows=rows) for one, rows in zip(trial.explanations, own, strict=True)]
        if trial.log_odds >= 0.0:
            taking_part &= ~np.any(own, axis=0)
            end = trial.end
    if not taking_part.all():
        end = end if some is every else solver(every.without(~taking_part), every)
        end = replace(end, residuals=residuals(problem.sights, end.estimate))
    return end, tuple(explanations)


_Suspects = tuple[ObservationGroups, tuple[int, ...]]
"""Groups of one kind, and the numbers of those that are suspected."""


class _Trial(Frozen):
    """The result of a solve without the suspects.

    Attributes:
        end: the end of that solve. rows: (N + M,) those of the suspects. log_odds: the least log odds that one
            of them is wrong.
        explanations: one for each suspect. next: the group that is suspected next, if any.
    """

    suspects: _Suspects
    end: RobustSolution
    rows: Mask
    log_odds: float
    explanations: tuple[Explanation, ...]
    next: int | None


def _best(trials: Sequence[_Trial]) -> _Trial | None:
    """The most probable trial, or the largest one that is certain and includes all rows of the most probable."""
    if not trials:
        return None
    best = max(trials, key=lambda trial: trial.log_odds)
    wider = [one for one in trials if one.log_odds > DOUBTFUL and not np.any(best.rows & ~one.rows)]
    return max(wider, key=lambda one: int(np.count_nonzero(one.rows)), default=best)


class _Competition:
    """The comparison of all suspects. `_taking_part`: (N + M,) the observations that no decided trial left out."""

    def __init__(self, some: Subproblem, solver: Solver) -> None:
        self._some, self._solver = some, solver
        self._tried: set[tuple[int, ...]] = set()
        self._taking_part = np.ones(some.problem.observations.rows, dtype=bool)

    def decided(self) -> list[_Trial]:
        """The trials of wrong groups, one after the other. The last one may be doubtful."""
        most_wrong = 4  # groups
        end, decided = self._some.end, list[_Trial]()
        while sum(len(one.explanations) for one in decided) < most_wrong:
            best = _best(list(self.trials(end)))
            if best is None or best.log_odds < -DOUBTFUL:
                break
            decided.append(best)
            if best.log_odds < 0.0:
                break
            end, self._taking_part = best.end, self._taking_part & ~best.rows
        return decided

    def trials(self, end: RobustSolution) -> Iterator[_Trial]:
        """The results of solves without each suspect. Where a second group may hide the first, both are left out."""
        for groups, numbers in self.suspects(end):
            trial = self.tried(end, (groups, numbers))
            if trial is not None and trial.log_odds < DOUBTFUL and trial.next is not None:
                pair = self.tried(end, (groups, (*numbers, trial.next)))
                trial = trial if pair is None or pair.log_odds < trial.log_odds else pair
            if trial is not None:
                yield trial

    # ---- suspects ---------------------------------------------------------------------------------------------------

    def suspects(self, end: RobustSolution) -> Iterator[_Suspects]:
        """Groups without which the rest may be better explained."""
        for groups in self._some.kinds:
            rejected = mostly_rejected(groups, end, self._taking_part, 1)
            for numbers in (*((one,) for one in rejected), *self._by_offsets(end, groups)):
                rows = tuple(np.flatnonzero(groups.among(numbers)).tolist())
                if rows not in self._tried:
                    self._tried.add(rows)
                    yield groups, numbers

    def _by_offsets(self, end: RobustSolution, groups: ObservationGroups) -> Iterator[tuple[int, ...]]:
        """Groups whose offsets the linear model finds suspicious: single ones, and the pair with the most evidence."""
        # Log Bayes factor of the linear model above which a solve without the group is made. One in thirty sound scenes
        # is above -4.4; errors that are correlated along lines over 2 m reach 1.6; a line 1.2 px off is above -4.7.
        suspect = -4.4
        if isinstance(groups, ViewGroups):
            above = excess(groups, end, self._taking_part)
            if np.max(above) < _STANDS_OUT + np.sqrt(2.0 * np.log(max(int(np.count_nonzero(above)), 1))):
                return
        chosen, offsets = self._offsets(end, groups, ())
        if offsets is None:
            return
        none, each = offsets.log_evidence(), offsets.log_evidence_with_each()
        first = int(np.argmax(each))
        for number in np.argsort(-each)[:2]:
            if each[number] - none > suspect + np.log(1.0 - offsets.prior.absent):
                yield (int(chosen[number]),)
        both = offsets.log_evidence_with_each((first,))
        second = int(np.argmax(both))
        if both[second] > max(none, each[first]):
            yield int(chosen[first]), int(chosen[second])

    # ---- trials -----------------------------------------------------------------------------------------------------

    def tried(self, end: RobustSolution, suspects: _Suspects) -> _Trial | None:
        """The result of a solve without the suspects; None if it fails, or if their rows do not agree on an offset."""
        groups, numbers = suspects
        without = self._without(groups, numbers)
        if without is None:
            return None
        there = residuals(self._some.problem.sights, without.estimate)
        chosen, offsets = self._offsets(replace(without, residuals=there), groups, numbers)
        if offsets is None:
            return None
        lengths, explanations, places = np.concatenate(there.lengths), [], np.searchsorted(chosen, numbers).tolist()
        for number, place in zip(numbers, places, strict=True):
            odds, rival = offsets.odds(place, places)
            own = groups.among([number]) & self._taking_part
            other = (end if odds > 0.0 else without).estimate
            if rival is not None and abs(odds) < DOUBTFUL:
                in_its_place = tuple(int(chosen[rival]) if one == number else one for one in numbers)
                rivals = self._without(groups, in_its_place)
                other = other if rivals is None or odds < 0.0 else rivals.estimate
            aside_px = float(medians_known(lengths[own]))
            explanations.append(Explanation(groups.name(number), own, aside_px, odds, groups.remedy, other))
        rows, least = groups.among(numbers) & self._taking_part, min(one.log_odds for one in explanations)
        further = offsets.next(places)
        further = None if further is None else int(chosen[further])
        return _Trial(suspects, without, rows, least, tuple(explanations), further)

    @or_none  # quiet: without the suspects the others determine nothing, so it is no explanation
    def _without(self, groups: ObservationGroups, numbers: tuple[int, ...]) -> RobustSolution | None:
        """The end of a solve without some groups; None where the others do not determine everything."""
        gone = groups.among(numbers)
        end = self._solver(self._some.without(gone | ~self._taking_part), self._some)
        every = self._some.problem
        there = residuals(every.sights, end.estimate)
        require_fits(replace(end, residuals=there), every)
        if isinstance(groups, FeatureGroups):
            return end
        alone = self._some.of_rows(gone).weighted(replace(end.problem.weighting, loss="cauchy"))
        estimate = with_placements_at_best(alone, end.estimate)
        return replace(end, solution=replace(end.solution, estimate=estimate))

    def _offsets(
        self, end: RobustSolution, groups: ObservationGroups, back: tuple[int, ...]
    ) -> tuple[Indices, Offsets | None]:
        """The numbers of the groups that are compared, and their measured offsets, including the rows of the groups
        `back`, which were left out of the solve.

        The offsets are None where the rows of a group in `back` do not agree: it is then no group.
        """
        recalled = groups.among(back) & self._taking_part
        rows = rows_compared(groups, end, self._taking_part, recalled)
        sights = self._some.of_rows(rows).sights
        if not len(sights):
            return np.empty(0, dtype=np.int64), None
        equations = write_equations(sights, end.estimate, end.residuals)
        weights = end.weights_of(equations)
        here = recalled[equations.observation]
        used = weights.used | here
        chosen, share = groups_compared(groups, end, rows & (end.inliers.rows | recalled), back)
        effect = groups.columns(equations, chosen)
        for number in back:
            own = np.flatnonzero(effect.group == np.searchsorted(chosen, number))
            left = (equations.residual * weights.inverse_sigma)[own]
            left = left + effect.columns[own] @ least_absolute(effect.columns[own], left)
            agree = np.abs(left) <= self._some.problem.options.reject_sigma
            if number not in chosen or 2 * np.count_nonzero(agree) < max(len(own), 2 * FEWEST):
                return chosen, None
            used[own] = agree
        if len(chosen) < 2:
            return chosen, None
        weights = replace(weights, used=used, robust=np.where(here, 1.0, weights.robust))
        model = make_linear_model(self._some.problem, end.estimate, equations, weights)
        prior = groups.prior  # that a group is wrong: reduced to that of the groups that are compared
        return chosen, aside.measure_offsets(model, effect, replace(prior, absent=1.0 - share * (1.0 - prior.absent)))


# ---- the subset -----------------------------------------------------------------------------------------------------


def compared_part(every: Subproblem) -> Subproblem:
    """All observations, or of very many a subset: views that stand out, and others evenly."""
    most_rejected = 4  # mostly rejected groups of each kind whose views are included
    sights, observations = every.problem.sights, every.problem.observations
    if len(sights.point_rows) + len(sights.curve_rows) <= _MOST_ASKED:
        return every
    there, view = shown_rows(sights), column_of(observations, "view")
    chosen = np.zeros(len(observations.views), dtype=bool)
    chosen[some_views(np.bincount(view[there], minlength=len(chosen)), _MOST_ASKED, _FEWEST_ASKED)] = True
    for groups in every.kinds:
        worst = mostly_rejected(groups, every.end, there, most_rejected)
        chosen |= views_compared(groups, every.end, there, groups.among(worst) & there)
    there &= chosen[view]
    rows = np.flatnonzero(there)[:: max(1, int(np.count_nonzero(there)) // (2 * _MOST_ASKED))]
    return _part(every, rows, int(np.searchsorted(rows, len(observations.points))))


def _part(every: Subproblem, rows: Indices, split: int) -> Subproblem:
    """The subproblem of some rows (n + m,), the first `split` of them points, as if there were no others."""
    p, c = rows[:split], rows[split:] - len(every.problem.observations.points)
    problem, there = every.problem.of_rows(p, c), every.end.residuals.of_rows(p, c)
    inliers, weighting = every.end.inliers.of_rows(p, c), every.end.problem.weighting
    used = replace(problem.used(inliers.points, inliers.curves), weighting=weighting, feet=there.feet)
    end = replace(every.end, problem=used, inliers=inliers, residuals=there)
    kinds = [replace(groups, observations=problem.observations, of=groups.of[rows]) for groups in every.kinds]
    return Subproblem(problem, end, kinds)


# ---- what is compared ----------------------------------------------------------------------------------------------


def rows_compared(groups: ObservationGroups, end: RobustSolution, taking_part: Mask, recalled: Mask) -> Mask:
    """(N + M,) mask of the rows that are compared: in some views, some rows of each group.

    Args:
        taking_part: (N + M,) the rows that may be chosen. recalled: (N + M,) rows that are compared even if rejected.
    """
    most_rows = 40  # rows of a group in one view
    inside, view = taking_part & (end.inliers.rows | recalled), column_of(groups.observations, "view")
    rows = np.flatnonzero(inside & views_compared(groups, end, inside, recalled)[view])
    inside[:] = False
    key = groups.of[rows].astype(np.int64) * len(groups.frames) + view[rows]
    inside[thinned_by_key(rows, key, groups.of[rows] >= 0, most_rows)] = True
    return inside


def views_compared(groups: ObservationGroups, end: RobustSolution, taking_part: Mask, recalled: Mask) -> Mask:
    """(V,) mask: views with recalled rows, views that stand out, some of the others, and some without any group."""
    most_others = 16  # views without any group, which determine the lens
    view = column_of(groups.observations, "view")
    shows_some = np.bincount(view[taking_part & (groups.of >= 0)], minlength=len(groups.frames))
    largest, most = standing_out(groups, end, taking_part), groups.most_views
    with_some, others = np.flatnonzero(shows_some), np.flatnonzero(shows_some == 0)
    chosen = np.zeros(len(shows_some), dtype=bool)
    chosen[distinct(view[recalled])[:most]] = True
    chosen[with_some[np.argsort(-largest[with_some], kind="stable")][: most // 2]] = True
    chosen[with_some[:: max(1, 2 * len(with_some) // most)]] = True
    chosen[others[:: max(1, len(others) // most_others)]] = True
    return chosen


def groups_compared(
    groups: ObservationGroups, end: RobustSolution, rows: Mask, recalled: Sequence[int]
) -> tuple[Indices, float]:
    """The numbers of groups that have enough of the rows (N + M,), and their share among all such groups.

    Of very many groups: those recalled, those that stand out, and others evenly.
    """
    most_together = 256  # groups, since time grows with their cube: 8 views of a field of 32 lines; 1350 took 25 s
    every = np.flatnonzero(groups.count(rows) >= FEWEST)
    if len(every) <= most_together:
        return every, 1.0
    standing_out = every[np.argsort(-excess(groups, end, rows)[every], kind="stable")]
    some = every[:: -(-2 * len(every) // most_together)]
    back = np.intersect1d(every, np.array(recalled, dtype=np.int64))
    chosen = distinct(np.concatenate([back, standing_out[: most_together // 2], some]))
    return chosen, len(chosen) / len(every)


def mostly_rejected(groups: ObservationGroups, end: RobustSolution, taking_part: Mask, most: int) -> list[int]:
    """The groups with the most outliers among those in which most observations are outliers."""
    counts, used = groups.count(taking_part), groups.count(end.inliers.rows & taking_part)
    gone = np.where((counts > FEWEST) & (used < _LEFT * counts), counts - used, 0)
    return [int(one) for one in np.argsort(-gone, kind="stable")[:most] if gone[one]]


def excess(groups: ObservationGroups, end: RobustSolution, taking_part: Mask) -> Array:
    """(size + 1,) by how many standard deviations the mean square residual of each group exceeds the median one."""
    lengths = end.inliers.sigmas
    points, size = len(groups.observations.points), groups.size + 1
    of = np.where(end.inliers.rows & taking_part & (groups.of >= 0), groups.of, np.int64(groups.size))
    spare = 2.0 * np.bincount(of[:points], minlength=size) + np.bincount(of[points:], minlength=size)
    square = np.bincount(of, lengths**2, minlength=size)
    spare[-1] = square[-1] = 0.0  # the last entry is for rows in no group
    square, there = square / np.maximum(spare, 1.0), spare > 0.0
    middle = median(square[there]) if np.any(there) else 1.0
    return np.asarray((square / max(middle, 1e-12) - 1.0) / np.sqrt(2.0 / np.maximum(spare, 1.0)) * there)


def standing_out(groups: ObservationGroups, end: RobustSolution, taking_part: Mask) -> Array:
    """(V,) the largest excess among the groups that each view shows."""
    largest, rows = np.full(len(groups.frames), -np.inf), np.flatnonzero(groups.of >= 0)
    above, view = excess(groups, end, taking_part), column_of(groups.observations, "view")
    np.maximum.at(largest, view[rows], above[groups.of[rows]])
    return largest
