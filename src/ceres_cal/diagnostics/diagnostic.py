"""What a diagnostic is: a kind of finding with its test and its words; and what it is asked about.

What a diagnosis finds: the cause by name, how large, how sure.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask, distinct
from ceres_cal.base.cached import cached_property
from ceres_cal.base.words import first_of, two_digits
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics.labels import Mislabelling
from ceres_cal.diagnostics.leftover import Noise
from ceres_cal.diagnostics.scores import Family, Selection, TestedAlternative
from ceres_cal.diagnostics.table import ResidualTable, plane_shift
from ceres_cal.effects.linearised import Linearised
from ceres_cal.observations import Observations
from ceres_cal.problem.equations import Equations, whole_structure
from ceres_cal.problem.noise import Inliers
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.structure import Structure
from ceres_cal.robust.repeats import AsBuilt

SMALL = 0.4
"""Beside the noise: an effect of less than this share of it does not show in a single observation, only in many."""
Wrong = Literal["model", "calibration", "observations"]


@dataclass(frozen=True)
class Amount:
    """One number that would mend it: its name, value, standard deviation and unit ("mm", "deg", "px", "")."""

    name: str
    value: float
    sd: float
    unit: str


def amounts(names: Iterable[str], values: Array, sd: Array, unit: str) -> tuple[Amount, ...]:
    """Several numbers of one unit."""
    return tuple(Amount(n, float(v), float(s), unit) for n, v, s in zip(names, values, sd, strict=False))


@dataclass(frozen=True)
class Finding:
    """One cause of what is left over.

    Attributes:
        kind: of one of DIAGNOSTICS. wrong: what is, the model (no covariance of the parameters contains that), the
            calibration (a refit would mend it), or the observations, their labels or their noise.
        subject: what it is about: a camera, a station, "target/feature", a board's target, "points" or "curves".
            frame: at which frame, None where it is about all.
        sentence: the cause in words. advice: what to do.
        effect_px: root mean square displacement in the image of the observations that it moves (of the lens: of what
            the calibration could not absorb); of noise its standard deviation, of a wrong label how far off it is.
        noise_ratio: that over the noise of the same observations; below SMALL it shows in many of them together only.
        effect_mm: the same on the target's plane; NaN where the plane is seen edge-on.
        amounts: what would mend it.
        log10_p: decimal logarithm of the probability of a false alarm anywhere in the calibration, after Bonferroni.
        observations: how many it moves; rows: (kind, row) of the observations of a wrong label.
    """

    kind: str
    wrong: Wrong
    subject: str
    frame: str | None
    sentence: str
    advice: str
    effect_px: float
    effect_mm: float
    noise_ratio: float
    amounts: tuple[Amount, ...]
    log10_p: float
    observations: int
    rows: tuple[tuple[str, int], ...] = ()

    @property
    def is_model_error(self) -> bool:
        """Whether it says that the model is wrong, so that no covariance contains it."""
        return self.wrong == "model"


_LN_10 = float(np.log(10.0))


class Effect(NamedTuple):
    """Root mean square over observations of what moves them, in the image and on their targets' planes."""

    px: float
    mm: float
    observations: int


@dataclass(frozen=True, eq=False)
class Case:
    """What is diagnosed.

    Attributes:
        problem: of all the observations. model: before any alternative is put in.
        calibration: of other observations, which may not hold on these; None where these are its own.
        as_built: what the calibration found not to be as drawn, and solved for.
    """

    observations: Observations
    problem: Problem
    estimate: Estimate
    inliers: Inliers
    model: Linearised
    table: ResidualTable
    labels: Mislabelling
    calibration: Calibration | None
    as_built: tuple[AsBuilt, ...] = ()

    @property
    def equations(self) -> Equations:
        return self.model.equations

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self.estimate.cameras)

    @cached_property
    def camera(self) -> Indices:
        """(E,) number of each equation's camera among `cameras`."""
        of_sight = np.array([self.cameras.index(key.camera) for key in self.equations.sights.keys])
        return np.asarray(of_sight[self.equations.sight])

    @cached_property
    def whole_structure(self) -> Structure:
        """Everything that could be built otherwise than it is drawn."""
        return whole_structure(self.observations.targets)

    @cached_property
    def slots(self) -> tuple[Indices, Indices]:
        """(E, BUILT) the offsets of that structure, and of the estimate's own: see `Equations`."""
        return self.equations.slots(self.whole_structure), self.equations.slots(self.estimate.structure)

    def effect(self, shift: Array, rows: Mask) -> Effect:
        """What a displacement (E,) px does to the observations of some equations."""
        count = len(distinct(self.equations.observation[rows]))
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = plane_shift(self.equations, shift)
        twice = np.where(self.equations.is_curve, 1.0, 2.0)  # both equations of a point carry its whole shift in mm
        squared = np.nansum(((x**2 + y**2) / twice)[rows])
        return Effect(float(np.sqrt(np.sum(shift[rows] ** 2) / count)), float(np.sqrt(squared / count)), count)

    def noise_px(self, left_over: Array, rows: Mask) -> float:
        """Root mean square over observations of what is left over, (E,) in standard deviations, px."""
        count = len(distinct(self.equations.observation[rows]))
        return float(np.sqrt(np.sum((left_over / self.model.weight)[rows] ** 2) / count))


@dataclass(frozen=True, eq=False)
class Tested:
    """A case, the alternatives that its residuals speak for, the noise that these leave, the rate of false alarms."""

    case: Case
    selection: Selection
    noise: tuple[Noise, ...]
    rate: float

    def log10_p(self, log_p: float) -> float:
        """Decimal logarithm after Bonferroni."""
        return min(0.0, (log_p + float(np.log(self.selection.tests))) / _LN_10)


class Diagnostic(ABC):
    """A kind of finding.

    Attributes:
        kind: its name. wrong: see `Finding`.
    """

    kind: ClassVar[str]
    wrong: ClassVar[Wrong] = "model"

    def tests(self, case: Case) -> int:
        """How many tests it makes besides score tests: all share one rate of false alarms."""
        return 0

    @abstractmethod
    def findings(self, tested: Tested) -> Iterator[Finding]:
        """Those whose probability is at most the selection's level."""


# ---- score tests ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Evidence:
    """An alternative that the residuals speak for.

    Attributes:
        others: the model with the other chosen alternatives free. shift: (E,) px that it moves.
        noise_ratio: its effect over the noise of the same observations.
    """

    case: Case
    score: TestedAlternative
    others: Linearised
    shift: Array
    effect: Effect
    noise_ratio: float

    @property
    def size(self) -> str:
        """Its effect in words."""
        px, mm, _ = self.effect
        digits = 1 if mm >= 0.1 else 2
        return f"{px:.2f} px, {mm:.{digits}f} mm rms, {two_digits(self.noise_ratio)} of the noise"

    def most_px(self, rows: Mask) -> float:
        """The largest displacement among some equations that take part."""
        return float(np.max(np.abs((self.shift * rows)[self.case.model.used])))


class Words(NamedTuple):
    """What a finding says: its cause, what to do, and what would mend it."""

    sentence: str
    advice: str
    amounts: tuple[Amount, ...] = ()


class ScoreTest(Diagnostic):
    """A diagnostic made of alternatives to the model, columns over the equations, of which the residuals choose.

    Attributes:
        absorbed: whether its effect is what the calibration's free numbers could not have taken up of it.
    """

    absorbed: ClassVar[bool] = False

    @abstractmethod
    def families(self, case: Case) -> Iterator[Family]:
        """Its alternatives, each family of its `kind`."""

    @abstractmethod
    def words(self, evidence: Evidence) -> Words:
        """What the finding of one of them says."""

    def findings(self, tested: Tested) -> Iterator[Finding]:
        for number, score in enumerate(tested.selection.chosen):
            if score.family.kind == self.kind:
                yield self._finding(tested, number)

    def _finding(self, tested: Tested, number: int) -> Finding:
        case, chosen = tested.case, tested.selection.chosen
        score, others = chosen[number], case.model
        for other in (*chosen[:number], *chosen[number + 1 :]):
            others = others.with_columns(other.columns)
        rows = np.any(score.columns != 0.0, axis=1) & case.model.used
        shift = score.columns @ score.amount
        if self.absorbed:
            shift = case.model.unabsorbed(shift)
        effect = case.effect(shift, rows)
        ratio = effect.px / case.noise_px(tested.selection.model.left_over, rows)
        sentence, advice, mending = self.words(Evidence(case, score, others, shift, effect, ratio))
        if score.rivals:
            names = first_of([f"{one.family.kind} ({one.subject})" for one in score.rivals], 3)
            sentence += f"; these data cannot tell it from {names}"
        return Finding(
            self.kind, self.wrong, score.subject, score.frame, sentence, advice, effect.px, effect.mm, ratio, mending,
            tested.log10_p(score.log_p), effect.observations,
        )  # fmt: skip
