"""What a diagnostic is: a kind of finding with its test and its words; and what it is asked about."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask, distinct
from ceres_cal.base.cached import cached_property
from ceres_cal.base.words import first_of, two_digits
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics.alternatives import Family
from ceres_cal.diagnostics.findings import Amount, Finding, Wrong
from ceres_cal.diagnostics.labels import Mislabelling
from ceres_cal.diagnostics.leftover import Noise
from ceres_cal.diagnostics.scores import Score, Selection
from ceres_cal.diagnostics.table import ResidualTable, plane_shift
from ceres_cal.model.equations import Equations, whole_structure
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.structure import Structure
from ceres_cal.observations import Observations
from ceres_cal.solve import AsBuilt, Problem
from ceres_cal.solve.linear_model import LinearModel
from ceres_cal.solve.noise import Inliers

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
    model: LinearModel
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
    score: Score
    others: LinearModel
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
