"""What was known beforehand against what everything else says: stated numbers, held ones, tolerances, an old posterior.

The linear picture of it (Wald's test, below) stands at residuals that a wrong prior has swollen or thrown out as
outliers. What looks suspicious in it is solved again without the prior and judged there, at the noise there.

Wald's test of what is stated: how far everything else is from it.

With C the covariance of some numbers x, P what their priors say of them and z = sum P_j (x - mean_j) their slope,
everything else says M = C^-1 - P and stands at x + M^-1 z; a prior j is d = x + M^-1 z - mean_j away from that, with
covariance M^-1 + P_j^-1, and the squared distance is Fisher's F. A number that is held is a prior without width, z the
slope of the cost along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base import Array, CalibrationError, Frozen, attempt, log_f_tail, numerical, or_none, replace
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
    Statement,
    WaldTest,
    agreed,
    contradicted,
    contradicting,
    doubted,
    grouped,
    likely_wrong,
    statements,
    together,
)

LARGEST_FREEDOM = 1e6
"""Degrees of freedom that count as infinitely many."""
_LEAST_TOLD = 1e-7  # of what is known of a number, the share that others must bring to speak of it


class Rest(Frozen):
    """What everything else says of a statement's numbers: a step from an estimate, and how well that is known."""

    estimate: Estimate
    step: Array
    information: Information
    freedom: float


def linear_rest(statement: Statement, end: RobustSolution, near: RobustSolution | None = None) -> Rest:
    """By the linear picture where the problem with the statement was solved.

    Args:
        near: where everything that is stated said little, if that was solved: less noise than there is none.
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
    # It swells the noise that the rest is measured by, as far as the linear picture goes.
    noise = max(freedom - float(slope @ step), 1.0) / freedom if end.inliers.degrees_of_freedom < np.inf else 1.0
    if near is not None:
        ratios = np.divide(near.problem.weighting.scales, end.problem.weighting.scales)
        noise = max(noise, min(1.0, float(ratios.min()) ** 2))
    return Rest(estimate, step, Information(rest.keys, rest.matrix / noise), freedom)


def _beside(covariance: Array, stated: Array, slope: Array) -> tuple[Array, Array]:
    """M = C^-1 - P and the step M^-1 z, both 0 where M is lost in rounding beside P."""
    root, back = _roots(stated, _LEAST_TOLD)
    share, turned = np.linalg.eigh(root.T @ covariance @ root)
    share = np.clip(share, 1e-300, None)
    told = share < 1.0 - _LEAST_TOLD
    root, back, rest = root @ turned[:, told], back @ turned[:, told], 1.0 / share[told] - 1.0
    return np.asarray(root * rest @ root.T), np.asarray(back @ (back.T @ slope / rest))


def _roots(stated: Array, least: float) -> tuple[Array, Array]:
    """(n, k) R and B with R R^T = P and B^T R = 1, over what is stated by more than the least at unit diagonal."""
    size = np.sqrt(np.where(np.diagonal(stated) > 0.0, np.diagonal(stated), 1.0))[:, None]
    values, vectors = np.linalg.eigh(stated / size / size.T)
    kept = values > least
    vectors, root = vectors[:, kept], np.sqrt(values[kept])
    return size * vectors * root, vectors / root / size


def _slopes(freed: Problem, estimate: Estimate, keys: Sequence[Key]) -> Array:
    """Derivative of the cost by what was held of a camera, everything else where it is."""
    name = keys[0].owner
    own = freed.sights.of_camera(name)
    if not len(own):
        return np.zeros(len(keys))
    gradient = normals_with_residuals(own, freed, estimate)[:, -1, :-1].sum(axis=0)
    every = [intrinsic_keys(name, estimate.cameras[name].lens)[number] for number in freed.layout.free[name]]
    return np.asarray(gradient[[every.index(key) for key in keys]])


def rest_at(statement: Statement, end: RobustSolution, known: Information | None = None) -> Rest:
    """Where a problem without the statement was solved, by what is known of its numbers there; else by the model."""
    reduced = end.information
    freedom = min(end.inliers.degrees_of_freedom, LARGEST_FREEDOM)
    known = (known or reduced.shared).marginal(statement.keys)
    return Rest(end.estimate, np.zeros(len(statement.keys)), known, freedom)


def worst_test(statement: Statement, rest: Rest) -> WaldTest:
    """The test of what is farthest off of a statement."""
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
    """The test of numbers that are off by so much; `stated` None: they were held."""
    matrix = rest.information.matrix
    squared = max(float(off @ matrix @ off), 0.0) if stated is None else _squared(off, stated.matrix, matrix)
    own = np.zeros(len(off)) if stated is None else stated.spread.sd
    others, keys = rest.information.spread.sd, rest.information.keys
    with np.errstate(invalid="ignore"):
        apart = np.nan_to_num(np.abs(off) / np.hypot(own, others))
    worst = int(np.argmax(apart))
    value = float(values_of(rest.estimate, [keys[worst]])[0] + rest.step[worst])
    return WaldTest(
        squared,
        log_probability(squared, rest),
        keys[worst],
        (value - float(off[worst]), float(own[worst])),
        (value, float(others[worst])),
        float(apart[worst]),
    )


def _squared(off: Array, stated: Array, rest: Array) -> float:
    """off^T (M^-1 + P^-1)^-1 off: where everything else, M, says nothing beside what is stated, P, it is 0 however far
    off that seems.
    """
    least = 1e-14  # eigenvalue, at unit diagonal, from which on a direction counts as stated
    root, back = _roots(stated, least)
    told, turn = np.linalg.eigh(back.T @ rest @ back)  # in directions in which each is stated to one
    along = off @ root @ turn
    return float(np.sum(np.where(told > _LEAST_TOLD, told / (1.0 + told), 0.0) * along**2))


def log_probability(squared: float, rest: Rest) -> float:
    """Natural logarithm of the probability of so large a squared distance."""
    rank = max(rest.information.known_rank, 1)
    return float(log_f_tail(squared / rank, rank, max(rest.freedom, 1.0)))


# Probability of a linear picture from which on other groups are judged without a statement: 2.2 sigma, where one in
# twenty is wrong.
_SUSPICIOUS = 0.028
_RIVAL = 0.6  # of the largest squared distance: a statement as far off may be the wrong one instead


class Conflicts(Frozen):
    """What contradicts what, and how the numbers move with each of it.

    Attributes:
        every: the conflicts. shifts: (K,) each, of the keys (K) of what is shared: by how much everything moves when
            statements in conflict are left out, or are not.
        answer: without what was stated and is contradicted; None where the answer stays.
        doubts: priors that look wrong, and are too likely right to be set aside.
    """

    every: tuple[Conflict, ...] = ()
    keys: tuple[Key, ...] = ()
    shifts: tuple[Array, ...] = ()
    answer: RobustSolution | None = None
    doubts: tuple[Doubt, ...] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """One line of each."""
        return (*(one.words for one in self.every), *(one.words for one in self.doubts))


class Doubt(Frozen):
    """That a prior may be wrong: its numbers, how probable that is, (K,) by how much everything moves without it."""

    keys: tuple[Key, ...]
    probability: float
    shift: Array
    words: str


@numerical("the test of what was stated")
def find_conflicts(
    problem: Problem,
    end: RobustSolution,
    solver: SolvedFrom,
    part: Problem | None = None,
    shifts_at: ShiftsAt | None = None,
    near: RobustSolution | None = None,
) -> Conflicts:
    """Everything stated that the rest contradicts, the worst first, each with those before it left out.

    Args:
        problem: of all the observations. end: its solution. solver: of the same without something, from an estimate.
        part: of those that have a part in the answer: it is solved without what was stated and is contradicted, as
            without an outlier; None where the answer stays. shifts_at: by which numbers scatter besides.
        near: where it was solved without what looks wrong, if it was: a wrong statement may lead to another minimum.
    """
    most = 4  # solves
    every = tuple(statements(problem, end.estimate))
    if not every:
        return Conflicts()
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


@or_none  # quiet: the linear test decides, and the answer stays
def _solved(problem: Problem, end: RobustSolution, solver: SolvedFrom) -> RobustSolution | None:
    """The problem solved from where another one ended; None where it cannot be."""
    after = solver(replace(problem, feet=end.residuals.feet), end.estimate)
    return None if after.solution.failed else after


@dataclass(eq=False)
class _ForwardSelection:
    """Forward selection: the worst statement is left out, then the worst of the others.

    Attributes:
        problem, end: without what was left out. left: statements that are not judged yet.
        out: those in conflict, their tests, and names of others that may be wrong in their place.
        doubts: see `Conflicts`. places: (K,) from the first end: it, ends without statements, and where rivals that are
            left out would lead.
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
        """Judge the most suspicious statement; False where none is."""
        # Probability of the linear picture from which on a solve decides. It stands where a wrong statement has bent
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
        """Where little was stated, with what is held still."""
        if self.near is None:
            return self.end
        cameras, there = dict(self.near.estimate.cameras), self.end.estimate.cameras
        for name, free in freed.layout.free.items():
            values, near = intrinsics_vector(there[name]), intrinsics_vector(cameras[name])
            values[free] = near[free]
            cameras[name] = with_intrinsics(cameras[name], values)
        return self.near.moved_to(replace(self.near.estimate, cameras=cameras), freed)

    def _linear_test(self, one: Statement) -> WaldTest:
        """By the linear picture under everything that is stated, or where it said little: a lens without a formula, as
        rough as it becomes under a wrong phi, says nothing against it.
        """
        near = self.near
        test = worst_test(one, linear_rest(one, self.end, near))
        if near is None or one.kind not in ("prior", "fixed") or not {*one.keys} <= {*near.information.shared.keys}:
            return test
        said = near.problem.priors_at(near.estimate)
        loose = replace(one, priors=tuple(prior for prior in said if {*one.keys} & {*prior.keys}))
        return min(test, worst_test(one, linear_rest(loose, near)), key=lambda test: test.log_p)

    def leave_out_together(self) -> None:
        """Judge all that is left of what was stated by what is solved for without any of it."""
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
        """By how much the least squares rise, over the same observations, when what was left out there is added."""
        without = after.problem.weighted(replace(after.problem.weighting, loss="trivial"))
        bound = replace(without, priors=self.problem.priors, layout=self.problem.layout)
        starts = (without, after.estimate), (bound, self.end.estimate)
        ends = attempt(lambda: [solve(*start).cost for start in starts])  # quiet: the linear test decides
        # Of exact observations it is rounding.
        return None if isinstance(ends, CalibrationError) else max(2.0 * (ends[1] - ends[0]), 0.0)

    def conflicts(self) -> list[Conflict]:
        """What is in conflict still when all of it is left out: a wrong height may have made others look wrong."""
        alone = all(prior.is_usual for prior in self.problem.priors) and len(self.out) == len(self.every)
        found = []
        for number, (statement, test, rivals) in enumerate(self.out):
            if number < len(self.out) - 1 and statement.kind != "earlier":
                test = worst_test(statement, rest_at(statement, self.end, self._known(self.end)))
            if test.log_p <= self._level:
                found.append(contradicted(statement, test, alone, rivals))
        return found

    def _known(self, end: RobustSolution) -> Information:
        """About the shared numbers at an end, as the observations scatter."""
        estimate = end.estimate
        reduced = end.information
        known = scattered(reduced, measure_scatter(end.problem, end.residuals, estimate, reduced))
        if self.shifts_at is None:
            return known
        keys, shifts = self.shifts_at(estimate, end.problem)
        return known.widened(over(np.array(shifts), keys, known.keys)) if len(shifts) else known

    def _confirmed(self, statement: Statement, after: RobustSolution) -> WaldTest:
        """The test where the problem without the statement was solved. In a bent valley the least squares themselves
        say how far apart the two are: by how much they rise, over the same observations, when the statement is added.
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
