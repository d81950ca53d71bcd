"""Observations from other programs: mrcal's corners.vnl, CSV or NPZ with named columns, the observations in an mrcal
.cameramodel, and the keypoints of a COLMAP model.
"""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ceres_cal.base import InputError, did_you_mean, finite, read_npz, replace, require_room
from ceres_cal.formats.colmap import read_model
from ceres_cal.formats.format import ImportFormat, ImportRequest
from ceres_cal.formats.mrcal import literal_of
from ceres_cal.formats.opencv import parse_size
from ceres_cal.observations import NO_CURVES, Curves, Observations, Points, View
from ceres_cal.scene.targets import SIDES, Target, checkerboard, custom, of_places, target_named, targets_by_name


def _read_corners(
    request: ImportRequest,
    *,
    columns: Annotated[int, "corners along a row of the board"] = 0,
    rows: Annotated[int, "rows of corners"] = 0,
    square: Annotated[float, "distance of the corners, m"] = 0.0,
    image_size: Annotated[str, "WIDTHxHEIGHT px"] = "",
    camera: Annotated[str, "name of the camera; default: camera"] = "camera",
    sigma_px: Annotated[float, "of a corner at level 0; default: 1"] = 1.0,
) -> Observations:
    """Read `# filename x y level`, one line for each corner, row by row; '-' or a level below 0 means not found."""
    if min(columns, rows) < 2 or not square > 0.0:
        raise InputError(
            "the file does not describe the board: give columns, rows and square (--columns N --rows N --square M)"
        )
    board = checkerboard(columns, rows, square)
    found: dict[str, list[tuple[float, float, float]]] = {}
    for number, line in enumerate(request.text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        seen = found.setdefault(words[0], [])
        try:
            absent = len(words) < 3 or "-" in words[1:3] or (len(words) > 3 and words[3] == "-")
            step = 0.0 if absent or len(words) < 4 else float(words[3])
            x, y = (np.nan, np.nan) if absent or step < 0.0 else (float(words[1]), float(words[2]))
            seen.append((x, y, 2.0**step))
        except (ValueError, OverflowError):
            raise InputError(f"line {number}: x, y and level must be numbers or -, not {line.strip()!r}") from None
    whole = {name: np.array(seen) for name, seen in found.items() if len(seen) > 1 or np.isfinite(seen[0][0])}
    for name, corners in whole.items():
        if len(corners) != len(board.points):
            raise InputError(f"image {name!r} has {len(corners)} corners, the board {len(board.points)}")
    size = parse_size(image_size)
    frames = {Path(name).stem: corners[:, :2] for name, corners in whole.items()}
    if len(frames) != len(whole):
        raise InputError("two images in different folders have the same name: import one camera at a time")
    bare = Observations.from_points(frames, board, size, camera=camera)
    level = np.concatenate([corners[np.isfinite(corners[:, 0]), 2] for corners in whole.values()])
    return replace(bare, points=replace(bare.points, sigma_px=sigma_px * level))


# ---- named columns --------------------------------------------------------------------------------------------------


_COLUMNS = ("frame", "camera", "station", "placement", "point", "curve", "side", "x_px", "y_px", "sigma_px")
_PLACE = ("X_m", "Y_m", "Z_m")
_BYTES_PER_CELL = 150  # bytes of memory for a cell of a row by names
_ZIP = b"PK"  # first bytes of an NPZ file


def _csv_rows(request: ImportRequest) -> tuple[Mapping[int, dict[str, Any]], Sequence[str]]:
    """Return rows by names, each under the number of its line, and the names. Comments may precede the names. Columns
    may be separated by semicolons or tabs, as in spreadsheets with decimal commas; commas are then read as decimal
    points.
    """
    marks = max(map(request.content.count, (b",", b";", b"\t"))) + request.content.count(b"\n")
    require_room(_BYTES_PER_CELL * marks + 2.0 * len(request.content), str(request.path))
    lines = [*io.StringIO(request.text, newline=None)]
    above = next((number for number, line in enumerate(lines) if not line.startswith("#")), 0)
    between = next((mark for mark in (",", ";", "\t") if lines and mark in lines[above]), ",")
    reader = csv.DictReader(lines[above:], restval="", delimiter=between, skipinitialspace=True)
    rows: dict[int, dict[str, Any]] = {}
    try:
        names = reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
        for row in reader:
            rows[above + reader.line_num] = row
    except csv.Error as error:
        raise InputError(f"not a CSV file (line {above + reader.line_num}): {error}") from None
    if longer := next((number for number, row in rows.items() if None in row), 0):
        raise InputError(
            f"line {longer} has more values than there are columns: put names with commas into quotes, and write "
            "semicolons between the columns where decimals have a comma"
        )
    for name in names if between != "," else ():
        if name.endswith(("_px", "_m")):
            for row in rows.values():
                row[name] = row[name].replace(",", ".")
    return rows, names


def _npz_rows(request: ImportRequest) -> tuple[Mapping[int, dict[str, Any]], Sequence[str]]:
    """Return rows by names, each under its number, and the names."""
    columns = read_npz(request.content, None, str(request.path))
    require_room(float(_BYTES_PER_CELL) * sum(array.size for array in columns.values()), str(request.path))
    lengths = {array.shape for array in columns.values()}
    if len(lengths) != 1 or any(len(shape) != 1 for shape in lengths):
        raise InputError(f"the columns must be one-dimensional and of equal length, not {sorted(lengths)}")
    rows = [dict(zip(columns, map(str, row), strict=True)) for row in zip(*columns.values(), strict=True)]
    return dict(enumerate(rows, start=2)), tuple(columns)


def _read_table(
    request: ImportRequest,
    *,
    target: Annotated[str, "whose features are named, such as ssl-b; without it X_m, Y_m"] = "",
    image_size: Annotated[str, "WIDTHxHEIGHT px"] = "",
    camera: Annotated[str, "name of the camera where no column says it"] = "camera",
    moves: Annotated[bool, "whether the target lay elsewhere in every frame (true)"] = False,
) -> Observations:
    """Read rows under named columns; each shows a point or a curve of the target, or a place in the world."""
    is_npz = request.path.suffix.lower() == ".npz" or request.content.startswith(_ZIP)
    rows, names = (_npz_rows if is_npz else _csv_rows)(request)
    if len(set(names)) < len(names):
        raise InputError("a column is there twice: keep one of them")
    if unknown := [name for name in names if name not in (*_COLUMNS, *_PLACE)]:
        raise InputError(f"unknown column {unknown[0]!r}: there are {', '.join((*_COLUMNS, *_PLACE))}")
    if missing := [name for name in ("x_px", "y_px") if name not in names]:
        raise InputError(f"column {missing[0]} is missing")
    if not rows:
        raise InputError("it holds no row")
    places = {number: _place(row, number) for number, row in rows.items()} if "X_m" in names else {}
    drawn = _target(target, [*places.values()], moves)
    views: dict[View, int] = {}
    points, curves = [], []
    for number, row in rows.items():
        if not places and bool(row.get("curve")) == bool(row.get("point")):
            which = "both a point and a curve" if row.get("point") else "neither a point nor a curve"
            raise InputError(f"line {number} names {which}: a row shows one of them")
        view = views.setdefault(_view(row, camera, moves=moves or drawn.movable), len(views))
        pixel = [_number(row, name, number) for name in ("x_px", "y_px")]
        sigma = _number(row, "sigma_px", number) if row.get("sigma_px") else 1.0
        if row.get("curve"):
            side = row.get("side") or "centre"
            if side not in SIDES:
                raise InputError(f"line {number}: side {side!r} is unknown: {', '.join(SIDES)}")
            curves.append((view, _index(drawn.curve_index, row["curve"], number), pixel, sigma, SIDES[side]))
        else:
            name = _place_name(places[number]) if places else row.get("point") or ""
            points.append((view, _index(drawn.point_index, name, number), pixel, sigma))
    points.sort(key=lambda one: one[0])
    curves.sort(key=lambda one: one[0])
    size = parse_size(image_size)
    cameras = dict.fromkeys((view.camera for view in views), size)
    return Observations(
        {"target": drawn}, cameras, tuple(views), Points(*_split(points, 4)), Curves(*_split(curves, 5))
    )


def _split(rows: Sequence[tuple[Any, ...]], count: int) -> list[Any]:
    columns: list[Any] = [np.array([row[k] for row in rows]) for k in range(count)]
    columns[2] = columns[2].reshape(-1, 2)
    return columns


def _view(row: Mapping[str, Any], camera: str, *, moves: bool) -> View:
    frame, camera = row.get("frame") or "0", row.get("camera") or camera
    return View(
        frame, camera, row.get("station") or camera, "target", row.get("placement") or (frame if moves else None)
    )


def _target(name: str, places: Sequence[tuple[float, float, float]], moves: bool) -> Target:
    if places:
        return of_places({_place_name(place): place for place in places}, moves=moves)
    if (known := target_named(name)) is None:
        what = f"target {name!r} is unknown" if name else "the target of these features is not given"
        raise InputError(
            f"{what}: give a target (--target), one of {', '.join(targets_by_name())}, or columns X_m, Y_m"
        )
    return known


def _place(row: Mapping[str, Any], number: int) -> tuple[float, float, float]:
    x, y, z = (_number(row, name, number) if row.get(name) else 0.0 for name in _PLACE)
    return x, y, z


def _place_name(place: tuple[float, float, float]) -> str:
    return " ".join(f"{v:.15g}" for v in place)


def _number(row: Mapping[str, Any], name: str, number: int) -> float:
    return finite(row.get(name), InputError(f"line {number}: {name} is not a finite number, but {row.get(name)!r}"))


def _index(numbers: Mapping[str, int], name: str, number: int) -> int:
    if name not in numbers:
        meant = did_you_mean(name, numbers) or ":"
        raise InputError(f"line {number}: there is no feature {name!r}{meant} `ceres-cal targets` lists the names")
    return numbers[name]


# ---- what others keep beside their cameras --------------------------------------------------------------------------


def _read_mrcal(request: ImportRequest) -> Observations:
    """Read the `optimization_inputs` of a .cameramodel: boards before static cameras."""
    data = literal_of(request.content)
    if "optimization_inputs" not in data:
        raise InputError("it has no optimization_inputs: mrcal did not store its observations")
    try:
        given = read_npz(base64.b85decode(data["optimization_inputs"]), None, str(request.path))
        boards = np.asarray(given["observations_board"], dtype=float)
        indices = np.asarray(given["indices_frame_camintrinsics_camextrinsics"], dtype=int)
        spacing, sizes = float(given["calibration_object_spacing"]), np.asarray(given["imagersizes"], dtype=int)
        count, rows, columns, three = boards.shape
        if three != 3 or indices.shape != (count, 3) or sizes.ndim != 2 or sizes.shape[1] != 2:
            raise ValueError("its arrays do not fit each other")
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(f"its optimization_inputs cannot be read: {error}") from None
    views, view, feature, pixels, sigma = [], [], [], [], []
    order = np.lexsort((indices[:, 1], indices[:, 0]))
    for number, row in enumerate(order[:count]):
        frame, camera = f"{indices[row, 0]:04d}", f"camera{indices[row, 1]}"
        views.append(View(frame, camera, camera, "board", frame))
        seen = boards[row].reshape(-1, 3)
        found = np.flatnonzero(seen[:, 2] > 0.0)  # weights; negative for outliers and corners not seen
        view.append(np.full(len(found), number))
        feature.append(found)
        pixels.append(seen[found, :2])
        sigma.append(1.0 / seen[found, 2])
    names = {f"camera{number}": (int(w), int(h)) for number, (w, h) in enumerate(sizes.tolist())}
    points = Points(*(np.concatenate(column) for column in (view, feature, pixels, sigma)))
    used = {name: size for name, size in names.items() if any(one.camera == name for one in views)}
    return Observations({"board": checkerboard(columns, rows, spacing)}, used, tuple(views), points, NO_CURVES)


def _read_colmap(request: ImportRequest) -> Observations:
    """Read the keypoints that show points of the model, converted to this package's pixels; the points are taken as
    known.
    """
    model = read_model(request.path)
    if not model.num_points3D():
        raise InputError("the model has no points")
    names = {number: place for place, number in enumerate(model.points3D)}
    target = custom({str(n): tuple(float(v) for v in model.points3D[n].xyz) for n in names})  # type: ignore[misc]
    views, rows, cameras = [], [], {}
    for _, image in sorted(model.images.items()):
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen:
            continue
        camera = f"camera{image.camera_id}"
        cameras[camera] = (int(image.camera.width), int(image.camera.height))
        views.append(View(image.name, camera, image.name, "target"))
        rows += [(len(views) - 1, names[point.point3D_id], point.xy - 0.5, 1.0) for point in seen]
    return Observations({"target": target}, cameras, tuple(views), Points(*_split(rows, 4)), NO_CURVES)


_NAMED = f"columns {', '.join((*_COLUMNS, *_PLACE))}"
FORMATS = (
    ImportFormat("corners-vnl", "mrcal's corners.vnl", (".vnl",), lambda _: True, _read_corners),
    ImportFormat("csv", f"observations as CSV, {_NAMED}", (".csv",), lambda _: True, _read_table),
    ImportFormat("npz-columns", "the same as an array for each column", (".npz",), lambda _: True, _read_table),
    # Only by their names: by default these files are read as cameras.
    ImportFormat(
        "mrcal-observations", "what a .cameramodel was made from", (".cameramodel",), lambda _: False, _read_mrcal
    ),
    ImportFormat("colmap-observations", "the keypoints of a COLMAP model", (), lambda _: False, _read_colmap),
)
