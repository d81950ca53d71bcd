"""What was known beforehand against what everything else says: stated numbers, held ones, tolerances, an old posterior.

The linear picture of it (`wald.py`) stands at residuals that a wrong prior has swollen or thrown out as outliers. What
looks suspicious in it is solved again without the prior and judged there, at the noise there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.numerical import numerical
from ceres_cal.model.information import Information
from ceres_cal.model.keys import Key
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.priors import GaussianPrior
from ceres_cal.observations import Observations
from ceres_cal.solve.bundle import solve
from ceres_cal.solve.information import ReducedInformation, information
from ceres_cal.solve.problem import Problem
from ceres_cal.solve.robust import RobustSolution, solve_robustly
from ceres_cal.solve.stated import LEVEL, Conflict, Statement, Test, contradicted, contradicting, grouped, statements
from ceres_cal.solve.wald import LARGEST_FREEDOM, Rest, linear_rest, log_probability, rest_at, worst_test

# Probability of a linear picture from which on it is worth another solve: 2.5 sigma.
_SUSPICIOUS = 0.0124
_MOST = 4  # solves
_RIVAL = 0.6  # of the largest squared distance: a statement as far off may be the wrong one instead


@dataclass(frozen=True, eq=False)
class Conflicts:
    """What contradicts what, and how the numbers move with each of it.

    Attributes:
        every: the conflicts. shifts: (K,) each, of the keys (K) of what is shared: by how much everything moves when a
            statement in conflict is left out.
    """

    every: tuple[Conflict, ...] = ()
    keys: tuple[Key, ...] = ()
    shifts: tuple[Array, ...] = ()


@numerical("the test of what was stated")
def find_conflicts(
    problem: Problem, observations: Observations, end: RobustSolution, usual: tuple[float, float] | None = None
) -> Conflicts:
    """Everything stated that the rest contradicts, the worst first, each with those before it left out.

    Args:
        problem: of all the observations. end: its solution. usual: noise scales that were seen before.
    """
    every = tuple(statements(problem, observations, end.solution.estimate))
    if not every:
        return Conflicts()
    reduced = end.reduced or information(end.problem, end.solution.estimate)
    search = _Search(problem, end, observations, usual, every)
    while search.solves < _MOST and search.leave_out_the_worst():
        pass
    pairs = list(contradicting(every))
    shifts = [*(_along(reduced, key, one.seen - one.stated) for key, one in pairs), *search.shifts]
    return Conflicts((*(one for _, one in pairs), *search.conflicts()), reduced.shared.keys, tuple(shifts))


def without_suspicious(problem: Problem, observations: Observations, end: RobustSolution) -> Problem:
    """The problem without what is stated of cameras and looks wrong where it was solved: it may bend what is said of
    others. Tolerances stay: a line that its own one does not hold is a line aside.
    """
    estimate = end.solution.estimate
    for one in statements(problem, observations, estimate):
        if one.kind in ("earlier", "tolerance"):
            continue
        if worst_test(one, linear_rest(one, end, observations)).log_p < np.log(_SUSPICIOUS):
            problem = one.left_out(problem, estimate)
    return problem


def contradicted_by(
    priors: Sequence[GaussianPrior], estimate: Estimate, posterior: Information, degrees_of_freedom: float
) -> str | None:
    """The prior that a solution without any of them contradicts most, in words; None where it contradicts none."""
    known = set(posterior.keys)
    groups = [one for one in grouped([prior.given(known) for prior in priors]) if one.kind == "prior" and one.keys]
    freedom = min(degrees_of_freedom, LARGEST_FREEDOM)
    rests = [Rest(estimate, np.zeros(len(one.keys)), posterior.marginal(one.keys), freedom) for one in groups]
    tests = [worst_test(one, rest) for one, rest in zip(groups, rests, strict=True)]
    number = min(range(len(tests)), key=lambda i: tests[i].log_p, default=-1)
    if number < 0 or tests[number].log_p > np.log(LEVEL):
        return None
    return contradicted(groups[number], tests[number], True, ()).words


def _along(reduced: ReducedInformation, key: Key, offset: float) -> Array:
    """(K,) how everything free moves with one number that moves by so much."""
    if key not in reduced.shared.keys:
        return np.zeros(len(reduced.shared.keys))
    covariance = reduced.shared.inverse
    column = reduced.shared.columns([key])[0]
    return np.asarray(covariance[:, column] / covariance[column, column] * offset)


@dataclass(eq=False)
class _Search:
    """Forward selection: the worst statement is left out, then the worst of the others.

    Attributes:
        problem, end: without what was left out. left: statements that are not judged yet.
        out: those in conflict, their tests, and names of others that may be wrong in their place.
        shifts: see `Conflicts`.
    """

    problem: Problem
    end: RobustSolution
    observations: Observations
    usual: tuple[float, float] | None
    every: tuple[Statement, ...]

    def __post_init__(self) -> None:
        self.left, self.solves = list(self.every), 0
        self.out: list[tuple[Statement, Test, Sequence[str]]] = []
        self.shifts: list[Array] = []
        self._level = float(np.log(LEVEL / len(self.every)))
        self._first = self.end.reduced or information(self.end.problem, self.end.solution.estimate)

    def leave_out_the_worst(self) -> bool:
        """Judge the most suspicious statement; False where none is."""
        tests = [worst_test(one, linear_rest(one, self.end, self.observations)) for one in self.left]
        number = min(range(len(tests)), key=lambda i: tests[i].log_p, default=-1)
        if number < 0 or tests[number].log_p > np.log(_SUSPICIOUS):
            return False
        suspect, test = self.left.pop(number), tests.pop(number)
        rivals = [
            (one, other)
            for one, other in zip(self.left, tests, strict=True)
            if one.kind != "usual" and other.squared > _RIVAL * test.squared
        ]
        freed = suspect.left_out(self.problem, self.end.solution.estimate)
        after = None if suspect.kind == "earlier" else self._solved(freed)
        self.solves += 1
        test = test if after is None else self._confirmed(suspect, after)
        if test.log_p > self._level:
            return True
        self.out.append((suspect, test, [one.name for one, _ in rivals]))
        self.shifts += [_along(self._first, t.key, t.seen[0] - t.stated[0]) for _, t in rivals]
        if after is not None:
            start = GaussianPrior.about(Information.nothing(self._first.shared.keys), self.end.solution.estimate)
            self.shifts.append(start.offsets(after.solution.estimate))
            self.problem, self.end = freed, after
        return True

    def conflicts(self) -> list[Conflict]:
        """What is in conflict still when all of it is left out: a wrong height may have made others look wrong."""
        stated = [one for one in self.every if one.kind != "usual"]
        alone = all(prior.is_usual for prior in self.problem.priors) and len(self.out) == len(stated)
        found = []
        for number, (statement, test, rivals) in enumerate(self.out):
            if number < len(self.out) - 1 and statement.kind != "earlier":
                test = worst_test(statement, rest_at(statement, self.end))
            if test.log_p <= self._level:
                found.append(contradicted(statement, test, alone, rivals))
        return found

    def _solved(self, problem: Problem) -> RobustSolution | None:
        """The problem solved from where the last one ended; None where it cannot be."""
        try:
            after = solve_robustly(problem, self.observations, self.end.solution.estimate, self.usual)
        except CalibrationError:  # quiet: the linear test decides
            return None
        return None if after.solution.failed else after

    def _confirmed(self, statement: Statement, after: RobustSolution) -> Test:
        """The test where the problem without the statement was solved. In a bent valley the least squares themselves
        say how far apart the two are: by how much they rise, over the same observations, when the statement is added.
        """
        rest = rest_at(statement, after)
        test = worst_test(statement, rest)
        without = after.problem.weighted(replace(after.problem.weighting, loss="trivial"))
        bound = replace(without, priors=self.problem.priors, layout=self.problem.layout)
        try:
            least, most = solve(without, rest.estimate), solve(bound, self.end.solution.estimate)
        except CalibrationError:  # quiet: the linear test decides
            return test
        rise = max(2.0 * (most.cost - least.cost), 0.0)  # of exact observations it is rounding
        if rise >= test.squared or len(statement.priors) > 1:
            return test
        share = float(np.sqrt(rise / test.squared))
        return test._replace(squared=rise, log_p=log_probability(rise, rest), sigmas=test.sigmas * share)
