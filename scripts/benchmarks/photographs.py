"""From photographs to a calibration: whole processes, ours and OpenCV's in turns. Run benchmark.py --photographs.

Our programs detect the board and calibrate with default options: once in Python, as OpenCV's programs do, and once as
two commands with files. OpenCV's programs use the usual finder with cornerSubPix, or the newer, exhaustive and accurate
one, and then call calibrateCamera with the boards that were found. Fields have no peer: our command is run for each
photograph.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from photos.real_data import real_place
from photos.shared import known_photographs

from benchmarks.process import Cost, command_of, spent

SAMPLE = Path(__file__).parents[2] / "data" / "ssl_field" / "photographs"
_OURS = """
import sys
from pathlib import Path
from time import process_time
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import detect_boards
from ceres_cal.scene.targets import checkerboard
columns, rows, *paths = sys.argv[1:]
imported = process_time()
found = detect_boards([Path(path) for path in paths], checkerboard(int(columns), int(rows), 0.03))
detected = process_time()
fit = calibrate(found.observations).fit
print(len(found.found), fit.points_rms_px, imported, detected - imported, process_time() - detected)
"""
_OPENCV = """
import sys, cv2, numpy as np
finder, columns, rows, *paths = sys.argv[1:]
shape = int(columns), int(rows)
board = np.zeros((shape[0] * shape[1], 3), np.float32)
board[:, :2] = 0.03 * np.mgrid[: shape[0], : shape[1]].T.reshape(-1, 2)
corners, criteria = [], (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.001)
for path in paths:
    image = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
    if finder == "plain":
        found, seen = cv2.findChessboardCorners(image, shape)
        seen = cv2.cornerSubPix(image, seen, (5, 5), (-1, -1), criteria) if found else None
    else:
        found, seen = cv2.findChessboardCornersSB(image, shape, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)
    if found:
        corners.append(seen)
rms = cv2.calibrateCamera([board] * len(corners), corners, image.shape[::-1], None, None)[0]
print(len(corners), rms)
"""


@dataclass(frozen=True)
class BoardSet:
    """Photographs of one board, and its number of inner corners."""

    name: str
    paths: tuple[str, ...]
    columns: int
    rows: int


def board_sets() -> Iterator[BoardSet]:
    """The sample's boards, and the real ones that are installed: see `photos.real_data`."""
    real, folders = real_place(), (("boofcv_sony_chess/*.jpg", 4, 6), ("udacity_gopro_wide/GOPR*.jpg", 8, 6))
    patterns = [("the sample", SAMPLE, "board_*.jpg", 9, 6)]
    patterns += [("OpenCV's left camera", real, "opencv_left_right/left*.jpg", 9, 6)]
    patterns += [("OpenCV's right camera", real, "opencv_left_right/right*.jpg", 9, 6)]
    patterns += [(name.partition("/")[0], real, name, columns, rows) for name, columns, rows in folders]
    for name, folder, pattern, columns, rows in patterns:
        if paths := sorted(folder.glob(pattern)):
            yield BoardSet(f"{name}, {len(paths)}", tuple(map(str, paths)), columns, rows)


def photograph_rows(repeat: int) -> list[dict[str, Any]]:
    """A row for each set: medians, and the median ratio within each turn, in elapsed and in processor time."""
    return [_row(one, repeat) for one in board_sets()]


def _row(one: BoardSet, repeat: int) -> dict[str, Any]:
    size = [str(one.columns), str(one.rows)]
    programs = {
        "ours": [_OURS, *size, *one.paths],
        "plain": [_OPENCV, "plain", *size, *one.paths],
        "accurate": [_OPENCV, "accurate", *size, *one.paths],
    }
    row: dict[str, Any] = {"set": one.name}
    for name, program in programs.items():  # so that files are cached
        said = subprocess.run([sys.executable, "-c", *program], capture_output=True, text=True, check=True).stdout
        boards, rms_px, *parts = map(float, said.split())
        row[f"{name}_boards"], row[f"{name}_rms_px"] = int(boards), rms_px
        row |= dict(zip(("imports", "corners", "calibration"), parts, strict=False))
    turns = []
    for _ in range(repeat):
        turn = {name: spent([sys.executable, "-c", *program]) for name, program in programs.items()}
        turns.append(turn | {"commands": _commands(one)})
    for what, ending in (("wall", ""), ("processor", "_processor")):
        for name in (*programs, "commands"):
            row[f"{name}{ending}"] = median(getattr(turn[name], what) for turn in turns)
        for peer in ("plain", "accurate"):
            ratios = [getattr(turn["ours"], what) / getattr(turn[peer], what) for turn in turns]
            row[f"times_{peer}{ending}"] = median(ratios)
    return row


def _commands(one: BoardSet) -> Cost:
    """`detect board` and then `calibrate`."""
    with tempfile.TemporaryDirectory() as folder:
        board, camera = f"{folder}/board.json", f"{folder}/camera.json"
        size = ["--columns", str(one.columns), "--rows", str(one.rows), "--square", "30mm"]
        steps = [
            spent(command_of("detect", "board", *one.paths, *size, "-o", board, "--quiet")),
            spent(command_of("calibrate", board, "-o", camera, "--quiet")),
        ]
    return Cost(sum(step.wall for step in steps), sum(step.processor for step in steps))


def field_rows() -> list[dict[str, Any]]:
    """Time of `detect field --auto` for each photograph of a field, and whether it finds the field.

    The photographs are the sample's and, if installed, those of another renderer, each with the options a user would
    give.
    """
    asked = [(path, "ssl-b", "LeftGoalLine=top") for path in sorted(SAMPLE.glob("000*.jpg"))]
    for known in known_photographs(real_place().parent / "photos"):
        asked.append((known.path, known.truth["asked_as"], known.truth["facing"]))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for path, target, facing in asked:
            options = ["--target", target, "--auto", "--facing", facing, "-o", f"{folder}/field.json", "--quiet"]
            one = spent(command_of("detect", "field", str(path), *options), codes=(0, 1, 2, 3))
            rows.append({"photograph": path.name, "found": one.code == 0, "wall": one.wall, "processor": one.processor})
    return rows


def field_summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Median and longest processor time, of found fields and of refusals."""
    kinds = {"found": True, "refused": False}
    own = {name: [row["processor"] for row in rows if row["found"] is kind] for name, kind in kinds.items()}
    return [
        {"fields": name, "photographs": len(times), "median": median(times), "worst": max(times)}
        for name, times in own.items()
        if times
    ]
