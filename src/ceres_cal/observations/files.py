"""Observations in JSON and NPZ files and in folders of columns (docs/files.md); every number is preserved exactly."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base import AnyArray, Codes, Column, Frozen, InputError, field, read_npz, replace, require_columns
from ceres_cal.base.files import PIXEL_ORIGIN, UNITS, PixelOrigin, Units, decode_json, opened, read_bytes, write_bytes
from ceres_cal.base.words import did_you_mean, no_such
from ceres_cal.observations.columns import (
    NO_CURVES,
    NO_POINTS,
    TYPES,
    Columns,
    Curves,
    Points,
    Prior,
    View,
    prior_from_json,
    prior_to_json,
    read_rows,
    rows_of,
    view_label,
)
from ceres_cal.scene.targets import SIDES, Target, targets_from_specs

FORMAT, VERSION = "ceres-cal/observations", 1
_NUMBERS: dict[str, Column] = {
    f"{kind}_{name}": (dtype, (kind, 2) if name == "pixels" else (kind,))
    for kind in ("points", "curves")
    for name, dtype in TYPES.items()
    if (kind, name) != ("points", "side")
}
_COLUMNS: dict[str, Column] = {"header": (np.uint8, ("bytes",)), **_NUMBERS}
_SIDE_NAMES = {value: name for name, value in SIDES.items()}


class Content(Frozen):
    """Content of a file, not checked: see `Observations`."""

    targets: Mapping[str, Target]
    cameras: Mapping[str, tuple[int, int]]
    views: tuple[View, ...]
    points: Points
    curves: Curves
    priors: tuple[Prior, ...] = ()
    notes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """Number of observations, of points and of curves together."""
        return len(self.points) + len(self.curves)

    def feature_name(self, kind: str, row: int) -> str:
        """Name of the feature that observation `row` of the points (kind "point") or curves ("curve") shows."""
        column: Columns = self.points if kind == "point" else self.curves
        target = self.targets[self.views[int(column.view[row])].target]
        names = target.point_names if kind == "point" else target.curve_names
        return names[int(column.feature[row])]


class _PointsFile(msgspec.Struct, forbid_unknown_fields=True):
    features: list[str]
    pixels: list[tuple[float, float]]
    sigma_px: float | list[float] = 1.0
    counts: list[int] | msgspec.UnsetType = msgspec.UNSET

    def each(self, here: str) -> list[str]:
        """Return the feature of each pixel; InputError where `counts` does not fit."""
        if not isinstance(self.counts, list):
            return self.features
        if len(self.counts) != len(self.features) or min(self.counts, default=1) < 1:
            raise InputError(f"{here}: counts must be a whole number above 0 for each of its features")
        if sum(self.counts) != len(self.pixels):
            raise InputError(f"{here}: counts add up to {sum(self.counts)}, but there are {len(self.pixels)} pixels")
        return [name for name, count in zip(self.features, self.counts, strict=True) for _ in range(count)]


class _CurvesFile(_PointsFile, forbid_unknown_fields=True):
    side: str | list[str] | msgspec.UnsetType = msgspec.UNSET


class _ViewFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True, kw_only=True):
    frame: str
    camera: str
    station: str | None = None
    target: str
    placement: str | None = None
    points: _PointsFile | None = None
    curves: _CurvesFile | None = None

    def view(self) -> View:
        station = self.camera if self.station is None else self.station
        return View(self.frame, self.camera, station, self.target, self.placement)


class _ObservedCamera(msgspec.Struct, forbid_unknown_fields=True):
    image_size: tuple[int, int]


class ObservationsFile(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Observations, but for the columns of an NPZ."""

    format: str
    version: int
    units: Units = UNITS
    pixel_origin: PixelOrigin = PIXEL_ORIGIN
    targets: dict[str, Any]
    cameras: dict[str, _ObservedCamera]
    views: list[_ViewFile]
    priors: list[dict[str, Any]] = []
    notes: dict[str, Any] | msgspec.UnsetType = msgspec.UNSET

    def content(self) -> Content:
        """Return everything except the columns; an InputError names the place."""
        return Content(
            targets_from_specs(self.targets),
            {name: camera.image_size for name, camera in self.cameras.items()},
            tuple(entry.view() for entry in self.views),
            NO_POINTS,
            NO_CURVES,
            tuple(prior_from_json(entry, f"prior {i}") for i, entry in enumerate(self.priors)),
            self.notes if isinstance(self.notes, dict) else {},
        )


def read_content(path: Path) -> Content:
    """See `Observations.load`."""
    wrong = InputError(
        f"{path}: not observations (.json, .npz or a folder .columns): `ceres-cal import` makes them of a CSV file, "
        "`ceres-cal detect` of photographs, and `ceres-cal run` takes a folder of photographs"
    )
    if path.is_dir() and not (path / HEADER).exists():
        raise wrong
    if path.suffix == ENDING or path.is_dir():
        header = decode_json(read_bytes(path / HEADER), ObservationsFile, str(path / HEADER), FORMAT, VERSION)
        return _of_columns(header, read_folder(path, _NUMBERS))
    content = read_bytes(path)
    if path.suffix not in (".json", ".npz") and not content.lstrip().startswith(b"{"):
        raise wrong
    return _from_npz(content, str(path)) if path.suffix == ".npz" else _from_json(content, str(path))


def write_content(content: Content, path: Path) -> None:
    """See `Observations.save`."""
    if path.suffix == ".npz":
        write_bytes(path, _to_npz(content))
    elif path.suffix == ".json":
        write_bytes(path, _to_json(content))
    elif path.suffix == ENDING:
        write_folder(path, header_of(content), {"points": content.points, "curves": content.curves})
    else:
        raise InputError(
            f"{path}: observations are written as .json or .npz, or as a folder .columns: give one of these endings"
        )


def header_of(content: Content) -> ObservationsFile:
    """Return everything except the columns, in the form of a file."""
    return ObservationsFile(
        format=FORMAT,
        version=VERSION,
        targets={name: target.spec for name, target in content.targets.items()},
        cameras={name: _ObservedCamera(size) for name, size in content.cameras.items()},
        views=[_ViewFile(**vars(view)) for view in content.views],
        priors=[prior_to_json(prior) for prior in content.priors],
        notes=dict(content.notes) or msgspec.UNSET,
    )


def _from_json(content: bytes, where: str) -> Content:
    data = decode_json(content, ObservationsFile, where, FORMAT, VERSION)
    header = data.content()
    targets, views = header.targets, header.views
    for number, view in enumerate(views):
        if view.target not in targets:
            raise InputError(f"{view_label(number, views)}: {no_such('target', view.target, targets)}")
    points = [(i, entry.points) for i, entry in enumerate(data.views) if entry.points is not None]
    curves = [(i, entry.curves) for i, entry in enumerate(data.views) if entry.curves is not None]
    point_index = {name: target.point_index for name, target in targets.items()}
    curve_index = {name: target.curve_index for name, target in targets.items()}
    sides = [_sides(entry, view_label(i, views)) for i, entry in curves]
    return replace(
        header,
        points=Points(**_columns(points, views, point_index, "point")),
        curves=Curves(**_columns(curves, views, curve_index, "curve"), side=_concatenate(sides, np.int8)),
    )


def _concatenate(parts: Sequence[Any], dtype: Any) -> AnyArray:
    return np.concatenate([np.empty(0, dtype), *parts]).astype(dtype)


def _columns(
    entries: Sequence[tuple[int, _PointsFile]], views: Sequence[View], index: Mapping[str, Mapping[str, int]], kind: str
) -> dict[str, Any]:
    """Return the columns of all views' features; an InputError names the view and the feature."""
    view, feature, sigma = [], [], []
    pixels: list[tuple[float, float]] = []
    for number, entry in entries:
        here = view_label(number, views)
        features = entry.each(here)
        count = len(features)
        if len(entry.pixels) != count:
            raise InputError(f"{here}: {count} {kind} features but {len(entry.pixels)} pixels")
        names = index[views[number].target]
        try:
            feature.append([names[name] for name in features])
        except KeyError as error:
            raise InputError(
                f"{here}: target {views[number].target!r} has no {kind} {error.args[0]!r}"
                f"{did_you_mean(error.args[0], names) or ':'} `ceres-cal targets` lists the names"
            ) from None
        if isinstance(entry.sigma_px, list) and len(entry.sigma_px) != count:
            raise InputError(f"{here}: {count} {kind} features but {len(entry.sigma_px)} numbers in sigma_px")
        view.append(np.full(count, number, np.int32))
        sigma.append(np.broadcast_to(np.asarray(entry.sigma_px, dtype=float), count))
        pixels.extend(entry.pixels)
    return {
        "view": _concatenate(view, np.int32),
        "feature": _concatenate(feature, np.int32),
        "pixels": np.array(pixels, dtype=float).reshape(-1, 2),
        "sigma_px": _concatenate(sigma, np.float64),
    }


def _sides(entry: _CurvesFile, here: str) -> list[int]:
    side, count = entry.side or "centre", len(entry.each(here))
    names = side if isinstance(side, list) else [side] * count
    if len(names) != count:
        raise InputError(f"{here}: {count} curve features but {len(names)} sides")
    for name in names:
        if name not in SIDES:
            raise InputError(f"{here}: side {name!r} is unknown: {', '.join(SIDES)}")
    return [SIDES[name] for name in names]


def _same_or_list(values: AnyArray) -> Any:
    return values[0].item() if len(values) and np.all(values == values[0]) else values.tolist()


def _to_json(content: Content) -> bytes:
    data = header_of(content)
    points, curves = (_rows_by_view(columns, len(data.views)) for columns in (content.points, content.curves))
    for p, c, entry in zip(points, curves, data.views, strict=True):
        target = content.targets[entry.target]
        if len(p):
            entry.points = _PointsFile(*_features(content.points, p, target.point_names))
        if len(c):
            features, pixels, sigma_px = _features(content.curves, c, target.curve_names)
            runs = [(name, len(list(same))) for name, same in groupby(features)]
            once, counts = [name for name, _ in runs], [count for _, count in runs]
            entry.curves = _CurvesFile(once, pixels, sigma_px, counts, _side_names(content.curves.side[c]))
    plain = {name: value for name, value in msgspec.structs.asdict(data).items() if value is not msgspec.UNSET}
    del plain["views"]
    head = msgspec.json.format(msgspec.json.encode(plain), indent=1).removesuffix(b"\n}")
    lines = b",\n  ".join(msgspec.json.encode(entry) for entry in data.views)
    return head + b',\n "views": [\n  ' + lines + b"\n ]\n}\n"


def _rows_by_view(columns: Points | Curves, views: int) -> list[AnyArray]:
    order = np.argsort(columns.view, kind="stable")
    return np.split(order, np.searchsorted(columns.view[order], np.arange(1, views)))


def _features(columns: Points | Curves, rows: AnyArray, names: Sequence[str]) -> tuple[Any, Any, Any]:
    """Return names, pixels and sigmas in the form of the files."""
    features = [names[i] for i in columns.feature[rows]]
    return features, columns.pixels[rows].tolist(), _same_or_list(columns.sigma_px[rows])


def _side_names(sides: Codes) -> str | list[str] | msgspec.UnsetType:
    if not np.any(sides):
        return msgspec.UNSET
    side = _same_or_list(sides)
    return [_SIDE_NAMES[s] for s in side] if isinstance(side, list) else _SIDE_NAMES[side]


def _to_npz(content: Content) -> bytes:
    arrays: dict[str, Any] = {"header": np.frombuffer(msgspec.json.encode(header_of(content)), np.uint8)}
    for kind, column in (("points", content.points), ("curves", content.curves)):
        arrays |= {f"{kind}_{name}": array for name, array in vars(column).items()}
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _from_npz(packed: bytes, where: str) -> Content:
    arrays = read_npz(packed, _COLUMNS, where)
    header = decode_json(arrays.pop("header").tobytes(), ObservationsFile, where, FORMAT, VERSION)
    return _of_columns(header, arrays)


def _of_columns(header: ObservationsFile, arrays: Mapping[str, AnyArray]) -> Content:
    """Combine a header and columns."""
    points, curves = (
        {name.removeprefix(kind): array for name, array in arrays.items() if name.startswith(kind)}
        for kind in ("points_", "curves_")
    )
    return replace(header.content(), points=Points(**points), curves=Curves(**curves))


# ---- observations in a folder ---------------------------------------------------------------------------------------


ENDING, HEADER = ".columns", "header.json"


def write_folder(path: Path, header: Any, columns: Mapping[str, Columns]) -> None:
    """Write a header and the columns of each kind into a temporary folder beside the destination, then rename it.

    Raises:
        InputError: the folder exists already, or cannot be written.
    """
    if path.exists():
        raise InputError(f"{path}: exists already: remove it, or give another name")
    beside = path.with_name(f".{path.name}.part")
    try:
        beside.mkdir()
        (beside / HEADER).write_bytes(msgspec.json.encode(header))
        for kind, column in columns.items():
            for name, array in vars(column).items():
                _write(beside / f"{kind}_{name}.npy", array)
        beside.rename(path)
    except OSError as error:
        from shutil import rmtree

        rmtree(beside, ignore_errors=True)
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def _write(path: Path, array: AnyArray) -> None:
    block = 1 << 22  # rows written at once
    with path.open("wb") as file:
        described = {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape}
        np.lib.format.write_array_header_1_0(file, described)
        for first in range(0, len(array), block):
            rows = read_rows(rows_of(array, first, min(first + block, len(array))))
            file.write(np.ascontiguousarray(rows).data)


def read_folder(path: Path, columns: Mapping[str, Column]) -> dict[str, AnyArray]:
    """Return the columns of a folder, memory-mapped.

    Raises:
        InputError: a column is missing, cut short, or of another type or shape.
    """
    arrays: dict[str, AnyArray] = {}
    for name in columns:
        file = path / f"{name}.npy"
        if not file.exists():
            raise InputError(f"{path}: column {name} is missing: write the folder again")
        with opened(file):  # refuses a pipe, on which NumPy would wait for ever
            pass
        try:
            arrays[name] = np.lib.format.open_memmap(file, mode="r")
        except Exception as error:  # NumPy raises half a dozen types of errors for a broken header
            raise InputError(f"{file}: cannot be read: it is cut short or not a column ({error})") from None
        if not arrays[name].flags.c_contiguous:
            raise InputError(f"{file}: its array is in Fortran order: save it in C order")
    require_columns(arrays, columns, str(path))
    return arrays
