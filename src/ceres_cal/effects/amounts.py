"""What was solved for besides the camera: amounts with their standard deviations, targets as built, other effects."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ceres_cal.base.arrays import Array
from ceres_cal.base.words import two_digits
from ceres_cal.problem.structure import Kind


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
class AsBuilt:
    """By how much the features of one kind lie off a target's drawing.

    Attributes:
        target, kind: "lines", "points" or "warp". sigma_m: the standard deviation that their offsets were solved for
            under. probability: that they are off at all. rms_m: of the offsets.
    """

    target: str
    kind: Kind
    sigma_m: float
    probability: float
    rms_m: float = 0.0

    @property
    def words(self) -> str:
        """What it says, without the target."""
        amount = f"{two_digits(1e3 * self.rms_m)} mm rms"
        return f"it is bowed by {amount}" if self.kind == "warp" else f"its {self.kind} lie {amount} aside"


@dataclass(frozen=True)
class EffectEstimate:
    """A group of an effect that was solved for.

    Attributes:
        kind, subject, frame: which, as a `Finding` has them. sigma: the standard deviation of its amounts, in their
            own unit, that they were solved for under. probability: that there is such an effect.
        sentence: what it is, in words. amounts: what was taken off the observations.
    """

    kind: str
    subject: str
    frame: str | None
    sigma: float
    probability: float
    sentence: str
    amounts: tuple[Amount, ...]

    @property
    def warning(self) -> str:
        """What somebody must know who uses the calibration."""
        return f"{self.sentence}; it was solved for"
