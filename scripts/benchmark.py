"""How fast we are, beside the others and by ourselves: python scripts/benchmark.py [--help]

First a wide lens (f 600 px, k1 -0.28, k2 0.07, 1280 x 960) from the corners of a checkerboard with 0.3 px of noise, solved
from a cold start by us, OpenCV, pycolmap and mrcal in turn; then, for us alone, growth with the frames, and with the line
points that a static camera sees of a field. Ours is everything from Observations to Calibration; theirs is the solver
alone, though OpenCV's seeds itself.
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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from benchmark_peers import PEERS, Answer, Corners, peak_mib
from benchmark_problems import OVERHEAD, WIDE, Problem, corner_observations, field_observations, wide_lens

OURS = "ceres-cal"
MODULES = {OURS: "ceres_cal.calibrate", "opencv": "cv2", "pycolmap": "pycolmap", "mrcal": "mrcal"}
MRCAL_PYTHON = "/usr/bin/python3"  # Debian's mrcal belongs to the system's Python
MIRRORED_DEG = 5.0  # that far off the truth, a pose is the other one of the two that a plane's picture allows
WARM_UP_FRAMES, WARM_UP_LINE_POINTS = 10, 1000
LAST_DECADES = 2.0  # over which growth is told

Solver = Callable[[Corners], Answer]


# ---- solvers --------------------------------------------------------------------------------------------------------


def solve_ours(corners: Corners) -> Answer:
    """From Observations to Calibration, with the nine intrinsics that OpenCV and mrcal solve for."""
    from ceres_cal.calibrate import calibrate
    from ceres_cal.initialise import initialise
    from ceres_cal.parameters import Options
    from ceres_cal.sights import gather_sights

    options = Options(lens="brown", free_aspect=True)
    observations = corner_observations(corners)  # new ones each time: they remember what was derived from them
    start = time.perf_counter()
    initialise(observations, gather_sights(observations), options)
    initialise_seconds = time.perf_counter() - start
    observations = corner_observations(corners)
    start = time.perf_counter()
    calibration = calibrate(observations, options)
    seconds = time.perf_counter() - start
    camera, station = calibration.cameras["camera"], calibration.station("camera").cam_from_world
    poses = [station @ calibration.placements[str(view.placement)] for view in observations.views]
    return Answer(
        seconds,
        np.array([camera.phi, camera.phi * camera.aspect, *camera.principal_point, *camera.lens.values]),
        np.array([np.column_stack([pose.rotation, pose.translation]) for pose in poses]),
        initialise_seconds,
    )


def solve_apart(name: str, corners: Corners) -> tuple[Answer, float]:
    """A peer's answer from a process of its own, and that process' peak memory in MiB."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "corners.npz"
        corners.save(path)
        found = json.loads(run(name, str(Path(__file__).with_name("benchmark_peers.py")), name, str(path)))
    answer = Answer(found["seconds"], np.array(found["intrinsics"]), np.array(found["cam_from_board"]))
    return answer, found["peak_mib"]


def run(name: str, *arguments: str) -> str:
    """What the Python of a solver prints; the system's must not find this one's packages."""
    if name != "mrcal":
        command, environment = sys.executable, dict(os.environ)
    else:
        command, environment = MRCAL_PYTHON, {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    return subprocess.run([command, *arguments], env=environment, capture_output=True, text=True, check=True).stdout


def import_seconds(name: str, repeat: int) -> float | None:
    """How long its import takes in a fresh process (median, files already read once); None where it is not there."""
    code = f"import time; start = time.perf_counter(); import {MODULES[name]}; print(time.perf_counter() - start)"
    try:
        return median([float(run(name, "-c", code)) for _ in range(repeat + 1)][1:])
    except (OSError, subprocess.CalledProcessError):
        return None


# ---- beside the others ----------------------------------------------------------------------------------------------


def judge(problem: Problem, answer: Answer) -> dict[str, float]:
    """The same for all: rms over every corner, error of the focal length, number of mirrored frames."""
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
    """All solvers on one problem, taking turns: medians, and ratios within each turn."""
    problem = wide_lens(frames)
    for solve in solvers.values():
        solve(problem.corners.first(WARM_UP_FRAMES))
    turns = [{name: solve(problem.corners) for name, solve in solvers.items()} for _ in range(repeat)]
    rows: dict[str, dict[str, float]] = {}
    for name, answer in turns[-1].items():
        rows[name] = {
            "seconds": median(turn[name].seconds for turn in turns),
            "times_ours": median(turn[name].seconds / turn[OURS].seconds for turn in turns),
            **judge(problem, answer),
        }
    rows[OURS]["initialise_seconds"] = median(turn[OURS].initialise_seconds or 0.0 for turn in turns)
    peers = [name for name in solvers if name != OURS]
    ratios = [min(turn[name].seconds for name in peers) / turn[OURS].seconds for turn in turns if peers]
    return {
        "frames": frames,
        "corners": len(problem.corners.view),
        "solvers": rows,
        "fastest_peer_times_ours": median(ratios) if ratios else None,
    }


def add_memory(found: dict[str, Any]) -> None:
    """Peak memory of each solver, each in a process of its own."""
    corners = wide_lens(found["frames"]).corners
    for name, row in found["solvers"].items():
        row["peak_mib"] = alone("corners", found["frames"]) if name == OURS else solve_apart(name, corners)[1]


# ---- alone in a fresh process ---------------------------------------------------------------------------------------


def alone(task: str, size: int, repeat: int = 1) -> Any:
    """The answer of one of the tasks below from a process of its own."""
    return json.loads(run(OURS, __file__, "--alone", task, str(size), str(repeat)))


def first_call(frames: int, repeat: int) -> float:
    """Seconds that the first calibration of a process takes longer than later ones: it loads the compiled kernels."""
    corners = wide_lens(frames).corners
    first, *later = (solve_ours(corners).seconds for _ in range(repeat + 1))
    return first - median(later)


def corners_memory(frames: int, repeat: int) -> float:
    """Peak memory, MiB."""
    for _ in range(repeat):
        solve_ours(wide_lens(frames).corners)
    return peak_mib()


def field_growth(line_points: int, repeat: int) -> dict[str, float]:
    """Seconds of calibrate (median) and the memory that the process holds at most meanwhile, observations included."""
    from ceres_cal.calibrate import calibrate

    calibrate(field_observations(WARM_UP_LINE_POINTS))
    observations = field_observations(line_points)
    reset_peak()
    seconds = []
    for _ in range(repeat):
        fresh = replace(observations)  # forgets what was derived from it
        start = time.perf_counter()
        calibration = calibrate(fresh)
        seconds.append(time.perf_counter() - start)
    return {
        "size": line_points,
        "frames": len(observations.views),
        "seconds": median(seconds),
        "rms_px": calibration.fit.curves_rms_px,
        "focal_error_px": calibration.cameras["overhead"].phi - OVERHEAD.phi,
        "peak_mib": peak_mib(),
    }


def reset_peak() -> None:
    """Let the peak memory count from here, where the system can (Linux)."""
    switch = Path("/proc/self/clear_refs")
    if switch.exists():
        switch.write_text("5", encoding="ascii")


TASKS: dict[str, Callable[[int, int], Any]] = {
    "first": first_call,
    "corners": corners_memory,
    "field": field_growth,
}


# ---- growth ---------------------------------------------------------------------------------------------------------


def frames_growth(frames: int, repeat: int) -> dict[str, float]:
    """Our seconds on the wide lens."""
    problem = wide_lens(frames)
    solve_ours(problem.corners.first(WARM_UP_FRAMES))
    answers = [solve_ours(problem.corners) for _ in range(repeat)]
    return {"size": frames, "seconds": median(a.seconds for a in answers), **judge(problem, answers[-1])}


def exponent(rows: Sequence[Mapping[str, float]]) -> float | None:
    """Slope of log seconds over log size in the last decades; None where there is a single size."""
    size, seconds = (np.log10([row[name] for row in rows]) for name in ("size", "seconds"))
    last = size >= size[-1] - LAST_DECADES - 1e-9
    return float(np.polyfit(size[last], seconds[last], 1)[0]) if np.sum(last) > 1 else None


# ---- tables ---------------------------------------------------------------------------------------------------------


def table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table, its first column to the left."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    print(f"\n{title}")
    for row in (head, *rows):
        first, *others = (cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True)))
        print("  ".join(["", first, *others]), flush=True)


def number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def print_comparison(found: Mapping[str, Any], imports: Mapping[str, float | None], repeat: int) -> None:
    head = ("", "import s", "initialise s", "solve s", "total s", "times ours", "rms px", "focal error px", "mirrored", "peak MiB")
    rows = []
    for name, row in found["solvers"].items():
        start = row.get("initialise_seconds")
        rows.append(
            (
                name,
                number(imports[name], ".2f"),
                number(start, ".4f"),
                number(row["seconds"] - (start or 0.0), ".4f"),
                number(row["seconds"] if name == OURS else None, ".4f"),
                number(row["times_ours"], ".2f"),
                number(row["rms_px"], ".4f"),
                number(row["focal_error_px"], "+.3f"),
                str(row["mirrored"]),
                number(row.get("peak_mib"), ".0f"),
            )
        )
    table(f"{found['frames']} frames, {found['corners']} corners, median of {repeat} turns", head, rows)
    if found["fastest_peer_times_ours"] is not None:
        print(f"  turn by turn, the fastest peer takes {found['fastest_peer_times_ours']:.2f} times as long as we do")


def print_growth(title: str, rows: Sequence[Mapping[str, float]]) -> None:
    head = ("", "frames", "seconds", "us each", "rms px", "focal error px", "peak MiB")
    cells = [
        (
            f"{row['size']:.0f}",
            number(row.get("frames", row["size"]), ".0f"),
            number(row["seconds"], ".4f"),
            number(1e6 * row["seconds"] / row["size"], ".2f"),
            number(row["rms_px"], ".4f"),
            number(row["focal_error_px"], "+.3f"),
            number(row.get("peak_mib"), ".0f"),
        )
        for row in rows
    ]
    table(title, head, cells)
    if (slope := exponent(rows)) is not None:
        print(f"  seconds grow as the power {slope:.3f} of the number, over the last {LAST_DECADES:.0f} decades")


# ---- the whole ------------------------------------------------------------------------------------------------------


def environment() -> dict[str, Any]:
    names = ("ceres-cal", "numpy", "numba", "pyceres", "pycolmap", "opencv-python-headless")
    return {
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in names},
        "load_before": os.getloadavg(),
    }


def measure(sizes: argparse.Namespace) -> dict[str, Any]:
    """Everything asked for, printed as it comes."""
    report: dict[str, Any] = {"environment": environment()}
    print(f"{report['environment']}\nthreads: each solver as many as it takes by itself; pycolmap num_threads -1")
    imports = {name: import_seconds(name, sizes.repeat) for name in (OURS, *sizes.peers)}
    for name in (name for name, seconds in imports.items() if seconds is None):
        print(f"{name} is skipped: {MRCAL_PYTHON if name == 'mrcal' else sys.executable} cannot import {MODULES[name]}")
    report["import_seconds"] = imports
    report["first_call_seconds"] = [alone("first", WARM_UP_FRAMES) for _ in range(2)][-1]  # the first may compile
    print(f"a process' first calibration takes {report['first_call_seconds']:.2f} s more: compiled kernels are loaded")
    solvers: dict[str, Solver] = {OURS: solve_ours, **{name: PEERS[name] for name in sizes.peers if imports[name]}}
    if "mrcal" in solvers:
        solvers["mrcal"] = lambda corners: solve_apart("mrcal", corners)[0]
    report["comparison"] = []
    for frames in sizes.frames:
        found = compare(frames, solvers, sizes.repeat)
        if sizes.memory and frames == max(sizes.frames):
            add_memory(found)
        report["comparison"].append(found)
        print_comparison(found, imports, sizes.repeat)
    if sizes.growth:
        report["frames"] = [frames_growth(frames, sizes.repeat) for frames in sizes.growth]
        print_growth("growth with the frames, ours", report["frames"])
    if sizes.points:
        report["field"] = [alone("field", count, sizes.repeat) for count in sizes.points]
        print_growth("growth with the line points of a static camera over a field, ours", report["field"])
    report["environment"]["load_after"] = os.getloadavg()
    print(f"\nload {report['environment']['load_before'][0]:.2f} before, {os.getloadavg()[0]:.2f} after")
    return report


def numbers(text: str) -> list[int]:
    """ "20,1e3" -> [20, 1000]"""
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
    parser.add_argument("--memory", action="store_true", help="peak memory of each solver at the most frames, too")
    parser.add_argument("--json", type=Path, help="write everything measured to this file")
    parser.add_argument("--quick", action="store_true", help="smallest sizes, one turn: does it run?")
    parser.add_argument("--alone", nargs=3, help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.alone:
        task, size, repeat = chosen.alone
        print(json.dumps(TASKS[task](int(size), int(repeat))))
        return 0
    if chosen.quick:
        chosen.frames, chosen.growth, chosen.points, chosen.repeat = [20], [20, 40], [1000], 1
    report = measure(chosen)
    if chosen.json:
        chosen.json.write_text(json.dumps(report, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
