"""Compare prior knowledge with everything else: stated numbers, held ones, tolerances, an earlier posterior.

The linear model (Wald's test, below) uses residuals that a wrong prior has enlarged, or that were rejected as outliers
because of it. A prior that looks suspicious is left out, the problem is solved again, and the prior is judged there, at
the noise found there.

Wald's test measures how far everything else is from what is stated.

With C the covariance of some numbers x, P the information of their priors and z = sum P_j (x - mean_j) their slope,
everything else has the information M = C^-1 - P and its estimate at x + M^-1 z. A prior j is d = x + M^-1 z - mean_j
away from that, with covariance M^-1 + P_j^-1, and the squared distance follows Fisher's F. A number that is held is a
prior without width, with z the slope of the cost along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base import (
    Array,
    CalibrationError,
    Frozen,
    attempt,
    eigh,
    is_diagonal,
    log_f_tail,
    numerical,
    or_none,
    replace,
)
from ceres_cal.effects.dependence import measure_scatter, scattered
from ceres_cal.effects.effect import ShiftsAt
from ceres_cal.problem import (
    Estimate,
    GaussianPrior,
    Information,
    Key,
    Problem,
    intrinsics_vector,
    over,
    solve,
    with_intrinsics,
)
from ceres_cal.problem.quantities import difference, intrinsic_keys, values_of
from ceres_cal.problem.reduced import ReducedInformation, information, normals_with_residuals
from ceres_cal.robust.robust import RobustSolution, SolvedFrom
from ceres_cal.robust.stated import (
    DOUBTED,
    LEVEL,
    Conflict,
    Conflicts,
    Doubt,
    Statement,
    WaldTest,
    agreed,
    contradicted,
    contradicting,
    doubted,
    grouped,
    likely_wrong,
    together,
)

LARGEST_FREEDOM = 1e6
"""Degrees of freedom that count as infinite."""
_LEAST_TOLD = 1e-7  # share of the information on a number that the rest must contribute to say anything about it


class Rest(Frozen):
    """A statement's numbers by everything else: a step from an estimate, its information, its degrees of freedom."""

    estimate: Estimate
    step: Array
    information: Information
    freedom: float


def linear_rest(statement: Statement, end: RobustSolution, near: RobustSolution | None = None) -> Rest:
    """The rest by the linear model, where the problem with the statement was solved.

    Args:
        near: the solution with all statements loosened, if there is one; the noise is at least that found there.
    """
    estimate, freedom = end.estimate, min(end.inliers.degrees_of_freedom, LARGEST_FREEDOM)
    if statement.priors:
        reduced = end.information
        stated = Information.nothing(statement.keys).beside_all(prior.information for prior in statement.priors)
        at = reduced.shared.columns(stated.keys)
        slope = np.zeros(len(stated.keys))
        for prior in statement.priors:
            slope[stated.columns(prior.keys)] += prior.information.matrix @ prior.offsets(estimate)
        matrix, step = _beside(reduced.shared.inverse[np.ix_(at, at)], stated.matrix, slope)
        rest = Information(stated.keys, matrix)
    else:
        freed = statement.left_out(end.problem, estimate)
        rest = information(freed, estimate).shared.marginal(statement.keys)
        slope = -_slopes(freed, estimate, statement.keys)
        step = rest.inverse @ slope
    # A wrong statement enlarges the noise estimate by which the rest is weighted: by as much as this.
    noise = max(freedom - float(slope @ step), 1.0) / freedom if end.inliers.degrees_of_freedom < np.inf else 1.0
    if near is not None:
        ratios = np.divide(near.problem.weighting.scales, end.problem.weighting.scales)
        noise = max(noise, min(1.0, float(ratios.min()) ** 2))
    return Rest(estimate, step, Information(rest.keys, rest.matrix / noise), freedom)


def _beside(covariance: Array, stated: Array, slope: Array) -> tuple[Array, Array]:
    """M = C^-1 - P and the step M^-1 z; both are 0 in directions where M is lost in rounding beside P."""
    root, back = _roots(stated, _LEAST_TOLD)
    share, turned = eigh(root.T @ covariance @ root)
    share = np.clip(share, 1e-300, None)
    told = share < 1.0 - _LEAST_TOLD
    root, back, rest = root @ turned[:, told], back @ turned[:, told], 1.0 / share[told] - 1.0
    return np.asarray(root * rest @ root.T), np.asarray(back @ (back.T @ slope / rest))


def _roots(stated: Array, least: float) -> tuple[Array, Array]:
    """(n, k) R and B with R R^T = P and B^T R = 1, over directions stated by more than `least` at unit diagonal."""
    size = np.sqrt(np.where(np.diagonal(stated) > 0.0, np.diagonal(stated), 1.0))[:, None]
    values, vectors = eigh(stated / size / size.T)
    kept = values > least
    vectors, root = vectors[:, kept], np.sqrt(values[kept])
    return size * vectors * root, vectors / root / size


def _slopes(freed: Problem, estimate: Estimate, keys: Sequence[Key]) -> Array:
    """Derivatives of the cost by the held intrinsics of a camera, with everything else at its place."""
    name = keys[0].owner
    own = freed.sights.of_camera(name)
    if not len(own):
        return np.zeros(len(keys))
    gradient = normals_with_residuals(own, freed, estimate)[:, -1, :-1].sum(axis=0)
    every = [intrinsic_keys(name, estimate.cameras[name].lens)[number] for number in freed.layout.free[name]]
    return np.asarray(gradient[[every.index(key) for key in keys]])


def rest_at(statement: Statement, end: RobustSolution, known: Information | None = None) -> Rest:
    """The rest where a problem without the statement was solved, from `known`, else from the model's information."""
    reduced = end.information
    freedom = min(end.inliers.degrees_of_freedom, LARGEST_FREEDOM)
    known = (known or reduced.shared).marginal(statement.keys)
    return Rest(end.estimate, np.zeros(len(statement.keys)), known, freedom)


def worst_test(statement: Statement, rest: Rest) -> WaldTest:
    """The test of that prior of a statement which is contradicted most."""
    if not statement.priors:
        off = values_of(rest.estimate, statement.keys) + rest.step - statement.held
        return _tested(off, None, rest)
    tests = []
    for prior in statement.priors:
        at = rest.information.columns(prior.keys)
        own = Rest(rest.estimate, rest.step[at], rest.information.marginal(prior.keys), rest.freedom)
        tests.append(_tested(prior.offsets(rest.estimate) + own.step, prior.information, own))
    return min(tests, key=lambda test: test.log_p)


def _tested(off: Array, stated: Information | None, rest: Rest) -> WaldTest:
    """The test of numbers that differ by `off` from what is stated; `stated` is None if they were held."""
    matrix = rest.information.matrix
    squared = max(float(off @ matrix @ off), 0.0) if stated is None else _squared(off, stated.matrix, matrix)
    own = np.zeros(len(off)) if stated is None else stated.spread.sd
    others, keys = rest.information.spread.sd, rest.information.keys
    mean = values_of(rest.estimate, keys) + rest.step - off
    with np.errstate(divide="ignore", invalid="ignore"):
        # Of correlated numbers the rest often knows only combinations: it tells of each what it is if the others are as
        # stated. By itself a number may be anywhere: "everything else gives 520589918 ± 123653026", of 0.0006.
        if not (stated is None or is_diagonal(stated.matrix)) or not np.any(np.isfinite(others)):
            others, off = 1.0 / np.sqrt(np.diagonal(matrix)), matrix @ off / np.diagonal(matrix)
        apart = np.nan_to_num(np.abs(off) / np.hypot(own, others))
    worst = int(np.argmax(apart))
    value = float(mean[worst] + off[worst])
    return WaldTest(
        squared,
        log_probability(squared, rest),
        keys[worst],
        (float(mean[worst]), float(own[worst])),
        (value, float(others[worst])),
        float(apart[worst]),
    )


def _squared(off: Array, stated: Array, rest: Array) -> float:
    """off^T (M^-1 + P^-1)^-1 off. It is 0 however large `off` seems where everything else, M, says nothing beside what
    is stated, P.
    """
    least = 1e-14  # eigenvalue at unit diagonal above which a direction counts as stated
    root, back = _roots(stated, least)
    told, turn = eigh(back.T @ rest @ back)  # in units in which each direction is stated with information 1
    along = off @ root @ turn
    return float(np.sum(np.where(told > _LEAST_TOLD, told / (1.0 + told), 0.0) * along**2))


def log_probability(squared: float, rest: Rest) -> float:
    """Natural logarithm of the probability of a squared distance this large."""
    rank = max(rest.information.known_rank, 1)
    return float(log_f_tail(squared / rank, rank, max(rest.freedom, 1.0)))


# Probability in the linear test of all statements together below which the problem is solved without any of them: 2.2
# sigma, if one statement in twenty is wrong.
_SUSPICIOUS = 0.028
_RIVAL = 0.6  # share of the largest squared distance above which another statement may be the wrong one instead


@numerical("the test of what was stated")
def find_conflicts(
    every: tuple[Statement, ...],
    problem: Problem,
    end: RobustSolution,
    solver: SolvedFrom,
    part: Problem | None = None,
    shifts_at: ShiftsAt | None = None,
    near: RobustSolution | None = None,
) -> Conflicts:
    """Find all statements that the rest contradicts: the worst first, each with those found before left out.

    Args:
        every: the statements of the problem.
        problem: of all the observations. end: its solution. solver: solves a changed problem from an estimate.
        part: the problem of the observations that determine the answer. It is solved without contradicted statements,
            as without outliers; None where the answer stays. shifts_at: further scatter of the numbers.
        near: the solution with all statements loosened, if there is one: a wrong one may lead to another minimum.
    """
    most = 4  # solves without a statement
    reduced = end.information
    search = _ForwardSelection(problem, end, solver, every, shifts_at, near)
    while search.solves < most and search.leave_out_the_worst():
        pass
    search.leave_out_together()
    pairs = list(contradicting(every))
    named = (*(one for _, one in pairs), *search.conflicts())
    priors, answer = agreed(problem.priors, named), None
    if part is not None and priors != problem.priors:
        answer = _solved(replace(part, priors=priors), search.end, solver)
    if answer is None:
        shifts = [*(_along(reduced, key, one.seen - one.stated) for key, one in pairs), *search.places[1:]]
    else:
        moved = difference(answer.estimate, end.estimate, reduced.shared.keys)
        shifts = [place - moved for place in search.places[:-1]]
    return Conflicts(named, reduced.shared.keys, tuple(shifts), answer, tuple(search.doubts))


def contradicted_by(
    priors: Sequence[GaussianPrior], estimate: Estimate, posterior: Information, degrees_of_freedom: float
) -> str | None:
    """The prior that a solution without these priors contradicts most, in words; None where it contradicts none."""
    known = set(posterior.keys)
    groups = [one for one in grouped([prior.given(known) for prior in priors]) if one.kind == "prior" and one.keys]
    freedom = min(degrees_of_freedom, LARGEST_FREEDOM)
    rests = [Rest(estimate, np.zeros(len(one.keys)), posterior.marginal(one.keys), freedom) for one in groups]
    tests = [worst_test(one, rest) for one, rest in zip(groups, rests, strict=True)]
    number = min(range(len(tests)), key=lambda i: tests[i].log_p, default=-1)
    if number < 0 or tests[number].log_p > np.log(LEVEL / len(tests)):
        return None
    return contradicted(groups[number], tests[number], True, ()).words


def _along(reduced: ReducedInformation, key: Key, offset: float) -> Array:
    """(K,) by how much all shared numbers move when one of them moves by `offset`."""
    if key not in reduced.shared.keys:
        return np.zeros(len(reduced.shared.keys))
    covariance = reduced.shared.inverse
    column = reduced.shared.columns([key])[0]
    return np.asarray(covariance[:, column] / covariance[column, column] * offset)


@or_none  # quiet: the linear test decides, and the answer stays
def _solved(problem: Problem, end: RobustSolution, solver: SolvedFrom) -> RobustSolution | None:
    """The problem solved from the end of another one; None where that fails."""
    after = solver(replace(problem, feet=end.residuals.feet), end.estimate)
    return None if after.solution.failed else after


@dataclass(eq=False)
class _ForwardSelection:
    """Forward selection: the worst statement is left out, then the worst of the others.

    Attributes:
        problem, end: without the statements left out so far. left: statements that are not judged yet.
        out: statements in conflict, their tests, and the names of others that may be wrong instead.
        doubts: see `Conflicts`. places: (K,) each, shifts from the first end: to itself, to ends without statements,
            and to where leaving out a rival would lead.
    """

    problem: Problem
    end: RobustSolution
    solver: SolvedFrom
    every: tuple[Statement, ...]
    shifts_at: ShiftsAt | None
    near: RobustSolution | None = None

    def __post_init__(self) -> None:
        self.left, self.solves = list(self.every), 0
        if self.near is not None:
            self.near = replace(self.near, reduced=self.near.information)
        self.out: list[tuple[Statement, WaldTest, Sequence[str]]] = []
        self.doubts: list[Doubt] = []
        self._level = float(np.log(LEVEL / len(self.every)))
        self._first = self.end.information
        self.places, self._start = [np.zeros(len(self._first.shared.keys))], self.end.estimate

    def leave_out_the_worst(self) -> bool:
        """Judge the most suspicious statement. Returns False where none is suspicious."""
        # Probability in the linear test below which a solve decides. That test is made where a wrong statement has bent
        # everything: of heights 5 % wrong at 20 deg, which the true lens contradicts at 2 to 3 sigma, three of twenty
        # were above 0.028.
        worth_a_solve = 0.2
        tests = [self._linear_test(one) for one in self.left]
        number = min(range(len(tests)), key=lambda i: tests[i].log_p, default=-1)
        if number < 0 or tests[number].log_p > np.log(worth_a_solve):
            return False
        suspect, test = self.left.pop(number), tests.pop(number)
        rivals = [
            (one, other) for one, other in zip(self.left, tests, strict=True) if other.squared > _RIVAL * test.squared
        ]
        freed = suspect.left_out(self.problem, self.end.estimate)
        after = None if suspect.kind == "earlier" else _solved(freed, self._start_of(freed), self.solver)
        self.solves += 1
        test = test if after is None else self._confirmed(suspect, after)
        if test.log_p > self._level:
            likely = likely_wrong(test.squared)
            if after is not None and suspect.kind == "prior" and likely > DOUBTED:
                shift = difference(after.estimate, self.end.estimate, self._first.shared.keys)
                words = doubted(suspect, test, len(self.every) == 1, likely)
                self.doubts.append(Doubt(suspect.keys, likely, shift, words))
            return True
        self.out.append((suspect, test, [one.name for one, _ in rivals]))
        here = self.places[-1]
        self.places += [here + _along(self._first, t.key, t.seen[0] - t.stated[0]) for _, t in rivals]
        if after is not None:
            self.places.append(difference(after.estimate, self._start, self._first.shared.keys))
            self.problem, self.end = freed, after
        return True

    def _start_of(self, freed: Problem) -> RobustSolution:
        """The end to start from: the one with loosened statements, with the values that are held kept."""
        if self.near is None:
            return self.end
        cameras, there = dict(self.near.estimate.cameras), self.end.estimate.cameras
        for name, free in freed.layout.free.items():
            values, near = intrinsics_vector(there[name]), intrinsics_vector(cameras[name])
            values[free] = near[free]
            cameras[name] = with_intrinsics(cameras[name], values)
        return self.near.moved_to(replace(self.near.estimate, cameras=cameras), freed)

    def _linear_test(self, one: Statement) -> WaldTest:
        """The linear test with all statements, or with loosened ones, whichever is worse. Under a wrong phi, a lens
        without a formula becomes rough enough to agree with it.
        """
        near = self.near
        test = worst_test(one, linear_rest(one, self.end, near))
        if near is None or one.kind not in ("prior", "fixed") or not {*one.keys} <= {*near.information.shared.keys}:
            return test
        said = near.problem.priors_at(near.estimate)
        loose = replace(one, priors=tuple(prior for prior in said if {*one.keys} & {*prior.keys}))
        return min(test, worst_test(one, linear_rest(loose, near)), key=lambda test: test.log_p)

    def leave_out_together(self) -> None:
        """Judge all remaining priors by what is solved for without any of them."""
        out = [one for one, *_ in self.out]
        parts = [one for one in self.every if one.kind == "prior" and one not in out]
        every = together(parts)
        if every is None or worst_test(every, linear_rest(every, self.end)).log_p > np.log(_SUSPICIOUS):
            return
        freed = every.left_out(self.problem, self.end.estimate)
        after = _solved(freed, self._start_of(freed), self.solver)
        if after is None:
            return
        rise = self._rise(after)
        if rise is None or log_probability(rise, rest_at(every, after)) > self._level:
            return
        rest = rest_at(every, after, self._known(after))
        tests = [(one, worst_test(one, rest)) for one in parts]
        wrong = [(one, test, ()) for one, test in tests if test.log_p <= self._level]
        if wrong:
            named = {one.keys for one, *_ in wrong}
            self.doubts = [one for one in self.doubts if one.keys not in named]
            self.out += wrong
            self.places.append(difference(after.estimate, self._start, self._first.shared.keys))
            self.problem, self.end = freed, after

    def _rise(self, after: RobustSolution) -> float | None:
        """The rise of the sum of squares, over the same observations, when the statements left out are added."""
        without = after.problem.weighted(replace(after.problem.weighting, loss="trivial"))
        bound = replace(without, priors=self.problem.priors, layout=self.problem.layout)
        starts = (without, after.estimate), (bound, self.end.estimate)
        ends = attempt(lambda: [solve(*start).cost for start in starts])  # quiet: the linear test decides
        # With exact observations the rise may be negative, by rounding.
        return None if isinstance(ends, CalibrationError) else max(2.0 * (ends[1] - ends[0]), 0.0)

    def conflicts(self) -> list[Conflict]:
        """Conflicts that remain when all of them are left out: a wrong height may have made other statements look
        wrong.
        """
        alone = all(prior.is_usual for prior in self.problem.priors) and len(self.out) == len(self.every)
        found = []
        for number, (statement, test, rivals) in enumerate(self.out):
            if number < len(self.out) - 1 and statement.kind != "earlier":
                test = worst_test(statement, rest_at(statement, self.end, self._known(self.end)))
            if test.log_p <= self._level:
                found.append(contradicted(statement, test, alone, rivals))
        return found

    def _known(self, end: RobustSolution) -> Information:
        """The information on the shared numbers at an end, with the scatter of the observations and of the effects."""
        estimate = end.estimate
        reduced = end.information
        known = scattered(reduced, measure_scatter(end.problem, end.residuals, estimate, reduced))
        if self.shifts_at is None:
            return known
        keys, shifts = self.shifts_at(estimate, end.problem)
        return known.widened(over(np.array(shifts), keys, known.keys)) if len(shifts) else known

    def _confirmed(self, statement: Statement, after: RobustSolution) -> WaldTest:
        """The test where the problem without the statement was solved. In a bent valley the sum of squares itself says
        how far apart both are: by how much it rises, over the same observations, when the statement is added.
        """
        rest = rest_at(statement, after)
        alone = worst_test(statement, rest)
        test = worst_test(statement, rest_at(statement, after, self._known(after)))
        rise = self._rise(after)
        if rise is None or rise >= alone.squared or len(statement.priors) > 1:
            return test
        share = rise / alone.squared
        squared, sigmas = share * test.squared, test.sigmas * share**0.5
        return test._replace(squared=squared, log_p=log_probability(squared, rest), sigmas=sigmas)
