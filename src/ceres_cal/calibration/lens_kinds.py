"""Each kind of lens near its best, and what follows for each of its lenses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.cached import cached_property
from ceres_cal.base.errors import CalibrationError, attempt
from ceres_cal.base.tails import upper_tail
from ceres_cal.calibration.lens_forms import AS_GOOD, CLEARLY, PAPER, Form, standard_errors, surprise
from ceres_cal.effects.groups import GroupNormals
from ceres_cal.problem.information import Key
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.quantities import moved, values_of

# Probability of what a lens leaves more than a longer one, under which it is no lens for these observations. At 0.01
# the paper's is missed more often, and seams in a carpet are decentring; at 0.001, by a scatter that one group could
# swell, halves of real sets took a lens too simple.
_REFUTED = 0.003
_NO_NOISE = 1e-12  # mean square that rounding leaves of exact observations, or less
_UNSEEN_GROUPS = 10.0  # so many that scatter as the noise has it stand beside those that were seen: a dozen vary


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of lens near its best, and what follows for each of its lenses.

    Attributes:
        forms: the longest first. normals: None where it gives no answer, and `failed` says why. sigma_px: of a typical
            observation. reach_px: how far from its principal point each camera's observations reach.
    """

    forms: tuple[Form, ...]
    estimate: Estimate
    normals: GroupNormals | None = None
    sigma_px: float = np.nan
    reach_px: Mapping[str, float] = field(default_factory=dict)
    failed: str = ""

    @property
    def least(self) -> float:
        """The least squares of its longest lens."""
        return np.inf if self.normals is None else self.normals.least

    def candidates(self, *, first: bool) -> Iterator[Candidate]:
        """The longest lens of the kind and the paper's, or all others."""
        for form in self.forms:
            if first == (form is self.forms[0] or form.label == PAPER):
                yield self._judged(form)

    def _judged(self, form: Form) -> Candidate:
        """A lens with its errors of prediction."""
        if self.normals is None:
            return Candidate(form, self, failed=self.failed)
        lens = set(self.forms[0].names) - set(form.names)
        squares, step = self.normals.held_out({key: step for key, step in self._to_nothing.items() if key[2] in lens})
        rms_px = self.sigma_px * float(np.sqrt(squares.sum() / self.normals.counts.sum()))
        least = self.normals.squares_at(step)
        return Candidate(form, self, surprise(squares, self.normals.counts), rms_px, step, least)

    @cached_property
    def _to_nothing(self) -> dict[Key, float]:
        """How far from where they stand the coefficients of its longest lens are 0."""
        names = set(self.forms[0].names)
        keys = (
            [key for key in self.normals.keys if key.kind == "camera" and key.quantity in names] if self.normals else []
        )
        return dict(zip(keys, (-values_of(self.estimate, keys)).tolist(), strict=True))

    @cached_property
    def noise(self) -> float:
        """Mean square of what it leaves, over the stated noise: 1 at most, for a first solve with another lens may have
        left more.
        """
        if self.normals is None:
            return 1.0
        spare = float(self.normals.counts.sum() - len(self.normals.keys))
        return min(1.0, max(self.least / max(spare, 1.0), _NO_NOISE))

    @cached_property
    def scatter(self) -> float:
        """Mean of the variances of its coefficients as groups scatter, over those by the stated noise; at least what
        noise alone makes of it, and the nearer to that the fewer groups there are.
        """
        if self.normals is None:
            return 1.0
        names = set(self.forms[0].names)
        own = [i for i, key in enumerate(self.normals.keys) if key.kind == "camera" and key.quantity in names]
        groups = len(self.normals.counts)
        more = self.normals.scatter_of(np.array(own)) - self.noise
        return self.noise + max(0.0, more) * groups / (groups + _UNSEEN_GROUPS)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A lens and its errors of prediction.

    Attributes:
        squares: (G,) of each group, in standard deviations; None where it gives no answer, and `failed` says why.
        rms_px: of all. step: from the kind's estimate to where this lens is at its best. least: all squares there.
    """

    form: Form
    of: Kind
    squares: Array | None = None
    rms_px: float = np.nan
    step: Array = field(default_factory=lambda: np.empty(0))
    least: float = np.nan
    failed: str = ""

    def refutes(self, other: Candidate) -> bool:
        """Whether the other lens, which has fewer numbers, leaves more than it may by chance."""
        more = self.form.size - other.form.size
        if more <= 0 or self.squares is None:
            return False
        left, known = other.least - self.least, len(self.squares) + _UNSEEN_GROUPS
        # Seldom does it leave more than the noise alone explains, which takes less to know.
        by_noise = upper_tail(left / self.of.noise, more, known) < _REFUTED
        return by_noise and upper_tail(left / self.of.scatter, more, known) < _REFUTED

    def may_win(self, best: Candidate | None) -> bool:
        """Whether it is the longest of a kind whose shorter ones may be as good as the best."""
        if self.form is not self.of.forms[0] or self.of.normals is None:
            return False
        if best is None or best.squares is None or self.squares is None:
            return True
        return standard_errors(self.squares, best.squares) <= AS_GOOD

    def clearly_beats(self, other: Candidate) -> bool:
        """Whether it predicts so much better that a lens which few programs know is worth it."""
        if self.squares is None or other.squares is None or self.fault:
            return False
        return standard_errors(other.squares, self.squares) > AS_GOOD and self.rms_px < CLEARLY * other.rms_px

    @cached_property
    def estimate(self) -> Estimate:
        """Near its best.

        Raises:
            InputError: there is no camera there.
        """
        there = moved(self.of.estimate, self.of.normals.keys if self.of.normals else (), self.step)
        blank = self.form.blank
        cameras = {}
        for name, camera in there.cameras.items():
            values = camera.lens.coefficients
            lens = blank.with_values([values[n] if n in self.form.names else 0.0 for n in blank.names])
            cameras[name] = replace(camera, lens=lens)
        return replace(there, cameras=cameras)

    @cached_property
    def fault(self) -> str:
        """Why it cannot be used, "" where it can."""
        there = attempt(lambda: self.estimate)  # reads: "..." beside that lens, why it failed
        if isinstance(there, CalibrationError):
            return str(there)
        for name, reach_px in self.of.reach_px.items():
            camera = there.cameras[name]
            if camera.folds and (not camera.lens.may_fold or camera.lens.monotone_radius(camera.phi) <= reach_px):
                return "folds inside the image"
        return ""
