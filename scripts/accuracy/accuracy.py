"""Accuracy of calibrations compared with what the noise allows: python scripts/run.py accuracy [--help]

Every figure comes from simulated scenes. It is printed beside its limit and, if it is a mean, beside its standard
error. "yes": the limit is kept. "no": it is missed. "open": it is missed by less than two standard errors, so that more
runs are needed. Exits with 1 when a figure is missed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from benchmarks.problems import corner_observations, wide_lens
from runner import Row, mean_and_error, over, script

from accuracy.bound import attempts, best, bound, efficiency, make_trial
from accuracy.scenes import (
    CLEAN_NOISE,
    GROSS_NOISE,
    PROBLEMS,
    SSL_NOISE,
    SSL_PROBLEMS,
    SSL_VISION_MM,
    Problem,
    field_places,
    painted_by_six_stations,
    painted_by_two_cameras,
    small_boards,
)
from ceres_cal.base.arrays import Array
from ceres_cal.base.words import HEIGHTS_M
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.bundle import placement_costs
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.problem import Weighting
from ceres_cal.problem.quantities import moved
from ceres_cal.problem.structure import Tolerance
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Arc, Target
from ceres_cal.simulate import Disturbance, simulate

MOST_SIGMA = 4.0  # a mean that differs from 0 by more than this many of its standard errors is a bias
LEAST_GAIN = 1e-6  # share of a pose's cost that another pose must save to count as different
DIVERGED = 5.0  # multiple of the expected mean error which chance does not reach
TOLERANCES = {"field": Tolerance(lines_m=0.010)}
DRAWS = 4000  # from a covariance, for the median of a quantity that is not normally distributed


# ---- against the Cramer-Rao bound -----------------------------------------------------------------------------------


def efficiency_rows(case: str, problem: Problem, disturbance: Disturbance, most: float, runs: int) -> Iterator[Row]:
    """Squared error over the bound and over the best estimate from the same noise, the bias, and the failures."""
    found = efficiency(problem, disturbance, range(runs))
    numbers = f"{len(found.keys)} numbers, {len(found.squared)} runs"
    yield Row(case, "squared error / Cramer-Rao bound", *found.ratio, 2.0 - most, most, numbers)
    note = f"{found.rejected:.0f} observations taken out"
    yield Row(case, "its excess over the best on this noise", *found.excess, -np.inf, most - 1.0, note)
    sigmas, name = found.bias
    yield Row(case, "farthest bias, in its standard errors", sigmas, 0.0, -np.inf, MOST_SIGMA, name)
    yield Row(case, "runs without a calibration", found.failed, most=0.0)


def clean_case(names: Sequence[str], runs: int) -> Iterator[Row]:
    for name in names:
        yield from efficiency_rows(name, PROBLEMS[name](), CLEAN_NOISE, 1.05, runs)


def outliers_case(runs: int) -> Iterator[Row]:
    for name, problem in PROBLEMS.items():
        yield from efficiency_rows(f"{name}, 20 % outliers", problem(), GROSS_NOISE, 1.12, runs)


# ---- mirrored poses -------------------------------------------------------------------------------------------------


def mirrored_count(calibration: Calibration, observations: Observations, cam_from_board: Mapping[str, Array]) -> int:
    """Number of placements whose cost is lower after a search that starts from the true pose.

    Args:
        cam_from_board: placement -> true rotation (3, 3). The search starts with the middle of the board where it was
            found, since a mirrored pose has it in the same place.
    """
    sights = gather_sights(observations)
    weighting = Weighting(calibration.fit.point_scale, 1.0, calibration.options.loss, calibration.options.loss_scale)
    poses = calibration.estimate.pose_stack(sights.keys)
    rotations = np.array([cam_from_board[str(key.placement)] for key in sights.keys])
    middle = calibration.targets[observations.views[0].target].point_array.mean(axis=0)
    translations = poses[:, :, :3] @ middle + poses[:, :, 3] - rotations @ middle
    truly = np.concatenate([rotations, translations[:, :, None]], axis=2)
    there, _ = placement_costs(sights, calibration.estimate, weighting, truly)
    here, _ = placement_costs(sights, calibration.estimate, weighting, poses)
    return int(np.count_nonzero(there < here * (1.0 - LEAST_GAIN)))


def mirrored_case(runs: int, frames: int = 1000) -> Iterator[Row]:
    seeds = min(runs, 20)
    counts, rms = zip(*over(partial(_mirrored_wide, frames), range(seeds)), strict=True)
    note = f"of {seeds} x {frames}"
    yield Row("mirrored, wide lens", "mirrored poses", sum(counts), most=0.0, note=note)
    yield Row("mirrored, wide lens", "rms, px", float(np.mean(rms)), 0.0, 0.415, 0.419, "0.417 expected")
    small = sum(over(partial(mirrored_small, frames, CLEAN_NOISE), range(seeds)))
    yield Row("mirrored, small boards", "mirrored poses", small, most=0.0, note=note)


def _mirrored_wide(frames: int, seed: int) -> tuple[int, float]:
    problem = wide_lens(frames, seed)
    observations = corner_observations(problem.corners)
    calibration = calibrate(observations, Options(lens="brown"))
    rotations = {str(number): rotation for number, rotation in enumerate(problem.rotations)}
    return mirrored_count(calibration, observations, rotations), calibration.rms_px


def mirrored_small(frames: int, disturbance: Disturbance, seed: int) -> int:
    """The number of small boards, out of `frames`, whose pose ends mirrored."""
    simulation = simulate(small_boards(frames, seed), disturbance, seed)
    calibration = calibrate(simulation.observations, Options(lens="brown"))
    rotations = {name: pose.rotation for name, pose in simulation.scene.placements.items()}
    return mirrored_count(calibration, simulation.observations, rotations)


# ---- the scenes of ssl-vision's table -------------------------------------------------------------------------------


def map_errors_mm(truth: Camera, estimate: Camera, places: Array, height_m: float) -> Array:
    """Errors (N,) with which the estimate locates the places (N, 2) m that the image shows at this height."""
    world = np.column_stack([places, np.full(len(places), height_m)])
    pixels = truth.project(world)
    shown = np.all((pixels >= -0.5) & (pixels <= np.array(truth.image_size) - 0.5), axis=1)
    return np.asarray(1e3 * np.linalg.norm(estimate.locate(pixels[shown], height_m) - places[shown], axis=1))


def predicted_mm(problem: Problem, places: Array, height_m: float) -> Array:
    """Errors (DRAWS, N) of places predicted by the Cramer-Rao bound, with derivatives of the true camera's map."""
    trial = make_trial(problem, SSL_NOISE, 0)
    known = bound(trial)
    keys, covariance = known.keys, np.linalg.inv(known.matrix)
    (name,) = trial.truth.stations
    truth = trial.truth.camera_at(name)

    def located(step: Array) -> Array:
        return moved(trial.truth, keys, step).camera_at(name).locate(pixels, height_m)

    pixels = truth.project(np.column_stack([places, np.full(len(places), height_m)]))
    pixels = pixels[np.all((pixels >= -0.5) & (pixels <= np.array(truth.image_size) - 0.5), axis=1)]
    steps = 1e-3 * np.diag(np.sqrt(np.diag(covariance)))
    slopes = np.array([(located(s) - located(-s)) / (2.0 * s.max()) for s in steps])
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(len(keys)), covariance, DRAWS, method="cholesky")
    return np.asarray(1e3 * np.linalg.norm(np.einsum("sp,pnk->snk", draws, slopes), axis=2))


def median_and_error(values: Array, expected: Array) -> tuple[float, float]:
    """The median, and its standard error if the values have the expected distribution."""
    picks = np.random.default_rng(0).integers(len(expected), size=(500, len(values)))
    return float(np.median(values)), float(np.std(np.median(expected[picks], axis=1)))


def ssl_vision_case(runs: int) -> Iterator[Row]:
    for name, make in SSL_PROBLEMS.items():
        yield from ssl_vision_rows(name, make(), runs)


def ssl_vision_rows(name: str, problem: Problem, runs: int) -> Iterator[Row]:
    (truth,) = (problem.scene.camera_at(station) for station in problem.scene.stations)
    places = field_places(half=name.startswith("half"))
    ours, ideal = [], []
    for trial, calibration in attempts(problem, SSL_NOISE, range(runs)):
        if calibration is not None:
            ours.append(calibration.station())
            ideal.append(best(trial).camera_at(*calibration.stations))
    for height_m, others in zip(HEIGHTS_M, SSL_VISION_MM[name], strict=True):
        case = f"{name}, z = {1e3 * height_m:.0f} mm"
        limit = predicted_mm(problem, places, height_m)
        errors = np.array([map_errors_mm(truth, camera, places, height_m) for camera in ours])
        for what, measure, other, slack in (("mean", np.mean, others[0], 1.1), ("worst", np.max, others[1], np.inf)):
            expected, found = measure(limit, axis=1), measure(errors, axis=1)
            middle = float(np.median(expected))
            note = f"bound {middle:.2f}, first 20 seeds {np.median(found[:20]):.2f}, ssl-vision {other}"
            value = median_and_error(found, expected)
            yield Row(case, f"{what} field error, mm (median)", *value, most=slack * middle, note=note)
        means = np.mean(errors, axis=1)
        spared = np.array([np.mean(map_errors_mm(truth, camera, places, height_m)) for camera in ideal])
        excess = mean_and_error((means - spared) / np.mean(spared))
        yield Row(case, "its excess over the best on this noise", *excess, most=0.1)
        diverged = runs - np.count_nonzero(means < DIVERGED * np.mean(limit))
        yield Row(case, "runs that diverge", float(diverged), most=0.0, note=f"of {runs}")


# ---- the field as built ---------------------------------------------------------------------------------------------


def offset_errors_mm(calibration: Calibration, truth_m: Mapping[str, float], field: Target) -> Array:
    """Error of each number of the field as built, after the best-fitting shift, rotation and scale are removed."""
    structure = calibration.estimate.structure
    found = dict(zip(structure.names, structure.values.tolist(), strict=True))
    errors = np.array([found[f"field/{name}"] - value for name, value in truth_m.items()])
    whole = np.array([_moved_by_the_whole(name, field) for name in truth_m])
    return np.asarray(1e3 * (errors - whole @ np.linalg.lstsq(whole, errors, rcond=None)[0]))


def _moved_by_the_whole(name: str, field: Target) -> tuple[float, float, float, float]:
    """The change of one number of the field under a shift along x and y, a rotation and a scaling."""
    curve_name, _, part = name.partition(".")
    curve = field.curves[curve_name]
    if isinstance(curve, Arc):
        x, y, _ = curve.centre
        return {"x": (1.0, 0.0, -y, x), "y": (0.0, 1.0, x, y), "radius": (0.0, 0.0, 0.0, curve.radius_m)}[part]
    (dx, dy), (x, y) = np.subtract(curve.end, curve.start)[:2], 0.5 * np.add(curve.start, curve.end)[:2]
    nx, ny = -dy / np.hypot(dx, dy), dx / np.hypot(dx, dy)
    return nx, ny, x * ny - y * nx, x * nx + y * ny


def as_built_case(runs: int) -> Iterator[Row]:
    fields = min(runs, 40)
    case, note = "as built, six stations", f"{fields} fields"
    errors = np.array(list(over(_offsets_from_six_stations, range(fields))))
    yield Row(case, "rms error of an offset, mm", float(np.sqrt(np.mean(errors**2))), most=1.0, note=note)
    yield Row(case, "largest error of an offset, mm", float(np.max(np.abs(errors))), most=1.0, note=note)
    for heights in ("unknown", "known"):
        case = f"as built, two heights {heights}"
        found = np.array(
            list(over(partial(floor_errors_of_two_cameras, heights_known=heights == "known"), range(fields)))
        )
        yield Row(case, "mean field error, nominal field, mm", *mean_and_error(found[:, 0]), note=note)
        yield Row(case, "mean field error, tolerances, mm", *mean_and_error(found[:, 1]), note=note)
        yield Row(case, "tolerances less nominal, mm", *mean_and_error(found[:, 1] - found[:, 0]), most=0.0)


def _offsets_from_six_stations(seed: int) -> Array:
    painted = painted_by_six_stations(seed)
    calibration = calibrate(painted.observations, Options(lens="radial", tolerances=TOLERANCES))
    return offset_errors_mm(calibration, painted.offsets_m, painted.observations.targets["field"])


def floor_errors_of_two_cameras(seed: int, heights_known: bool) -> list[float]:
    """Mean field error (mm) with the nominal field and with tolerances, over the floor that each camera sees."""
    painted, means = painted_by_two_cameras(seed, heights_known), []
    for options in (Options(lens="radial"), Options(lens="radial", tolerances=TOLERANCES)):
        stations = calibrate(painted.observations, options).stations
        errors = [
            map_errors_mm(painted.scene.camera_at(name), camera, field_places(), 0.0)
            for name, camera in stations.items()
        ]
        means.append(float(np.mean(np.concatenate(errors))))
    return means


# ---- the cases ------------------------------------------------------------------------------------------------------

CASES: dict[str, Callable[[int], Iterator[Row]]] = {
    "boards": partial(clean_case, ("boards, radial", "boards, brown")),
    "field": partial(clean_case, ("field",)),
    "two-cameras": partial(clean_case, ("two cameras",)),
    "outliers": outliers_case,
    "mirrored": mirrored_case,
    "ssl-vision": ssl_vision_case,
    "as-built": as_built_case,
}


main = script(CASES, __doc__, (400, "simulated calibrations of each problem"), 2)
