"""What a report is made of, gathered once: maps, seams, the closed form beside the bundle, projected paint."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import CalibrationError
from ceres_cal.calibrating import calibrate
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics import Diagnosis
from ceres_cal.model.residuals import residuals
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import gather_sights
from ceres_cal.scene.curves import curve_points
from ceres_cal.scene.targets import Target
from ceres_cal.uncertainty import Disagreement, FieldMap, Uncertainty, Verdict

HEIGHTS_M = (0.0, 0.15)
"""Of the maps: the floor, and the top of a robot."""
_CURVE_PIECES = 95
_FINER = 2  # than the maps' own grid, where that is quick
_BORDER_STEPS = 60
_MOST_SEAMS = 6


@dataclass(frozen=True, eq=False)
class ClosedForm:
    """The paper's own method on the same observations.

    Attributes:
        calibration: its answer. lengths: (N,) px, of the residuals of every observation, points first; NaN where it
            cannot show one.
    """

    calibration: Calibration
    lengths: Array


@dataclass(frozen=True, eq=False)
class Seam:
    """What two stations disagree about: predicted at HEIGHTS_M, and found in what both observed."""

    first: str
    second: str
    maps: tuple[FieldMap, ...]
    found: Disagreement


@dataclass(frozen=True, eq=False)
class Material:
    """A calibration, observations, and what the residuals between them say."""

    calibration: Calibration
    observations: Observations
    diagnosis: Diagnosis

    @cached_property
    def known(self) -> Uncertainty | None:
        """How well everything is known; None where nothing was minimised."""
        return None if self.calibration.posterior is None else self.calibration.uncertainty

    @cached_property
    def verdicts(self) -> dict[tuple[str, str, str], Verdict]:
        """By kind, owner and quantity; what was held is not there."""
        return {} if self.known is None else {verdict.key[:3]: verdict for verdict in self.known.verdicts}

    @cached_property
    def fields(self) -> tuple[Target, ...]:
        """Targets that lie in the world."""
        names = dict.fromkeys(view.target for view in self.observations.views if view.placement is None)
        return tuple(self.observations.targets[name] for name in names)

    @cached_property
    def placed(self) -> tuple[str, ...]:
        """Stations that have a place over a field, of those that the observations name."""
        if not self.fields:
            return ()
        return tuple(name for name in self.observations.stations if ("station", name, "height") in self.verdicts)

    @cached_property
    def maps(self) -> dict[str, tuple[FieldMap, ...]]:
        """Of each placed station, at HEIGHTS_M."""
        if self.known is None:
            return {}
        return {name: tuple(self.known.map_sd_mm(name, h) for h in HEIGHTS_M) for name in self.placed}

    @cached_property
    def drawn_maps(self) -> dict[str, tuple[FieldMap, ...]]:
        """The same on the finer grid that is drawn; what is said in numbers is the maps' own, as everywhere."""
        return {name: tuple(self._finer(one) for one in maps) for name, maps in self.maps.items()}

    def _finer(self, found: FieldMap) -> FieldMap:
        known = self.calibration.uncertainty
        if self.observations.stations[found.station] in known.posterior.profiles:  # each place takes long there
            return found
        x, y = (np.linspace(axis[0], axis[-1], _FINER * (len(axis) - 1) + 1) for axis in (found.x_m, found.y_m))
        return known.map_sd_mm(found.station, found.height_m, x, y)

    @cached_property
    def seams(self) -> tuple[Seam, ...]:
        """Of stations of different cameras that see some place both, at most six."""
        return tuple(seam for seam, _ in zip(self._seams(), range(_MOST_SEAMS), strict=False))

    def _seams(self) -> Iterator[Seam]:
        if self.known is None or self.diagnosis.new_data:
            return
        cameras = self.observations.stations
        for first, second in combinations(self.placed, 2):
            if cameras[first] == cameras[second]:
                continue
            maps = tuple(self.known.seam_sd_mm(first, second, height_m) for height_m in HEIGHTS_M)
            if not np.all(np.isnan(maps[0].sd_mm)):
                yield Seam(first, second, maps, self.calibration.disagreement(self.observations, first, second))

    @cached_property
    def closed_form(self) -> ClosedForm | str:
        """The paper's method, or why there is none."""
        if self.diagnosis.new_data:
            return "these observations are others than those the calibration was made from"
        if not self.calibration.rounds:
            return "this calibration is the closed form itself"
        try:
            found = calibrate(self.observations, replace(self.calibration.options, closed_form_only=True))
        except CalibrationError as error:
            return str(error)
        left = residuals(self.observations, gather_sights(self.observations), found.estimate)
        return ClosedForm(found, np.concatenate([np.linalg.norm(left.points, axis=1), np.abs(left.curves)]))

    def border(self, station: str, height_m: float) -> Array:
        """(B, 2) m: the border of a station's image on a plane, NaN where it does not meet that."""
        camera = self.calibration.estimate.camera_at(station)
        width, height = camera.image_size
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]]) - 0.5
        steps = np.linspace(0.0, 1.0, _BORDER_STEPS)[:, None]
        sides = [a + steps * (b - a) for a, b in pairwise(corners)]
        return camera.locate(np.concatenate(sides), height_m)

    def of_camera(self, camera: str) -> Mask:
        """(N,) bool: rows of the residual table that a camera observed."""
        owners = np.array([view["camera"] == camera for view in self.diagnosis.table.views])
        return np.asarray(owners[self.diagnosis.table.view])

    def paint(self) -> Iterator[Array]:
        """Each curve of what lies in the world as a polyline (S, 3) m."""
        for target in self.fields:
            for curve in target.curves.values():
                yield curve_points(curve, 0, _CURVE_PIECES)
