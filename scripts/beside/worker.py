"""A peer in its own Python: python scripts/beside/worker.py PEER JOBS.json ANSWERS.json

JOBS is a list of tasks, each with a setting and files of corners; an answer is a dictionary, or a refusal. All peers
are asked by this same code.
"""

from __future__ import annotations

import json
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np
from benchmarks.peers import Corners, peak_mib

from beside.peer_fit import PeerFit, agreement, grid_of, held_out, turn_basis

MODULES = {name: f"beside.{name}_peer" for name in ("ours", "opencv", "mrcal", "pycolmap", "calibsense", "lensboy")}


def fitted(peer: str, job: dict[str, Any], corners: Corners) -> PeerFit:
    found: PeerFit = import_module(MODULES[peer]).SETTINGS[job["setting"]](corners)
    return found


def pair(peer: str, job: dict[str, Any]) -> dict[str, Any]:
    """Two halves of the views: difference of their calibrations over what they state."""
    halves = [Corners.load(Path(path)) for path in job["corners"]]
    first, second = (fitted(peer, job, half) for half in halves)
    return agreement(first, second, grid_of(Corners.load(Path(job["whole"]))))


def predict(peer: str, job: dict[str, Any]) -> dict[str, Any]:
    """One half is calibrated, the poses of the other half are solved for: residuals, and their predicted squares."""
    known, new = (Corners.load(Path(path)) for path in job["corners"])
    lengths, expected = held_out(fitted(peer, job, known), new)
    return {"lengths": lengths.tolist(), "expected": expected.tolist()}


def answer(peer: str, job: dict[str, Any]) -> dict[str, Any]:
    """The camera itself, with its messages and stated uncertainties."""
    (corners,) = (Corners.load(Path(path)) for path in job["corners"])
    found = fitted(peer, job, corners)
    rays = found.rays(np.array(job["pixels"])) if "pixels" in job else np.empty((0, 3))
    return {
        "names": found.names, "values": found.values.tolist()[:12], "noise_px": found.noise_px,
        "sd": None if found.sd is None else found.sd.tolist(), "said": found.said, "taken_out": found.taken_out,
        "rays": rays.tolist(), "stated": _stated(found, rays), "more": found.more, "board": found.board.tolist(),
    }  # fmt: skip


def _stated(found: PeerFit, rays: Any) -> list[float] | None:
    shown = rays[np.isfinite(rays[:, 0])]
    if not len(shown):
        return None
    stated = found.stated_squares(shown, turn_basis(found, shown), at_infinity=True)
    return None if stated is None else stated.tolist()


def timed(peer: str, job: dict[str, Any]) -> dict[str, Any]:
    """Seconds of the first solve and of the fastest one, and the peak memory."""
    corners = Corners.load(Path(job["corners"][0]))
    first, repeat = time.perf_counter(), job["repeat"]
    fitted(peer, job, corners)
    seconds = [time.perf_counter() - first]
    for _ in range(repeat - 1):
        start = time.perf_counter()
        fitted(peer, job, corners)
        seconds.append(time.perf_counter() - start)
    return {"first": seconds[0], "best": min(seconds), "peak_mib": peak_mib()}


TASKS = {"pair": pair, "predict": predict, "answer": answer, "timed": timed}


def work(peer: str, jobs: str, answers: str) -> int:
    jobs_given = json.loads(Path(jobs).read_text(encoding="utf-8"))
    if all(job["task"] != "timed" for job in jobs_given):
        cv2.setNumThreads(1)  # its threads wait for each other while other processes run
    found = []
    for job in jobs_given:
        start = time.perf_counter()
        try:
            one = TASKS[job["task"]](peer, job)
        except Exception as error:  # an error of any type is a refusal, and is reported
            one = {"refused": f"{type(error).__name__}: {error}"[:400]}
        found.append(one | {"seconds": time.perf_counter() - start})
    Path(answers).write_text(json.dumps(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(work(*sys.argv[1:]))
