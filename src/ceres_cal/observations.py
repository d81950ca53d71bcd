"""Observations: what the frames show, as columns, with their targets, cameras, views and priors.

The row of an observation in `points` or `curves` is its permanent id: nothing here reorders or drops rows.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ceres_cal.errors import InputError
from ceres_cal.files import check_header, convert, parse_json, read_bytes, write_bytes
from ceres_cal.targets import SIDES, Target, target_from_spec
from ceres_cal.transforms import Array

FORMAT, VERSION = "ceres-cal/observations", 1
_SIDE_NAMES = {value: name for name, value in SIDES.items()}
Ints = NDArray[np.int32]


@dataclass(frozen=True)
class View:
    """What one frame shows of one target. `placement` None: the target lies in the world, as a field does."""

    frame: str
    camera: str
    station: str
    target: str
    placement: str | None = None


@dataclass(frozen=True)
class Prior:
    """What is known beforehand: `quantity` of a camera or station is `value` with standard deviation `sigma`.

    Quantities of a station: height_m, position_m (m). Of a camera: phi, principal_point (px), aspect, and the lens's
    coefficients by name in the units of the files.
    """

    owner: str
    """"camera" or "station"."""
    name: str
    quantity: str
    value: tuple[float, ...]
    sigma: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", tuple(float(v) for v in self.value))
        object.__setattr__(self, "sigma", tuple(float(s) for s in self.sigma))


_TYPES = {"view": np.int32, "feature": np.int32, "pixels": np.float64, "sigma_px": np.float64, "side": np.int8}


def _freeze(columns: Columns) -> None:
    """Own, read-only columns of the types that the files have."""
    for name, values in vars(columns).items():
        column = np.array(values, dtype=_TYPES[name])
        column.setflags(write=False)
        object.__setattr__(columns, name, column)


@dataclass(frozen=True, eq=False)
class Points:
    """Columns of the point observations: index of the view, index into the target's point names, pixel, its sigma."""

    view: Ints
    feature: Ints
    pixels: Array
    sigma_px: Array

    def __post_init__(self) -> None:
        _freeze(self)

    def __len__(self) -> int:
        return len(self.view)


@dataclass(frozen=True, eq=False)
class Curves:
    """Columns of the curve observations; `side` is 0 for the centre of the paint, +1 for left, -1 for right."""

    view: Ints
    feature: Ints
    pixels: Array
    sigma_px: Array
    side: NDArray[np.int8]

    def __post_init__(self) -> None:
        _freeze(self)

    def __len__(self) -> int:
        return len(self.view)


Columns = Points | Curves


@dataclass(frozen=True, eq=False)
class Observations:
    """Everything that was observed.

    Attributes:
        targets: by name.
        cameras: name -> (width, height) px.
        views: what frame shows which target.
        points: point observations, in the order of their views and in pixels with (0, 0) at the centre of the top-left
            pixel. `sigma_px` is the standard deviation of each coordinate, 1 where nobody stated one (only ratios
            matter then: the solve estimates the scale).
        curves: curve observations, in the order of their views; `sigma_px` is that of the distance to the curve.
        priors: what is known beforehand.

    Raises:
        InputError: on construction, naming the view and the feature: a name that is not there, a number that is not
            finite, a camera without any observation.
    """

    targets: Mapping[str, Target]
    cameras: Mapping[str, tuple[int, int]]
    views: tuple[View, ...]
    points: Points
    curves: Curves
    priors: tuple[Prior, ...] = ()

    def __post_init__(self) -> None:
        self._check_names()
        self._check_columns("point", self.points)
        self._check_columns("curve", self.curves)
        seen = {self.views[i].camera for column in (self.points, self.curves) for i in np.unique(column.view)}
        for name in self.cameras:
            if name not in seen:
                raise InputError(f"camera {name!r} has no observation: add views of it or remove the camera")
        self._check_priors()

    # ---- files --------------------------------------------------------------------------------------------------

    @classmethod
    def load(cls, path: str | Path) -> Observations:
        """Read `.json` or `.npz` (design, section 9).

        Raises:
            InputError: one line that names the file, the view and the feature.
        """
        return load_observations(Path(path))

    def save(self, path: str | Path) -> None:
        """Write `.json` or, for large sets, `.npz`; every number comes back exactly."""
        save_observations(self, Path(path))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the content, the same for the JSON and the NPZ file: where a calibration came from."""
        content = hashlib.sha256(msgspec.json.encode(_header(self)))
        for column in (self.points, self.curves):
            for array in vars(column).values():
                content.update(array.tobytes())
        return content.hexdigest()

    # ---- reading ------------------------------------------------------------------------------------------------

    @property
    def stations(self) -> dict[str, str]:
        """Name of the camera of each station, in order of appearance."""
        return {view.station: view.camera for view in self.views}

    @property
    def placements(self) -> tuple[str, ...]:
        """Names of the placements, in order of appearance."""
        return tuple(dict.fromkeys(view.placement for view in self.views if view.placement is not None))

    def feature_name(self, kind: str, row: int) -> str:
        """Name of the feature that observation `row` of the points (kind "point") or curves ("curve") shows."""
        column: Columns = self.points if kind == "point" else self.curves
        target = self.targets[self.views[int(column.view[row])].target]
        names = target.point_names if kind == "point" else target.curve_names
        return names[int(column.feature[row])]

    # ---- checks -------------------------------------------------------------------------------------------------

    def _check_names(self) -> None:
        for name, size in self.cameras.items():
            if len(size) != 2 or min(size) < 1:
                raise InputError(f"camera {name!r}: image_size must be two positive whole numbers, not {size}")
        owner: dict[str, str] = {}
        placed: dict[str, str] = {}
        for number, view in enumerate(self.views):
            here = _here(number, self.views)
            if view.camera not in self.cameras:
                raise InputError(f"{here} names camera {view.camera!r}, which is not there: {_listed(self.cameras)}")
            if view.target not in self.targets:
                raise InputError(f"{here} names target {view.target!r}, which is not there: {_listed(self.targets)}")
            if owner.setdefault(view.station, view.camera) != view.camera:
                raise InputError(f"{here}: station {view.station!r} belongs to camera {owner[view.station]!r} already")
            if view.placement is not None and placed.setdefault(view.placement, view.target) != view.target:
                raise InputError(
                    f"{here}: placement {view.placement!r} holds target {placed[view.placement]!r} already; "
                    "give each rigid thing a placement of its own"
                )

    def _check_columns(self, kind: str, column: Columns) -> None:
        count = len(column.view)
        if column.pixels.shape != (count, 2) or any(len(array) != count for array in vars(column).values()):
            raise InputError(f"the columns of the {kind} observations differ in length: write them again")
        if count == 0:
            return
        if np.any(wrong := (column.view < 0) | (column.view >= len(self.views))):
            raise InputError(
                f"a {kind} observation names view {column.view[np.argmax(wrong)]}, but there are {len(self.views)}"
            )
        if np.any(np.diff(column.view) < 0):
            raise InputError(f"the {kind} observations are not in the order of their views: sort the columns by view")
        targets = [self.targets[view.target] for view in self.views]
        known = np.array([len(target.points if kind == "point" else target.curves) for target in targets])
        if np.any(wrong := (column.feature < 0) | (column.feature >= known[column.view])):
            row = int(np.argmax(wrong))
            here, target = _here(column.view[row], self.views), self.views[column.view[row]].target
            raise InputError(
                f"{here}: {kind} feature number {column.feature[row]} is unknown in target {target!r}, "
                f"which has {known[column.view[row]]}"
            )
        side = column.side if isinstance(column, Curves) else np.zeros(1, np.int8)
        for what, bad in (
            ("its pixel is not finite", ~np.all(np.isfinite(column.pixels), axis=1)),
            ("its sigma_px must be positive and finite", ~(np.isfinite(column.sigma_px) & (column.sigma_px > 0.0))),
            ("its side must be 0, 1 or -1", (side < -1) | (side > 1)),
        ):
            if np.any(bad):
                row = int(np.argmax(bad))
                here = _here(column.view[row], self.views)
                raise InputError(f"{here}, {kind} {self.feature_name(kind, row)!r}: {what}: correct or remove it")

    def _check_priors(self) -> None:
        for prior in self.priors:
            names: Iterable[str] = self.cameras if prior.owner == "camera" else self.stations
            if prior.name not in names:
                raise InputError(f"a prior names {prior.owner} {prior.name!r}, which is not there: {_listed(names)}")
            if not np.all(np.isfinite(prior.value)) or not np.all(np.isfinite(prior.sigma)) or min(prior.sigma) <= 0.0:
                raise InputError(f"prior on {prior.quantity!r} of {prior.name!r}: finite numbers and a sigma above 0")


def _here(number: int, views: Sequence[View]) -> str:
    return f"view {number} (frame {views[number].frame!r})"


def _listed(names: Iterable[str]) -> str:
    return "there are " + (", ".join(map(repr, names)) or "none")


def combine(parts: Sequence[Observations]) -> Observations:
    """Several sets as one: views one after the other, targets, cameras and priors together.

    Raises:
        InputError: a target or camera means different things in two sets.
    """
    if len(parts) == 1:
        return parts[0]
    targets: dict[str, Target] = {}
    cameras: dict[str, tuple[int, int]] = {}
    for part in parts:
        for name, target in part.targets.items():
            if targets.setdefault(name, target) != target:
                raise InputError(f"target {name!r} is described in two ways: give one of them another name")
        for name, size in part.cameras.items():
            if cameras.setdefault(name, size) != size:
                raise InputError(f"camera {name!r} has image sizes {cameras[name]} and {size}: these are two cameras")
    starts = np.cumsum([0, *(len(part.views) for part in parts)])

    def joined(columns: Sequence[Any]) -> dict[str, Any]:
        moved = [replace(c, view=(c.view + start).astype(np.int32)) for c, start in zip(columns, starts, strict=False)]
        return {name: np.concatenate([getattr(c, name) for c in moved]) for name in vars(columns[0])}

    return Observations(
        targets,
        cameras,
        tuple(view for part in parts for view in part.views),
        Points(**joined([part.points for part in parts])),
        Curves(**joined([part.curves for part in parts])),
        tuple(dict.fromkeys(prior for part in parts for prior in part.priors)),
    )


# ---- JSON and NPZ ---------------------------------------------------------------------------------------------------


class _PointsFile(msgspec.Struct, forbid_unknown_fields=True):
    features: list[str]
    pixels: list[tuple[float, float]]
    sigma_px: float | list[float] = 1.0


class _CurvesFile(msgspec.Struct, forbid_unknown_fields=True):
    features: list[str]
    pixels: list[tuple[float, float]]
    sigma_px: float | list[float] = 1.0
    side: str | list[str] = "centre"


class _ViewFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    frame: str
    camera: str
    target: str
    station: str | None = None
    placement: str | None = None
    points: _PointsFile | None = None
    curves: _CurvesFile | None = None


class _CameraFile(msgspec.Struct, forbid_unknown_fields=True):
    image_size: tuple[int, int]


class _ObservationsFile(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    version: int
    targets: dict[str, Any]
    cameras: dict[str, _CameraFile]
    views: list[_ViewFile]
    priors: list[dict[str, Any]] = []
    units: str = "metres, radians, pixels"
    pixel_origin: str = "centre of the top-left pixel"


def load_observations(path: Path) -> Observations:
    """See `Observations.load`."""
    content = read_bytes(path)
    try:
        if path.suffix == ".npz":
            return _from_npz(content, str(path))
        return _from_json(content, str(path))
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(f"{path}: ") else f"{path}: {text}") from None


def save_observations(observations: Observations, path: Path) -> None:
    """See `Observations.save`."""
    if path.suffix == ".npz":
        write_bytes(path, _to_npz(observations))
    elif path.suffix == ".json":
        write_bytes(path, _to_json(observations))
    else:
        raise InputError(f"{path}: observations are written as .json or .npz: give one of these endings")


def _header(observations: Observations) -> dict[str, Any]:
    """Everything but the columns, as a file has it."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "units": "metres, radians, pixels",
        "pixel_origin": "centre of the top-left pixel",
        "targets": {name: target.spec for name, target in observations.targets.items()},
        "cameras": {name: {"image_size": list(size)} for name, size in observations.cameras.items()},
        "views": [
            {
                "frame": view.frame,
                "camera": view.camera,
                "station": view.station,
                "target": view.target,
                **({"placement": view.placement} if view.placement is not None else {}),
            }
            for view in observations.views
        ],
        "priors": [prior_to_json(prior) for prior in observations.priors],
    }


def prior_to_json(prior: Prior) -> dict[str, Any]:
    """A prior as the files have it: `{"station": "a", "height_m": 4.02, "sigma_m": 0.01}`."""
    value, sigma = (v[0] if len(v) == 1 else list(v) for v in (prior.value, prior.sigma))
    return {prior.owner: prior.name, prior.quantity: value, "sigma_m" if prior.owner == "station" else "sigma": sigma}


def prior_from_json(entry: Mapping[str, Any], where: str) -> Prior:
    """The prior that a file describes.

    Raises:
        InputError: naming `where`, when the entry does not name one owner, one quantity and one sigma.
    """
    rest = dict(entry)
    owners = [key for key in ("camera", "station") if key in rest]
    if len(owners) != 1:
        raise InputError(f'{where}: a prior names one "camera" or one "station"')
    name = rest.pop(owners[0])
    sigma_key = "sigma_m" if owners[0] == "station" else "sigma"
    sigma = rest.pop(sigma_key, None)
    if sigma is None or len(rest) != 1:
        raise InputError(f'{where}: a prior of a {owners[0]} has one quantity and "{sigma_key}", not {sorted(entry)}')
    ((quantity, value),) = rest.items()
    size = {"position_m": 3, "principal_point": 2}.get(quantity, 1)
    if owners[0] == "station" and quantity not in ("height_m", "position_m"):
        raise InputError(f"{where}: a station's prior is on height_m or position_m, not {quantity!r}")
    values = _numbers(value, size, f"{where}: {quantity}")
    return Prior(owners[0], str(name), quantity, values, _numbers(sigma, size, f"{where}: {sigma_key}", spread=True))


def _numbers(value: Any, size: int, where: str, *, spread: bool = False) -> tuple[float, ...]:
    if isinstance(value, (int, float)) and (size == 1 or spread):
        return (float(value),) * size
    numbers = convert(value, list[float], where)
    if len(numbers) != size:
        raise InputError(f"{where}: {size} numbers are needed, not {len(numbers)}")
    return tuple(numbers)


def _read_header(data: dict[str, Any]) -> tuple[dict[str, Target], dict[str, tuple[int, int]], tuple[Prior, ...]]:
    targets = {name: target_from_spec(spec, f"target {name!r}") for name, spec in data["targets"].items()}
    cameras = {name: tuple(entry["image_size"]) for name, entry in data["cameras"].items()}
    priors = tuple(prior_from_json(entry, f"prior {i}") for i, entry in enumerate(data.get("priors", [])))
    return targets, cameras, priors


def _view(entry: _ViewFile) -> View:
    station = entry.camera if entry.station is None else entry.station
    return View(entry.frame, entry.camera, station, entry.target, entry.placement)


def _from_json(content: bytes, where: str) -> Observations:
    try:
        data = msgspec.json.decode(content, type=_ObservationsFile)  # several times faster than by way of plain data
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        plain = check_header(parse_json(content, where), where, FORMAT, VERSION)
        data = convert(plain, _ObservationsFile, where)
    check_header({"format": data.format, "version": data.version}, where, FORMAT, VERSION)
    cameras = {name: {"image_size": entry.image_size} for name, entry in data.cameras.items()}
    targets, sizes, priors = _read_header({"targets": data.targets, "cameras": cameras, "priors": data.priors})
    views = tuple(_view(entry) for entry in data.views)
    for number, view in enumerate(views):
        if view.target not in targets:
            raise InputError(
                f"{_here(number, views)} names target {view.target!r}, which is not there: {_listed(targets)}"
            )
    points = [(i, entry.points) for i, entry in enumerate(data.views) if entry.points is not None]
    curves = [(i, entry.curves) for i, entry in enumerate(data.views) if entry.curves is not None]
    point_index = {name: {f: i for i, f in enumerate(target.point_names)} for name, target in targets.items()}
    curve_index = {name: {f: i for i, f in enumerate(target.curve_names)} for name, target in targets.items()}
    sides = [_sides(entry, _here(i, views)) for i, entry in curves]
    return Observations(
        targets,
        sizes,
        views,
        Points(**_columns(points, views, point_index, "point")),
        Curves(**_columns(curves, views, curve_index, "curve"), side=_concatenate(sides, np.int8)),
        priors,
    )


def _concatenate(parts: Sequence[Any], dtype: Any) -> NDArray[Any]:
    return np.concatenate([np.empty(0, dtype), *parts]).astype(dtype)


def _columns(
    entries: Sequence[tuple[int, _PointsFile | _CurvesFile]],
    views: Sequence[View],
    index: Mapping[str, Mapping[str, int]],
    kind: str,
) -> dict[str, Any]:
    """The columns of all views' features; InputError naming the view and the feature."""
    view, feature, sigma = [], [], []
    pixels: list[tuple[float, float]] = []
    for number, entry in entries:
        here, count = _here(number, views), len(entry.features)
        if len(entry.pixels) != count:
            raise InputError(f"{here}: {count} {kind} features but {len(entry.pixels)} pixels")
        names = index[views[number].target]
        try:
            feature.append([names[name] for name in entry.features])
        except KeyError as error:
            raise InputError(
                f"{here}: {kind} feature {error.args[0]!r} is unknown in target {views[number].target!r}: "
                "`ceres-cal targets` lists the names"
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
    names = entry.side if isinstance(entry.side, list) else [entry.side] * len(entry.features)
    if len(names) != len(entry.features):
        raise InputError(f"{here}: {len(entry.features)} curve features but {len(names)} sides")
    for name in names:
        if name not in SIDES:
            raise InputError(f"{here}: side {name!r} is unknown: {', '.join(SIDES)}")
    return [SIDES[name] for name in names]


def _same_or_list(values: NDArray[Any]) -> Any:
    return values[0].item() if len(values) and np.all(values == values[0]) else values.tolist()


def _to_json(observations: Observations) -> bytes:
    data = _header(observations)
    for kind, column in (("points", observations.points), ("curves", observations.curves)):
        order = np.argsort(column.view, kind="stable")
        bounds = np.searchsorted(column.view[order], np.arange(len(observations.views) + 1))
        for number, entry in enumerate(data["views"]):
            rows = order[bounds[number] : bounds[number + 1]]
            if not len(rows):
                continue
            target = observations.targets[entry["target"]]
            names = target.point_names if kind == "points" else target.curve_names
            entry[kind] = {
                "features": [names[i] for i in column.feature[rows]],
                "pixels": column.pixels[rows].tolist(),
                "sigma_px": _same_or_list(column.sigma_px[rows]),
            }
            if isinstance(column, Curves) and np.any(column.side[rows]):
                side = _same_or_list(column.side[rows])
                entry[kind]["side"] = [_SIDE_NAMES[s] for s in side] if isinstance(side, list) else _SIDE_NAMES[side]
    views = data.pop("views")
    head = msgspec.json.format(msgspec.json.encode(data), indent=1).rstrip(b"}\n")
    lines = b",\n  ".join(msgspec.json.encode(entry) for entry in views)
    return head + b',\n "views": [\n  ' + lines + b"\n ]\n}\n"


def _to_npz(observations: Observations) -> bytes:
    arrays: dict[str, Any] = {"header": np.frombuffer(msgspec.json.encode(_header(observations)), np.uint8)}
    for kind, column in (("points", observations.points), ("curves", observations.curves)):
        arrays |= {f"{kind}_{name}": array for name, array in vars(column).items()}
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _arrays(content: bytes, where: str) -> dict[str, NDArray[Any]]:
    """What an NPZ file holds, by name."""
    reason = "it is cut short or no NPZ file"
    try:
        if zipfile.is_zipfile(io.BytesIO(content)):
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
    except Exception as error:  # zipfile, zlib and NumPy raise a dozen kinds for a broken archive
        if "allow_pickle" in str(error):
            reason = "it holds pickled objects"
    raise InputError(f"{where}: cannot be read, {reason}: write it again with Observations.save")


def _taken(arrays: dict[str, NDArray[Any]], kind: str, names: Sequence[str], where: str) -> dict[str, Any]:
    """The columns of one kind, taken out of the arrays."""
    found = {}
    for name in names:
        array, dtype, ndim = arrays.pop(f"{kind}_{name}", None), np.dtype(_TYPES[name]), 2 if name == "pixels" else 1
        if array is None:
            raise InputError(f"{where}: column {kind}_{name} is missing")
        if array.dtype != dtype or array.ndim != ndim:
            raise InputError(
                f"{where}: column {kind}_{name} must be {dtype} in {ndim} dimensions, not {array.dtype} in {array.ndim}"
            )
        found[name] = array
    return found


def _from_npz(content: bytes, where: str) -> Observations:
    arrays = _arrays(content, where)
    header = arrays.pop("header", None)
    if header is None or header.dtype != np.uint8:
        raise InputError(f"{where}: no header: this is not a file of observations")
    plain = check_header(parse_json(header.tobytes(), where), where, FORMAT, VERSION)
    typed = convert(plain, _ObservationsFile, where)
    targets, cameras, priors = _read_header(plain)
    names = ("view", "feature", "pixels", "sigma_px")
    points = Points(**_taken(arrays, "points", names, where))
    curves = Curves(**_taken(arrays, "curves", (*names, "side"), where))
    if arrays:
        raise InputError(f"{where}: unknown column {min(arrays)!r}")
    return Observations(targets, cameras, tuple(_view(entry) for entry in typed.views), points, curves, priors)
