"""Ten faulty inputs, the same for all peers: who notices, and who states a small error for a wrong answer?

Sixteen views of a board of 9 x 6 corners, 25 mm apart, in front of a known camera, with 0.15 px of noise; each input
has one fault. "Named": a message says what is wrong. "Said": a message is printed that the correct input does not
cause, or corners are removed. Errors of f, cx and cy show how wrong the answer is.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmarks.peers import Array, Corners

from beside.boards import Task
from beside.environments import OURS
from beside.opencv_peer import NAMES, brown
from beside.peer_fit import PeerFit, grid_of, turn_basis

SIZE, GRID, SQUARE_M = (1280, 960), (9, 6), 0.025
TRUTH = np.array([900.0, 900.0, 655.3, 471.1, -0.22, 0.08, 2e-4, -1e-4, 0.0])
VIEWS, NOISE_PX = 16, 0.15
ASKED: Mapping[str, str] = {
    OURS: "audit", "opencv": "default", "mrcal": "default", "pycolmap": "OPENCV", "calibsense": "audit",
    "lensboy": "default",
}  # fmt: skip
"""The setting of each peer that reports most."""
WRONG_SDS, WRONG_TIMES = 5.0, 3.0
"""An answer is wrong beyond so many standard deviations of f, cx or cy, or times the stated error of projections."""
SOUND_SD_PX = {"fx": 2.0, "phi": 2.0, "cx": 0.8, "cy": 0.8}
"""Approximately the sigmas that OpenCV states for the correct input, in px, for answers that state no uncertainty."""


@dataclass(frozen=True)
class Fault:
    """One faulty input.

    Attributes:
        words: pattern that a message must contain to name the fault. what: for the page. scale: factor of the lengths
            in the answer.
    """

    what: str
    words: str
    make: Callable[[Corners], Corners]
    scale: float = 1.0


def _poses() -> Array:
    """(V, 6) rotation vectors and translations of the views."""
    rng = np.random.default_rng(4)
    width, height = (np.array(GRID) - 1) * SQUARE_M
    poses: list[Array] = []
    while len(poses) < VIEWS:
        turn = rng.normal(size=3) * (0.4, 0.4, 0.3)
        middle = np.array([rng.uniform(-0.13, 0.13), rng.uniform(-0.09, 0.09), rng.uniform(0.3, 0.5)])
        rotation = cv2.Rodrigues(turn)[0]
        pose = np.concatenate([turn, middle - rotation @ (0.5 * width, 0.5 * height, 0.0)])
        if np.all(_seen(pose, _board()) > 5.0) and np.all(_seen(pose, _board()) < np.array(SIZE) - 6.0):
            poses.append(pose)
    return np.array(poses)


def _board() -> Array:
    number = np.arange(GRID[0] * GRID[1])
    return np.asarray(np.column_stack([number % GRID[0], number // GRID[0], 0 * number]) * SQUARE_M, dtype=float)


def _seen(pose: Array, board: Array, values: Array = TRUTH) -> Array:
    return brown(np.asarray(board @ cv2.Rodrigues(pose[:3])[0].T + pose[3:], dtype=float), values)


def sound(board: Array | None = None, values: Callable[[int], Array] = lambda view: TRUTH) -> Corners:
    """The correct views, or views of another board, or by a camera that changes from view to view."""
    rng = np.random.default_rng(5)
    pixels = np.vstack([_seen(p, _board() if board is None else board, values(n)) for n, p in enumerate(_poses())])
    count = len(_board())
    return Corners(
        np.array(SIZE), np.array(GRID), np.array(SQUARE_M), np.repeat(np.arange(VIEWS, dtype=np.int32), count),
        np.tile(np.arange(count, dtype=np.int32), VIEWS), pixels + NOISE_PX * rng.standard_normal(pixels.shape),
    )  # fmt: skip


# ---- faults ---------------------------------------------------------------------------------------------------------


def _transposed(corners: Corners) -> Corners:
    pixels, first = corners.pixels.copy(), 3 * len(_board()) + 20
    pixels[[first, first + 1]] = pixels[[first + 1, first]]
    return replace(corners, pixels=pixels)


def _mirrored(corners: Corners) -> Corners:
    return replace(corners, pixels=np.column_stack([SIZE[0] - 1.0 - corners.pixels[:, 0], corners.pixels[:, 1]]))


def _moved(corners: Corners) -> Corners:
    knocked = TRUTH * [1.015, 1.015, 1.0, 1.0, *[1.0] * 5] + [0.0, 0.0, 8.0, -9.0, *[0.0] * 5]
    return sound(values=lambda view: TRUTH if view >= VIEWS // 2 else knocked)


def _bent(corners: Corners) -> Corners:
    board = _board()
    along = board[:, 0] / board[:, 0].max()
    board[:, 2] = 4.0 * 0.0015 * along * (1.0 - along)
    return sound(board)


def _repeated(corners: Corners) -> Corners:
    count, times = len(_board()), 8
    rows = np.concatenate([np.arange(len(corners.view)), *[np.arange(2 * count, 3 * count)] * times])
    view = np.repeat(np.arange(VIEWS + times, dtype=np.int32), count)
    return replace(corners, view=view, feature=corners.feature[rows], pixels=corners.pixels[rows])


def _blurred(corners: Corners) -> Corners:
    """Every third view is rendered with a motion of the camera, 14 px at its middle, and measured with OpenCV's
    cornerSubPix.
    """
    pixels, count = corners.pixels.copy(), len(_board())
    for view, pose in list(enumerate(_poses()))[::3]:
        picture = _picture(pose, np.linspace(0.0, 1.0, 9) ** 2)
        start = _seen(pose, _board()).astype(np.float32) + np.float32(2.0)
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
        pixels[view * count : (view + 1) * count] = cv2.cornerSubPix(picture, start, (9, 9), (-1, -1), criteria)
    return replace(corners, pixels=pixels)


def _picture(pose: Array, moments: Array) -> Any:
    """A board seen by the camera while it turns by 14 px about its y axis and rolls a little."""
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    matrix = np.array([[TRUTH[0], 0.0, TRUTH[2]], [0.0, TRUTH[1], TRUTH[3]], [0.0, 0.0, 1.0]])
    pixels = np.column_stack([x.ravel(), y.ravel()]).astype(np.float32)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-8)
    flat = (
        cv2.undistortPointsIter(pixels, matrix, TRUTH[4:], None, None, criteria)
        if hasattr(cv2, "undistortPointsIter")
        else cv2.undistortPoints(pixels, matrix, TRUTH[4:])
    )
    rays = np.column_stack([flat.reshape(-1, 2), np.ones(len(pixels))])
    light = np.zeros(len(pixels))
    for moment in moments:
        turned = cv2.Rodrigues(np.array([0.0, 14.0 / TRUTH[0], 0.01]) * moment)[0]
        rotation = turned @ cv2.Rodrigues(pose[:3])[0]
        shift = turned @ pose[3:]
        normal = rotation[:, 2]
        there = rays * ((normal @ shift) / (rays @ normal))[:, None] - shift
        column, row = (there @ rotation[:, :2]).T / SQUARE_M
        inside = (column > -1.5) & (column < GRID[0] + 0.5) & (row > -1.5) & (row < GRID[1] + 0.5)
        light += np.where(inside, 200.0 * ((np.floor(column) + np.floor(row)) % 2 == 0) + 30.0, 230.0)
    shown = (light / len(moments)).reshape(SIZE[1], SIZE[0])
    return np.clip(cv2.GaussianBlur(shown, (0, 0), 0.8), 0, 255).astype(np.uint8)


SOUND = "sound"
FAULTS: Mapping[str, Fault] = {
    SOUND: Fault("nothing is wrong", "^$", lambda corners: corners),
    "transposed label": Fault(
        "two neighbouring corners of one view under each other's labels", "label|exchang|swap|transpos", _transposed
    ),
    "mirrored board": Fault("every picture is mirrored left to right", "mirror|behind|left-handed", _mirrored),
    "moved camera": Fault(
        "the lens was knocked half-way: 12 px of the principal point, 1.5 % of the focal length",
        "moved|knocked|bumped|not the same camera|changed between", _moved,
    ),
    "wrong square": Fault(
        "squares of 25 mm are said to be 30 mm", "square|scale of the board",
        lambda c: replace(c, square_m=np.array(0.03)), 1.2,
    ),
    "half-pixel convention": Fault(
        "pixels count from the corner of the first one, not from its middle", "half a pixel|half-pixel",
        lambda c: replace(c, pixels=c.pixels + 0.5),
    ),
    "bent board": Fault("the board is bowed by 1.5 mm over 200 mm", "warp|bow|bent|not flat|not as drawn", _bent),
    "blur": Fault("every third view was taken with 14 px of motion", "blur|motion", _blurred),
    "exchanged axes": Fault(
        "pixels are (row, column)", "axes|row, column|outside its image|exchanged",
        lambda c: replace(c, pixels=c.pixels[:, ::-1].copy()),
    ),
    "repeated picture": Fault(
        "one picture is there nine times", "repeat|cop(y|ies)|same picture|duplicate|identical", _repeated
    ),
    "millimetres for metres": Fault(
        "squares of 25 mm are said to be 25 m", "millimet|unit|metres",
        lambda c: replace(c, square_m=np.array(25.0)), 1000.0,
    ),
}  # fmt: skip


# ---- answers --------------------------------------------------------------------------------------------------------


def tasks(peers: Sequence[str], folder: Path, faults: Sequence[str] = tuple(FAULTS)) -> Iterator[Task]:
    """Each fault for each peer."""
    grid = grid_of(sound())
    for name in faults:
        fault = FAULTS[name]
        path = folder / f"{name}.npz"
        fault.make(sound()).save(path)
        for peer in peers:
            job = {"task": "answer", "setting": ASKED[peer], "corners": [str(path)], "pixels": grid.tolist()}
            yield Task(name, peer, ASKED[peer], job)


def rows(given: Sequence[Task], found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For each fault and peer: its messages, and the errors of its answer beside the stated ones."""
    usual = {task.peer: one for task, one in zip(given, found, strict=True) if task.name == SOUND}
    return [_row(task, one, usual[task.peer]) for task, one in zip(given, found, strict=True)]


def _row(task: Task, one: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    fault, row = FAULTS[task.name], {"fault": task.name, "peer": task.peer, "setting": task.setting}
    if "refused" in one:
        named = bool(re.search(fault.words, one["refused"], re.IGNORECASE))
        return row | {"said": [one["refused"][:200]], "notices": "refuses, named" if named else "refuses"}
    before = {_kind(line) for line in usual.get("said", ())}
    new = [line for line in one["said"] if _kind(line) not in before]
    named = any(re.search(fault.words, line, re.IGNORECASE) for line in new)
    more = one["taken_out"] > usual.get("taken_out", 0) + 1
    notices = "named" if named else "takes corners out" if more else "says something" if new else "no"
    return (
        row
        | {"notices": notices, "said": [line[:200] for line in new[:4]], "taken_out": one["taken_out"]}
        | _wrong(one, fault)
    )


def _kind(line: str) -> str:
    """A message without its numbers."""
    return re.sub(r"[-+\d.e±]+", "#", line)[:40]


def _wrong(one: Mapping[str, Any], fault: Fault) -> dict[str, Any]:
    """Errors of the answer, in its own standard deviations where it states them."""
    names = {name: number for number, name in enumerate(one["names"])}
    truth = {"fx": TRUTH[0], "phi": TRUTH[0], "cx": TRUTH[2], "cy": TRUTH[3]}
    known = [name for name in truth if name in names]
    off = {name: float(one["values"][names[name]] - truth[name]) for name in known}
    found: dict[str, Any] = {"off": {name: round(value, 3) for name, value in off.items()}, "scale": fault.scale}
    if one["sd"] is not None:
        found["sds"] = float(max(abs(off[name]) / max(one["sd"][names[name]], 1e-12) for name in known))
    pixels, rays = grid_of(sound()), np.array(one["rays"], dtype=float)
    kept = np.isfinite(rays[:, 0])
    true = PeerFit(NAMES[:9], TRUTH, brown, _board())
    there = true.seen(rays[kept])
    basis = turn_basis(true, rays[kept])
    left = (there - pixels[kept]).ravel()
    left -= basis @ (basis.T @ left)
    found["off_px"] = float(np.sqrt(np.mean(np.sum(left.reshape(-1, 2) ** 2, axis=1))))
    if one["stated"] is not None:
        found["stated_px"] = float(np.sqrt(np.nanmean(np.array(one["stated"], dtype=float))))
    usual = max(abs(off[name]) / SOUND_SD_PX[name] for name in known)
    sds = found.get("sds", 0.0 if "stated_px" in found else usual)
    beyond = found["off_px"] > WRONG_TIMES * found.get("stated_px", np.inf)
    found["wrong"] = bool(sds > WRONG_SDS or beyond or fault.scale != 1.0)
    return found
