"""The measurements of `constants.py`: small, fast scenes whose figures show what a constant decides."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from photos.auto import FACING, VIEWS, near, outcome, searched, take_view
from photos.shots import Shot, clicks, distances_px, floor_error_mm, hidden_places, off_by, take, turned, varied
from rendering.photograph import frames, photograph
from scenery import BoardRanges, board_scene, overhead_pose

from accuracy.accuracy import mirrored_small
from accuracy.bound import attempts, efficiency
from accuracy.diagnostic_scenes import CLEAN, FAULTS
from accuracy.false_alarms import diagnosed
from accuracy.lens_choice import LENSES, SCENES, choices
from accuracy.moves import (
    ALARMS,
    CAMERA,
    CORNERS,
    DAY,
    HOME,
    MOST_SIGMA,
    NOISE,
    SMALL_SHIFT,
    SMALL_TILT,
    TILTED,
    calibrated,
    random_move,
    seen,
    sigmas_off,
    thinned,
    truth_of,
)
from accuracy.scenes import CLEAN_NOISE, GROSS_NOISE, PROBLEMS, tilted
from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import detect_boards
from ceres_cal.detect.photographs import Auto
from ceres_cal.detect.photographs.by_hand import starts_from_clicks
from ceres_cal.detect.photographs.follow import follow
from ceres_cal.detect.rings import detect_rings
from ceres_cal.diagnostics.advice import advise
from ceres_cal.moves.checks import check
from ceres_cal.moves.comparisons import compare
from ceres_cal.moves.refits import refit
from ceres_cal.observations import Observations, taken
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.quantities import difference
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import KannalaBrandt, Radial
from ceres_cal.scene.targets import checkerboard, ssl_field
from ceres_cal.simulate import Station, built_in_scene, simulate

Figures = dict[str, float]


def _answer(attempt: Callable[[], object]) -> str:
    """The message with which an attempt is refused, "" where it succeeds."""
    try:
        attempt()
    except CalibrationError as error:
        return str(error)
    return ""


# ---- calibrations ---------------------------------------------------------------------------------------------------


def calibrations(runs: int, folder: Path) -> Figures:
    """Error over the Cramer-Rao bound, poses left mirrored or lost, and right and wrong refusals."""
    figures: Figures = {}
    failed = 0
    for short, name, noise in (
        ("field", "field", CLEAN_NOISE),
        ("field, 20 % outliers", "field", GROSS_NOISE),
        ("boards, 20 % outliers", "boards, brown", GROSS_NOISE),
    ):
        found = efficiency(PROBLEMS[name](), noise, range(runs))
        figures[f"squared error / bound, {short}"] = found.ratio[0]
        failed += found.failed
    figures["taken out, clean boards"] = efficiency(PROBLEMS["boards, brown"](), CLEAN_NOISE, range(2)).rejected
    figures["refused"] = failed
    for name, noise in {"poses mirrored or lost": CLEAN_NOISE, "the same, 20 % outliers": GROSS_NOISE}.items():
        figures[name] = sum(mirrored_small(100, noise, seed) for seed in range(max(runs // 4, 1)))
    figures["fisheye boards, 30 % outliers, wrong"] = sum(_lost(seed) for seed in range(max(runs // 2, 1)))
    figures["few corners, error in sigmas"] = _few_corners(2 * runs)
    figures["shuffled labels not refused"] = sum(not _answer(partial(_shuffled, seed)) for seed in range(runs))
    return figures


def _lost(seed: int) -> int:
    """Number of the 40 boards that end in a wrong pose. Some are lost by the initial estimate of the fisheye."""
    cameras = {"camera": Camera((1280, 960), 400.0, (646.5, 473.8), KannalaBrandt((-0.012, 0.004, -0.003, 0.0006)))}
    stations = {"camera": Station("camera", Pose.identity())}
    board = checkerboard(9, 6, 0.05)
    scene = board_scene(board, cameras, stations, 40, seed, held=BoardRanges((0.3, 2.5), (0.0, 60.0)))
    seen_boards = simulate(scene, replace(NOISE, outliers=0.3), seed).observations
    try:
        posed = calibrate(seen_boards, Options(lens="kannala-brandt")).estimate.placements
    except CalibrationError:
        return len(scene.placements)
    wrong = [np.linalg.norm(posed[name].rotation - true.rotation) > 0.1 for name, true in scene.placements.items()]
    return int(np.count_nonzero(wrong))


def _few_corners(runs: int) -> float:
    """Root mean square error of all numbers, in stated sigmas, with only 12 redundant equations."""
    pulls = []
    names = (*CORNERS, "LeftFieldLeftPenaltyCorner", "LeftFieldRightPenaltyCorner")
    for seed in range(runs):
        observations = thinned(seen(TILTED, NOISE, seed).observations, names, 20, seed)
        with suppress(CalibrationError):
            found = calibrate(observations, Options(lens="radial", fixed={"phi": CAMERA.phi, "cx": 646.5, "cy": 473.8}))
            pulls.append(sigmas_off(found, truth_of(found, TILTED)))
    return float(np.sqrt(np.mean(np.concatenate(pulls) ** 2)))


def _shuffled(seed: int) -> Calibration:
    """Boards whose corners have permuted names."""
    seen_boards = simulate(PROBLEMS["boards, brown"]().scene, NOISE, seed).observations
    feature = np.random.default_rng(seed).permutation(seen_boards.points.feature)
    return calibrate(replace(seen_boards, points=replace(seen_boards.points, feature=feature)), Options(lens="brown"))


# ---- verdicts and advice --------------------------------------------------------------------------------------------


def verdicts(runs: int, folder: Path) -> Figures:
    """Coverage of 95 % intervals, shares of verdicts where phi and height are correlated, and weak directions named."""
    figures: Figures = {}
    for tilt_deg in (0.0, 1.0, 3.0):
        held, words, known, sentences = [], [], [], 0
        for trial, calibration in attempts(tilted(tilt_deg), CLEAN_NOISE, range(runs)):
            if calibration is None:
                continue
            uncertainty = calibration.uncertainty
            bounds = uncertainty.posterior.bounds
            off = difference(trial.truth, calibration.estimate, uncertainty.posterior.keys)
            held.append((bounds[:, 0] <= off) & (off <= bounds[:, 1]))
            words += [one.verdict for one in uncertainty.verdicts if one.key.quantity in ("phi", "height")]
            known.append([np.isfinite(one.high - one.low) for one in uncertainty.verdicts])
            sentences += len(uncertainty.weak_directions)
        name = f"{tilt_deg:g} deg"
        figures[f"intervals that hold, {name}"] = float(np.mean(held))
        figures[f"intervals that are open, {name}"] = 1.0 - float(np.mean(known))
        figures[f"phi and height weak, {name}"] = words.count("weak") / len(words)
        figures[f"phi and height unknown, {name}"] = words.count("unknown") / len(words)
        figures[f"weak directions named, {name}"] = sentences / runs
    return figures


def advice(runs: int, folder: Path) -> Figures:
    """The advice: number of ranked measurements, and the worst error after the best one."""
    figures: Figures = {}
    for tilt_deg in (3.0, 8.0):
        promises, worst = [], []
        for _, calibration in attempts(tilted(tilt_deg), CLEAN_NOISE, range(max(runs // 5, 1))):
            assert calibration is not None
            given = advise(calibration, good_enough_mm=1.0)
            promises.append(len(given.promises))
            worst.append(np.nan if given.best is None else given.best.after.worst_mm)
        figures[f"measurements ranked, {tilt_deg:g} deg"] = float(np.mean(promises))
        figures[f"worst error left by the one to follow, mm, {tilt_deg:g} deg"] = float(np.mean(worst))
    return figures


# ---- diagnostics ----------------------------------------------------------------------------------------------------


def diagnoses(runs: int, folder: Path) -> Figures:
    """False alarms of `diagnose` on clean scenes, planted faults that are named, and other findings beside them."""
    alarms = others = named = 0
    each = max(runs // 3, 1)
    for problem in CLEAN.values():
        alarms += sum(bool(diagnosed(problem, seed).findings) for seed in range(each))
    for problem, kind, subject in FAULTS.values():
        for seed in range(each):
            findings = diagnosed(problem, seed).findings
            named += bool(findings) and (findings[0].kind, findings[0].subject) == (kind, subject)
            others += sum((one.kind, one.subject) != (kind, subject) for one in findings)
    return {
        f"false alarms of {each * len(CLEAN)}": alarms,
        f"faults named of {each * len(FAULTS)}": named,
        "other findings beside them": others,
    }


# ---- moves ----------------------------------------------------------------------------------------------------------


def checks(runs: int, folder: Path) -> Figures:
    """`check`: alarms for unmoved cameras, small moves that are found, and `compare`: equal cameras that differ."""
    known = [calibrated(seed) for seed in range(4)]

    def share(pose: Pose, kind: int, count: int, camera: Camera = CAMERA) -> float:
        alarms = 0
        for seed in range(count):
            shown = seen(pose, DAY, 10_000 * kind + seed, spacing_m=0.12, camera=camera).observations
            alarms += not check(known[seed % 4], thinned(shown, (), 100, seed), ALARMS).holds
        return alarms / count

    pairs = [compare(a, b)["overhead"] for number, a in enumerate(known) for b in known[:number]]
    return {
        "false alarms of check": share(HOME, 1, 20 * runs),
        "0.01 deg found": share(_turned(0.01), 2, 4 * runs),
        "0.05 deg found": share(SMALL_TILT, 3, runs),
        "3 mm found": share(SMALL_SHIFT, 4, runs),
        "1 deg found": share(_turned(1.0), 5, runs),
        "calibrations of one camera that differ": sum(pair.holds is False for pair in pairs),
    }


def _turned(degrees: float) -> Pose:
    return Pose.looking(
        HOME.position, Pose.exp((np.deg2rad(degrees), 0.0, 0.0, 0.0, 0.0, 0.0)).rotation @ HOME.rotation
    )


def refits(runs: int, folder: Path) -> Figures:
    """`refit`: large moves, few observations, and changes that must be named as something else than a move."""
    known = [calibrated(seed) for seed in range(4)]
    good = refused = silent = 0
    for seed in range(2 * runs):
        pose, calibration = random_move(seed), known[seed % 4]
        try:
            off = np.max(
                sigmas_off(refit(calibration, seen(pose, DAY, seed).observations), truth_of(calibration, pose))
            )
        except CalibrationError:
            refused += 1
            continue
        good += bool(off <= MOST_SIGMA)
        silent += not off <= MOST_SIGMA
    return {
        f"moves refitted of {2 * runs}": good,
        "refused": refused,
        "wrong without saying so": silent,
        "four corners, error in sigmas": _four_corners(known, 2 * runs),
        **{f"{name}, named": _named(*story, known, runs) for name, story in OTHER_STORIES.items()},
    }


def _named(make: Callable[[Calibration, int], Calibration], words: str, known: list[Calibration], runs: int) -> float:
    """Share of refits that are refused with these words."""
    return sum(words in _answer(partial(make, known[seed % 4], seed)) for seed in range(runs)) / runs


def _four_corners(known: list[Calibration], runs: int) -> float:
    pulls = []
    for seed in range(runs):
        calibration = known[seed % 4]
        with suppress(CalibrationError):
            moved = refit(calibration, thinned(seen(TILTED, NOISE, seed).observations, CORNERS, 0, seed))
            pulls.append(sigmas_off(moved, truth_of(calibration, TILTED)))
    return float(np.sqrt(np.mean(np.concatenate(pulls) ** 2))) if pulls else np.nan


LEANING = overhead_pose(-2.3, -1.0, 3.9, tilt_y_deg=-15.0, yaw_deg=90.0)
"""From straight above, another zoom looks like another height, so this pose is tilted."""


def _through(camera: Camera) -> Callable[[Calibration, int], Calibration]:
    return lambda calibration, seed: refit(calibration, seen(LEANING, DAY, seed, camera=camera).observations)


def _labels_turned(calibration: Calibration, seed: int) -> Calibration:
    turned_field = Pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    return refit(calibration, seen(HOME @ turned_field, DAY, seed).observations)


def _one_line(calibration: Calibration, seed: int) -> Calibration:
    found = seen(random_move(seed), DAY, seed).observations
    few = taken(found.curves, np.flatnonzero(found.curves.feature == found.curves.feature[0]))
    return refit(calibration, replace(found, points=taken(found.points, np.arange(1)), curves=few))


def _shuffled_lines(calibration: Calibration, seed: int) -> Calibration:
    found = seen(TILTED, DAY, seed).observations
    rng = np.random.default_rng(seed)
    points = replace(found.points, feature=rng.permutation(found.points.feature))
    curves = replace(found.curves, feature=rng.permutation(found.curves.feature))
    return refit(calibration, replace(found, points=points, curves=curves))


OTHER_STORIES: Mapping[str, tuple[Callable[[Calibration, int], Calibration], str]] = {
    "another zoom (3 %)": (_through(replace(CAMERA, phi=1.03 * CAMERA.phi)), "zoom was changed"),
    "another iris": (_through(replace(CAMERA, lens=Radial((-5.6e-5, 6.4e-7)))), "another iris"),
    "another lens": (_through(replace(CAMERA, phi=700.0, lens=Radial((2.0e-5, 2.0e-7)))), "another lens"),
    "labels turned": (_labels_turned, "labels are swapped"),
    "shuffled labels": (_shuffled_lines, "no explanation fits"),
    "one line and a corner": (_one_line, ":"),
}


# ---- photographs ----------------------------------------------------------------------------------------------------


def _shots(folder: Path, name: str, make: Callable[[int], Shot], count: int) -> Iterator[Shot]:
    """Photographs, rendered once for all the settings that are measured with this folder."""
    for seed in range(count):
        path = folder / f"{name}-{seed}.pickle"
        if not path.exists():
            path.write_bytes(pickle.dumps(make(seed)))
        shot: Shot = pickle.loads(path.read_bytes())
        yield shot


def lines(runs: int, folder: Path) -> Figures:
    """Fields followed from near and far initial cameras, and the accuracy of the line centres."""
    errors, pulls = [], []
    counts = dict.fromkeys(("missed", "behind robots", "arrived", "wrong without saying so"), 0)
    for seed, shot in enumerate(_shots(folder, "field", take, runs)):
        found = follow(
            shot.grey, shot.target, [off_by(shot.camera, 1.5 / shot.camera.phi, seed)], shot.target.curve_names
        )
        counts["missed"] += not found.holds
        if found.holds:
            rows = found.lines.found
            errors.append(distances_px(shot, found.lines.course.curve[rows], found.lines.pixels[rows]))
            pulls.append(errors[-1] / found.lines.sigma_px[rows])
            counts["behind robots"] += int(np.count_nonzero(hidden_places(shot, found.lines.course.pixels) & rows))
        axis = np.random.default_rng([4, seed]).standard_normal(3)
        far = turned(shot.camera, np.deg2rad(5.0) * axis / np.linalg.norm(axis))
        from_far = follow(shot.grey, shot.target, [far], shot.target.curve_names)
        right = from_far.holds and bool(np.max(floor_error_mm(shot, from_far.camera)) < 5.0)
        counts["arrived"] += right
        counts["wrong without saying so"] += from_far.holds and not right
    every = np.concatenate(errors) if errors else np.array([np.nan])
    pull = np.concatenate(pulls) if pulls else np.array([np.nan])
    return {
        "line centres": len(every),
        "their spread, px": float(np.std(every)),
        "farther off than 1 px": int(np.count_nonzero(np.abs(every) > 1.0)),
        "spread over stated sigma": float(np.std(pull)),
        **counts,
    }


def auto(runs: int, folder: Path) -> Figures:
    """Fields found without an initial camera: right, wrong, missed; and cases in which none must be found."""
    shots = list(_shots(folder, "field", take, runs))
    what = [outcome(shot, FACING).what for shot in shots]
    few = max(runs // 4, 1)
    for name, view in (*list(VIEWS.items())[::3], ("near", near)):
        what += [one.what for one in searched(_shots(folder, name, partial(take_view, name, view), few))]
    silent = [outcome(shot, Auto()).what for shot in shots[:few]]
    other = [outcome(shot, FACING, ssl_field("A")).what for shot in shots[:few]]
    return {
        f"found of {len(what)}": what.count("right"),
        "wrong": what.count("wrong"),
        "missed": what.count("miss") + what.count("several ways"),
        f"both ways named of {few}": silent.count("several ways"),
        "a field of another division found": other.count("wrong"),
    }


def boards(runs: int, folder: Path) -> Figures:
    """Boards in photographs: number of corners found, and their accuracy."""
    board = checkerboard(9, 6, 0.1)
    stations = {"overhead": Station("overhead", HOME)}
    scene = board_scene(board, {"overhead": CAMERA}, stations, runs, seed=0)
    paths = []
    for number, (_, frame) in enumerate(frames(scene)):
        paths.append(folder / f"board-{frame}.png")
        if not paths[-1].exists():
            cv2.imwrite(str(paths[-1]), photograph(scene, "overhead", frame, varied(number), number).image)
    found = detect_boards(paths, board, "overhead").observations
    truth = simulate(scene, None, 0).observations
    errors = _corner_errors(found, truth)
    return {
        f"corners of {len(truth.points)}": len(errors),
        "their spread, px": float(np.sqrt(np.mean(errors**2) / 2.0)),
        "farther off than 0.3 px": int(np.count_nonzero(errors > 0.3)),
        "stated sigma, px": float(np.median(found.points.sigma_px)),
    }


def _corner_errors(found: Observations, truth: Observations) -> np.ndarray:
    """(N,) px from each corner to the nearest true one of its photograph."""
    errors = []
    for number, view in enumerate(found.views):
        same = [n for n, other in enumerate(truth.views) if Path(view.frame).stem.endswith(other.frame)]
        there = truth.points.pixels[np.isin(truth.points.view, same)]
        mine = found.points.pixels[found.points.view == number]
        errors.append(np.min(np.linalg.norm(mine[:, None] - there[None], axis=2), axis=1))
    return np.concatenate(errors)


def rings(runs: int, folder: Path) -> Figures:
    """The paper's rings in photographs: number of rings found, and the polynomial that is solved from them."""
    scene, _ = built_in_scene("rings-2004")
    camera, radii = scene.camera_at("overhead"), scene.targets["rings"].spec["radii_m"]
    assert isinstance(camera.lens, Radial)
    radius, worst, counts, edges = np.linspace(0.0, camera.corner_radius, 200), [], [], []
    for seed in range(max(runs // 3, 1)):
        path = folder / f"rings-{seed}.png"
        if not path.exists():
            cv2.imwrite(str(path), photograph(scene, "overhead", "rings", varied(seed), seed).image)
        with suppress(CalibrationError):
            found = detect_rings(path, radii)
            solved = np.power.outer(radius, [1, 2, 3]) @ (found.polynomial / found.polynomial[0])
            worst.append(float(np.max(np.abs(solved - camera.lens.ideal_radius(radius)))))
            counts.append(found.rings)
            edges.append(len(found.observations.curves))
    return {
        "sheets read": len(worst),
        "rings on them": sum(counts),
        "edges on them": sum(edges),
        "worst error of the polynomial, px": max(worst, default=np.nan),
    }


def from_clicks(runs: int, folder: Path) -> Figures:
    """Initial cameras from four rough clicks: share that is followed to the right pose."""
    right = 0
    for seed, shot in enumerate(_shots(folder, "field", take, runs)):
        with suppress(CalibrationError):
            starts, freedom = starts_from_clicks(clicks(shot, seed), shot.target, shot.camera.image_size)
            found = follow(shot.grey, shot.target, starts, shot.target.curve_names, freedom)
            right += found.holds and bool(np.max(floor_error_mm(shot, found.camera)) < 5.0)
    return {f"clicks followed of {runs}": right}


def lenses(runs: int, _: Path) -> Figures:
    """How often the default lens choice recognises the true lens."""
    return {
        f"{name}, {scene}: recognised of {runs}": choices(scene, name, runs)[name]
        for scene in SCENES
        for name in LENSES
    }


FIGURES: Mapping[str, Callable[[int, Path], Figures]] = {
    "calibrate": calibrations,
    "lens": lenses,
    "verdicts": verdicts,
    "advice": advice,
    "diagnose": diagnoses,
    "check": checks,
    "refit": refits,
    "lines": lines,
    "clicks": from_clicks,
    "auto": auto,
    "boards": boards,
    "rings": rings,
}
"""Group of constants -> its figures, from a number of runs and a folder for pictures."""
