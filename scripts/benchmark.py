"""Speed of calibration, compared with other calibrators and by itself: python scripts/benchmark.py [--help]

First a wide lens (f 600 px, k1 -0.28, k2 0.07, 1280 x 960) is calibrated from the corners of a checkerboard with 0.3 px
of noise, without an initial estimate, by ceres-cal, OpenCV, pycolmap and mrcal in turns. Then the growth of our time is
measured with the number of frames, and with the number of line points that a static camera sees of a field. Our time is
that from Observations to Calibration; for the others only the solver counts, although OpenCV's call includes its
initial estimate.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from benchmarks.lenses import lens_rows
from benchmarks.peers import PEERS, WARM_UP_FRAMES, Answer, Corners, peak_mib, reset_peak, solve_warm
from benchmarks.photographs import field_rows, field_summary, photograph_rows
from benchmarks.problems import (
    HEIGHT_M,
    OVERHEAD,
    TILT_DEG,
    WIDE,
    Problem,
    corner_observations,
    field_observations,
    wide_lens,
)
from benchmarks.process import OURS_ALONE, process_rows
from benchmarks.scale import FOLDER, folder_for, frames_in_turns, stored_growth, write_field
from scenery import overhead_pose

from ceres_cal.base.words import ROBOT_TOP_M
from ceres_cal.scene.lens import KannalaBrandt

OURS = "ceres-cal"
MODULES = {OURS: "ceres_cal.calibration.calibrating", "opencv": "cv2", "pycolmap": "pycolmap", "mrcal": "mrcal"}
MRCAL_PYTHON = "/usr/bin/python3"  # Debian's mrcal belongs to the system's Python
MIRRORED_DEG = 5.0  # a pose farther from the truth is the mirrored one of a plane
WARM_UP_LINE_POINTS, WARM_UP_S = 1000, 0.3
PIXELS, FEW_PIXELS = 1_000_000, 10_000
LAST_DECADES = 2.0  # over which growth is fitted

Solver = Callable[[Corners], Answer]


# ---- solvers --------------------------------------------------------------------------------------------------------


def solve_ours(corners: Corners) -> Answer:
    """Time and result from Observations to Calibration, with the nine intrinsics that OpenCV and mrcal solve for."""
    from ceres_cal.calibration.calibrating import calibrate
    from ceres_cal.observations.sights import gather_sights
    from ceres_cal.problem.parameters import Options
    from ceres_cal.start.initialise import initialise

    options = Options(lens="brown", free_aspect=True)
    observations = corner_observations(corners)  # new ones each time, since they cache what is derived
    start = time.perf_counter()
    calibration = calibrate(observations, options)
    seconds = time.perf_counter() - start
    observations = corner_observations(corners)
    start = time.perf_counter()
    initialise(gather_sights(observations), options)
    initialise_seconds = time.perf_counter() - start
    camera, station = calibration.cameras["camera"], calibration.station("camera").cam_from_world
    poses = [station @ calibration.placements[str(view.placement)] for view in observations.views]
    return Answer(
        seconds,
        np.array([camera.phi, camera.phi * camera.aspect, *camera.principal_point, *camera.lens.values]),
        np.array([np.column_stack([pose.rotation, pose.translation]) for pose in poses]),
        initialise_seconds,
    )


def solve_apart(name: str, warm_up_s: float, corners: Corners) -> tuple[Answer, float]:
    """A peer's answer from a process of its own, and the peak memory of that process in MiB."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "corners.npz"
        corners.save(path)
        script = Path(__file__).parent / "benchmarks" / "peers.py"
        found = json.loads(run(name, str(script), name, str(path), str(warm_up_s)))
    answer = Answer(found["seconds"], np.array(found["intrinsics"]), np.array(found["cam_from_board"]))
    return answer, found["peak_mib"]


def answer_apart(name: str, warm_up_s: float, corners: Corners) -> Answer:
    """A peer's answer from a process of its own."""
    return solve_apart(name, warm_up_s, corners)[0]


def run(name: str, *arguments: str) -> str:
    """Output of a solver's Python; a Python other than this one must not find this one's packages."""
    strange = python_of(name) != sys.executable
    variables = {k: v for k, v in os.environ.items() if k != OURS_ALONE and not (strange and k.startswith("PYTHON"))}
    command = [python_of(name), *arguments]
    try:
        return subprocess.run(command, env=variables, capture_output=True, text=True, check=True).stdout
    except subprocess.CalledProcessError as error:
        error.add_note(error.stderr)
        raise


def python_of(name: str) -> str:
    return MRCAL_PYTHON if name == "mrcal" else sys.executable


def import_seconds(name: str, repeat: int) -> float | None:
    """Median time of its import in a fresh process, with an extra first run unless repeat is 1; None without it."""
    code = f"import time; start = time.perf_counter(); import {MODULES[name]}; print(time.perf_counter() - start)"
    try:
        times = [float(run(name, "-c", code)) for _ in range(repeat + (repeat > 1))]
        return median(times[-repeat:])
    except (OSError, subprocess.CalledProcessError):
        return None


# ---- beside the others ----------------------------------------------------------------------------------------------


def judge(problem: Problem, answer: Answer) -> dict[str, Any]:
    """The same for all solvers: rms over every corner, error of the focal length, number of mirrored frames."""
    import cv2

    corners, pose = problem.corners, answer.cam_from_board[problem.corners.view]
    in_camera = np.einsum("nij,nj->ni", pose[:, :, :3], corners.board[corners.feature]) + pose[:, :, 3]
    fx, fy, cx, cy, *lens = answer.intrinsics
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    shown = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), matrix, np.array(lens))[0].reshape(-1, 2)
    cosine = 0.5 * (np.einsum("fij,fij->f", answer.cam_from_board[:, :, :3], problem.rotations) - 1.0)
    return {
        "rms_px": float(np.sqrt(np.mean(np.sum((shown - corners.pixels) ** 2, axis=1)))),
        "focal_error_px": float(fx - WIDE.phi),
        "mirrored": int(np.sum(cosine < np.cos(np.deg2rad(MIRRORED_DEG)))),
    }


def compare(frames: int, solvers: Mapping[str, Solver], repeat: int) -> dict[str, Any]:
    """All solvers on one problem in turns: medians, and ratios within each turn."""
    problem = wide_lens(frames)
    turns = [{name: solve(problem.corners) for name, solve in solvers.items()} for _ in range(repeat)]
    rows: dict[str, dict[str, Any]] = {}
    for name, answer in turns[-1].items():
        rows[name] = {
            "solver": name,
            "solve_seconds": median(turn[name].seconds for turn in turns),
            "times_ours": median(turn[name].seconds / turn[OURS].seconds for turn in turns),
            **judge(problem, answer),
        }
    ours = rows[OURS]
    ours["total_seconds"] = ours["solve_seconds"]
    ours["initialise_seconds"] = median(turn[OURS].initialise_seconds for turn in turns)
    ours["solve_seconds"] -= ours["initialise_seconds"]
    peers = [name for name in solvers if name != OURS]
    ratios = [min(turn[name].seconds for name in peers) / turn[OURS].seconds for turn in turns if peers]
    return {
        "frames": frames,
        "corners": len(problem.corners.view),
        "solvers": rows,
        "fastest_peer_times_ours": median(ratios) if ratios else None,
    }


def add_memory(found: dict[str, Any]) -> None:
    """Peak memory of each solver in a process of its own."""
    corners = wide_lens(found["frames"]).corners
    for name, row in found["solvers"].items():
        row["peak_mib"] = alone("corners", found["frames"]) if name == OURS else solve_apart(name, 0.0, corners)[1]


# ---- alone in a fresh process ---------------------------------------------------------------------------------------


def alone(task: str, size: int, repeat: int = 1) -> Any:
    """The result of one of the tasks below from a process of its own."""
    return json.loads(run(OURS, __file__, "--alone", task, str(size), str(repeat)))


def first_call(frames: int, repeat: int) -> float:
    """Additional seconds of the first calibration of a process, which loads the compiled kernels."""
    corners = wide_lens(frames).corners
    first, *later = (solve_ours(corners).seconds for _ in range(repeat + 1))
    return first - median(later)


def corners_memory(frames: int, repeat: int) -> float:
    """Peak memory, MiB."""
    for _ in range(repeat):
        solve_ours(wide_lens(frames).corners)
    return peak_mib()


def field_growth(line_points: int, repeat: int) -> dict[str, Any]:
    """Seconds of calibrate (median), and the peak memory of the process meanwhile, observations included."""
    from ceres_cal.calibration.calibrating import calibrate
    from ceres_cal.problem.parameters import Options

    calibrate(field_observations(WARM_UP_LINE_POINTS), Options(lens="radial"))
    observations = field_observations(line_points)
    reset_peak()
    seconds = []
    for _ in range(repeat):
        fresh = replace(observations)  # without cached results
        start = time.perf_counter()
        calibration = calibrate(fresh, Options(lens="radial"))
        seconds.append(time.perf_counter() - start)
    return {
        "size": line_points,
        "frames": len(observations.views),
        "seconds": median(seconds),
        "rms_px": calibration.fit.curves_rms_px,
        "focal_error_px": calibration.cameras["overhead"].phi - OVERHEAD.phi,
        "peak_mib": peak_mib(),
    }


TASKS: dict[str, Callable[[int, int], Any]] = {
    "first": first_call,
    "corners": corners_memory,
    "field": field_growth,
    "stored": stored_growth,
}


# ---- growth ---------------------------------------------------------------------------------------------------------


def uncertainty_share(frames: int, repeat: int) -> float:
    """Time of all standard deviations, placements included, over the time of a calibration without them (median)."""
    from ceres_cal.calibration.calibrating import calibrate
    from ceres_cal.effects.dependence import measure_scatter
    from ceres_cal.observations.sights import gather_sights
    from ceres_cal.posterior.assess import assess
    from ceres_cal.problem.parameters import Options, make_layout
    from ceres_cal.problem.problem import Problem, Weighting
    from ceres_cal.problem.reduced import information
    from ceres_cal.problem.residuals import residuals

    observations, options = corner_observations(wide_lens(frames).corners), Options(lens="brown", free_aspect=True)
    calibrate(observations, options)
    layout, sights, shares = make_layout(observations, options), gather_sights(observations), []
    for _ in range(repeat):
        start = time.perf_counter()
        calibration = calibrate(observations, options)
        calibrated = time.perf_counter() - start
        estimate, there = calibration.estimate, residuals(sights, calibration.estimate)
        assert len(there.lengths[0])  # calibrate() has computed them already
        start = time.perf_counter()
        whole = Problem(sights, layout, (), Weighting(calibration.fit.point_scale), options)
        reduced, scatter_at = information(whole, estimate), partial(measure_scatter, whole, there)
        _, posterior = assess(whole, estimate, reduced, np.inf, scatter_at)
        assessed = time.perf_counter() - start
        known = len(posterior.placements)  # computes all of them
        everything = time.perf_counter() - start
        assert known == frames
        shares.append(everything / (calibrated - assessed))  # calibrate() includes the uncertainty of what is shared
    return median(shares)


def frames_growth(frames: int, repeat: int) -> dict[str, Any]:
    """Our seconds for the wide lens."""
    problem = wide_lens(frames)
    answers = [solve_warm(solve_ours, WARM_UP_S, problem.corners) for _ in range(repeat)]
    seconds = median(answer.seconds for answer in answers)
    return {"size": frames, "frames": frames, "seconds": seconds, **judge(problem, answers[-1])}


def exponent(rows: Sequence[Mapping[str, float]]) -> float | None:
    """Slope of log seconds over log size in the last decades; None for a single size."""
    size, seconds = (np.log10([row[name] for row in rows]) for name in ("size", "seconds"))
    last = size >= size[-1] - LAST_DECADES - 1e-9
    return float(np.polyfit(size[last], seconds[last], 1)[0]) if np.sum(last) > 1 else None


# ---- tables ---------------------------------------------------------------------------------------------------------


COMPARISON = {
    "solver": ("", "s"),
    "import_seconds": ("import s", ".2f"),
    "initialise_seconds": ("initialise s", ".4f"),
    "solve_seconds": ("solve s", ".4f"),
    "total_seconds": ("total s", ".4f"),
    "times_ours": ("times ours", ".2f"),
    "rms_px": ("rms px", ".4f"),
    "focal_error_px": ("focal error px", "+.3f"),
    "mirrored": ("mirrored", "d"),
    "peak_mib": ("peak MiB", ".0f"),
}
GROWTH = {
    "size": ("number", "d"),
    "frames": ("frames", "d"),
    "seconds": ("seconds", ".4f"),
    "rms_px": ("rms px", ".4f"),
    "focal_error_px": ("focal error px", "+.3f"),
    "mirrored": ("mirrored", "d"),
    "peak_mib": ("peak MiB", ".0f"),
}


PROCESS = {
    "problem": ("whole process", ""),
    "ours_wall": ("ours s", ".3f"),
    "opencv_wall": ("OpenCV s", ".3f"),
    "times_wall": ("ratio", ".2f"),
    "ours_processor": ("ours CPU s", ".3f"),
    "opencv_processor": ("OpenCV CPU s", ".3f"),
    "times_processor": ("ratio", ".2f"),
}
PHOTOGRAPHS = {
    "set": ("photographs of a board", ""),
    "ours": ("ours s", ".2f"),
    "plain": ("OpenCV s", ".2f"),
    "times_plain": ("ratio", ".2f"),
    "accurate": ("its SB s", ".2f"),
    "times_accurate": ("ratio", ".2f"),
    "ours_processor": ("ours CPU s", ".2f"),
    "times_plain_processor": ("ratio", ".2f"),
    "times_accurate_processor": ("to SB", ".2f"),
    "imports": ("imports CPU s", ".2f"),
    "corners": ("corners", ".2f"),
    "calibration": ("calibration", ".2f"),
    "commands": ("two commands s", ".2f"),
    "ours_boards": ("boards", "d"),
    "plain_boards": ("OpenCV", "d"),
    "accurate_boards": ("SB", "d"),
    "ours_rms_px": ("rms px", ".3f"),
    "plain_rms_px": ("OpenCV", ".3f"),
    "accurate_rms_px": ("SB", ".3f"),
}
FIELDS = {
    "fields": ("detect field --auto", ""),
    "photographs": ("photographs", "d"),
    "median": ("median CPU s", ".2f"),
    "worst": ("worst", ".2f"),
}
SCALE = {
    "size": ("line points", "d"),
    "workers": ("workers", "d"),
    "seconds": ("seconds", ".1f"),
    "processor": ("of a processor", ".1f"),
    "longest": ("caller and busiest", ".1f"),
    "times_seconds": ("times one's seconds", ".2f"),
    "times_longest": ("busiest", ".2f"),
    "open_seconds": ("opened in", ".1f"),
    "peak_mib": ("peak MiB", ".0f"),
    "worker_mib": ("of a worker", ".0f"),
    "iterations": ("iterations", "d"),
    "iteration_seconds": ("s each", ".3f"),
    "iteration_bytes": ("bytes a worker", "d"),
    "overhead_ms": ("overhead ms", ".1f"),
    "focal_error_px": ("focal error px", "+.3f"),
}
FRAMES = {
    "frames": ("frames", "d"),
    "processor_us": ("us of a processor", ".1f"),
    "wall_us": ("us", ".1f"),
    "times_processor": ("times the fewest's, processor", ".3f"),
    "times_wall": ("wall", ".3f"),
    "peak_mib": ("peak MiB", ".0f"),
}
LENSES = {
    "frames": ("frames", "d"),
    "brown": ("brown s", ".4f"),
    "spline": ("spline s", ".4f"),
    "spline_times": ("times brown's", ".2f"),
    "by_name": ("chosen by name s", ".4f"),
    "auto": ("auto s", ".4f"),
    "auto_adds": ("auto adds %", "+.0f"),
    "chosen": ("chosen", ""),
}
PIXELS_TOLD = {"lens": ("lens", ""), "locate": ("locate s", ".3f"), "project": ("project s", ".3f")}


def print_table(title: str, columns: Mapping[str, tuple[str, str]], rows: Iterable[Mapping[str, Any]]) -> None:
    """Rows by key; columns: key -> head and format. A missing value is printed as a dash."""
    lines = [[head for head, _ in columns.values()]]
    for row in rows:
        values = [(row.get(key), form) for key, (_, form) in columns.items()]
        lines.append(["-" if value is None else format(value, form) for value, form in values])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    print(f"\n{title}")
    for first, *others in lines:
        cells = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        print("  ".join(["", first.ljust(widths[0]), *cells]), flush=True)


def pixel_rows(repeat: int, count: int) -> list[dict[str, Any]]:
    """Seconds to locate so many pixels at robot height and to project them back, for a lens of each kind."""
    camera = replace(OVERHEAD, phi=600.0).at(overhead_pose(0.0, 0.0, HEIGHT_M, tilt_x_deg=TILT_DEG))
    pixels = np.random.default_rng(0).uniform((0.0, 0.0), camera.image_size, (count, 2))
    rows = []
    for lens in (OVERHEAD.lens, WIDE.lens, KannalaBrandt((-0.02, 0.004, -0.001, 0.0))):
        one, there, back = replace(camera, lens=lens), [], []
        for _ in range(repeat):
            start = time.perf_counter()
            places = one.locate(pixels, ROBOT_TOP_M)
            middle = time.perf_counter()
            one.project(np.column_stack([places, np.full(len(places), ROBOT_TOP_M)]))
            there.append(middle - start)
            back.append(time.perf_counter() - middle)
        rows.append({"lens": lens.kind, "locate": median(there), "project": median(back)})
    return rows


def print_comparison(found: Mapping[str, Any], repeat: int) -> None:
    title = f"{found['frames']} frames, {found['corners']} corners, median of {repeat} turns"
    print_table(title, COMPARISON, found["solvers"].values())
    if (ratio := found["fastest_peer_times_ours"]) is not None:
        print(f"  the fastest of the others takes {ratio:.2f} times as long as we do (median over the turns)")


def print_growth(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    print_table(title, GROWTH, rows)
    if (slope := exponent(rows)) is not None:
        print(f"  seconds grow as the number to the power {slope:.3f} (last {LAST_DECADES:.0f} decades)")


# ---- measurements ---------------------------------------------------------------------------------------------------


def environment() -> dict[str, Any]:
    names = ("ceres-cal", "numpy", "pyceres", "pycolmap", "opencv-python-headless")
    return {
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        **{name: version(name) for name in names},
        "load before": round(os.getloadavg()[0], 2),
    }


def measure(chosen: argparse.Namespace) -> dict[str, Any]:
    """Measures everything that was chosen, and prints it immediately."""
    report: dict[str, Any] = {"environment": environment()}
    print(", ".join(f"{name} {value}" for name, value in report["environment"].items()))
    print("each solver takes as many threads as it does by itself; pycolmap's num_threads is -1: all")
    report["import_seconds"] = {name: import_seconds(name, chosen.repeat) for name in (OURS, *chosen.peers)}
    for name, seconds in report["import_seconds"].items():
        if seconds is None:
            print(f"{name} is skipped: {python_of(name)} cannot import {MODULES[name]}")
    report["first_call_seconds"] = alone("first", WARM_UP_FRAMES)
    print(f"a process' first calibration takes {report['first_call_seconds']:.2f} s more: compiled kernels are loaded")
    report["comparison"] = compare_all(chosen, report["import_seconds"])
    report["uncertainty_share"] = uncertainty_share(max(chosen.frames), chosen.repeat)
    share = f"{100.0 * report['uncertainty_share']:.1f} % of our time at {max(chosen.frames)} frames"
    print(f"\nthe standard deviations of everything add {share}")
    if chosen.growth:
        report["frames"] = [frames_growth(frames, chosen.repeat) for frames in chosen.growth]
        print_growth("growth with the frames, ours", report["frames"])
    if chosen.points:
        report["field"] = [alone("field", count, chosen.repeat) for count in chosen.points]
        print_growth("growth with the line points of a static camera over a field, ours", report["field"])
    pixels = FEW_PIXELS if chosen.quick else PIXELS
    report["pixels"] = pixel_rows(chosen.repeat, pixels)
    print_table(
        f"{pixels:,} pixels located at {1e3 * ROBOT_TOP_M:.0f} mm, and projected back", PIXELS_TOLD, report["pixels"]
    )
    report["environment"]["load after"] = round(os.getloadavg()[0], 2)
    print(f"\nload after {report['environment']['load after']}")
    return report


def measure_scale(chosen: argparse.Namespace) -> dict[str, Any]:
    """Line points in files, in one process and with Dask's workers; frames; and the growth with their number."""
    rows: list[dict[str, Any]] = []
    for count in chosen.scale:
        with folder_for(count) as folder:
            os.environ[FOLDER] = str(folder / "field.columns")
            write_field(folder / "field.columns", count)
            for workers in chosen.workers:
                row = alone("stored", count, workers)
                one = next((other for other in rows if other["size"] == count and other["workers"] == 1), row)
                row |= {f"times_{what}": row[what] / one[what] for what in ("seconds", "longest") if workers}
                rows.append(row)
                print_table("line points in files", SCALE, rows[-1:])
    for workers in chosen.workers:
        print_growth(f"with {workers} workers", [row for row in rows if row["workers"] == workers])
    frames = frames_in_turns(chosen.scale_frames, chosen.repeat)
    title = f"a frame's time, in turns with {min(chosen.scale_frames)} frames; median of {chosen.repeat} turns"
    print_table(title, FRAMES, frames)
    total = [{"size": row["frames"], "seconds": row["frames"] * row["processor_us"]} for row in frames]
    if (slope := exponent(total)) is not None:
        print(f"  processor seconds grow as the number to the power {slope:.3f} (last {LAST_DECADES:.0f} decades)")
    return {"environment": environment(), "stored": rows, "frames": frames}


def measure_processes(repeat: int) -> dict[str, Any]:
    """Whole processes, printed."""
    rows = process_rows(repeat)
    print_table(f"from start to exit, median of {repeat} turns; ratio: how many times OpenCV's", PROCESS, rows)
    return {"environment": environment(), "process": rows}


def measure_photographs(repeat: int, fields: bool) -> dict[str, Any]:
    """Photographs of boards to a calibration, compared with OpenCV, and photographs of fields; printed."""
    rows = photograph_rows(repeat)
    print_table(f"from photographs to a calibration, whole processes, median of {repeat} turns", PHOTOGRAPHS, rows)
    found = field_rows() if fields else []
    print_table("fields, a command for each photograph", FIELDS, field_summary(found))
    return {"environment": environment(), "boards": rows, "fields": found}


def measure_lenses(chosen: argparse.Namespace) -> dict[str, Any]:
    """A lens by its name, compared with another one and with the automatic choice; printed."""
    rows = lens_rows(chosen.frames, chosen.repeat, chosen.warm_up)
    print_table(f"the wide lens by lens, median of {chosen.repeat} turns, and of ratios within each", LENSES, rows)
    return {"environment": environment(), "lenses": rows}


def compare_all(chosen: argparse.Namespace, imports: Mapping[str, float | None]) -> list[dict[str, Any]]:
    """Every size of the comparison, by the solvers that are installed."""
    warm_up_s = chosen.warm_up
    solvers: dict[str, Solver] = {OURS: partial(solve_warm, solve_ours, warm_up_s)}
    for name in (name for name in chosen.peers if imports[name] is not None):
        if python_of(name) == sys.executable:
            solvers[name] = partial(solve_warm, PEERS[name], warm_up_s)
        else:
            solvers[name] = partial(answer_apart, name, warm_up_s)
    comparison = []
    for frames in chosen.frames:
        found = compare(frames, solvers, chosen.repeat)
        if chosen.memory and frames == max(chosen.frames):
            add_memory(found)
        for name, row in found["solvers"].items():
            row["import_seconds"] = imports[name]
        print_comparison(found, chosen.repeat)
        comparison.append(found)
    return comparison


def numbers(text: str) -> list[int]:
    """A list with commas: 20,1e3 is [20, 1000]."""
    return sorted(int(float(part)) for part in text.split(",") if part)


def peer_names(text: str) -> list[str]:
    names = [part for part in text.split(",") if part]
    if unknown := [name for name in names if name not in PEERS]:
        raise argparse.ArgumentTypeError(f"unknown peer {unknown[0]!r}: choose from {', '.join(PEERS)}")
    return names


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[1])
    sizes = {"frames": "20,100,400,1000", "growth": "100,1000,10000", "points": "1e3,1e4,1e5,1e6,1e7"}
    parser.add_argument("--frames", type=numbers, default=sizes["frames"], help="of the comparison: %(default)s")
    parser.add_argument("--growth", type=numbers, default=sizes["growth"], help="frames for us alone: %(default)s")
    parser.add_argument("--points", type=numbers, default=sizes["points"], help="line points for us alone: %(default)s")
    parser.add_argument("--peers", type=peer_names, default=",".join(PEERS), help="of the comparison: %(default)s")
    parser.add_argument("--repeat", type=int, default=3, help="turns of everything: %(default)s")
    parser.add_argument(
        "--warm-up", type=float, default=WARM_UP_S, help="seconds of work before each is timed: %(default)s"
    )
    parser.add_argument("--memory", action="store_true", help="peak memory of each solver at the most frames, too")
    parser.add_argument("--json", type=Path, help="write everything measured to this file")
    parser.add_argument("--quick", action="store_true", help="smallest sizes, one turn: does it run?")
    parser.add_argument(
        "--scale",
        type=numbers,
        nargs="?",
        const="1e7,1e8",
        help="line points in files, and --scale-frames; no more: %(const)s",
    )
    parser.add_argument("--scale-frames", type=numbers, default="1e3,1e4,1e5", help="in --scale: %(default)s")
    parser.add_argument("--workers", type=numbers, default="0,1,2", help="of Dask in --scale, 0 is none: %(default)s")
    parser.add_argument("--process", action="store_true", help="whole processes in turns, and no more")
    parser.add_argument(
        "--photographs", action="store_true", help="from photographs to a calibration beside OpenCV, and no more"
    )
    parser.add_argument("--no-fields", action="store_true", help="with --photographs: boards alone")
    parser.add_argument("--lenses", action="store_true", help="spline and auto beside a lens by name, and no more")
    parser.add_argument("--alone", nargs=3, help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.alone:
        task, size, repeat = chosen.alone
        print(json.dumps(TASKS[task](int(size), int(repeat))))
        return 0
    if chosen.quick:
        chosen.frames, chosen.growth, chosen.points, chosen.repeat = [20], [20, 40], [1000], 1
        chosen.warm_up = 0.0
    if chosen.scale:
        report = measure_scale(chosen)
    elif chosen.photographs:
        report = measure_photographs(chosen.repeat, not chosen.no_fields)
    elif chosen.lenses:
        report = measure_lenses(chosen)
    else:
        report = measure_processes(chosen.repeat) if chosen.process else measure(chosen)
    if chosen.json:
        chosen.json.write_text(json.dumps(report, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
