"""mrcal by its own unchanged program: mrcal-calibrate-cameras reads the corners from a file.

It is called as in https://mrcal.secretsauce.net/how-to-calibrate.html: with LENSMODEL_OPENCV8 first, and with the
splined stereographic model, which it recommends. The board's warp, outlier rejection and regularization are on by
default (mrcal-calibrate-cameras --help). Its uncertainty is mrcal.projection_uncertainty
(https://mrcal.secretsauce.net/uncertainty.html).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmarks.peers import Array, Corners, solve_mrcal

from beside.peer_fit import PeerFit, warp_said
from beside.starts import wide_focal

SPLINED = "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={columns}_Ny={rows}_fov_x_deg={fov}"


def _table(corners: Corners) -> Iterator[str]:
    """A row for each corner of the grid in each picture, in the format of its corners cache."""
    count = int(np.prod(corners.grid))
    yield "# filename x y level"
    cuts = np.searchsorted(corners.view, np.arange(1, corners.frames))
    for frame, (features, pixels) in enumerate(
        zip(np.split(corners.feature, cuts), np.split(corners.pixels, cuts), strict=True)
    ):
        seen = dict(zip(features.tolist(), pixels.tolist(), strict=True))
        for feature in range(count):
            x, y = seen.get(feature, ("-", "-"))
            level = 0 if feature in seen else "-"
            yield f"frame{frame:05d}.png {x} {y} {level}" if feature in seen else f"frame{frame:05d}.png -1 -1 -"


def focal_guess(corners: Corners) -> float:
    """Focal length for its option, px: OpenCV's initial estimate, clipped, or that of a wide lens."""
    if (focal := wide_focal(corners)) is not None:
        return focal
    objects, images = ([part.astype(np.float32) for part in parts] for parts in corners.by_frame())
    width, height = corners.image_size.tolist()
    flat = [(o * (1.0, 1.0, 0.0)).astype(np.float32) for o in objects]
    guess = float(cv2.initCameraMatrix2D(flat, images, (width, height))[0, 0])
    return float(np.clip(np.nan_to_num(guess, nan=width), 0.3 * width, 3.0 * width))


def field_of_view(corners: Corners, focal: float) -> float:
    """Degrees that the splined model must cover: those of an equidistant lens, and ten per cent more."""
    return float(np.clip(np.rad2deg(1.1 * float(corners.image_size[0]) / focal), 40.0, 200.0))


def splined(columns: int, corners: Corners) -> str:
    width, height = corners.image_size.tolist()
    rows = max(round(columns * height / width), 6)
    return SPLINED.format(columns=columns, rows=rows, fov=round(field_of_view(corners, focal_guess(corners))))


def program() -> str:
    """Path of its tool: beside the Python of its environment, or Debian's."""
    beside = Path(sys.executable).with_name("mrcal-calibrate-cameras")
    return str(beside) if beside.exists() else "/usr/bin/mrcal-calibrate-cameras"


def command_of(lens: str, corners: Corners, cache: Path, folder: Path) -> list[str]:
    columns, rows = corners.grid.tolist()
    return [
        *([sys.executable] if Path(sys.executable).with_name("mrcal-calibrate-cameras").exists() else []),
        program(), "--corners-cache", str(cache), "--lensmodel", lens, "--focal", f"{focal_guess(corners):.1f}",
        "--imagersize", *(str(n) for n in corners.image_size.tolist()),
        "--object-spacing", repr(float(corners.square_m)),
        "--object-width-n", str(columns), "--object-height-n", str(rows), "--outdir", str(folder), "frame*.png",
    ]  # fmt: skip


def _fit(lens: str | Callable[[Corners], str], more: tuple[str, ...], corners: Corners) -> PeerFit:
    mrcal: Any = import_module("mrcal")
    named = lens if isinstance(lens, str) else lens(corners)
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "corners.vnl"
        cache.write_text("\n".join(_table(corners)) + "\n", encoding="ascii")
        command = command_of(named, corners, cache, Path(folder))
        start = time.perf_counter()
        done = subprocess.run([*command[:-1], *more, command[-1]], capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - start
        paths = list(Path(folder).glob("*.cameramodel"))
        if not paths:
            raise RuntimeError((done.stderr or done.stdout).strip().splitlines()[-1])
        model = mrcal.cameramodel(str(paths[0]))
    return fitted_of(mrcal, model, corners, seconds, done.stdout)


def fitted_of(mrcal: Any, model: Any, corners: Corners, seconds: float, printed: str) -> PeerFit:
    """Its model, its board and its uncertainty."""
    lens, intrinsics = model.intrinsics()
    given = model.optimization_inputs()
    columns, rows = corners.grid.tolist()
    board = mrcal.ref_calibration_object(
        columns, rows, float(corners.square_m), calobject_warp=given["calobject_warp"]
    ).reshape(-1, 3)
    left = mrcal.measurements_board(given)
    observed = given["observations_board"][..., 2]

    def project(places: Array, values: Array) -> Array:
        return np.asarray(mrcal.project(np.ascontiguousarray(places, dtype=float), lens, values))

    def variance(places: Array, *, at_infinity: bool) -> Array:
        found = mrcal.projection_uncertainty(places, model=model, atinfinity=at_infinity, what="covariance")
        return np.asarray(np.trace(found, axis1=-2, axis2=-1))

    said = [line for line in printed.splitlines() if "outliers" in line and "Noutliers: 0 " not in line]
    said += warp_said(board)  # which its report prints as calobject_warp
    return PeerFit(
        ("fx",), np.array(intrinsics), project, board, float(np.std(left)), variance=variance,
        said=tuple(said), taken_out=int(np.sum(observed < 0.0)) - (observed.size - len(corners.view)), seconds=seconds,
    )  # fmt: skip


def _solve_alone(corners: Corners) -> PeerFit:
    """Its solver from its own seed, as the benchmark of this package times it, without its program and warp."""
    found = solve_mrcal(corners)
    mrcal: Any = import_module("mrcal")

    def project(places: Array, values: Array) -> Array:
        return np.asarray(mrcal.project(np.ascontiguousarray(places, dtype=float), "LENSMODEL_OPENCV5", values))

    return PeerFit(("fx",), found.intrinsics, project, corners.board, seconds=found.seconds)


SETTINGS: dict[str, Callable[[Corners], PeerFit]] = {
    "solve alone": _solve_alone,
    "default": partial(_fit, "LENSMODEL_OPENCV8", ()),
    "splined, 30 knots": partial(_fit, partial(splined, 30), ()),
    "splined, 11 knots": partial(_fit, partial(splined, 11), ()),
    "OPENCV5": partial(_fit, "LENSMODEL_OPENCV5", ()),
    "OPENCV12": partial(_fit, "LENSMODEL_OPENCV12", ()),
}
