"""What a report is made of, gathered once: maps, seams, the closed form beside the bundle, projected paint."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
from msgspec import Struct

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import CalibrationError, attempt
from ceres_cal.base.frozen import cached_property, replace
from ceres_cal.calibration import Calibration, LensChoice
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.diagnostics import Diagnosis
from ceres_cal.observations.sights import gather_sights
from ceres_cal.posterior.maps import FieldMap
from ceres_cal.problem.residuals import residuals
from ceres_cal.report.quality import Quality, Seam
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import curve_points
from ceres_cal.scene.targets import Target


class ClosedForm(Struct, frozen=True, eq=False):
    """The paper's own method on the same observations.

    Attributes:
        calibration: its answer. lengths: (N,) px, of the residuals of every observation, points first; NaN where it
            cannot show one.
    """

    calibration: Calibration
    lengths: Array


class FramePhotographs(Struct, frozen=True, eq=False):
    """Photographs by the names of their frames and stations, and the calibration to compare with.

    Attributes:
        paths: frame, station -> image file. before: an earlier calibration, drawn in cyan; None for the closed form,
            where there is one.
    """

    paths: Mapping[tuple[str, str], Path]
    before: Calibration | None = None


class Material(Quality):
    """A calibration, observations, what the residuals between them say, and what was asked for besides.

    Attributes:
        choice: of lens, by held-out error. photographs: into which the model is drawn.
    """

    diagnosis: Diagnosis
    choice: LensChoice | None = None
    photographs: FramePhotographs | None = None

    @cached_property
    def placed(self) -> tuple[str, ...]:
        """Stations that have a place over a field, of those that the observations name."""
        placed = super().placed
        return tuple(name for name in self.observations.stations if name in placed)

    @cached_property
    def drawn_maps(self) -> dict[str, tuple[FieldMap, ...]]:
        """The same on the finer grid that is drawn; what is said in numbers is the maps' own, as everywhere."""
        return {name: tuple(self._finer(one) for one in maps) for name, maps in self.maps.items()}

    def _finer(self, one: FieldMap) -> FieldMap:
        finer = 2  # than the maps' own grid, where that is quick
        uncertainty = self.calibration.uncertainty
        if self.observations.stations[one.station] in uncertainty.posterior.followed:  # each place takes long there
            return one
        x, y = (np.linspace(axis[0], axis[-1], finer * (len(axis) - 1) + 1) for axis in (one.x_m, one.y_m))
        return uncertainty.map_sd_mm(one.station, one.height_m, x, y)

    @cached_property
    def seams(self) -> tuple[Seam, ...]:
        """At most six; none of new data, which say nothing of how well the others agree."""
        most_seams = 6
        return () if self.diagnosis.new_data else tuple(islice(self.each_seam(), most_seams))

    @cached_property
    def closed_form(self) -> ClosedForm | str:
        """The paper's method, or why there is none."""
        if self.diagnosis.new_data:
            return "these observations are others than those the calibration was made from"
        if not self.calibration.rounds:
            return "this calibration is the closed form itself"
        options = replace(self.calibration.options, closed_form_only=True)
        calibration = attempt(
            lambda: calibrate(self.observations, options)
        )  # reads: "..." in place of the paper's method
        if isinstance(calibration, CalibrationError):
            return str(calibration)
        remaining = residuals(gather_sights(self.observations), calibration.estimate)
        lengths = np.concatenate([np.linalg.norm(remaining.points, axis=1), np.abs(remaining.curves)])
        return ClosedForm(calibration, lengths)

    def of_camera(self, camera: str) -> Mask:
        """(N,) bool: rows of the residual table that a camera observed."""
        owners = np.array([view["camera"] == camera for view in self.diagnosis.table.views])
        return np.asarray(owners[self.diagnosis.table.view])

    def observed(self, station: str) -> Array:
        """(N, 2) px: where observations of a station lie that took part, evenly thinned where they are many."""
        most_dots = 2000  # observations drawn into one map
        table = self.diagnosis.table
        seen = np.array([view["station"] == station for view in table.views])
        pixels = table.pixel[seen[table.view] & table.inlier]
        return np.asarray(pixels[:: -(-len(pixels) // most_dots) or 1])


def paint_of(targets: Iterable[Target]) -> Iterator[Array]:
    """Each curve of targets that lie in the world as a polyline (S, 3) m."""
    curve_pieces = 95
    for target in targets:
        yield from (curve_points(curve, 0, curve_pieces) for curve in target.curves.values())


def image_border(camera: Camera, height_m: float) -> Array:
    """(B, 2) m: the border of a posed camera's image on a plane, NaN where it does not meet that."""
    border_steps = 60
    width, height = camera.image_size
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]]) - 0.5
    steps = np.linspace(0.0, 1.0, border_steps)[:, None]
    sides = [a + steps * (b - a) for a, b in pairwise(corners)]
    return camera.locate(np.concatenate(sides), height_m)
