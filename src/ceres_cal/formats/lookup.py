"""Look-up table from pixels to the field, for programs that track at many frames a second without this package.

A ray meets the plane z = l where it meets the floor plus l times a constant of the pixel. This is the change with
height of the third column of the paper's H (section 4), and exact for every height. So four numbers per node are
enough.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal import posterior, scene
from ceres_cal.base import HEIGHTS_M, AnyArray, Array, Column, Frozen, InputError, grid_places, read_npz, replace
from ceres_cal.base.files import read_bytes, write_bytes
from ceres_cal.formats.format import Export, ExportFormat, ExportLoss, ExportRequest
from ceres_cal.formats.loss import field_error_mm
from ceres_cal.scene.camera import in_image

FILE_FORMAT, VERSION = "ceres-cal/table", 1
_COLUMNS: dict[str, Column] = {
    **dict.fromkeys(("format", "station"), (np.str_, ())),
    **dict.fromkeys(("version", "step_px"), (np.int64, ())),
    "image_size": (np.int64, (2,)),
    "x_px": (float, ("X",)),
    "y_px": (float, ("Y",)),
    **dict.fromkeys(("floor_m", "per_height"), (float, ("Y", "X", 2))),
    "error_mm": (float, ("heights", 3)),
    "homography": (float, (3, 3)),
    "third_column": (float, (3,)),
}


class LookupTable(Frozen):
    """Places on the field seen by the nodes of a grid over the image.

    Attributes:
        x_px (X,), y_px (Y,): the nodes, evenly spaced by step_px, beginning and ending outside the image.
        floor_m: (Y, X, 2) x and y on the floor; NaN where a node sees none. per_height: (Y, X, 2) change for each metre
            of height.
        error_mm: height_m -> root mean square and largest error of bilinear interpolation, half-way between nodes, over
            the given box of the field.
        homography: (3, 3) the paper's H of the floor. third_column: (3,) change of its third column per metre.
    """

    station: str
    image_size: tuple[int, int]
    step_px: int
    x_px: Array
    y_px: Array
    floor_m: Array
    per_height: Array
    error_mm: dict[float, tuple[float, float]]
    homography: Array
    third_column: Array

    def locate(self, pixels: ArrayLike, height_m: float = 0.0) -> Array:
        """Return places (N, 2) m at a height for pixels (N, 2), interpolated; NaN outside the table."""
        at = (np.asarray(pixels, dtype=float) - (self.x_px[0], self.y_px[0])) / self.step_px
        inside = np.all((at >= 0.0) & (at <= (len(self.x_px) - 1, len(self.y_px) - 1)), axis=1)
        at = np.where(inside[:, None], at, 0.0)
        column, row = np.minimum(at.astype(int), (len(self.x_px) - 2, len(self.y_px) - 2)).T
        u, v = (at - np.column_stack([column, row])).T[:, :, None]
        nodes = self.floor_m + height_m * self.per_height
        upper = (1.0 - u) * nodes[row, column] + u * nodes[row, column + 1]
        lower = (1.0 - u) * nodes[row + 1, column] + u * nodes[row + 1, column + 1]
        return np.where(inside[:, None], (1.0 - v) * upper + v * lower, np.nan)

    def to_bytes(self) -> bytes:
        """Return the content of its NPZ file."""
        stream = io.BytesIO()
        errors = [(height_m, *error) for height_m, error in self.error_mm.items()]
        content: dict[str, Any] = {**vars(self), "error_mm": errors}
        np.savez_compressed(stream, format=FILE_FORMAT, version=VERSION, **content)
        return stream.getvalue()

    def save(self, path: str | Path) -> None:
        """Write it as NPZ."""
        write_bytes(path, self.to_bytes())

    @classmethod
    def load(cls, path: str | Path) -> LookupTable:
        """Read a table.

        Raises:
            InputError: it is none.
        """
        arrays = read_npz(read_bytes(path), _COLUMNS, str(path))
        try:
            return _table_of(arrays)
        except ValueError as error:
            raise InputError(f"{path}: is not a table ({error}): export it again") from None


def _table_of(arrays: Mapping[str, AnyArray]) -> LookupTable:
    """Return the table of an NPZ file; ValueError where its numbers contradict each other."""
    if (str(arrays["format"]), int(arrays["version"])) != (FILE_FORMAT, VERSION):
        raise ValueError(f"not of format {FILE_FORMAT}, version {VERSION}")
    nodes = {name: arrays[name] for name in ("x_px", "y_px", "floor_m", "per_height", "homography", "third_column")}
    station, step_px = str(arrays["station"]), int(arrays["step_px"])
    station.encode()  # fails if it is no text
    size = (int(arrays["image_size"][0]), int(arrays["image_size"][1]))
    errors = {float(height_m): (float(rms), float(worst)) for height_m, rms, worst in arrays["error_mm"]}
    for name, length in zip(("x_px", "y_px"), size, strict=True):
        even = nodes[name][0] + step_px * np.arange(len(nodes[name]), dtype=float)
        if step_px < 1 or len(even) < 2 or not np.allclose(nodes[name], even, atol=1e-6, rtol=0.0):
            raise ValueError(f"{name} is not evenly spaced by step_px")
        if length < 1 or even[0] > -0.5 or even[-1] < length - 0.5 or even[-1] > length + 2 * step_px:
            raise ValueError(f"{name} does not span the image")
    if not all(np.all(np.isfinite(arrays[name])) for name in ("homography", "third_column", "error_mm")):
        raise ValueError("a number is not finite")
    if any(np.isinf(nodes[name]).any() for name in ("floor_m", "per_height")):
        raise ValueError("a number is infinite")
    if len(errors) != len(arrays["error_mm"]) or np.any(arrays["error_mm"][:, 1:] < 0.0):
        raise ValueError("error_mm is not one row for each height")
    return LookupTable(station, size, step_px, **nodes, error_mm=errors)


def make_lookup_table(
    camera: scene.Camera, station: str, x_m: Array, y_m: Array, error_mm: float = 0.1, step_px: int | None = None
) -> LookupTable:
    """Make the table of a camera; without a step, the widest grid whose largest error is at most `error_mm`.

    Args:
        x_m, y_m: errors count over the box around these places of the field.

    Raises:
        InputError: a step below 1 or beyond the image, or no step of 1 px or more keeps to the error.
    """
    steps_px = (64, 32, 16, 8, 4, 2, 1)
    widest = min(camera.image_size)
    if step_px is not None and not 1 <= step_px <= widest:
        raise InputError(f"step_px must be from 1 to {widest}, not {step_px}")
    table = None
    for step in steps_px if step_px is None else (step_px,):
        table = _table(camera, station, step, x_m, y_m)
        if max(worst for _, worst in table.error_mm.values()) <= error_mm:
            return table
    if step_px is None or table is None:
        raise InputError(f"no table with a step of 1 px or more keeps to {error_mm:g} mm: allow a larger error")
    return table


def _table(camera: scene.Camera, station: str, step: int, x_m: Array, y_m: Array) -> LookupTable:
    x, y = (step * np.arange(-1, int(np.ceil((size - 0.5) / step)) + 1, dtype=float) for size in camera.image_size)
    # Where the nodes' rays meet the floor, and the change of this place with height.
    floor = camera.locate(grid_places(x, y))
    slope = (camera.position[:2] - floor) / camera.position[2]
    rays = [plane.reshape(len(y), len(x), 2) for plane in (floor, slope)]
    flat = camera.homography(), np.array(camera.cam_from_world.rotation[:, 2])
    plain = LookupTable(station, camera.image_size, step, x, y, rays[0], rays[1], {}, *flat)
    pixels = grid_places(x[:-1] + 0.5 * step, y[:-1] + 0.5 * step)
    inside = in_image(pixels, camera.image_size)
    errors = field_error_mm(camera, plain.locate, pixels[inside], (x_m, y_m), HEIGHTS_M)
    return replace(plain, error_mm=errors)


# ---- as an export format --------------------------------------------------------------------------------------------


def _export(
    request: ExportRequest,
    *,
    error_mm: Annotated[float, "largest interpolation error on the field; default: 0.1"] = 0.1,
    step_px: Annotated[int | None, "distance of the nodes; default: the widest that keeps to the error"] = None,
) -> Export:
    if not error_mm > 0.0:
        raise InputError(f"error_mm must be above 0, not {error_mm:g}")
    (station,), box = request.stations, posterior.field_grid(request.calibration.targets)
    table = make_lookup_table(request.calibration.station(station), station, *box, error_mm, step_px)
    nodes = (len(table.x_px), len(table.y_px))
    facts = {"station": station, "step_px": table.step_px, "nodes": nodes}
    words = f"{nodes[0]} x {nodes[1]} nodes every {table.step_px} px"
    return Export(table.to_bytes(), (ExportLoss(station, table.error_mm),), words, facts)


FORMATS = (ExportFormat("table", "a look-up table from pixels to the field", (".npz",), _export),)
