"""Quality of a calibration, gathered once for the commands' answers and for the report.

Includes how far known faults of the model move a result: places on the field, a camera's own numbers.

Also the further parts of a report: seams, the closed form beside the bundle adjustment, projected paint.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations, islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct

from ceres_cal.base import HEIGHTS_M, Array, CalibrationError, Frozen, Mask, attempt, cached_property, largest, replace
from ceres_cal.calibration import Calibration, LensChoice
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.diagnostics import Diagnosis, diagnose
from ceres_cal.effects.effect import Finding
from ceres_cal.effects.table import EFFECTS, JointStep
from ceres_cal.observations import Observations, gather_sights, thinned
from ceres_cal.posterior import FieldMap, ImageMap, Uncertainty, Verdict, locate_slopes, visible_pixels
from ceres_cal.problem import OF_PIXELS, Key
from ceres_cal.problem.residuals import residuals
from ceres_cal.scene import Camera, Target, curve_points

if TYPE_CHECKING:
    from ceres_cal.posterior.seam import Disagreement


def with_faults(
    known: Uncertainty, of: FieldMap, step: JointStep | None, faults: Sequence[Finding], doubtful_mm: float
) -> tuple[FieldMap, float]:
    """Return a map whose radii include faults, and the root mean square number of standard deviations by which these
    move its known places. A fault that is an effect of a camera displaces the image, and moves the camera's numbers.
    """
    within = 2.0  # ratio of the limit of a remaining fault to its root mean square
    moved_mm = np.zeros(of.shape)
    if step is not None and step.causes:
        pixels = visible_pixels(known.estimate, of.station, of.places, of.height_m)
        own = known.posterior.keys_of(known.estimate, of.station)
        slopes = locate_slopes(known.estimate, own, of.station, pixels, of.height_m)
        displaced = step.displaced(known.estimate.stations[of.station].camera, pixels)
        back = known.estimate.camera_at(of.station).locate(pixels - displaced, of.height_m)
        by_m = back - of.places + slopes @ _steps(step, own)
        moved_mm = 1e3 * np.linalg.norm(by_m, axis=1).reshape(of.shape)
    others = [fault.effect_mm for fault in faults if not _is_of_camera(fault)]
    moved_mm, left_mm = np.hypot(moved_mm, doubtful_mm), within * float(np.sqrt(np.nansum(np.square(others))))
    told = np.isfinite(of.sd_mm) & np.isfinite(moved_mm)
    moved, sd = (float(np.sqrt(np.sum(one[told] ** 2))) for one in (moved_mm, of.sd_mm))
    return replace(of, radius_95_mm=np.sqrt(of.radius_95_mm**2 + moved_mm**2 + left_mm**2)), moved / sd if sd else 0.0


def _is_of_camera(fault: Finding) -> bool:
    return fault.kind in EFFECTS and EFFECTS[fault.kind].displacement is not None


def sigmas_of_cameras(known: Uncertainty, step: JointStep | None) -> float:
    """Return the largest number of standard deviations by which faults move a number of a camera. Coefficients are
    ignored, since they trade off against one another.
    """
    keys, sd = known.posterior.keys, known.posterior.sd
    own = np.array([key.kind == "camera" and key.quantity in OF_PIXELS for key in keys], dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigmas = np.abs(_steps(step, keys)[own]) / sd[own]
    return float(np.nanmax(sigmas, initial=0.0))


def _steps(step: JointStep | None, keys: Sequence[Key]) -> Array:
    """(K,) how far the joint step moves some numbers."""
    moves = {} if step is None else step.moves
    return np.array([moves.get(key, 0.0) for key in keys])


def _by_number(known: Uncertainty | None) -> dict[tuple[str, str, str], Verdict]:
    """Verdicts by kind, owner and quantity."""
    return {} if known is None else {one.key[:3]: one for one in known.verdicts}


Seam = tuple[tuple[str, str], tuple[FieldMap, ...], "Disagreement"]
"""Disagreement of two stations: their names, the prediction at HEIGHTS_M, and that measured in what both observed."""


def quality_of(calibration: Calibration, observations: Observations) -> Quality:
    """Diagnose a calibration on its own observations, or on a sample if there are very many; not where nothing was
    minimised. If the diagnosis fails, the verdict says so.
    """
    diagnosed = 5_000  # number of observations for the answer of `calibrate`; `diagnose` and the report read all
    observations = calibration.as_taken(observations)
    if not calibration.rounds:
        return Quality(calibration, observations, None)
    few = thinned(observations, diagnosed)
    # reads: "Its residuals could not be judged. So it is not known whether the model is right: ..."
    found = attempt(lambda: diagnose(calibration, few, new_data=few is not observations))
    if isinstance(found, CalibrationError):
        return Quality(calibration, observations, None, str(found))
    return Quality(calibration, observations, found)


class Quality(Frozen):
    """A calibration, the observations beside it, and how well it is known.

    Attributes:
        diagnosis: diagnosis of the residuals; None where it failed, or nothing was minimised.
        undiagnosed: why it failed.
    """

    calibration: Calibration
    observations: Observations
    diagnosis: Diagnosis | None
    undiagnosed: str = ""

    @cached_property
    def uncertainty(self) -> Uncertainty | None:
        """Uncertainty of the calibration; None where nothing was minimised."""
        return None if self.calibration.posterior is None else self.calibration.uncertainty

    @cached_property
    def verdicts(self) -> dict[tuple[str, str, str], Verdict]:
        """Verdicts by kind, owner and quantity; numbers that were held have none."""
        return _by_number(self.uncertainty)

    @cached_property
    def undisputed(self) -> dict[tuple[str, str, str], Verdict]:
        """Verdicts without prior knowledge that is contradicted."""
        return _by_number(self.uncertainty and self.uncertainty.undisputed)

    @cached_property
    def fields(self) -> tuple[Target, ...]:
        """Targets in the world."""
        names = dict.fromkeys(view.target for view in self.observations.views if view.placement is None)
        return tuple(self.observations.targets[name] for name in names)

    @cached_property
    def placed(self) -> tuple[str, ...]:
        """Stations that are posed over a field."""
        if not self.fields:
            return ()
        return tuple(name for name in self.calibration.stations if ("station", name, "height") in self.verdicts)

    @cached_property
    def maps(self) -> dict[str, tuple[FieldMap, ...]]:
        """Maps of each placed station, at HEIGHTS_M."""
        if self.uncertainty is None:
            return {}
        return {name: tuple(self.uncertainty.map_sd_mm(name, h) for h in HEIGHTS_M) for name in self.placed}

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings of the diagnosis."""
        return () if self.diagnosis is None else self.diagnosis.findings

    @cached_property
    def faults(self) -> tuple[Finding, ...]:
        """Findings that the model is wrong, which no standard deviation includes."""
        return tuple(finding for finding in self.findings if finding.is_model_error)

    @property
    def _step(self) -> JointStep | None:
        return None if self.diagnosis is None else self.diagnosis.step

    @cached_property
    def faulty_maps(self) -> tuple[tuple[tuple[FieldMap, float], ...], ...]:
        """Maps of each placed station `with_faults`, at HEIGHTS_M."""
        if self.uncertainty is None:
            return ()
        return tuple(
            tuple(with_faults(self.uncertainty, one, self._step, self.faults, self.doubtful_mm) for one in maps)
            for maps in self.maps.values()
        )

    @property
    def doubtful_mm(self) -> float:
        """Largest offset, mm, that was estimated for a feature of a field, if a camera's faults are as large as the
        noise; else 0. The feature may then be in its nominal position, and the camera wrong there by this amount.
        """
        if sum(fault.noise_ratio**2 for fault in self.faults if _is_of_camera(fault)) < 1.0:
            return 0.0
        structure, targets = self.calibration.estimate.structure, self.observations.targets
        aside = zip(structure.names[: structure.own], structure.values.tolist(), strict=False)
        return 1e3 * max((abs(by) for name, by in aside if not targets[name.partition("/")[0]].movable), default=0.0)

    @cached_property
    def fault_sigmas(self) -> float:
        """Standard deviations by which faults move places on the fields, or, without any fields, a camera's numbers."""
        if self.uncertainty is None:
            return 0.0
        if not self.faulty_maps:
            return sigmas_of_cameras(self.uncertainty, self._step)
        return max(sigmas for maps in self.faulty_maps for _, sigmas in maps)

    @cached_property
    def observed_px(self) -> float:
        """Radius, px, that contains 95 % of image positions, whatever the pose, at the worst place in the box around
        what was observed, for the least known camera; NaN where nothing was minimised.
        """
        if self.uncertainty is None:
            return np.nan
        every = [_of_observed(self.uncertainty.map_px(name), self.observations) for name in self.calibration.cameras]
        return max(every, default=np.nan)

    def each_seam(self) -> Iterator[Seam]:
        """Yield the seams of stations of different cameras that both see some place."""
        owners = self.calibration.estimate.stations
        for pair in combinations(self.placed, 2):
            if self.uncertainty is None or owners[pair[0]].camera == owners[pair[1]].camera:
                continue
            maps = tuple(self.uncertainty.seam_sd_mm(*pair, height_m) for height_m in HEIGHTS_M)
            if not np.all(np.isnan(maps[0].sd_mm)):
                yield pair, maps, self.calibration.disagreement(self.observations, *pair)


def _of_observed(known: ImageMap, observations: Observations) -> float:
    """Largest radius in the box around a camera's observations, px."""
    views = np.array([view.camera == known.camera for view in observations.views])
    seen = [one.pixels[views[one.view]] for one in (observations.points, observations.curves)]
    pixels = np.concatenate(seen)
    if not len(pixels):
        return np.nan
    (left, top), (right, bottom) = pixels.min(axis=0), pixels.max(axis=0)
    columns, rows = (known.x_px >= left) & (known.x_px <= right), (known.y_px >= top) & (known.y_px <= bottom)
    return largest(known.radius_95_px[np.ix_(rows, columns)])


# ---- what a report is made of ---------------------------------------------------------------------------------------


class FramePhotographs(Struct, frozen=True, eq=False):
    """Photographs by the names of their frames and stations, and a calibration to compare with.

    Attributes:
        paths: frame, station -> image file.
        before: an earlier calibration, drawn in cyan; None for the closed form, if there is one.
    """

    paths: Mapping[tuple[str, str], Path]
    before: Calibration | None = None


class Material(Quality):
    """A calibration, observations, their diagnosis, and further inputs of a report.

    Attributes:
        choices: camera -> choice of its lens by held-out error. photographs: into which the model is drawn.
    """

    diagnosis: Diagnosis
    choices: Mapping[str, LensChoice] | None = None
    photographs: FramePhotographs | None = None

    @cached_property
    def placed(self) -> tuple[str, ...]:
        """Stations that are posed over a field, among those that the observations name."""
        placed = super().placed
        return tuple(name for name in self.observations.stations if name in placed)

    @cached_property
    def drawn_maps(self) -> dict[str, tuple[FieldMap, ...]]:
        """Maps on a finer grid for drawing; stated numbers are always those of `maps`."""
        return {name: tuple(self._finer(one) for one in maps) for name, maps in self.maps.items()}

    def _finer(self, one: FieldMap) -> FieldMap:
        finer = 2  # factor on the resolution of the maps' own grid, where that is fast
        uncertainty = self.calibration.uncertainty
        if self.observations.stations[one.station] in uncertainty.posterior.followed:  # each place takes long there
            return one
        x, y = (np.linspace(axis[0], axis[-1], finer * (len(axis) - 1) + 1) for axis in (one.x_m, one.y_m))
        return uncertainty.map_sd_mm(one.station, one.height_m, x, y)

    @cached_property
    def seams(self) -> tuple[Seam, ...]:
        """At most six seams; none for new data, which show nothing of how well the other cameras agree."""
        most_seams = 6
        return () if self.diagnosis.new_data else tuple(islice(self.each_seam(), most_seams))

    @cached_property
    def closed_form(self) -> tuple[Calibration, Array] | str:
        """The calibration of the same observations by the paper's own method, and the lengths (N,) px of its residuals,
        points first, NaN where it cannot show an observation; or the reason why there is none.
        """
        if self.diagnosis.new_data:
            return "these observations are others than those the calibration was made from"
        if not self.calibration.rounds:
            return "this calibration is the closed form itself"
        options = replace(self.calibration.options, closed_form_only=True)
        # reads: "..." in place of the paper's method
        calibration = attempt(lambda: calibrate(self.observations, options))
        if isinstance(calibration, CalibrationError):
            return str(calibration)
        remaining = residuals(gather_sights(self.observations), calibration.estimate)
        lengths = np.concatenate([np.linalg.norm(remaining.points, axis=1), np.abs(remaining.curves)])
        return calibration, lengths

    def of_camera(self, camera: str) -> Mask:
        """(N,) bool: rows of the residual table that a camera observed."""
        owners = np.array([view["camera"] == camera for view in self.diagnosis.table.views])
        return np.asarray(owners[self.diagnosis.table.view])

    def observed(self, station: str) -> Array:
        """(N, 2) px of a station's inliers, evenly thinned if there are many."""
        most_dots = 2000  # observations drawn into one map
        table = self.diagnosis.table
        seen = np.array([view["station"] == station for view in table.views])
        pixels = table.pixel[seen[table.view] & table.inlier]
        return np.asarray(pixels[:: -(-len(pixels) // most_dots) or 1])


def paint_of(targets: Iterable[Target]) -> Iterator[Array]:
    """Yield each curve of targets in the world as a polyline (S, 3) m."""
    curve_pieces = 95
    for target in targets:
        yield from (curve_points(curve, 0, curve_pieces) for curve in target.curves.values())


def image_border(camera: Camera, height_m: float) -> Array:
    """(B, 2) m, the border of a posed camera's image on a plane; NaN where a ray does not meet it."""
    border_steps = 60
    width, height = camera.image_size
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]]) - 0.5
    steps = np.linspace(0.0, 1.0, border_steps)[:, None]
    sides = [a + steps * (b - a) for a, b in pairwise(corners)]
    return camera.locate(np.concatenate(sides), height_m)
