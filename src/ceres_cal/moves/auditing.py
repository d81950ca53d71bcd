"""May the calibration of another program be trusted? Asked of observations, by what would have to change for it to
explain them.

Ours is fitted to the observations, with whichever lens explains them best. The other's cost stands so far above that
least one. Had it been made from as many observations as these, twice the difference would be twice a chi-square of as
many degrees as ours has free numbers; beyond that it is at fault. Then the least change that brings it down to such a
value is the cause that is named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError, InputError
from ceres_cal.base.numerical import numerical
from ceres_cal.base.tails import upper_tail
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Columns, Observations
from ceres_cal.observations.sights import gather_sights
from ceres_cal.posterior.uncertainty import field_grid
from ceres_cal.problem.bundle import solve
from ceres_cal.problem.parameters import Estimate, Layout, Options, Station
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.residuals import residuals
from ceres_cal.scene.camera import Camera, in_image
from ceres_cal.scene.heights import HEIGHTS_M, at_height

# How often a sound calibration is said to be at fault.
_FALSE_ALARMS = 0.005
_FAR = 1e3  # sigmas, of what a camera does not show at all
_LENSES = (("radial", (2, 3)), ("radial", (3,)), ("radial", (3, 5)), ("brown", (2, 3)), ("kannala-brandt", (2, 3)))
_SCALES = (0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 0.75, 4.0 / 3.0, 1.5, 2.0, 3.0, 4.0)


@dataclass(frozen=True, eq=False)
class StationAudit:
    """What observations say of one station of another program's calibration.

    Attributes:
        trusted: whether it explains them as well as another calibration of as many would.
        cause: None, or "another image size", "half a pixel", "swapped focal lengths", "moved", "too few coefficients",
            "other intrinsics". words: the answer, in a line.
        off_px: root mean square by which its picture is off beyond the noise. noise_px: that of the observations.
        off_mm: height_m -> root mean square and largest distance from where ours locates, over what it sees of the
            field; empty without a field. known_mm: how well ours knows that, root mean square.
        posed: whether it said where it stands; else the pose that is best for it was taken.
        ours: the calibration of the same observations.
    """

    station: str
    trusted: bool
    cause: str | None
    words: str
    off_px: float
    noise_px: float
    off_mm: dict[float, tuple[float, float]]
    known_mm: dict[float, float]
    posed: bool
    ours: Calibration


@numerical("the audit")
def audit(foreign: Calibration, observations: Observations) -> dict[str, StationAudit]:
    """Hold a calibration, ours or another program's, against observations of its stations.

    Args:
        foreign: see `formats.import_calibration`. A single station need not be named as in the observations.

    Raises:
        InputError: none of its stations was observed. CalibrationError: the observations determine no camera.
    """
    names = {name: name for name in observations.stations if name in foreign.stations}
    if not names and len(observations.stations) == len(foreign.stations) == 1:
        names = {next(iter(observations.stations)): next(iter(foreign.stations))}
    if not names:
        there, here = (", ".join(map(repr, one)) for one in (foreign.stations, observations.stations))
        raise InputError(f"the calibration has stations {there}, the observations {here}: name them alike")
    return {name: _audited(name, foreign.station(own), observations.of_station(name)) for name, own in names.items()}


# ---- one station ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _AuditCase:
    """One station's observations, those of them that count, and ours."""

    observations: Observations
    ours: Calibration
    problem: Problem

    @property
    def name(self) -> str:
        return next(iter(self.ours.stations))

    def least(self, camera: Camera, *, pose: bool, lens: tuple[int, ...] = ()) -> tuple[float, Camera]:
        """Twice the least cost with a camera, and the camera: its pose free, and these of its intrinsics."""
        estimate, owner = self._with(camera), next(iter(self.ours.cameras))
        free = self.problem.layout
        stations = free.stations if pose else frozenset()
        layout = Layout({owner: np.array(lens, dtype=np.int64)}, frozenset(stations), free.placements)
        if layout.size:
            problem = replace(self.problem, layout=layout)
            try:
                estimate = solve(problem, estimate, precision=1e-10, is_near=False).estimate
            except CalibrationError:  # quiet: a change that cannot be solved for costs more than any other
                return np.inf, camera
        return self._cost(estimate), estimate.camera_at(self.name)

    def _with(self, camera: Camera) -> Estimate:
        old = self.ours.estimate
        owner = next(iter(old.cameras))
        station = Station(owner, camera.cam_from_world)
        return replace(old, cameras={owner: camera.at(Pose.identity())}, stations={self.name: station})

    def _cost(self, estimate: Estimate) -> float:
        there = residuals(self.observations, self.problem.sights, estimate)
        total = 0.0
        columns: tuple[Columns, ...] = (self.observations.points, self.observations.curves)
        masks, scales = self.ours.inlier_masks(self.observations), self.ours.fit.scales
        for lengths, column, mask, scale in zip(there.lengths, columns, masks, scales, strict=True):
            sigmas = (lengths / (scale * column.sigma_px))[mask] if len(column) else np.empty(0)
            total += float(np.sum(np.minimum(np.nan_to_num(sigmas, nan=_FAR), _FAR) ** 2))
        return total


def _audited(name: str, given: Camera, observations: Observations) -> StationAudit:
    case = _case(observations, given)
    here = case.ours.station(name)
    tied = bool(case.problem.layout.stations)  # else only boards were seen, and the camera is the world
    posed = tied and not np.array_equal(given.cam_from_world.matrix, np.eye(3, 4))
    camera = given if posed else given.at(here.cam_from_world)
    best = case.least(here, pose=False)[0]
    free = case.problem.layout.free[next(iter(case.ours.cameras))]
    degrees = len(free) + (6 if posed else 0)
    cost, as_it_is = case.least(camera, pose=not posed)
    cause, words = (None, "") if _sound(cost - best, degrees) else _cause(case, camera, best, degrees, posed)
    size = case.ours.fit.points + case.ours.fit.curves
    noise = float(np.hypot(*case.ours.fit.noise_px))
    off_mm = _off_mm(as_it_is, here, case.ours)
    return StationAudit(
        name,
        cause is None,
        cause,
        _words(cause, words, off_mm, posed),
        noise * float(np.sqrt(max(cost - best, 0.0) / size)),
        noise,
        off_mm,
        _known_mm(case.ours),
        posed,
        case.ours,
    )


def _case(observations: Observations, given: Camera) -> _AuditCase:
    """Ours, with the lens that explains the observations best for the number of its coefficients."""
    found: list[tuple[float, Calibration]] = []
    failure: CalibrationError | None = None
    for kind, powers in dict.fromkeys([*_LENSES, (given.lens.kind, given.lens.powers or (2, 3))]):
        try:
            ours = calibrate(observations, Options(lens=kind, powers=powers, free_aspect=given.aspect != 1.0))
        except CalibrationError as error:  # quiet: the next lens is tried, and the failure raised where none is left
            failure = failure or error
            continue
        count = ours.fit.points * 2 + ours.fit.curves
        outliers = len(ours.outliers)  # each of them as a residual of five sigmas
        misfit = count * np.log(ours.fit.rms_px**2) + 25.0 * outliers
        found.append((misfit + len(ours.station().lens.names) * np.log(count), ours))
    if not found:
        raise failure or InputError("nothing was observed")
    ours = min(found, key=lambda one: one[0])[1]
    weighting = Weighting(*ours.fit.scales, "trivial")
    observations = ours.drawn_alike(observations)
    sights = gather_sights(observations)
    problem = ours.problem(observations)
    used = replace(problem, sights=sights, weighting=weighting, priors=())
    points, curves = ours.inlier_masks(observations)
    return _AuditCase(observations, ours, used.used(points, curves))


def _sound(rise: float, degrees: int) -> bool:
    """Whether a cost so far above the least is what two calibrations of as many observations show."""
    return upper_tail(0.5 * rise, degrees) >= _FALSE_ALARMS


# ---- what is wrong with it ------------------------------------------------------------------------------------------


def _cause(case: _AuditCase, camera: Camera, best: float, degrees: int, posed: bool) -> tuple[str, str]:
    """The least change after which the camera explains the observations, and what to do."""
    for cause, words, changed in _mistakes(camera, case.ours.station()):
        if _sound(case.least(changed, pose=not posed)[0] - best, degrees):
            return cause, words
    here = camera.at(case.ours.station().cam_from_world)
    if posed and _sound(case.least(here, pose=True)[0] - best, degrees - 6):
        return "moved", "it explains them from another place: refit it, or calibrate again"
    for cause, words, changed in _mistakes(here, case.ours.station()) if posed else ():
        if _sound(case.least(changed, pose=True)[0] - best, degrees - 6):
            return cause, f"{words}; and it has moved"
    used = [number for number, value in enumerate(camera.lens.values) if value != 0.0]
    within = (0, *((1,) if camera.aspect != 1.0 else ()), 2, 3, *(4 + number for number in used))
    refitted = case.least(here, pose=True, lens=within)[0]
    if not _sound(refitted - best, max(degrees - 6 - len(within), 1)):
        return "too few coefficients", "its lens model with the coefficients that it uses cannot explain them: " + (
            f"a {case.ours.station().lens.kind} lens does ({', '.join(case.ours.station().lens.names)})"
        )
    return "other intrinsics", "another zoom or lens, or it was calibrated from too little: calibrate again"


def _mistakes(camera: Camera, ours: Camera) -> Iterator[tuple[str, str, Camera]]:
    """What goes wrong between programs, what to do, and the camera with it undone."""
    cx, cy = camera.principal_point
    for shift in (-0.5, 0.5):
        moved = replace(camera, principal_point=(cx + shift, cy + shift))
        yield "half a pixel", f"with cx and cy {shift:+g} px it does: pixels were counted from a corner", moved
    if camera.aspect != 1.0:
        swapped = replace(camera, phi=camera.phi * camera.aspect, aspect=1.0 / camera.aspect)
        yield "swapped focal lengths", "with fx and fy swapped it does", swapped
    wide, high = ours.image_size
    scales = sorted(
        {wide / camera.image_size[0], *_SCALES} - {1.0}, key=lambda s: abs(np.log(s * camera.phi / ours.phi))
    )[:2]
    for scale in scales:
        yield (
            "another image size",
            f"it is one of images {scale:.3g} times as large",
            resized(camera, scale, (wide, high)),
        )


def resized(camera: Camera, scale: float, image_size: tuple[int, int]) -> Camera:
    """The camera of images that were scaled: a pixel's centre c goes to s (c + 1/2) - 1/2."""
    cx, cy = (scale * (c + 0.5) - 0.5 for c in camera.principal_point)
    lens = camera.lens
    if lens.acts_on_pixels:
        lens = lens.with_values([v * scale ** (1 - order) for v, order in zip(lens.values, lens.orders, strict=True)])
    return replace(camera, image_size=image_size, phi=scale * camera.phi, principal_point=(cx, cy), lens=lens)


# ---- how far it is off ----------------------------------------------------------------------------------------------


def _off_mm(camera: Camera, ours: Camera, calibration: Calibration) -> dict[float, tuple[float, float]]:
    off_mm = {}
    for height_m in HEIGHTS_M if _has_field(calibration) else ():
        x, y = (part.ravel() for part in np.meshgrid(*field_grid(calibration.targets)))
        pixels = ours.project(np.column_stack([x, y, np.full(len(x), height_m)]))
        pixels = pixels[in_image(pixels, ours.image_size)]
        off = 1e3 * np.linalg.norm(camera.locate(pixels, height_m) - ours.locate(pixels, height_m), axis=1)
        off = np.where(np.isfinite(off), off, np.inf)
        off_mm[height_m] = _root_mean_square(off), float(np.max(off, initial=0.0))
    return off_mm


def _known_mm(calibration: Calibration) -> dict[float, float]:
    if not _has_field(calibration) or calibration.posterior is None:
        return {}
    maps = {height_m: calibration.uncertainty.map_sd_mm(height_m=height_m).sd_mm for height_m in HEIGHTS_M}
    return {height_m: _root_mean_square(sd[np.isfinite(sd)]) for height_m, sd in maps.items()}


def _has_field(calibration: Calibration) -> bool:
    return any(not target.movable for target in calibration.targets.values())


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _words(cause: str | None, what_to_do: str, off_mm: dict[float, tuple[float, float]], posed: bool) -> str:
    sizes = [f"{rms:.2g} mm rms and {worst:.2g} mm at most {at_height(h)}" for h, (rms, worst) in off_mm.items()]
    placed = "" if posed else " (from the pose that is best for it: it says none)"
    if cause is None:
        off = f", within {', '.join(sizes)} of ours" if sizes else ""
        return f"explains the observations as well as a calibration of its own would{placed}{off}"
    off = f"; it is off by {', '.join(sizes)}" if sizes else ""
    return f"does not explain the observations{placed}: {cause}: {what_to_do}{off}"
