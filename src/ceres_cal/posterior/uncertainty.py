"""Everything a calibration can say of its own trustworthiness, under one name: `calibration.uncertainty`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array, median
from ceres_cal.base.cached import cached_property
from ceres_cal.base.errors import InputError
from ceres_cal.base.shown import Shown, html_of, text_of
from ceres_cal.base.typed import rows
from ceres_cal.base.words import at_precision, two_digits
from ceres_cal.posterior.image import ImageMap, image_map
from ceres_cal.posterior.maps import FieldGrid, FieldMap, PointSpread, field_map, spread_of_points
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.posterior.seam import RigPair, rig_pairs, seam_map
from ceres_cal.posterior.weak import Verdict, WeakDirection, ratio_sd, unknown_placements, verdicts, weak_directions
from ceres_cal.problem.parameters import Estimate
from ceres_cal.robust.stated import Conflict
from ceres_cal.scene.targets import Target

_GRID = 36  # steps along the longer side
_WIDENED = 1.1  # factor on standard deviations that is worth a word


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How well a calibration is known. It holds as far as the model does: see `Posterior`.

    Attributes:
        conflicts: what was stated and everything else contradicts.
    """

    estimate: Estimate
    posterior: Posterior
    targets: Mapping[str, Target]
    conflicts: tuple[Conflict, ...] = ()

    @property
    def _shown(self) -> Shown:
        numbers = []
        for one in self.verdicts:
            unit = "" if one.key.unit == "1" else f" {one.key.unit}"
            value = f"{at_precision(one.value, one.sd)} ± {two_digits(one.sd)}{unit}"
            numbers.append((f"{one.key.quantity} of {one.key.owner}", value, one.verdict))
        return f"Uncertainty of {len(numbers)} numbers (value ± standard deviation)", numbers

    def __repr__(self) -> str:
        return text_of(self._shown)

    def _repr_html_(self) -> str:
        return html_of(self._shown)

    @cached_property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Known, weak, unknown or in conflict, of each shared number."""
        return verdicts(self.estimate, self.posterior, self.conflicts)

    def table(self) -> list[dict[str, Any]]:
        """Each shared number as a row of a table: `pandas.DataFrame(known.table())`."""
        return [
            {
                "kind": one.key.kind,
                "owner": one.key.owner,
                "quantity": one.key.quantity,
                "unit": one.key.unit,
                "value": float(one.value),
                "sd": float(one.sd),
                "low": float(one.low),
                "high": float(one.high),
                "verdict": one.verdict,
            }
            for one in self.verdicts
        ]

    def verdict(self, kind: str, owner: str, quantity: str) -> Verdict:
        """Of one number.

        Raises:
            InputError: it is not a free number.
        """
        return self.verdicts[self.posterior.column(kind, owner, quantity)]

    @cached_property
    def weak_directions(self) -> tuple[WeakDirection, ...]:
        """What is hardly known, weakest first, in words."""
        return weak_directions(self.estimate, self.posterior)

    @cached_property
    def unknown_placements(self) -> dict[str, tuple[str, ...]]:
        """Placements of which some number is not known at all, and which."""
        return unknown_placements(self.posterior)

    @cached_property
    def rig(self) -> tuple[RigPair, ...]:
        """Baseline and angle between the first station and those of other cameras."""
        return rig_pairs(self.estimate, self.posterior)

    @property
    def widening(self) -> str:
        """Why standard deviations are larger than by the model alone, in a line; "" where they are not."""
        dependence, factor = self.posterior.dependence, median(self.posterior.factors)
        if dependence is None or not dependence.causes or factor < _WIDENED:
            return ""
        return f"{' and '.join(dependence.causes)}: standard deviations {two_digits(factor)} times as large as without"

    def ratio_sd(self, station: str) -> float:
        """Relative standard deviation of phi over the station's height."""
        return ratio_sd(self.estimate, self.posterior, self.estimate.stations[station].camera, station)

    def located(self, pixels: ArrayLike, height_m: float = 0.0, station: str | None = None) -> PointSpread:
        """Pixels (N, 2) located at a height, with 95 % bounds.

        Raises:
            InputError: see `map_sd_mm`.
        """
        name = self.estimate.station_name(station)
        return spread_of_points(self.estimate, self.posterior, name, rows(pixels, 2, "pixels"), height_m)

    def map_sd_mm(
        self,
        station: str | None = None,
        height_m: float = 0.0,
        x_m: ArrayLike | None = None,
        y_m: ArrayLike | None = None,
    ) -> FieldMap:
        """How well a station locates points at a height, over a grid; by default one over the field.

        Raises:
            InputError: no such station, none named where there are several, or it was held as the world.
        """
        name = self.estimate.station_name(station)
        return field_map(self.estimate, self.posterior, name, self._grid(height_m, x_m, y_m))

    def map_px(self, camera: str | None = None) -> ImageMap:
        """How well a camera knows its image, px, whatever its pose.

        Raises:
            InputError: no such camera, or none named where there are several.
        """
        if camera is None:
            (camera, *others) = self.estimate.cameras
            if others:
                raise InputError(f"which camera? One of {', '.join(self.estimate.cameras)}")
        return image_map(self.estimate, self.posterior, camera)

    def seam_sd_mm(
        self,
        first: str,
        second: str,
        height_m: float = 0.0,
        x_m: ArrayLike | None = None,
        y_m: ArrayLike | None = None,
    ) -> FieldMap:
        """By how much two stations may disagree about places that both see.

        Raises:
            InputError: see `map_sd_mm`.
        """
        return seam_map(self.estimate, self.posterior, (first, second), self._grid(height_m, x_m, y_m))

    def _grid(self, height_m: float, x_m: ArrayLike | None, y_m: ArrayLike | None) -> FieldGrid:
        """A grid over the box around what does not move, where x and y are not given.

        Raises:
            InputError: there is nothing that does not move.
        """
        field = field_grid(self.targets) if x_m is None or y_m is None else ()
        x, y = (field[axis] if given is None else given for axis, given in enumerate((x_m, y_m)))
        return FieldGrid(height_m, np.asarray(x, dtype=float), np.asarray(y, dtype=float))


def field_grid(targets: Mapping[str, Target]) -> tuple[Array, Array]:
    """x and y of a grid over the box around what does not move.

    Raises:
        InputError: there is nothing that does not move.
    """
    box = [target.box for target in targets.values() if not target.movable]
    if not box:
        raise InputError("no field to draw a map of: give x_m and y_m")
    low, high = np.min([b[0] for b in box], axis=0), np.max([b[1] for b in box], axis=0)
    spacing = float(np.max(high - low)) / _GRID
    counts = np.maximum(np.round((high - low) / spacing).astype(int) + 1, 2)
    x, y = (np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True))
    return x, y
