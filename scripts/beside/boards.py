"""Two questions for real boards: is the stated uncertainty true, and are new views predicted?

Truth: random halves of the views are calibrated separately; their difference is divided by what both state.
Prediction: every other view is held out, and only its pose is solved for, by the same code for all peers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.peers import Array, Corners

from beside.environments import OURS, ask
from beside.sets import of_views

WIDE = ("ov plane", "fisheye")
"""Sets that are too wide for a pinhole with a polynomial."""
STATED: Mapping[str, Sequence[str]] = {
    OURS: ("default",),
    "opencv": ("default",),
    "mrcal": ("default",),
    "pycolmap": ("OPENCV",),
    "calibsense": ("default", "clustered"),
}
"""Settings of the peers that state an uncertainty."""
_WIDE_STATED: Mapping[str, Sequence[str]] = {
    OURS: ("default",),
    "mrcal": ("default",),
    "pycolmap": ("OPENCV_FISHEYE",),
    "calibsense": ("fisheye", "fisheye, clustered"),
}
PREDICTING: Mapping[str, Sequence[str]] = {
    OURS: ("default", "as drawn", "brown", "kannala-brandt", "spline"),
    "opencv": ("default", "as ROS", "rational", "released", "fisheye, as Kalibr's equi"),
    "mrcal": ("default", "OPENCV5", "splined, 11 knots"),
    "pycolmap": ("default", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "OPENCV, Cauchy"),
    "calibsense": ("default", "rational", "fisheye"),
    "lensboy": ("default", "FULL_14", "spline 12x9"),
}
_OTHERS = 3.0  # times the smallest median; an answer below has a vote on which corners count
_FAR = 6.0  # times the median of an answer, above which a corner is an outlier for it


@dataclass(frozen=True)
class Task:
    """One job, with its set, peer and setting."""

    name: str
    peer: str
    setting: str
    job: Mapping[str, Any]


def answers(tasks: Sequence[Task], jobs: int) -> list[dict[str, Any]]:
    """Answers to all tasks; the tasks of a peer for one set share a process, or all tasks of a peer where jobs is 1."""
    groups: dict[tuple[str, str], list[int]] = {}
    for number, task in enumerate(tasks):
        groups.setdefault((task.peer, task.name if jobs > 1 else ""), []).append(number)
    found: list[dict[str, Any]] = [{} for _ in tasks]
    with ThreadPoolExecutor(max(jobs, 1)) as executor:
        run = executor.map(lambda own: ask(own[0][0], [tasks[k].job for k in own[1]]), groups.items())
        for own, said in zip(groups.values(), run, strict=True):
            for number, one in zip(own, said, strict=True):
                found[number] = one
    return found


# ---- truth ----------------------------------------------------------------------------------------------------------


def truth_tasks(sets: Mapping[str, Corners], peers: Sequence[str], splits: int, folder: Path) -> Iterator[Task]:
    """Random halves of each set, for each peer that states an uncertainty."""
    for name, corners in sets.items():
        whole = _saved(folder / f"{name}.npz", corners)
        for split in range(splits):
            order = np.random.default_rng(split).permutation(corners.frames)
            first = np.isin(np.arange(corners.frames), order[: corners.frames // 2])
            paths = [
                _saved(folder / f"{name}-{split}-{half}.npz", of_views(corners, own))
                for half, own in enumerate((first, ~first))
            ]
            for peer, settings in (_WIDE_STATED if name in WIDE else STATED).items():
                for setting in settings if peer in peers else ():
                    job = {"task": "pair", "setting": setting, "corners": paths, "whole": whole}
                    yield Task(name, peer, setting, job)


def truth_rows(tasks: Sequence[Task], found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Root mean squares over the splits for each set, peer and setting."""
    rows: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for task, one in zip(tasks, found, strict=True):
        rows.setdefault((task.name, task.peer, task.setting), []).append(one)
    return [_truth_row(*key, own) for key, own in rows.items()]


def _truth_row(name: str, peer: str, setting: str, own: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    kept = [one for one in own if "refused" not in one]
    row: dict[str, Any] = {"set": name, "peer": peer, "setting": setting, "splits": len(kept)}
    for what in ("numbers", "projections", "apart_px", "stated_px"):
        values = [one[what] for one in kept if what in one]
        if values:
            row[what] = float(np.sqrt(np.mean(values)))
    if len(kept) < len(own):
        row["refused"] = next(one["refused"] for one in own if "refused" in one)[:160]
    return row


# ---- prediction -----------------------------------------------------------------------------------------------------


def prediction_tasks(sets: Mapping[str, Corners], peers: Sequence[str], folder: Path) -> Iterator[Task]:
    """Each set is split into two halves (views in turns), and each half predicts the other, for every setting."""
    for name, corners in sets.items():
        turn = np.arange(corners.frames) % 2 == 0
        paths = [
            _saved(folder / f"{name}-turn-{half}.npz", of_views(corners, own)) for half, own in enumerate((turn, ~turn))
        ]
        for peer, settings in PREDICTING.items():
            for setting in settings if peer in peers else ():
                for pair in (paths, paths[::-1]):
                    yield Task(name, peer, setting, {"task": "predict", "setting": setting, "corners": pair})


def prediction_rows(tasks: Sequence[Task], found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For each set, peer and setting: rms over the corners that count for all, and its ratio to the predicted rms."""
    rows: list[dict[str, Any]] = []
    for name in dict.fromkeys(task.name for task in tasks):
        own: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
        for task, one in zip(tasks, found, strict=True):
            if task.name == name:
                own.setdefault((task.peer, task.setting), []).append(one)
        whole = {key: _joined(parts) for key, parts in own.items() if all("refused" not in one for one in parts)}
        counted = _counted([lengths for lengths, _ in whole.values()])
        for (peer, setting), parts in own.items():
            row: dict[str, Any] = {"set": name, "peer": peer, "setting": setting}
            if (peer, setting) in whole:
                lengths, expected = whole[peer, setting]
                squares = lengths[counted] ** 2
                row["rms_px"] = float(np.sqrt(np.mean(squares)))
                if np.isfinite(expected).all():
                    row["over_predicted"] = float(np.sqrt(np.sum(squares) / np.sum(expected[counted])))
            else:
                row["refused"] = next(one["refused"] for one in parts if "refused" in one)[:160]
            rows.append(row)
    return rows


def _joined(parts: Sequence[Mapping[str, Any]]) -> tuple[Array, Array]:
    lengths, expected = ([np.array(one[what], dtype=float) for one in parts] for what in ("lengths", "expected"))
    return np.concatenate(lengths), np.concatenate(expected)


def _counted(lengths: Sequence[Array]) -> Any:
    """(N,) whether a corner counts: it is not an outlier for half of the useful answers or more."""
    medians = [float(np.median(one)) for one in lengths]
    say = [one for one, m in zip(lengths, medians, strict=True) if m < _OTHERS * min(medians)]
    return np.mean([one > _FAR * np.median(one) for one in say], axis=0) < 0.5


def _saved(path: Path, corners: Corners) -> str:
    corners.save(path)
    return str(path)
