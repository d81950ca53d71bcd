"""Accuracy of a refit after a move: python scripts/run.py moves [--help]

A camera above half of a league's field is calibrated once with boards, then moved many times by 0.1 to 30 degrees and
1 mm to 1 m; every tenth move adds a rotation by 180 degrees. "yes": the limit is kept. "no": it is missed. Exits with 1
when a figure is missed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
from photos.shots import varied
from rendering.photograph import frames, photograph
from runner import Row, over, script, share_error
from scenery import board_scene, field_scene, join, overhead_pose

from accuracy.accuracy import map_errors_mm
from accuracy.odd_scenes import MOST_RADII
from accuracy.scenes import FIELD, field_places, without_noise
from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.base.words import HEIGHTS_M
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import detect_boards
from ceres_cal.detect.photographs import FieldOptions, check_photographs, detect_field
from ceres_cal.moves.refit_plan import make_plan, refit_problem
from ceres_cal.moves.refits import refit
from ceres_cal.observations import Observations, combine, taken
from ceres_cal.posterior.maps import locate_slopes, visible_pixels
from ceres_cal.problem.information import Key
from ceres_cal.problem.parameters import Estimate, Options
from ceres_cal.problem.problem import Weighting
from ceres_cal.problem.quantities import difference
from ceres_cal.problem.reduced import information
from ceres_cal.problem.structure import make_structure
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, Radial
from ceres_cal.scene.targets import checkerboard
from ceres_cal.simulate import Disturbance, Scene, Simulation, Station, simulate

CAMERA = Camera((1280, 960), 868.0, (646.5, 473.8), Radial((-5.2e-5, 6.1e-7)))
HOME = overhead_pose(-2.27, -0.12, 4.02, tilt_x_deg=1.8, tilt_y_deg=-2.4, yaw_deg=90.6)
MOVED = overhead_pose(-2.0, 0.06, 4.0, tilt_x_deg=-3.1, tilt_y_deg=1.2, yaw_deg=88.9)
NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3)
DAY = replace(NOISE, outliers=0.04, wrong_labels=0.01)
MOST_SIGMA = 5.0


@lru_cache(maxsize=8)
def calibrated(seed: int, disturbance: Disturbance = NOISE, boards: int = 12) -> Calibration:
    """The camera at its first pose, calibrated with the field and boards."""
    stations = {"overhead": Station("overhead", HOME)}
    scene = field_scene(FIELD, {"overhead": CAMERA}, stations, spacing_m=0.15)
    shown = board_scene(checkerboard(9, 6, 0.1), {"overhead": CAMERA}, stations, boards, seed=1)
    return calibrate(simulate(join(scene, shown), disturbance, seed).observations, Options(lens="radial"))


def seen(
    pose: Pose, disturbance: Disturbance, seed: int, spacing_m: float = 0.3, camera: Camera = CAMERA
) -> Simulation:
    """The field seen from a pose."""
    stations = {"overhead": Station("overhead", pose)}
    return simulate(field_scene(FIELD, {"overhead": camera}, stations, spacing_m=spacing_m), disturbance, seed)


def random_move(seed: int, home: Pose = HOME, camera: Camera = CAMERA) -> Pose:
    """A move by 0.1 to 30 degrees about any axis and 1 mm to 1 m in any direction, both uniform in the logarithm; one
    in ten adds a rotation by 180 degrees. The camera still sees a seventh of the field, which a refit needs.
    """
    rng = np.random.default_rng([seed, 7])
    while True:
        turn, shift = (direction / np.linalg.norm(direction) for direction in rng.standard_normal((2, 3)))
        turn = turn * np.deg2rad(np.exp(rng.uniform(*np.log([0.1, 30.0]))))
        shift = shift * np.exp(rng.uniform(*np.log([1e-3, 1.0])))
        rotation = rotation_exp(turn) @ home.rotation
        if rng.random() < 0.1:
            rotation = rotation_exp((0.0, 0.0, np.pi)) @ rotation
        pose = Pose.looking(home.position + shift, rotation)
        if _looks_at_field(camera.at(pose)):
            return pose


def _looks_at_field(camera: Camera) -> bool:
    x, y = field_places().T
    pixels = camera.project(np.column_stack([x, y, np.zeros(len(x))]))
    inside = np.all((pixels >= 0.0) & (pixels <= np.array(camera.image_size) - 1.0), axis=1)
    return bool(np.count_nonzero(inside) >= len(x) / 7)


def truth_of(calibration: Calibration, pose: Pose, camera: Camera = CAMERA) -> Estimate:
    """The truth as an estimate with the calibration's targets."""
    structure = make_structure(calibration.targets, {})
    return Estimate({"overhead": camera}, {"overhead": Station("overhead", pose)}, {}, structure)


def sigmas_off(calibration: Calibration, truth: Estimate) -> Array:
    """Error of every number in its own stated sigmas."""
    posterior = calibration.posterior
    assert posterior is not None
    return np.abs(difference(truth, calibration.estimate, posterior.keys)) / posterior.sd


# ---- moves ----------------------------------------------------------------------------------------------------------


def moves_case(runs: int) -> Iterator[Row]:
    """Whether moves are found, or refused with a message."""
    fresh = [calibrated(seed) for seed in range(8)]
    good, reported, silent, times, worst = 0, [], [], [], 0.0
    for seed in range(runs):
        pose, calibration = random_move(seed), fresh[seed % len(fresh)]
        observations = seen(pose, DAY, seed).observations
        begin = time.perf_counter()
        try:
            result = refit(calibration, observations)
        except CalibrationError as error:
            reported.append(f"{seed}: {error}")
            continue
        times.append(time.perf_counter() - begin)
        off = float(np.max(sigmas_off(result, truth_of(calibration, pose))))
        worst = max(worst, off)
        if off <= MOST_SIGMA:
            good += 1
        else:
            silent.append(f"{seed}: {off:.1f} sigma")
    note = "; ".join(reported[:3])
    yield Row("moves", "share within 5 sigma of the truth", good / runs, least=0.995, note=f"{runs} moves")
    yield Row("moves", "refused, with a reason", len(reported), note=note)
    yield Row("moves", "farther off, not refused", len(silent), most=0.0, note="; ".join(silent[:5]))
    yield Row("moves", "farthest number of all, sigma", worst)
    yield Row("moves", "time of a refit, ms (median)", 1e3 * float(np.median(times)))


# ---- from one picture, without options ------------------------------------------------------------------------------

STEEPNESS = {"weak": (0.0, 4.0), "tilted": (8.0, 20.0)}  # tilt in degrees: phi is hardly known, and is known


def of_one_picture(how: str, seed: int) -> tuple[Calibration, dict[float, tuple[Array, Array, Array]]]:
    """A refit of a camera that was calibrated from one picture by its lines and corners alone; and, for each height,
    its errors (N,) mm over the field, the stated standard deviations, and the 95 % radii.
    """
    rng = np.random.default_rng([seed, 11])
    lens = (CAMERA.lens, Brown((-0.2, 0.06, 3e-4, -2e-4, 0.0)))[seed % 2]
    camera = replace(CAMERA, phi=650.0, lens=lens)  # which sees all of the field

    def pose() -> Pose:
        x, y, height = rng.normal((0.0, 0.0, 5.2), 0.05).tolist()
        direction, tilt_deg = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*STEEPNESS[how])
        return overhead_pose(x, y, height, tilt_deg * np.cos(direction), tilt_deg * np.sin(direction), 90.0)

    before, after = pose(), pose()
    first, second = (seen(there, NOISE, seed, 0.2, camera).observations for there in (before, after))
    found = refit(calibrate(first), second)
    truth, errors = camera.at(after), {}
    for height_m in HEIGHTS_M:
        pixels = visible_pixels(truth_of(found, after, camera), "overhead", field_places(), height_m)
        pixels = pixels[np.isfinite(pixels[:, 0])]
        off = np.linalg.norm(found.station().locate(pixels, height_m) - truth.locate(pixels, height_m), axis=1)
        known = found.uncertainty.located(pixels, height_m=height_m)
        errors[height_m] = (1e3 * off, 1e3 * known.sd_m, 1e3 * known.radius_95_m)
    return found, errors


def _of_one_picture(how: str, runs: int) -> Iterator[Row]:
    """Whether the uncertainty that a refit states is correct at each height."""
    count = min(runs, 200)
    every = [errors for _, errors in over(partial(of_one_picture, how), range(count))]
    for height_m in HEIGHTS_M:
        off, sd, radius = (np.array(column, dtype=object) for column in zip(*(e[height_m] for e in every), strict=True))
        which, note = f"places at {1e3 * height_m:.0f} mm", f"{count} moves"
        held = float(np.mean(np.concatenate(off) <= np.concatenate(radius)))
        yield Row(how, f"{which} within their 95 % radius", held, 0.0, 0.9, 1.0, note)
        worst = [float(np.max(a / b)) for a, b in zip(off, radius, strict=True)]
        yield Row(how, f"{which} over 2.5 radii off, moves", int(np.sum(np.array(worst) > MOST_RADII)), most=0.0)
        error, stated = (float(np.sqrt(np.mean(np.concatenate(column) ** 2))) for column in (off, sd))
        yield Row(how, f"{which}, rms over stated", error / stated, note=f"{error:.2f} mm for {stated:.2f}")


def weak_case(runs: int) -> Iterator[Row]:
    """Phi is hardly known, so that the earlier knowledge is not described by a covariance alone."""
    return _of_one_picture("weak", runs)


def tilted_case(runs: int) -> Iterator[Row]:
    """Phi is known."""
    return _of_one_picture("tilted", runs)


# ---- against the Cramer-Rao bound -----------------------------------------------------------------------------------

TILTED = overhead_pose(-2.05, 0.1, 4.0, tilt_x_deg=-2.4, tilt_y_deg=1.8, yaw_deg=90.0)
CORNERS = ("TopLeftCorner", "BottomLeftCorner", "TopHalfwayCrossing", "BottomHalfwayCrossing")


def thinned(observations: Observations, points: Sequence[str], curves: int, seed: int) -> Observations:
    """The points with these names, and so many of the curve observations."""
    target = observations.targets["field"]
    wanted = [target.point_names.index(name) for name in points]
    p = np.flatnonzero(np.isin(observations.points.feature, wanted))
    picked = np.random.default_rng([seed, 3]).permutation(len(observations.curves))[:curves]
    return replace(
        observations,
        points=taken(observations.points, p),
        curves=taken(observations.curves, np.sort(picked)),
    )


def bound_of(calibration: Calibration, clean: Observations, pose: Pose) -> tuple[tuple[Key, ...], Array]:
    """Keys and covariance at the truth, from the data and the prior together."""
    truth = truth_of(calibration, pose)
    plan = make_plan(calibration, clean, "pose")
    problem, known = refit_problem(plan, "pose", truth)
    problem = replace(problem, layout=known, weighting=Weighting(1.0, 1.0, "trivial"))
    found = information(problem, truth).shared
    return found.keys, np.asarray(np.linalg.inv(found.matrix))


def bound_case(runs: int) -> Iterator[Row]:
    """Refits from 30 line points and 4 corners, compared with the bound and with calibrations of the new data alone."""
    count = min(runs, 200)
    places = field_places(half=True)
    squared: dict[float, list[tuple[float, float]]] = {height_m: [] for height_m in HEIGHTS_M}
    ours, scratch = [], []
    for seed in range(count):
        calibration = calibrated(seed)
        simulation = seen(TILTED, NOISE, seed, spacing_m=0.12)
        few = thinned(simulation.observations, CORNERS, 30, seed)
        pixels = thinned(without_noise(simulation), CORNERS, 30, seed)
        result = refit(calibration, few)
        truth = truth_of(calibration, TILTED)
        keys, covariance = bound_of(calibration, pixels, TILTED)
        for height_m, found in squared.items():
            shown = visible_pixels(truth, "overhead", places, height_m)
            shown = shown[np.isfinite(shown[:, 0])]
            slopes = locate_slopes(truth, keys, "overhead", shown, height_m)
            expected = np.einsum("nij,jk,nik->", slopes, covariance, slopes) / len(shown)
            off = result.station().locate(shown, height_m) - truth.camera_at("overhead").locate(shown, height_m)
            found.append((float(np.mean(np.sum(off**2, axis=1))), float(expected)))
        ours.append(float(np.mean(map_errors_mm(CAMERA.at(TILTED), result.station(), places, 0.15))))
        alone = _from_scratch(simulation.observations, seed)
        if alone is not None:
            scratch.append(float(np.mean(map_errors_mm(CAMERA.at(TILTED), alone.station(), places, 0.15))))
    for height_m, found in squared.items():
        error, expected = np.sqrt(np.mean(found, axis=0))
        spread = 0.5 * error / expected * np.std([a / b for a, b in found]) / np.sqrt(count)
        what = f"field error / bound at {1e3 * height_m:.0f} mm"
        note = f"{1e3 * error:.2f} mm rms, {count} runs"
        yield Row("30 line points, 4 corners", what, error / expected, float(spread), most=1.1, note=note)
    gain = float(np.median(scratch) / np.median(ours))
    note = f"mean error {np.median(ours):.2f} mm against {np.median(scratch):.2f} mm (medians)"
    yield Row("30 line points, 4 corners", "smaller than from scratch, 150 mm", gain, least=3.0, note=note)


def _from_scratch(observations: Observations, seed: int) -> Calibration | None:
    """A calibration from 200 line points (or as many as there are), without a prior for phi or height."""
    try:
        return calibrate(thinned(observations, (), 200, seed), Options(lens="radial"))
    except CalibrationError:
        return None


# ---- checks by photographs (by observations: checks.py) -------------------------------------------------------------

ALARMS = 0.01
SMALL_TILT = Pose.looking(HOME.position, rotation_exp((np.deg2rad(0.05), 0.0, 0.0)) @ HOME.rotation)
SMALL_SHIFT = Pose.looking(HOME.position + np.array([0.003, 0.0, 0.0]), HOME.rotation)

BOARD = checkerboard(9, 6, 0.1)
FIELD_SHOTS, BOARD_SHOTS, CHECKS = 2, 6, 10  # photographs of a calibration, and photographs to check it


def photographs_case(runs: int) -> Iterator[Row]:
    """Calibrations from photographs, checked by others with different light, noise and robots."""
    count = int(np.clip(runs // CHECKS, 1, 10))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        known = [_from_photographs(folder, seed) for seed in range(count)]
        false, noise = _photographed_alarms(known, HOME, CHECKS, 1, folder)
        total = count * CHECKS
        error = share_error(ALARMS, total)
        note = f"{total} photographs, {count} calibrations"
        yield Row("check by photographs", "false alarms at 1 %", false, error, most=0.01 + 3.0 * error, note=note)
        yield Row(
            "check by photographs", "noise of detection over that of the calibration", noise, least=0.8, most=1.25
        )
        for kind, what, pose in ((2, "0.05 deg of tilt found", SMALL_TILT), (3, "3 mm at 4 m found", SMALL_SHIFT)):
            found, _ = _photographed_alarms(known, pose, 2, kind, folder)
            yield Row("check by photographs", what, found, least=0.99, note=f"{2 * count} photographs")
        far = Pose.looking(HOME.position, rotation_exp((0.0, np.deg2rad(50.0), 0.0)) @ HOME.rotation)
        found, _ = _photographed_alarms(known[:2], far, 1, 4, folder)
        yield Row("check by photographs", "turned away by 50 deg: does not hold", found, least=1.0)


def _from_photographs(folder: Path, seed: int) -> Calibration:
    """The camera at home, calibrated with photographs of the field and of boards."""
    stations = {"overhead": Station("overhead", HOME)}
    boards = board_scene(BOARD, {"overhead": CAMERA}, stations, BOARD_SHOTS, seed=seed)
    shown = [_saved(folder, boards, frame, 100 * seed + i) for i, (_, frame) in enumerate(frames(boards))]
    fields = [_field_photograph(folder, HOME, 10_000 + 100 * seed + i) for i in range(FIELD_SHOTS)]
    lines = detect_field(fields, FIELD, CAMERA.at(HOME), options=FieldOptions("overhead")).observations
    return calibrate(combine([lines, detect_boards(shown, BOARD, "overhead").observations]), Options(lens="radial"))


def _field_photograph(folder: Path, pose: Pose, seed: int) -> Path:
    scene = field_scene(FIELD, {"overhead": CAMERA}, {"overhead": Station("overhead", pose)})
    return _saved(folder, scene, "0001", seed)


def _saved(folder: Path, scene: Scene, frame: str, seed: int) -> Path:
    path = folder / f"{frame}-{seed}.png"
    cv2.imwrite(str(path), photograph(scene, "overhead", frame, varied(seed), seed).image)
    return path


def _photographed_alarms(
    known: Sequence[Calibration], pose: Pose, each: int, kind: int, folder: Path
) -> tuple[float, float]:
    """Share of photographs by which a calibration is said not to hold, and the median of their noise."""
    alarms, noise = 0, []
    for number, calibration in enumerate(known):
        for i in range(each):
            path = _field_photograph(folder, pose, 100_000 * kind + 100 * number + i)
            found, _ = check_photographs(calibration, [path], false_alarms=ALARMS)
            alarms += not found.holds
            noise.append(found["overhead"].misfit.noise[1])
    return alarms / (len(known) * each), float(np.median(noise))


# ---- repeated refits, and their time --------------------------------------------------------------------------------

PHASES = """
import sys, time
marks = [time.perf_counter()]
import ceres_cal.moves
from ceres_cal.calibration import Calibration
from ceres_cal.observations import Observations, combine
marks.append(time.perf_counter())
old, new = Calibration.load(sys.argv[1]), Observations.load(sys.argv[2])
marks.append(time.perf_counter())
result = ceres_cal.moves.refit(old, new)
marks.append(time.perf_counter())
ceres_cal.moves.refit(old, new)
marks.append(time.perf_counter())
result.save(sys.argv[3])
marks.append(time.perf_counter())
print(*(b - a for a, b in zip(marks, marks[1:])))
"""


def time_case(runs: int) -> Iterator[Row]:
    """Time of `ceres-cal refit` as a whole process, and its parts."""
    count = int(np.clip(runs, 2, 9))
    with tempfile.TemporaryDirectory() as folder:
        old, new, out = (str(Path(folder) / name) for name in ("old.json", "new.json", "out.json"))
        calibrated(0).save(old)
        seen(MOVED, DAY, 1).observations.save(new)
        command = [sys.executable, "-c", "from ceres_cal.cli import main; raise SystemExit(main())"]
        whole, processor = [], []
        for _ in range(count):
            begin, used = time.perf_counter(), os.times()
            subprocess.run([*command, "refit", old, new, "-o", out], check=True, capture_output=True)
            whole.append(time.perf_counter() - begin)
            now = os.times()
            processor.append(now.children_user + now.children_system - used.children_user - used.children_system)
        note = f"processor {min(processor):.2f} s; the least of {count} runs"
        yield Row("time", "ceres-cal refit, cold, s", min(whole), most=1.5, note=note)
        parts = []
        for _ in range(count):
            done = subprocess.run([sys.executable, "-c", PHASES, old, new, out], check=True, capture_output=True)
            parts.append([float(part) for part in done.stdout.split()])
        imports, reading, first, again, writing = np.min(parts, axis=0)
        yield Row("time", "of it: imports (numpy, pyceres), s", imports)
        yield Row("time", "of it: what is loaded at the first one, s", first - again)
        yield Row("time", "of it: the refit itself, s", again)
        yield Row("time", "of it: reading and writing, s", reading + writing)


def again_case(runs: int) -> Iterator[Row]:
    """Refits of a refit with the same observations."""
    worst = 0.0
    count = min(runs, 100)
    for seed in range(count):
        observations = seen(random_move(seed), DAY, seed).observations
        first = refit(calibrated(seed % 8), observations)
        second = refit(first, observations)
        posterior = first.posterior
        assert posterior is not None
        change = difference(second.estimate, first.estimate, posterior.keys) / posterior.sd
        worst = max(worst, float(np.max(np.abs(change))))
    yield Row("again", "largest change of any number, sigma", worst, most=1e-3, note=f"{count} refits of refits")


CASES: dict[str, Callable[[int], Iterator[Row]]] = {
    "moves": moves_case,
    "weak": weak_case,
    "tilted": tilted_case,
    "bound": bound_case,
    "photographs": photographs_case,
    "again": again_case,
    "time": time_case,
}


main = script(CASES, __doc__, (1000, "simulated moves"))
