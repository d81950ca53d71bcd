"""Time and memory: corners to a result, whole processes, photographs to a result. Best of several turns.

All solve for the nine numbers of OpenCV's default lens without an initial estimate. A whole process reads the corners,
imports its library, calibrates and ends; mrcal's is its program. Memory is the peak memory of such a process.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.photographs import _OPENCV, _OURS, BoardSet, board_sets
from benchmarks.problems import wide_lens
from benchmarks.process import Cost

from beside.environments import OURS, python_of

FRAMES = (20, 100, 400, 1000)
SOLVED: Mapping[str, str] = {
    OURS: "brown, free aspect", "opencv": "calibrateCamera", "mrcal": "solve alone", "pycolmap": "OPENCV",
    "calibsense": "default", "lensboy": "default",
}  # fmt: skip
DEFAULTS: Mapping[str, str] = {OURS: "default"}
"""Additional settings that are timed."""
_WORKER = Path(__file__).with_name("worker.py")
_REPEAT = 3
_LONG_S = 20.0  # a solve after which its process is not repeated


def corner_rows(peers: Sequence[str], frames: Sequence[int], turns: int) -> list[dict[str, Any]]:
    """For each number of frames and peer: the fastest solve, the fastest whole process, and its memory."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        for count in frames:
            path = Path(name) / f"{count}.npz"
            wide_lens(count).corners.save(path)
            own = [(peer, SOLVED[peer]) for peer in peers] + [(p, s) for p, s in DEFAULTS.items() if p in peers]
            found: dict[tuple[str, str], list[dict[str, Any]]] = {key: [] for key in own}
            for _ in range(turns):
                for peer, setting in own:
                    if not any(one.get("long") for one in found[peer, setting]):
                        found[peer, setting].append(_turn(peer, setting, path, Path(name)))
            rows += [_row(count, *key, said) for key, said in found.items()]
    return rows


def _row(count: int, peer: str, setting: str, said: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    row: dict[str, Any] = {"frames": count, "peer": peer, "setting": setting, "turns": len(said)}
    kept = [one for one in said if "refused" not in one]
    if not kept:
        return row | {"refused": said[0]["refused"]}
    return row | {name: min(one[name] for one in kept) for name in ("solve_s", "whole_s", "processor_s", "peak_mib")}


def _turn(peer: str, setting: str, path: Path, folder: Path) -> dict[str, Any]:
    """One whole process with a single solve, then one with several; the fastest solve counts."""
    once, spent = _process(peer, setting, path, folder, 1)
    if "refused" in once:
        return once
    found = {"whole_s": spent.wall, "processor_s": spent.processor, "peak_mib": once["peak_mib"]}
    long = once["best"] > _LONG_S
    best = once["best"] if long else min(once["best"], _process(peer, setting, path, folder, _REPEAT)[0]["best"])
    return found | {"solve_s": best, "long": long}


def _process(peer: str, setting: str, path: Path, folder: Path, repeat: int) -> tuple[dict[str, Any], Cost]:
    jobs, answers = folder / "jobs.json", folder / "answers.json"
    jobs.write_text(json.dumps([{"task": "timed", "setting": setting, "corners": [str(path)], "repeat": repeat}]))
    used = _spent([python_of(peer), str(_WORKER), peer, str(jobs), str(answers)])
    (found,) = json.loads(answers.read_text(encoding="utf-8"))
    return found, used


def _spent(command: Sequence[str]) -> Cost:
    """Cost of one process; another Python must not find this one's packages, and stores its compiled modules."""
    variables = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    before, start = os.times(), time.perf_counter()
    done = subprocess.run(command, env=variables, capture_output=True, check=False)
    wall, after = time.perf_counter() - start, os.times()
    processor = after.children_user - before.children_user + after.children_system - before.children_system
    return Cost(wall, processor, done.returncode)


# ---- photographs ----------------------------------------------------------------------------------------------------


def photograph_rows(peers: Sequence[str], turns: int) -> list[dict[str, Any]]:
    """From photographs of a board to a result, whole processes in turns, for peers that detect plain boards."""
    rows = []
    for one in board_sets():
        with tempfile.TemporaryDirectory() as name:
            programs = _programs(one, peers, Path(name))
            found: dict[str, list[Cost]] = {key: [] for key in programs}
            for _ in range(turns + 1):  # the first one fills the file cache; the best counts
                for key, command in programs.items():
                    if not any(one.wall > _LONG_S for one in found[key]):
                        found[key].append(_spent(command))
        for key, said in found.items():
            kept = [spent for spent in said if spent.code == 0]
            row: dict[str, Any] = {"set": one.name, "photographs": len(one.paths), "method": key}
            if kept:
                row |= {"whole_s": min(s.wall for s in kept), "processor_s": min(s.processor for s in kept)}
            rows.append(row | ({} if kept else {"refused": "it ends with an error"}))
    return rows


def _programs(one: BoardSet, peers: Sequence[str], folder: Path) -> dict[str, list[str]]:
    size = [str(one.columns), str(one.rows)]
    opencv = python_of("opencv")
    programs = {
        "ceres-cal": [sys.executable, "-c", _OURS, *size, *one.paths],
        "OpenCV, plain finder": [opencv, "-c", _OPENCV, "plain", *size, *one.paths],
        "OpenCV, accurate finder": [opencv, "-c", _OPENCV, "accurate", *size, *one.paths],
    }
    if "calibsense" in peers:
        for path in map(Path, one.paths):
            (folder / path.name).symlink_to(path.resolve())
        python, target = python_of("calibsense"), f"checkerboard:{one.columns}x{one.rows}:30mm"
        session = str(folder / "session.npz")
        steps = [["ingest", "images", "--images", str(folder), "--target", target, "-o", session], ["refit", session]]
        lines = " && ".join(" ".join([python, "-m", "calibsense", *step]) for step in steps)
        programs["calibsense"] = ["bash", "-c", lines]
    return programs
