"""What a diagnosis finds: the cause by name, how large, how sure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from ceres_cal.base.arrays import Array

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
