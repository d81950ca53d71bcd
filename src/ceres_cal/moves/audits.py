"""May the calibration of another program be trusted? A test by observations: what would have to change for the
calibration to explain them.

Our own calibration is fitted to the observations, with the lens that explains them best. The statistic is how far the
other's cost is above this least cost. Had the other been made from as many observations, twice the difference would be
twice a chi-square of as many degrees as ours has free numbers; beyond that it is at fault. Then the least change that
reduces it to such a value is reported as the cause.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from ceres_cal.base import Array, CalibrationError, InputError, Pose, at_height, attempt, checked, numerical, upper_tail
from ceres_cal.base.frozen import Frozen, replace
from ceres_cal.base.words import IN_A_METRE, short
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.moves.agreement import Agreement, Agreements, MapChange, Misfit, change_of, field_grids
from ceres_cal.observations import Columns, Observations, gather_sights
from ceres_cal.posterior.maps import FieldGrid, field_map
from ceres_cal.problem import Estimate, Layout, Options, Problem, Station, Weighting, solve
from ceres_cal.problem.residuals import residuals
from ceres_cal.scene.camera import Camera

# Rate at which a sound calibration is reported to be at fault.
_FALSE_ALARMS = 0.005
_SCALES = (0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 0.75, 4.0 / 3.0, 1.5, 2.0, 3.0, 4.0)


@checked
@numerical("the audit")
def audit(foreign: Calibration, observations: Observations) -> Agreements:
    """Test a calibration, ours or another program's, by observations of its stations.

    The answer for a station has as its `cause` the least change that explains the observations ("another image size",
    "half a pixel", "swapped focal lengths", "another unit", "another focal length", "moved", "too few coefficients" or
    "other intrinsics"), as its `solution` our own calibration of the same observations, and as its `change` the change
    from that to the given camera, with the uncertainty of ours as the expected difference. `pose_free`: the calibration
    had no pose, and the best one was fitted.

    Args:
        foreign: see `formats.import_calibration`. A single station may have another name than in the observations.

    Raises:
        InputError: none of its stations was observed. CalibrationError: the observations determine no camera.
    """
    names = {name: name for name in observations.stations if name in foreign.stations}
    if not names and len(observations.stations) == len(foreign.stations) == 1:
        names = {next(iter(observations.stations)): next(iter(foreign.stations))}
    if not names:
        there, here = (", ".join(map(repr, one)) for one in (foreign.stations, observations.stations))
        raise InputError(f"the calibration has stations {there}, the observations {here}: name them alike")
    answers = {name: _audited(name, foreign.station(own), observations.of_station(name)) for name, own in names.items()}
    return Agreements(answers, _FALSE_ALARMS)


# ---- one station ----------------------------------------------------------------------------------------------------


class _AuditCase(Frozen):
    """Our calibration of one station's observations, and its problem with the inliers."""

    ours: Calibration
    problem: Problem

    @property
    def name(self) -> str:
        return next(iter(self.ours.stations))

    def least(self, camera: Camera, *, pose: bool, lens: tuple[int, ...] = ()) -> tuple[float, Camera]:
        """Return twice the least cost with a camera, and the camera; its pose may be free, and these intrinsics are."""
        estimate, owner = self._with(camera), next(iter(self.ours.cameras))
        free = self.problem.layout
        stations = free.stations if pose else frozenset()
        layout = Layout({owner: np.array(lens, dtype=np.int64)}, frozenset(stations), free.placements)
        if layout.size:
            problem = replace(self.problem, layout=layout)
            # quiet: a change that cannot be solved for costs more than any other
            solution = attempt(lambda: solve(problem, estimate, precision=1e-10, is_near=False))
            if isinstance(solution, CalibrationError):
                return np.inf, camera
            estimate = solution.estimate
        return self._cost(estimate), estimate.camera_at(self.name)

    def _with(self, camera: Camera) -> Estimate:
        old = self.ours.estimate
        owner = next(iter(old.cameras))
        station = Station(owner, camera.cam_from_world)
        return replace(old, cameras={owner: camera.at(Pose.identity())}, stations={self.name: station})

    def _cost(self, estimate: Estimate) -> float:
        far = 1e3  # sigmas, for observations that a camera does not show
        there, observations = residuals(self.problem.sights, estimate), self.problem.observations
        total = 0.0
        columns: tuple[Columns, ...] = (observations.points, observations.curves)
        masks, scales = self.ours.inlier_masks(observations), self.ours.fit.scales
        for lengths, column, mask, scale in zip(there.lengths, columns, masks, scales, strict=True):
            sigmas = (lengths / (scale * column.sigma_px))[mask] if len(column) else np.empty(0)
            total += float(np.sum(np.minimum(np.nan_to_num(sigmas, nan=far), far) ** 2))
        return total


def _audited(name: str, given: Camera, observations: Observations) -> Agreement:
    case = _case(observations, given)
    ours, here = case.ours, case.ours.station(name)
    tied = bool(case.problem.layout.stations)  # else only boards were seen, and the camera is the world
    posed = tied and not np.array_equal(given.cam_from_world.matrix, np.eye(3, 4))
    camera = given if posed else given.at(here.cam_from_world)
    best = case.least(here, pose=False)[0]
    free = case.problem.layout.free[next(iter(ours.cameras))]
    degrees = len(free) + (6 if posed else 0)
    cost, as_it_is = case.least(camera, pose=not posed)
    probability = _probability(cost - best, degrees)
    holds = probability >= _FALSE_ALARMS
    cause, what_to_do = (None, "") if holds else _cause(case, camera, best, degrees, posed)

    def known(grid: FieldGrid) -> Array:
        return field_map(ours.estimate, ours.uncertainty.posterior, name, grid).sd_mm

    # A camera that is the world has no pose over a field, even where its targets include one.
    grids = field_grids(ours.targets) if tied else []
    change = change_of(ours.estimate, name, as_it_is, grids, known if ours.posterior is not None else None)
    return Agreement(
        name=name,
        holds=holds,
        probability=probability,
        statistic=0.5 * max(cost - best, 0.0),
        degrees=degrees,
        words=_words(cause, what_to_do, change, posed),
        cause=cause,
        change=change,
        misfit=Misfit(ours.fit.points, ours.fit.curves, len(ours.outliers)),
        pose_free=not posed,
        solution=ours,
    )


def excess_px(one: Agreement) -> tuple[float, float]:
    """Return the root mean square error of an audited camera's picture beyond the noise, and the noise, px."""
    assert one.solution is not None
    fit = one.solution.fit
    noise = float(np.hypot(*fit.noise_px))
    return noise * float(np.sqrt(2.0 * one.statistic / (fit.points + fit.curves))), noise


def _case(observations: Observations, given: Camera) -> _AuditCase:
    """Calibrate with the lens that explains the observations best for the number of its coefficients."""
    lenses = (("radial", (2, 3)), ("radial", (3,)), ("radial", (3, 5)), ("brown", (2, 3)), ("kannala-brandt", (2, 3)))
    found: list[tuple[float, Calibration]] = []
    failure: CalibrationError | None = None
    for kind, powers in dict.fromkeys([*lenses, (given.lens.kind, given.lens.powers or (2, 3))]):
        # Targets are as drawn, because other programs take them so.
        own = Options(lens=kind, powers=powers, free_aspect=given.aspect != 1.0, as_built="as drawn")
        # quiet: the next lens is tried, and the failure raised where none is left
        tried = attempt(partial(calibrate, observations, own))
        if isinstance(tried, CalibrationError):
            failure = failure or tried
            continue
        fit, outliers = tried.fit, len(tried.outliers)  # each counts as a residual of five sigmas
        count = fit.points * 2 + fit.curves
        misfit = count * np.log(fit.rms_px**2) + 25.0 * outliers
        found.append((misfit + len(tried.station().lens.names) * np.log(count), tried))
    if not found:
        raise failure or InputError("nothing was observed")
    ours = min(found, key=lambda one: one[0])[1]
    weighting = Weighting(*ours.fit.scales, "trivial")
    observations = ours.as_taken(observations)
    sights = gather_sights(observations)
    problem = ours.problem(observations)
    used = replace(problem, sights=sights, weighting=weighting, priors=())
    points, curves = ours.inlier_masks(observations)
    return _AuditCase(ours, used.used(points, curves))


def _probability(rise: float, degrees: int) -> float:
    """Return the probability of a cost so far above the least, if both were made from as many observations."""
    return upper_tail(0.5 * rise, degrees)


def _sound(rise: float, degrees: int) -> bool:
    return _probability(rise, degrees) >= _FALSE_ALARMS


# ---- what is wrong with it ------------------------------------------------------------------------------------------


def _cause(case: _AuditCase, camera: Camera, best: float, degrees: int, posed: bool) -> tuple[str, str]:
    """Return the least change after which the camera explains the observations, and what to do."""
    for cause, words, changed in _mistakes(camera, case.ours.station()):
        if _sound(case.least(changed, pose=not posed)[0] - best, degrees):
            return cause, words
    unit, scaled = _in_metres(camera, case.ours.station())
    if case.least(scaled, pose=False)[0] < case.least(camera, pose=False)[0]:
        rest = case.least(scaled, pose=False)[0] - best
        besides = "" if _sound(rest, degrees) else f"; besides, {': '.join(_cause(case, scaled, best, degrees, posed))}"
        return "another unit", f"its position is in {unit}, it seems, and must be in metres{besides}"
    here = camera.at(case.ours.station().cam_from_world)
    if freed := _freed(case, camera, here, best, degrees, posed):
        return freed
    for cause, words, changed in _mistakes(here, case.ours.station()) if posed else ():
        if _sound(case.least(changed, pose=True)[0] - best, degrees - 6):
            return cause, f"{words}; and it has moved"
    used = [number for number, value in enumerate(camera.lens.values) if value != 0.0]
    within = (0, *((1,) if camera.aspect != 1.0 else ()), 2, 3, *(4 + number for number in used))
    refitted = case.least(here, pose=True, lens=within)[0]
    if not _sound(refitted - best, max(degrees - 6 - len(within), 1)):
        return "too few coefficients", "its lens model cannot explain them with the coefficients that it uses: " + (
            f"a {case.ours.station().lens.kind} lens can ({', '.join(case.ours.station().lens.names)})"
        )
    return "other intrinsics", "another zoom or lens, or it was calibrated from too little: calibrate again"


def _freed(
    case: _AuditCase, camera: Camera, here: Camera, best: float, degrees: int, posed: bool
) -> tuple[str, str] | None:
    """Return what explains it when freed: its focal length, else its pose, else both; None where none does."""
    zoomed = "it does with a focal length of {:.1f} px in place of {:.1f}"
    tried = [("another focal length", zoomed, camera, 1)]
    if posed:
        moved = "it explains them from another place: refit it, or calibrate again"
        tried += [("moved", moved, here, 6), ("another focal length", f"{zoomed}; and it has moved", here, 7)]
    for cause, words, start, let_go in tried:
        cost, there = case.least(start, pose=not posed or let_go > 1, lens=() if let_go == 6 else (0,))
        if _sound(cost - best, degrees - let_go):
            return cause, words.format(there.phi, camera.phi)
    return None


def _in_metres(camera: Camera, ours: Camera) -> tuple[str, Camera]:
    """Return the unit in which it is about as far from the origin as ours, and the camera with metres from that."""
    far = float(np.linalg.norm(camera.position) / np.linalg.norm(ours.position))
    unit = min(IN_A_METRE, key=lambda one: abs(np.log(far / IN_A_METRE[one])))
    pose = camera.cam_from_world
    return unit, camera.at(replace(pose, translation=pose.translation / IN_A_METRE[unit]))


def _mistakes(camera: Camera, ours: Camera) -> Iterator[tuple[str, str, Camera]]:
    """Yield mistakes that happen between programs, what to do, and the camera with each corrected."""
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
            f"it was made for images {short(1.0 / scale, 3)} times as large",
            resized(camera, scale, (wide, high)),
        )


def resized(camera: Camera, scale: float, image_size: tuple[int, int]) -> Camera:
    """Return the camera for scaled images: a pixel's centre c goes to s (c + 1/2) - 1/2."""
    cx, cy = (scale * (c + 0.5) - 0.5 for c in camera.principal_point)
    lens = camera.lens.with_values(np.array(camera.lens.values) / camera.lens.scales(scale))
    return replace(camera, image_size=image_size, phi=scale * camera.phi, principal_point=(cx, cy), lens=lens)


# ---- in words -------------------------------------------------------------------------------------------------------


def _words(cause: str | None, what_to_do: str, change: MapChange, posed: bool) -> str:
    sizes = [
        f"{short(one.rms_mm)} mm rms and {short(one.most_mm)} mm at most {at_height(one.height_m)}"
        for one in change.maps
    ]
    placed = "" if posed else " (from its best-fitting pose: its file has none)"
    if cause is None:
        off = f"; its map differs from the new one by {', '.join(sizes)}" if sizes else ""
        return f"explains the observations as well as a new calibration would{placed}{off}"
    off = f"; its map is off by {', '.join(sizes)}" if sizes else ""
    return f"does not explain the observations{placed}: {cause}: {what_to_do}{off}"
