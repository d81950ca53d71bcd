"""The other solvers of the benchmark, each on the same corners: OpenCV, pycolmap and mrcal.

Needs only NumPy and the library of the peer, nothing of this package. Therefore mrcal can run in the system's Python,
and each peer in a process of its own. `python scripts/benchmarks/peers.py NAME CORNERS.npz WARM_UP_SECONDS` prints the
answer of a peer.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
WARM_UP_FRAMES = 10


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of a checkerboard, seen in many frames by one camera, in the order of the frames.

    Attributes:
        image_size: (2,) width, height. grid: (2,) columns, rows of corners. square_m: () distance between them.
        view, feature: (N,) number of the frame, and r * columns + c of the corner. pixels: (N, 2).
    """

    image_size: NDArray[np.int64]
    grid: NDArray[np.int64]
    square_m: Array
    view: NDArray[np.int32]
    feature: NDArray[np.int32]
    pixels: Array

    @property
    def frames(self) -> int:
        return int(self.view[-1]) + 1

    @property
    def board(self) -> Array:
        """(columns * rows, 3) m."""
        columns, rows = self.grid
        number = np.arange(columns * rows)
        return np.column_stack([number % columns, number // columns, 0 * number]) * self.square_m

    def by_frame(self) -> tuple[list[Array], list[Array]]:
        """Corners on the board (n, 3) m and in the image (n, 2) px, frame by frame."""
        cuts = np.searchsorted(self.view, np.arange(1, self.frames))
        return np.split(self.board[self.feature], cuts), np.split(self.pixels, cuts)

    def first(self, frames: int) -> Corners:
        """The first frames only."""
        n = int(np.searchsorted(self.view, frames))
        return Corners(self.image_size, self.grid, self.square_m, self.view[:n], self.feature[:n], self.pixels[:n])

    def save(self, path: Path) -> None:
        np.savez(path, **vars(self))

    @classmethod
    def load(cls, path: Path) -> Corners:
        with np.load(path) as archive:
            return cls(**archive)


@dataclass(frozen=True, eq=False)
class Answer:
    """Result of a solver.

    Attributes:
        seconds: of the solve. initialise_seconds: of the initial estimate, where it is known to be a part of them.
        intrinsics: (9,) fx, fy, cx, cy, k1, k2, p1, p2, k3 in OpenCV's notation. cam_from_board: (F, 3, 4) as [R t].
    """

    seconds: float
    intrinsics: Array
    cam_from_board: Array
    initialise_seconds: float = 0.0


def peak_mib() -> float:
    """Peak memory of this process, MiB; NaN where the system does not report it (here only Linux does).

    `resource.getrusage` is not used: its figure outlives `exec`, so that a child starts with its parent's.
    """
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text(encoding="ascii")) if status.exists() else None
    return int(found[1]) / 1024.0 if found else float("nan")


def reset_peak() -> None:
    """Restarts the measurement of the peak memory, where the system supports it (Linux)."""
    switch = Path("/proc/self/clear_refs")
    if switch.exists():
        switch.write_text("5", encoding="ascii")


def _seed(corners: Corners) -> tuple[Array, Array]:
    """Initial estimate without distortion: camera matrix (3, 3) and cam_from_board (F, 3, 4), by OpenCV."""
    import cv2

    objects, images = corners.by_frame()
    size = tuple(corners.image_size.tolist())
    matrix = cv2.initCameraMatrix2D(
        [o.astype(np.float32) for o in objects], [i.astype(np.float32) for i in images], size
    )
    poses = []
    for on_board, pixels in zip(objects, images, strict=True):
        _, turn, shift = cv2.solvePnP(on_board, pixels, matrix, None)
        poses.append(np.column_stack([cv2.Rodrigues(turn)[0], shift]))
    return np.asarray(matrix, dtype=float), np.array(poses)


def solve_opencv(corners: Corners) -> Answer:
    """calibrateCamera with its defaults; its time includes its own initial estimate."""
    import cv2

    objects, images = ([part.astype(np.float32) for part in parts] for parts in corners.by_frame())
    size = tuple(corners.image_size.tolist())
    start = time.perf_counter()
    _, matrix, lens, turns, shifts = cv2.calibrateCamera(objects, images, size, None, None)
    seconds = time.perf_counter() - start
    poses = [np.column_stack([cv2.Rodrigues(turn)[0], shift]) for turn, shift in zip(turns, shifts, strict=True)]
    intrinsics = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *lens.ravel()[:5]]
    return Answer(seconds, np.array(intrinsics), np.array(poses))


def _reconstruction(corners: Corners) -> Any:
    """The corners as a pycolmap reconstruction at the initial estimate; the first pixel's centre is (0.5, 0.5)."""
    import pycolmap

    matrix, poses = _seed(corners)
    width, height = corners.image_size.tolist()
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    camera = pycolmap.Camera(
        camera_id=1, model="OPENCV", width=width, height=height, params=[fx, fy, cx + 0.5, cy + 0.5, 0, 0, 0, 0]
    )
    scene = pycolmap.Reconstruction()
    scene.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in corners.board]
    first = np.searchsorted(corners.view, np.arange(corners.frames))
    for number, (pixels, pose) in enumerate(zip(corners.by_frame()[1], poses, strict=True)):
        image = pycolmap.Image(name=str(number), keypoints=pixels + 0.5, camera_id=1, image_id=number + 1)
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for place in range(len(pixels)):
            tracks[corners.feature[first[number] + place]].add_element(number + 1, place)
    for place_m, track in zip(corners.board, tracks, strict=True):
        scene.add_point3D(place_m, track)
    return scene


def solve_pycolmap(corners: Corners) -> Answer:
    """Bundle adjustment with a fixed board and model OPENCV (no k3, whose true value is 0); only its `solve` counts."""
    import pycolmap

    scene = _reconstruction(corners)
    options = pycolmap.BundleAdjustmentOptions(
        refine_principal_point=True, refine_points3D=False, refine_sensor_from_rig=False, print_summary=False
    )
    options.ceres.solver_options.num_threads = -1
    config = pycolmap.BundleAdjustmentConfig()
    for number in scene.images:
        config.add_image(number)
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, scene)
    start = time.perf_counter()
    adjuster.solve()
    seconds = time.perf_counter() - start
    fx, fy, cx, cy, *lens = scene.cameras[1].params
    poses = [scene.images[number + 1].cam_from_world().matrix() for number in range(corners.frames)]
    return Answer(seconds, np.array([fx, fy, cx - 0.5, cy - 0.5, *lens, 0.0]), np.array(poses))


def solve_mrcal(corners: Corners) -> Answer:
    """mrcal.optimize with LENSMODEL_OPENCV5 from mrcal's own seed; in its grid, unseen corners have weight -1."""
    import mrcal  # type: ignore[import-not-found, unused-ignore]

    columns, rows = corners.grid
    grids = np.full((corners.frames, rows * columns, 3), -1.0)
    grids[corners.view, corners.feature, :2] = corners.pixels
    grids[corners.view, corners.feature, 2] = 1.0
    grids = grids.reshape(corners.frames, rows, columns, 3)
    indices = np.zeros((corners.frames, 2), np.int32)
    indices[:, 0] = np.arange(corners.frames)
    size = corners.image_size.astype(np.int32)[None]
    spacing = float(corners.square_m)
    core, _, frames = mrcal.seed_stereographic(size, 0.5 * float(size[0, 0]), indices, grids, spacing)
    intrinsics = np.concatenate([core, np.zeros((1, 5))], axis=1)
    newer = "rt_ref_frame" in mrcal.optimize.__doc__  # which 2.5 says for frames_rt_toref
    cameras, boards = ("rt_cam_ref", "rt_ref_frame") if newer else ("extrinsics_rt_fromref", "frames_rt_toref")
    seen = np.column_stack([indices, -np.ones_like(indices[:, 1])]).astype(np.int32)
    start = time.perf_counter()
    mrcal.optimize(
        intrinsics=intrinsics,
        **{cameras: None, boards: frames},
        points=None,
        observations_board=grids,
        indices_frame_camintrinsics_camextrinsics=seen,
        observations_point=None,
        indices_point_camintrinsics_camextrinsics=None,
        lensmodel="LENSMODEL_OPENCV5",
        imagersizes=size,
        do_optimize_calobject_warp=False,
        calibration_object_spacing=spacing,
        do_apply_outlier_rejection=False,
        do_apply_regularization=False,
    )
    seconds = time.perf_counter() - start
    poses = np.moveaxis(mrcal.Rt_from_rt(frames), -2, -1)  # its rows are R and then t
    rotations = np.moveaxis(poses[:, :, :3], -2, -1)
    return Answer(seconds, intrinsics[0], np.concatenate([rotations, poses[:, :, 3:]], axis=2))


PEERS: dict[str, Callable[[Corners], Answer]] = {
    "opencv": solve_opencv,
    "pycolmap": solve_pycolmap,
    "mrcal": solve_mrcal,
}


def solve_warm(solve: Callable[[Corners], Answer], warm_up_s: float, corners: Corners) -> Answer:
    """The answer of a solver, after it has solved ten of the frames repeatedly for so long.

    A core that was idle, for example while another process ran, is slower for a while.
    """
    few, start = corners.first(WARM_UP_FRAMES), time.perf_counter()
    while time.perf_counter() - start < warm_up_s:
        solve(few)
    return solve(corners)


def print_answer(name: str, path: str, warm_up_s: str) -> None:
    """Print a peer's answer with the process' peak memory."""
    answer = solve_warm(PEERS[name], float(warm_up_s), Corners.load(Path(path)))
    print(
        json.dumps(
            {
                "seconds": answer.seconds,
                "intrinsics": answer.intrinsics.tolist(),
                "cam_from_board": answer.cam_from_board.tolist(),
                "peak_mib": peak_mib(),
            }
        )
    )


if __name__ == "__main__":
    print_answer(*sys.argv[1:])
