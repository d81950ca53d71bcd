"""Competing explanations: the same observations without a line that may not belong, as a whole.

A line that lies aside as a whole outvotes the others: the fit goes half of the way towards it, no row of it is an
outlier, and good rows elsewhere become some. So it is asked of each curve in each frame, of each feature over all
frames, of each frame and of each placement, whether the rest is better explained without it. The linear model at the
end of all rounds names a few suspects (see `offsets`), a solve without each of them tells what the rest says of it, and
the more probable explanation wins.

What is said of a group that may not belong: how far it lies aside, how surely, and what else may be.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ceres_cal.base.arrays import Indices, Mask, medians_known
from ceres_cal.base.errors import CalibrationError, attempt, or_none
from ceres_cal.base.frozen import Frozen, replace
from ceres_cal.base.words import two_digits
from ceres_cal.effects.columns import least_absolute
from ceres_cal.effects.evidence import Offsets, measure_offsets
from ceres_cal.effects.linearised import make_linear_model
from ceres_cal.observations import Observations
from ceres_cal.problem.bundle import with_placements_at_best
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.residuals import residuals, write_equations
from ceres_cal.robust.conflicts import without_suspicious
from ceres_cal.robust.groups import (
    FEWEST,
    FeatureGroups,
    ObservationGroups,
    Subproblem,
    ViewGroups,
    compared_part,
    excess,
    groups_compared,
    groups_of,
    mostly_rejected,
    rows_compared,
)
from ceres_cal.robust.robust import RobustSolution
from ceres_cal.robust.usable import require_fits

# Log odds between which both explanations are named: 19 to 1.
DOUBTFUL = 3.0


class Explanation(Frozen):
    """That a group of observations does not belong.

    Attributes:
        name: of the group. rows: (N + M,) its observations, points by row and then curves by row. aside_px: how far it
            lies aside, the median. log_odds: natural logarithm of the odds that it does not belong.
        remedy: what to look at. instead: what the next best explanation says. other: the estimate of the less
            probable one of the two.
    """

    name: str
    rows: Mask
    aside_px: float
    log_odds: float
    remedy: str
    instead: str
    other: Estimate

    @property
    def doubt(self) -> float:
        """Probability of the less probable explanation."""
        return float(1.0 / (1.0 + np.exp(abs(self.log_odds))))

    @property
    def is_doubtful(self) -> bool:
        """Whether both explanations are to be named."""
        return abs(self.log_odds) < DOUBTFUL

    @property
    def is_taken(self) -> bool:
        """Whether it is the more probable one, and its observations are taken out."""
        return self.log_odds > 0.0

    @property
    def words(self) -> str:
        """What it says."""
        return f"the whole of {self.name}: {np.count_nonzero(self.rows)} rows, {two_digits(self.aside_px)} px off"

    @property
    def warning(self) -> str:
        """What to know before the calibration is used."""
        if not self.is_doubtful:
            return f"{self.words}: taken out together; {self.remedy}"
        where = f"{self.name} may be {two_digits(self.aside_px)} px off its nominal position"
        sure = f"probability {100.0 * (1.0 - self.doubt if self.is_taken else self.doubt):.0f} %"
        how = "taken out together" if self.is_taken else "used"
        return (
            f"{where} ({sure}; {np.count_nonzero(self.rows)} rows, {how}). The stated uncertainties include this. "
            "Look at it in the picture, or observe more"
        )


# Standard deviations by which a view's mean square must stand out, beyond the largest of so many by noise, for views to
# be looked at: boards whose drawing is 3 % too short in one of ten do by 2 to 4, 10 % by 17.
_STANDS_OUT = 2.5


Solver = Callable[[Problem, Subproblem], RobustSolution]
"""Solves a problem of some of the observations that are compared_part, from a start that the others had no part in."""


def compete(
    problem: Problem, observations: Observations, end: RobustSolution, solver: Solver
) -> tuple[RobustSolution, tuple[Explanation, ...]]:
    """The end of all rounds without the groups that do not belong, and these; also those that are in doubt.

    Args:
        problem: of all the observations. end: of its rounds.
    """
    every = Subproblem(problem, observations, end, list(groups_of(observations, problem.sights)))
    if not every.kinds:
        return end, ()
    part = compared_part(every)
    some = _freed(part, solver)
    trials, explanations = _Competition(some, solver).decided(), list[Explanation]()
    taking_part = np.ones(len(observations.points) + len(observations.curves), dtype=bool)
    for trial in trials:
        groups = every.kinds[some.kinds.index(trial.suspects[0])]
        own = [groups.among(np.array([number])) & taking_part for number in trial.suspects[1]]
        found = trial.explanations if some is part else [_as_stated(one, part, solver) for one in trial.explanations]
        explanations += [replace(one, rows=rows) for one, rows in zip(found, own, strict=True)]
        if trial.log_odds >= 0.0:
            taking_part &= ~np.any(own, axis=0)
            end = trial.end
    if not taking_part.all():
        end = end if some is every else solver(every.without(~taking_part), every)
        end = replace(end, residuals=residuals(observations, problem.sights, end.solution.estimate))
    return end, tuple(explanations)


def _freed(every: Subproblem, solver: Solver) -> Subproblem:
    """Without the statements that look wrong: a line is not blamed for what they bend."""
    freed = without_suspicious(every.problem, every.observations, every.end)
    if freed is every.problem:
        return every
    # quiet: they are competed with as stated; what contradicts them is tested afterwards
    end = attempt(lambda: solver(freed, every))
    if isinstance(end, CalibrationError) or end.solution.failed:
        return every
    return replace(every, problem=freed, end=end)


def _as_stated(one: Explanation, part: Subproblem, solver: Solver) -> Explanation:
    """With the other estimate under all that is stated: what moves without that is no doubt about a group."""
    if not one.is_doubtful:
        return one
    # quiet: without that solve the doubt stays as large as it was
    other = part.end if one.is_taken else attempt(lambda: solver(part.without(one.rows), part))
    if isinstance(other, CalibrationError) or other.solution.failed:
        return one
    return replace(one, other=other.solution.estimate)


_Suspects = tuple[ObservationGroups, tuple[int, ...]]
"""Groups of one kind, by their numbers."""


class _Trial(Frozen):
    """What a solve without the suspects says of them.

    Attributes:
        end: of that solve. rows: (N + M,) theirs. log_odds: the least of theirs. explanations: of each.
        next: the group that does not belong either, where one is suspected.
    """

    suspects: _Suspects
    end: RobustSolution
    rows: Mask
    log_odds: float
    explanations: tuple[Explanation, ...]
    next: int | None


def _best(trials: Sequence[_Trial]) -> _Trial | None:
    """The most probable one, or the largest that is sure and takes all of that along."""
    if not trials:
        return None
    best = max(trials, key=lambda trial: trial.log_odds)
    wider = [one for one in trials if one.log_odds > DOUBTFUL and not np.any(best.rows & ~one.rows)]
    return max(wider, key=lambda one: int(np.count_nonzero(one.rows)), default=best)


class _Competition:
    """What is asked of all suspects. taking_part: (N + M,) the observations that none of them took along."""

    def __init__(self, some: Subproblem, solver: Solver) -> None:
        self._some, self._solver = some, solver
        self._tried: set[tuple[int, ...]] = set()
        self._taking_part = np.ones(len(some.observations.points) + len(some.observations.curves), dtype=bool)

    def decided(self) -> list[_Trial]:
        """The trials of groups that do not belong, one after the other; the last one may be in doubt."""
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
        """What solves without the suspects say; also without one more, where a second one may hide the first."""
        for groups, numbers in self.suspects(end):
            trial = self.tried(end, (groups, numbers))
            if trial is not None and trial.log_odds < DOUBTFUL and trial.next is not None:
                pair = self.tried(end, (groups, (*numbers, trial.next)))
                trial = trial if pair is None or pair.log_odds < trial.log_odds else pair
            if trial is not None:
                yield trial

    # ---- who is looked at -------------------------------------------------------------------------------------------

    def suspects(self, end: RobustSolution) -> Iterator[_Suspects]:
        """Groups without which the rest may be better explained."""
        for groups in self._some.kinds:
            for numbers in (*self._mostly_rejected(end, groups), *self._by_offsets(end, groups)):
                rows = tuple(np.flatnonzero(groups.among(np.array(numbers))).tolist())
                if rows not in self._tried:
                    self._tried.add(rows)
                    yield groups, numbers

    def _mostly_rejected(self, end: RobustSolution, groups: ObservationGroups) -> Iterator[tuple[int, ...]]:
        """The one with most outliers, where most of its observations are."""
        rejected = mostly_rejected(groups, end, self._taking_part)
        if np.any(rejected):
            yield (int(np.argmax(rejected)),)

    def _by_offsets(self, end: RobustSolution, groups: ObservationGroups) -> Iterator[tuple[int, ...]]:
        """Those that the offsets speak against: single ones, and the pair of most evidence."""
        # Log Bayes factor, by the linear model, from which on a group is looked at by a solve without it: one in thirty
        # sound scenes is above -4.4, errors that agree along lines over 2 m reach 1.6, a line 1.2 px aside is above
        # -4.7.
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

    # ---- what is said of them ---------------------------------------------------------------------------------------

    def tried(self, end: RobustSolution, suspects: _Suspects) -> _Trial | None:
        """What a solve without the suspects says of them; None where there is none, or they lie here and there."""
        groups, numbers = suspects
        without = self._without(groups, numbers)
        if without is None:
            return None
        there = residuals(self._some.observations, self._some.problem.sights, without.solution.estimate)
        chosen, offsets = self._offsets(replace(without, residuals=there), groups, numbers)
        if offsets is None:
            return None
        lengths, explanations = np.concatenate(there.lengths), []
        for number in numbers:
            odds, rival = _odds(offsets, chosen, number, numbers)
            own = groups.among(np.array([number])) & self._taking_part
            other = (end if odds > 0.0 else without).solution.estimate
            instead = "it belongs"
            if rival is not None and abs(odds) < DOUBTFUL:
                instead = f"the whole of {groups.name(rival)} does not belong"
                rivals = self._without(groups, tuple(rival if one == number else one for one in numbers))
                other = other if rivals is None or odds < 0.0 else rivals.solution.estimate
            aside_px = float(medians_known(lengths[own]))
            explanations.append(Explanation(groups.name(number), own, aside_px, odds, groups.remedy, instead, other))
        rows = groups.among(np.array(numbers)) & self._taking_part
        least = min(one.log_odds for one in explanations)
        return _Trial(suspects, without, rows, least, tuple(explanations), _next(offsets, chosen, numbers))

    @or_none  # quiet: what determines nothing without the suspects is no explanation
    def _without(self, groups: ObservationGroups, numbers: tuple[int, ...]) -> RobustSolution | None:
        """The end of a solve without some groups; None where the others determine nothing."""
        gone = groups.among(np.array(numbers))
        end = self._solver(self._some.without(gone | ~self._taking_part), self._some)
        every = self._some.problem
        there = residuals(self._some.observations, every.sights, end.solution.estimate)
        require_fits(replace(end, residuals=there), every)
        if isinstance(groups, FeatureGroups):
            return end
        alone = self._some.of_rows(gone).weighted(replace(end.problem.weighting, loss="cauchy"))
        estimate = with_placements_at_best(alone, end.solution.estimate)
        return replace(end, solution=replace(end.solution, estimate=estimate))

    def _offsets(
        self, end: RobustSolution, groups: ObservationGroups, back: tuple[int, ...]
    ) -> tuple[Indices, Offsets | None]:
        """Which groups are looked at, and what is said of their offsets, with all rows of some that were left out.

        None where some of these lie here and there: they are no group.
        """
        recalled = groups.among(np.array(back, dtype=np.int64)) & self._taking_part
        observations, problem = self._some.observations, self._some.problem
        rows = rows_compared(groups, end, self._taking_part, recalled)
        sights = self._some.of_rows(rows).sights
        if not len(sights):
            return np.empty(0, dtype=np.int64), None
        equations = write_equations(observations, sights, end.solution.estimate, end.residuals)
        weights = end.weights_of(observations, equations)
        here = recalled[equations.observation]
        weights = replace(weights, used=weights.used | here, robust=np.where(here, 1.0, weights.robust))
        model = make_linear_model(problem, end.solution.estimate, equations, weights)
        chosen, share = groups_compared(groups, end, rows & (end.inliers.rows | recalled), back)
        effect = groups.columns(equations, chosen)
        agreeing = model.used.copy()
        for number in back:
            own = np.flatnonzero(effect.group == np.searchsorted(chosen, number))
            left = (equations.residual * model.weight)[own]
            left = left + effect.columns[own] @ least_absolute(effect.columns[own], left)
            agree = np.abs(left) <= problem.options.reject_sigma
            if number not in chosen or 2 * np.count_nonzero(agree) < max(len(own), 2 * FEWEST):
                return chosen, None
            agreeing[own] = agree
        if back:
            model = make_linear_model(problem, end.solution.estimate, equations, replace(weights, used=agreeing))
        if len(chosen) < 2:
            return chosen, None
        prior = groups.prior  # that it is one of those that are compared
        return chosen, measure_offsets(model, effect, replace(prior, absent=1.0 - share * (1.0 - prior.absent)))


def _odds(offsets: Offsets, chosen: Indices, number: int, wrong: tuple[int, ...]) -> tuple[float, int | None]:
    """Log odds that one of the wrong groups does not belong, against that it does, or another one in its place: then
    which.
    """
    at = {int(one): place for place, one in enumerate(chosen)}
    others = [at[one] for one in wrong if one != number]
    each = offsets.log_evidence_with_each(others)
    evidence, none = float(each[at[number]]), offsets.log_evidence(others)
    each[at[number]] = -np.inf
    rival = int(np.argmax(each))
    return evidence - max(none, float(each[rival])), int(chosen[rival]) if each[rival] > none else None


def _next(offsets: Offsets, chosen: Indices, wrong: tuple[int, ...]) -> int | None:
    """The group that does not belong, either, when these do not; None where there is none."""
    at = [int(np.flatnonzero(chosen == number)[0]) for number in wrong]
    each = offsets.log_evidence_with_each(at)
    best = int(np.argmax(each))
    return int(chosen[best]) if each[best] > offsets.log_evidence(at) else None
