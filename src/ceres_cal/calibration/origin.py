"""How a calibration came about: its fit, what was taken out, what it is a refit of, and by which packages."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from ceres_cal.base.version import __version__
from ceres_cal.problem import solver_version
from ceres_cal.problem.priors import GaussianPrior

COPY = "a copy"
"""How the reason begins of an observation that repeats another one, and was not taken out for its residual."""


@dataclass(frozen=True)
class Rejected:
    """One observation that was taken out: its permanent id (kind and row), what it shows, and why it was taken out."""

    kind: str
    row: int
    frame: str
    feature: str
    reason: str

    @property
    def is_of_whole(self) -> bool:
        """Whether it was taken out with all others of its line, frame or placement; the reason then says which."""
        return self.reason.startswith("the whole of ")


_TOO_FEW = "the observations are too few to compare lenses by"
_NOT_THE_BEST = (
    "the lens that predicts best makes no calibration of all observations; {}, which was taken, predicts {:.1f} "
    "standard errors worse, and its map may be off by more than is stated: name another lens (--lens)"
)
_NOT_CHOSEN = (
    "no lens could be chosen ({}), and {} was taken: what is stated holds only if the camera has it: name its lens "
    "(--lens)"
)


@dataclass(frozen=True)
class TriedLens:
    """A lens that was compared with others.

    Attributes:
        label: kind with powers or free coefficients. coefficients: how many are free.
        rms_px: of the errors with which views or features are predicted by all others; None where there is no answer.
        worse: by how many standard errors of the paired difference it predicts worse than the one that was chosen.
        failed: why there is no answer, "" where there is.
        probability: that it is the one that predicts best; None where there is no answer, and in files of before.
    """

    label: str
    coefficients: int
    rms_px: float | None = None
    worse: float | None = None
    failed: str = ""
    probability: float | None = None


@dataclass(frozen=True)
class LensChoice:
    """Which lens was chosen, over what, and by how much.

    Attributes:
        chosen: its label. tried: every lens that was compared, the chosen one first, then as they predict.
        groups: views, placements or features that were held out in turn. share: of the observations that took part.
    """

    chosen: str
    tried: tuple[TriedLens, ...]
    groups: int
    share: float

    @property
    def words(self) -> str:
        """In a line."""
        if not self.groups:
            return f"{self.chosen}, the paper's: {self.tried[0].failed or _TOO_FEW}"
        others = [one for one in self.tried if one.worse is not None and one.label != self.chosen]
        if not others or self.tried[0].rms_px is None:
            return f"{self.chosen}, the only one that can be calibrated"
        over = ", ".join(f"{one.label} {one.rms_px:.4f} px ({one.worse:+.1f})" for one in others[:3])
        return (
            f"{self.chosen} of {len(self.tried)}: predicts {self.groups} held-out parts to {self.tried[0].rms_px:.4f} "
            f"px; next {over} (standard errors by which they predict worse)"
        )

    @property
    def caveat(self) -> str:
        """What speaks against the lens that was taken, "" where nothing does."""
        taken = self.tried[0]
        if taken.worse:
            return _NOT_THE_BEST.format(taken.label, taken.worse)
        return _NOT_CHOSEN.format(taken.failed, taken.label) if taken.failed else ""


@dataclass(frozen=True)
class Fit:
    """How well the observations fit.

    Attributes:
        points, curves: numbers of observations that took part.
        points_rms_px: root mean square length of the points' residual vectors, of those that took part (OpenCV's rms).
            curves_rms_px: the same of the distances to the curves. They say how consistent the data are with the model,
            not how well the camera is known.
        point_scale, curve_scale: estimated factors on the stated sigmas.
        unknowns: free numbers.
        point_sigma_px, curve_sigma_px: root mean square of the stated sigmas of those that took part; None in files of
            0.1, which do not have them.
    """

    points: int
    curves: int
    points_rms_px: float
    curves_rms_px: float
    point_scale: float
    curve_scale: float
    unknowns: int
    point_sigma_px: float | None = None
    curve_sigma_px: float | None = None

    @property
    def noise_px(self) -> tuple[float, float]:
        """Standard deviations of each coordinate of a point and of the distance to a curve, px; 0 of what nobody saw.

        Where the stated sigmas are not known, from the residuals, as if every equation determined as much as any other.
        """
        if self.point_sigma_px is not None and self.curve_sigma_px is not None:
            return self.point_scale * self.point_sigma_px, self.curve_scale * self.curve_sigma_px
        spare = max(1.0 - self.unknowns / max(2 * self.points + self.curves, 1), 1e-3)
        return self.points_rms_px / (2.0 * spare) ** 0.5, self.curves_rms_px / spare**0.5

    @property
    def scales(self) -> tuple[float, float]:
        """Noise scales of points and of curves."""
        return self.point_scale, self.curve_scale

    @property
    def rms_px(self) -> float:
        """Root mean square residual over points and curves together."""
        total = self.points * self.points_rms_px**2 + self.curves * self.curves_rms_px**2
        return float((total / max(self.points + self.curves, 1)) ** 0.5)


@dataclass(frozen=True, eq=False)
class Refitted:
    """How a calibration came from an earlier one.

    Attributes:
        what: was free, one of `moves.WHAT`. moved: stations whose poses were sought.
        explanation: what the observations say has happened, in words.
        prior: what was known beforehand of everything that was carried over.
        scales: noise scales of points and curves of the calibration before.
        digests: of the observations that are in the prior.
    """

    what: str
    moved: tuple[str, ...]
    explanation: str
    prior: GaussianPrior
    scales: tuple[float, float]
    digests: tuple[str, ...]


@cache
def package_versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    return {"ceres-cal": __version__, "pyceres": solver_version, "numpy": np.__version__}
