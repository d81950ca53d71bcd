"""What a diagnosis finds: the cause by name, how large, how sure."""

from __future__ import annotations

from dataclasses import dataclass

OF_LENS = ("radius", "decentring", "aspect", "principal point", "phi")
MODEL_ERRORS = (*OF_LENS, "curve aside", "point aside", "board bent")
"""Kinds of findings that say the model is wrong: no covariance of the parameters contains them."""
MOTIONS = ("moved after", "moved in")
SMALL = 0.4
"""Beside the noise: an effect of less than this share of it does not show in a single observation, only in many."""


@dataclass(frozen=True)
class Amount:
    """One number that would mend it: its name, value, standard deviation and unit ("mm", "deg", "px", "")."""

    name: str
    value: float
    sd: float
    unit: str


@dataclass(frozen=True)
class Finding:
    """One cause of what is left over.

    Attributes:
        kind: "radius", "decentring", "aspect", "principal point" or "phi" (of a camera: subject), "curve aside",
            "point aside" ("target/feature") or "board bent" (target), "moved after", "moved in" (of a station: subject,
            at a frame), "wrong label" ("target/feature" as named), "does not hold"
            (on new data: stations), "noise" or "correlated" ("points" or "curves").
        subject: what it is about. frame: at which frame, None where it is about all.
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
        return self.kind in MODEL_ERRORS or self.kind in MOTIONS
