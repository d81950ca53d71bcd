"""Statements on a problem's numbers, made beforehand, and the words for a statement that is contradicted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ceres_cal.base import Array, Frozen, is_diagonal, log_chi2_tail, replace, two_digits
from ceres_cal.effects.aside import DOUBTFUL
from ceres_cal.effects.evidence import FEATURE_ASIDE
from ceres_cal.problem import Estimate, GaussianPrior, Information, Key, Options, Problem, intrinsic_keys, values_of

if TYPE_CHECKING:
    from ceres_cal.robust.robust import RobustSolution

LEVEL = 1e-3
"""Probability of any conflict, over all statements, where everything stated is right. A conflict withdraws a
calibration's promise, so it is as rare as ten heads in a row.
"""
DOUBTED = float(1.0 / (1.0 + np.exp(DOUBTFUL)))
"""Probability that a statement is wrong above which both explanations are named, as for a misplaced feature."""
_FACTORS = {1e3: "mm", 1e2: "cm", 1.0 / 0.3048: "feet", 1.0 / 0.0254: "inches", 1e-3: "km"}
_STATED = {"prior": "stated", "fixed": "held", "tolerance": "drawn", "earlier": "known"}


class Conflict(Frozen, eq=True):
    """A statement that everything else contradicts.

    Attributes:
        kind: "prior", "fixed", "tolerance", "earlier" (the posterior of an earlier calibration) or "priors" (two of
            them contradict each other). owner, quantity, unit: of the number.
        stated, stated_sd: the value as stated and its sd, which is 0 for a fixed number.
        seen, seen_sd: the value that everything else says, or that of the other one of two priors, and its sd.
        sigmas: distance of both values, in standard deviations of their difference.
        words: all of it in one line.
    """

    kind: str
    owner: str
    quantity: str
    unit: str
    stated: float
    stated_sd: float
    seen: float
    seen_sd: float
    sigmas: float
    words: str

    @property
    def number(self) -> tuple[str, str, str]:
        """Owner, quantity and unit of the number: its key without the kind."""
        return self.owner, self.quantity, self.unit


class Conflicts(Frozen):
    """The statements that are contradicted, and how the numbers move without each of them.

    Attributes:
        every: the conflicts. shifts: (K,) each, over the shared keys (K): by how much the numbers move when statements
            in conflict are left out, or when they are kept.
        answer: the solution without contradicted statements; None where the answer stays.
        doubts: priors that look wrong but are too likely right to be set aside.
    """

    every: tuple[Conflict, ...] = ()
    keys: tuple[Key, ...] = ()
    shifts: tuple[Array, ...] = ()
    answer: RobustSolution | None = None
    doubts: tuple[Doubt, ...] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """One line for each conflict and each doubt."""
        return (*(one.words for one in self.every), *(one.words for one in self.doubts))


class Doubt(Frozen):
    """A prior that may be wrong: its keys, the probability of that, and the shift (K,) of the numbers without it."""

    keys: tuple[Key, ...]
    probability: float
    shift: Array
    words: str


class WaldTest(NamedTuple):
    """The test of one prior of a statement, or of the numbers that it holds, against the rest.

    Attributes:
        squared: squared distance, in variances. log_p: natural logarithm of its probability.
        key: the number that differs most. stated, seen: its mean and sd as stated, and by the rest. sigmas: their
            distance.
    """

    squared: float
    log_p: float
    key: Key
    stated: tuple[float, float]
    seen: tuple[float, float]
    sigmas: float


class Statement(Frozen):
    """Priors on the same numbers; or, without priors, numbers that are held."""

    kind: str
    keys: tuple[Key, ...]
    priors: tuple[GaussianPrior, ...]
    held: Array

    @property
    def name(self) -> str:
        """Its name in messages."""
        if self.kind == "earlier":
            return "the earlier calibration"
        names = " and ".join(key.quantity for key in self.keys)
        return f"the {_STATED[self.kind]} {names} of {self.keys[0].whose}"

    @property
    def spanning(self) -> GaussianPrior:
        """One normal distribution with the moments of a mixture of its priors in equal parts."""
        means, variances = [], []
        for key in self.keys:
            known = np.array([stated_value(prior, key) for prior in self.priors if key in prior.keys])
            means.append(float(known[:, 0].mean()))
            variances.append(float(np.mean(known[:, 1] ** 2 + (known[:, 0] - means[-1]) ** 2)))
        sigmas = dict(zip(self.keys, np.sqrt(variances).tolist(), strict=True))
        return GaussianPrior(Information.of_sigmas(sigmas), np.array(means))

    def left_out(self, problem: Problem, estimate: Estimate) -> Problem:
        """The problem without the statement."""
        if self.priors:
            rest = [prior.without(self.keys) if is_plain(prior) else prior for prior in problem.priors]
            return replace(problem, priors=tuple(prior for prior in rest if prior.keys))
        camera = estimate.cameras[self.keys[0].owner]
        every = intrinsic_keys(self.keys[0].owner, camera.lens)
        freed = np.union1d(problem.layout.free[self.keys[0].owner], [every.index(key) for key in self.keys])
        return replace(problem, layout=replace(problem.layout, free={**problem.layout.free, self.keys[0].owner: freed}))


def is_plain(prior: GaussianPrior) -> bool:
    """Whether each number is stated by itself, unlike in a posterior."""
    return is_diagonal(prior.information.matrix)


def statements(problem: Problem, estimate: Estimate) -> Iterator[Statement]:
    """All statements on a problem's numbers, and numbers held by name. Estimated tolerances are no statements."""
    told, every = problem.options.tolerances, problem.stated_at(estimate)
    plain = ([key for key in prior.keys if key.kind != "structure" or key.owner in told] for prior in every)
    yield from grouped([one.given(own) if is_plain(one) else one for one, own in zip(every, plain, strict=True)])
    yield from _held(problem.options, estimate)


def grouped(priors: Sequence[GaussianPrior]) -> Iterator[Statement]:
    """Statements of priors: those with a number in common are one statement, tolerances are one each."""
    groups: list[Statement] = []
    nothing = np.empty(0)
    for prior in (one for one in priors if one.keys):
        if prior.gives_way:
            continue
        if not is_plain(prior):
            yield Statement("earlier", prior.keys, (prior,), nothing)
        elif prior.keys[0].kind == "structure":
            yield from (Statement("tolerance", (key,), (prior.given([key]),), nothing) for key in prior.keys)
        else:
            others = [group for group in groups if set(group.keys) & set(prior.keys)]
            groups = [group for group in groups if group not in others]
            together = (*(one for group in others for one in group.priors), prior)
            keys = tuple(dict.fromkeys(key for one in together for key in one.keys))
            groups.append(Statement("prior", keys, together, nothing))
    yield from groups


def together(every: Iterable[Statement]) -> Statement | None:
    """One statement of all priors, since wrong ones may confirm one another: a phi and a height that are both a fifth
    too large, or heights that are all in feet. None where there are fewer than two.
    """
    parts = [one for one in every if one.kind == "prior"]
    keys, priors = (tuple(chain.from_iterable(getattr(one, of) for one in parts)) for of in ("keys", "priors"))
    return Statement("prior", keys, priors, np.empty(0)) if len(parts) > 1 else None


def agreed(priors: Sequence[GaussianPrior], conflicts: Sequence[Conflict]) -> tuple[GaussianPrior, ...]:
    """The priors that remain after conflicts. A prior that everything else contradicts is removed, like an outlier;
    priors that contradict only each other are replaced by one that spans them.
    """
    left = list(priors)
    disputed = {kind: {one.number for one in conflicts if one.kind == kind} for kind in ("prior", "priors")}
    for one in grouped(priors):
        own = {key[1:] for key in one.keys if one.kind == "prior"}
        is_wrong = bool(own & disputed["prior"])
        if is_wrong or own & disputed["priors"]:
            left = [prior for prior in left if prior not in one.priors]
            left += [] if is_wrong else [one.spanning]
    return tuple(left)


def _held(options: Options, estimate: Estimate) -> Iterator[Statement]:
    """Statements of what the options hold by name; the principal point is one statement."""
    for name, camera in estimate.cameras.items():
        every = {key.quantity: key for key in intrinsic_keys(name, camera.lens)}
        centre = [q for q in ("cx", "cy") if not options.free_principal_point or q in options.fixed]
        others = [[quantity] for quantity in options.fixed if quantity not in centre]
        for quantities in ([centre] if centre else []) + others:
            keys = tuple(every[quantity] for quantity in quantities)
            yield Statement("fixed", keys, (), values_of(estimate, keys))


def stated_value(prior: GaussianPrior, key: Key) -> tuple[float, float]:
    """Mean and standard deviation of one number in a prior."""
    column = prior.information.columns([key])[0]
    return float(prior.mean[column]), float(prior.information.spread.sd[column])


def number_text(value: float, sd: float, key: Key) -> str:
    """Text such as "3.000 ± 0.005 m"; for a number that is held (sd 0), only its value."""
    unit = "" if key.unit == "1" else f" {key.unit}"
    if sd == 0.0:
        return f"{value:g}{unit}"
    spread = two_digits(sd)
    places = len(spread.partition(".")[2])
    text = f"{value:.4g}" if "e" in spread else f"{value:.{places}f}"
    return f"{text} ± {spread}{unit}"


def likely_wrong(squared: float) -> float:
    """Probability that a statement this far off is wrong; one in twenty is, as of misplaced lines."""
    log_odds = log_odds_wrong(squared**0.5) + 0.5 * squared
    return float(1.0 / (1.0 + np.exp(-log_odds)))


def log_odds_wrong(sigmas: float) -> float:
    """Logarithm of the odds of a wrong statement that is `sigmas` standard deviations off to a right one that is not
    off. Beyond the largest expected distance the odds stay the same.
    """
    variances = 1.0 + FEATURE_ASIDE.scatter**2
    squared = min(sigmas**2, float(variances[-1]))
    others = (FEATURE_ASIDE.probabilities / np.sqrt(variances) * np.exp(-0.5 * squared / variances))[1:]
    return float(np.log(np.sum(others) / FEATURE_ASIDE.absent))


def contradicted(statement: Statement, test: WaldTest, alone: bool, rivals: Sequence[str]) -> Conflict:
    """The conflict of a statement, with its words.

    Args:
        alone: whether only observations contradict it. rivals: names of other statements that may be wrong instead.
    """
    key, also = test.key, "".join(f", or else {one}" for one in rivals)
    remedy = f"{_in_another_unit(test)}correct or remove it"
    if statement.kind == "earlier":
        together = "calibrate the earlier and these observations together, as two stations of one camera"
        remedy = f"if the lens is the same, {together}; else refit with --what everything"
    words = f"{_apart(statement, test, alone)}: {remedy}{also}"
    return Conflict(statement.kind, key.owner, key.quantity, key.unit, *test.stated, *test.seen, test.sigmas, words)


def doubted(statement: Statement, test: WaldTest, alone: bool, probability: float) -> str:
    """The words for a statement in doubt."""
    return f"{_apart(statement, test, alone)}. It {_wrong_by(probability)}"


def may_be_wrong(conflict: Conflict, key: Key, probability: float, lens: str) -> str:
    """The words for a statement that is in conflict under another lens and may be wrong."""
    stated = number_text(conflict.stated, conflict.stated_sd, key)
    seen = f"with the lens {lens} everything else gives {number_text(conflict.seen, conflict.seen_sd, key)}"
    return f"the {_STATED[conflict.kind]} {key.quantity} of {key.whose}, {stated}: {seen}. It {_wrong_by(probability)}"


def _wrong_by(probability: float) -> str:
    wrong = f"may be wrong (probability {100.0 * probability:.0f} %)"
    return f"{wrong}. The stated uncertainties include this: measure again"


def _apart(statement: Statement, test: WaldTest, alone: bool) -> str:
    key, who = test.key, "the observations alone give" if alone else "everything else gives"
    about = f"{_STATED[statement.kind]} {key.quantity} of {key.whose}, {number_text(*test.stated, key)}"
    return f"the {about}: {who} {number_text(*test.seen, key)}, {two_digits(test.sigmas)} sigmas apart"


def contradicting(statements: Sequence[Statement]) -> Iterator[tuple[Key, Conflict]]:
    """Pairs of priors on one number that contradict each other, whatever the observations say; with that number."""
    every = [(s, key) for s in statements if len(s.priors) > 1 for key in s.keys]
    for statement, key in every:
        known = [stated_value(prior, key) for prior in statement.priors if key in prior.keys]
        for one, other in combinations(known, 2):
            sigmas = abs(one[0] - other[0]) / float(np.hypot(one[1], other[1]))
            if log_chi2_tail(sigmas**2, 1.0) <= np.log(LEVEL):
                words = (
                    f"two priors contradict each other: {key.quantity} of {key.whose} is stated as "
                    f"{number_text(*one, key)} and as {number_text(*other, key)}, {two_digits(sigmas)} sigmas apart: "
                    "correct or remove one"
                )
                yield key, Conflict("priors", key.owner, key.quantity, key.unit, *one, *other, sigmas, words)


def _in_another_unit(test: WaldTest) -> str:
    """The likely cause, where both values agree in another unit."""
    near = 0.1  # relative difference up to which a unit is the likely cause
    if test.key.unit != "m" or not test.seen[0]:
        return ""
    ratio = test.stated[0] / test.seen[0]
    units = [unit for factor, unit in _FACTORS.items() if abs(ratio / factor - 1.0) < near]
    return f"is it in {units[0]}? Give metres; " if units else ""
