"""The type of an effect: something that may displace the observations, with its columns over the equations and its
words.

Also the types of what is found: a finding with its cause, size and certainty; and what is solved for, targets as built
and other effects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, cached_property, distinct, first_of, replace, two_digits
from ceres_cal.effects.columns import EffectColumns, ScoreTest, Selection
from ceres_cal.effects.evidence import SizePrior
from ceres_cal.effects.linearised import Linearised
from ceres_cal.observations import Observations
from ceres_cal.problem import Estimate, Key, Kind, Problem, Structure, intrinsic_names, unit_px
from ceres_cal.problem.residuals import Equations, plane_shift, whole_structure
from ceres_cal.scene.camera import Camera

SMALL = 0.4
"""Ratio of an effect to the noise below which it shows only in many observations together, not in a single one."""
Wrong = Literal["model", "calibration", "observations"]


class Amount(Frozen, eq=True):
    """One number that would correct an effect: name, value, standard deviation and unit ("mm", "deg", "px", "")."""

    name: str
    value: float
    sd: float
    unit: str


def amounts(names: Iterable[str], values: Array, sd: Array, unit: str) -> tuple[Amount, ...]:
    """Several amounts of one unit."""
    return tuple(Amount(n, float(v), float(s), unit) for n, v, s in zip(names, values, sd, strict=False))


class AsBuilt(Frozen, eq=True):
    """The offsets of the features of one kind from a target's drawing.

    Attributes:
        target: its name. kind: "lines", "points", "warp", "heights" or "stretch". sigma_m: the standard deviation of
            the offsets under which they were solved for. probability: that they are off at all. rms_m: of the offsets.
        stretch: for a stretched board, by what share it is longer along x than along y, and the standard deviation that
            its size then has; None for all other kinds.
    """

    target: str
    kind: Kind
    sigma_m: float
    probability: float
    rms_m: float = 0.0
    stretch: tuple[float, float] | None = None

    @property
    def words(self) -> str:
        """The words for it, without the target."""
        if self.stretch is not None:
            longer, sd = self.stretch
            sides = "x than along y" if longer > 0.0 else "y than along x"
            return f"it is {100 * abs(longer):.2f} % longer along {sides}, and its size is known to {100 * sd:.2g} %"
        amount = f"{two_digits(1e3 * self.rms_m)} mm rms"
        if self.kind == "heights":
            return f"its surface is uneven by {amount}"
        return f"it is bowed by {amount}" if self.kind == "warp" else f"its {self.kind} are displaced by {amount}"


class EffectEstimate(Frozen, eq=True):
    """A group of an effect that was solved for, or a floor's effect that only widens the standard deviations.

    Attributes:
        kind, subject, frame: as in a `Finding`. sigma: the standard deviation of its amounts, in their own unit, under
            which they were solved for. probability: that there is such an effect.
        sentence: the effect in words. amounts: what was subtracted from the observations; both are empty if it only
            widens.
    """

    kind: str
    subject: str
    frame: str | None
    sigma: float
    probability: float
    sentence: str
    amounts: tuple[Amount, ...]

    @property
    def is_solved(self) -> bool:
        """Whether its amounts were solved for; if not, it only widens the standard deviations."""
        return bool(self.amounts)

    @property
    def warning(self) -> str:
        """The warning for users of the calibration."""
        return f"{self.sentence}; it was solved for"


ShiftsAt = Callable[[Estimate, Problem | None], tuple[Sequence[Key], Sequence[Array]]]
"""A function of an estimate and, if given, of another problem with its statements and held numbers. It returns keys,
and shifts of these numbers: the sum of their outer products is what effects add to the covariance.
"""


class Finding(Frozen, eq=True):
    """One cause of residuals that the calibration does not explain.

    Attributes:
        kind: of the effect or check. wrong: what is wrong: the model (no covariance of the parameters includes that),
            the calibration (a refit would correct it), or the observations, their labels or their noise.
        subject: a camera, a station, "target/feature", a board's target, "points" or "curves". frame: the name of the
            frame; None for a finding about all frames.
        sentence: the cause in words. advice: what to do.
        effect_px: root mean square displacement in the image of the observations concerned (for the lens: of what the
            calibration could not absorb); for noise its standard deviation, for a wrong label its distance.
        noise_ratio: effect_px over the noise of the same observations; below SMALL it shows only in many observations
            together.
        effect_mm: the displacement on the target's plane; NaN where the plane is seen edge-on.
        amounts: what would correct it.
        log10_p: decimal logarithm of the probability of a false alarm anywhere in the calibration, after Bonferroni.
        observations: the number of observations concerned. rows: (kind, row) of the observations of a wrong label.
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
        """Whether the model is wrong, so that no covariance includes the error."""
        return self.wrong == "model"


class Case(Frozen):
    """The problem in which effects are looked for, where its solve ended.

    Attributes:
        problem: of all the observations. model: its equations at the estimate, before any effect is added.
    """

    problem: Problem
    estimate: Estimate
    model: Linearised

    @property
    def equations(self) -> Equations:
        return self.model.equations

    @property
    def as_solved(self) -> Linearised:
        """The model with the equations that took part in the solve; `model` may use more of them."""
        return self.model

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
        """The structure with everything that could differ from its drawing."""
        return whole_structure(self.problem.observations.targets)

    @cached_property
    def slots(self) -> tuple[Indices, Indices]:
        """(E, BUILT) the offsets of that structure, and those of the estimate's own structure: see `Equations`."""
        return self.equations.slots(self.whole_structure), self.equations.slots(self.estimate.structure)

    def effect(self, shift: Array, rows: Mask) -> tuple[float, float, int]:
        """The effect of a displacement (E,) px on the observations of some equations: its root mean square in the
        image, px, and on their targets' planes, mm; and the number of these observations.
        """
        count = len(distinct(self.equations.observation[rows]))
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = plane_shift(self.equations, shift)
        twice = np.where(self.equations.is_curve, 1.0, 2.0)  # both equations of a point carry its whole shift in mm
        squared = np.nansum(((x**2 + y**2) / twice)[rows])
        return float(np.sqrt(np.sum(shift[rows] ** 2) / count)), float(np.sqrt(squared / count)), count

    def noise_px(self, left_over: Array, rows: Mask) -> float:
        """Root mean square (px) over observations of what is left over, (E,) in standard deviations."""
        count = len(distinct(self.equations.observation[rows]))
        return float(np.sqrt(np.sum((left_over / self.model.weight)[rows] ** 2) / count))

    def free_coefficients(self, camera: str) -> set[str]:
        """Names of the lens coefficients that are solved for."""
        lens = self.estimate.cameras[camera].lens
        names = intrinsic_names(lens)
        return {names[number] for number in self.problem.layout.free[camera]} & set(lens.names)


def half_diagonals(camera: Camera, pixels: Array) -> Array:
    """(N, 2) offsets of pixels (N, 2) from the principal point, in half image diagonals."""
    return np.asarray(camera.offsets(pixels) / unit_px(camera))


class Evidence(Frozen):
    """A group of an effect that the residuals support.

    Attributes:
        others: the model with the other chosen effects free. shift: (E,) px displacement. effect: see `Case.effect`.
        noise_ratio: the effect in px over the noise of the same observations.
    """

    case: Case
    score: ScoreTest
    others: Linearised
    shift: Array
    effect: tuple[float, float, int]
    noise_ratio: float

    @property
    def in_mm(self) -> tuple[Array, Array]:
        """Its amounts (Q,) and their standard deviations (Q,) in mm, if they are lengths."""
        return 1e3 * self.score.amount, 1e3 * self.score.sd

    def words(self, sentence: str, advice: str, names: Iterable[str] = (), unit: str = "px") -> Words:
        """The words of a finding: its size is added to the sentence; all amounts, by their names, would correct it."""
        values, sds = self.in_mm if unit in ("mm", "mrad") else (self.score.amount, self.score.sd)
        return Words(f"{sentence} ({self.size})", advice, amounts(names, values, sds, unit))

    @property
    def size(self) -> str:
        """The effect in words."""
        px, mm, _ = self.effect
        digits = 1 if mm >= 0.1 else 2
        return f"{px:.2f} px, {mm:.{digits}f} mm rms, {two_digits(self.noise_ratio)} times the noise"

    def most_px(self, rows: Mask | bool = True) -> float:
        """The largest displacement (px) among the chosen equations that take part."""
        return float(np.max(np.abs((self.shift * rows)[self.case.model.used])))


class Words(NamedTuple):
    """The words of a finding: its cause, the advice, and the amounts that would correct it."""

    sentence: str
    advice: str
    amounts: tuple[Amount, ...] = ()


Displaces = Callable[[Case, str, Array], Array | None]
"""A function of case, camera and pixels that returns a displacement, see `Effect`."""


def of_any_size(case: Case, camera: str) -> float:
    """The usual size of amounts for which no size is usual."""
    return np.inf


class Effect(Frozen):
    """A row of the table of effects: what may displace the observations besides the free numbers.

    Attributes:
        kind: its name. over: the columns over the equations, by case. words: what the finding about one group says.
            absorbed: whether its displacement is reported without what the calibration's free numbers could absorb.
            wrong: what is wrong where it is found, see `Finding`.
        built: the kind of a target's construction that `calibrate` solves for separately; "" for all other effects.
        displacement: for an effect of a camera on its picture, (N, 2, Q) px at its pixels (N, 2) per unit of its
            amounts; None where the camera solves for them.
        prior: the prior on the size of its amounts, in their own unit, if `calibrate` estimates it: it solves for the
            effect where that is likely, and else widens by it. reach: factor on that size for one group, from the size
            of its subject. concerns: whether the effect may displace any of the observations.
        usual: the usual size of its amounts by case and camera, where `calibrate` estimates none.
        together: combines the findings of several of its groups into those that are reported.
    """

    kind: str
    over: Callable[[Case], Iterator[EffectColumns]]
    words: Callable[[Evidence], Words]
    absorbed: bool = False
    wrong: Wrong = "model"
    built: str = ""
    displacement: Displaces | None = None
    prior: SizePrior | None = None
    reach: Callable[[EffectColumns, int, Case], float] = lambda columns, number, case: 1.0
    concerns: Callable[[Observations], bool] = lambda observations: True
    usual: Callable[[Case, str], float] = of_any_size
    together: Callable[[Sequence[Finding]], Iterable[Finding]] = tuple

    def columns(self, case: Case) -> Iterator[EffectColumns]:
        """The columns of the effect over the equations, with its kind."""
        for columns in self.over(case):
            yield replace(columns, kind=self.kind)

    def prior_of(self, columns: EffectColumns, number: int, case: Case) -> SizePrior | None:
        """The prior of one of its groups; None for a target as built whose tolerance is stated."""
        if self.prior is None or (self.built and columns.subjects[number] in case.problem.options.tolerances):
            return None
        return self.prior.times(self.reach(columns, number, case))

    def evidence(self, case: Case, score: ScoreTest, others: Linearised, left_over: Array) -> Evidence:
        """The evidence for one of its groups, beside other effects in a model; `left_over` (E,) is what all leave."""
        rows = np.any(score.columns != 0.0, axis=1) & case.model.used
        shift = score.columns @ score.amount
        if self.absorbed:
            shift = case.model.left_of_column(shift * case.model.weight) / case.model.weight
        effect = case.effect(shift, rows)
        return Evidence(case, score, others, shift, effect, effect[0] / case.noise_px(left_over, rows))

    def findings(self, case: Case, selection: Selection) -> Iterator[Finding]:
        """The findings of those of its groups that were chosen."""
        own = [number for number, score in enumerate(selection.chosen) if score.effect.kind == self.kind]
        yield from self.together([self._finding(case, selection, number) for number in own])

    def variances(self, case: Case, score: ScoreTest) -> Array:
        """(Q,) expected variances of the amounts of a group: what the residuals show, within limits from the usual
        size. A bow of 24 ± 26 mm moves a camera only by what floors usually have, not by 24 mm, and one of 150 ± 30 mm
        is something else that looks like it. Infinite where no size is usual.
        """
        most = 4.0  # largest size in usual sizes: 9 mm for a field of 9 m
        prior = self.prior_of(score.effect, score.number, case)
        usual = self.usual(case, score.subject) ** 2 if prior is None else float(np.mean(np.square(prior.sizes)))
        return np.clip(score.amount**2 - score.sd**2, usual, most**2 * usual)

    def is_implausible(self, case: Case, score: ScoreTest) -> bool:
        """Whether amounts that are clearly not 0 would be less than half as large under the expected size."""
        clear = 2.0  # standard deviations from which on an amount is clearly not 0
        return bool(np.any((np.abs(score.amount) > clear * score.sd) & (self.variances(case, score) < score.sd**2)))

    def _finding(self, case: Case, selection: Selection, number: int) -> Finding:
        chosen = selection.chosen
        score, others = chosen[number], case.model
        for other in (*chosen[:number], *chosen[number + 1 :]):
            others = others.with_columns(other.columns)
        evidence = self.evidence(case, score, others, selection.model.left_over)
        px, mm, observations = evidence.effect
        sentence, advice, mending = self.words(evidence)
        if score.rivals:
            names = first_of([f"{one.effect.kind} ({one.subject})" for one in score.rivals], 3)
            sentence += f"; these data do not distinguish it from {names}"
        if self.is_implausible(case, score):
            sentence += ". This is larger than usual, so a similar effect is the more probable cause"
        return Finding(
            self.kind, self.wrong, score.subject, score.frame, sentence, advice, px, mm, evidence.noise_ratio, mending,
            selection.log10_p(score.log_p), observations,
        )  # fmt: skip


def camera_effect(
    kind: str,
    displacement: Displaces,
    words: Callable[[Evidence], Words],
    usual: Callable[[Case, str], float] = of_any_size,
) -> Effect:
    """An effect of a camera on its picture."""
    over = partial(_over_cameras, displacement)
    return Effect(kind, over, words, absorbed=True, displacement=displacement, usual=usual)


def _over_cameras(displacement: Displaces, case: Case) -> Iterator[EffectColumns]:
    equations, group, parts = case.equations, case.camera.copy(), []
    for number, name in enumerate(case.cameras):
        own = np.flatnonzero(case.camera == number)
        first = np.diff(equations.observation[own], prepend=-1) != 0  # both equations of a point are at one pixel
        displaced = displacement(case, name, equations.pixel[own[first]])
        if displaced is None:
            group[own] = -1
        else:
            parts.append((own, np.einsum("ei,eik->ek", equations.direction[own], displaced[np.cumsum(first) - 1])))
    columns = np.zeros((len(equations), max((part.shape[1] for _, part in parts), default=1)))
    for own, part in parts:
        columns[own, : part.shape[1]] = part
    yield EffectColumns(columns, group, case.cameras)
