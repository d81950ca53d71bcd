"""What observations are made of: views, priors, and columns of points and curves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from ceres_cal.base import Frozen, InputError, Rows, convert, parts_of, run_parts, take_types
from ceres_cal.base.arrays import AnyArray, Array, Codes, Indices, Indices32, Mask


class View(Frozen, eq=True):
    """What one frame shows of one target. `placement` None: the target lies in the world, as a field does."""

    frame: str
    camera: str
    station: str
    target: str
    placement: str | None = None


_OFFSET, COMA = ".offset_m", "coma"
PRIOR_OWNERS = ("camera", "station", "target")


class Prior(Frozen, eq=True):
    """What is known beforehand: `quantity` of a camera, station or target is `value` with standard deviation `sigma`.

    Quantities of a station: height_m, position_m (m). Of a camera: phi, principal_point (px), aspect, and the lens's
    coefficients by name in the units of the files. Of a target: its dimensions (m), which are solved for then; a sigma
    that is infinite says that the value is only where to start from. And CURVE.offset_m, of a curve that lies
    beside its drawing: about 0, it is solved for, too. Of a camera also COMA, about 0: how far its lens's coma may draw
    everything outwards, by the square of the radius, px at half a diagonal of the image.

    Raises:
        InputError: on construction: an unknown owner, numbers that are not finite, a sigma that is not above 0.
    """

    owner: str
    """"camera", "station" or "target"."""
    name: str
    quantity: str
    value: tuple[float, ...]
    sigma: tuple[float, ...]
    gives_way: bool = False
    """Whether it counts less, the farther off it is: files have none that does."""

    def __post_init__(self) -> None:
        take_types(self)
        here = f"prior on {self.quantity!r} of {self.name!r}"
        if self.owner not in PRIOR_OWNERS:
            raise InputError(f"{here}: its owner must be one of {', '.join(PRIOR_OWNERS)}, not {self.owner!r}")
        size = {"position_m": 3, "principal_point": 2}.get(self.quantity, 1)
        if len(self.value) != size or len(self.sigma) != size:
            raise InputError(f"{here}: give {size} numbers and {size} sigmas")
        finite = np.all(np.isfinite(self.value)) and (self.is_open or np.all(np.isfinite(self.sigma)))
        if not finite or not min(self.sigma) > 0.0:
            raise InputError(f"{here}: finite numbers and a sigma above 0")
        if (self.curve or self.is_coma) and (self.value != (0.0,) or self.is_open):
            raise InputError(f"{here}: an offset is about 0, and its sigma finite")
        if self.dimension and not self.value[0] > 0.0:
            raise InputError(f"{here}: a length is above 0 m, not {self.value[0]:g}")

    @property
    def is_open(self) -> bool:
        """Whether a target's dimension is not known at all."""
        return self.owner == "target" and self.sigma == (np.inf,)

    @property
    def is_coma(self) -> bool:
        """Whether it is about what coma does to a camera's picture."""
        return self.owner == "camera" and self.quantity == COMA

    @property
    def dimension(self) -> str:
        """The "target/dimension" that it is about; nothing where it is about something else."""
        return f"{self.name}/{self.quantity}" if self.owner == "target" and not self.curve else ""

    @property
    def curve(self) -> str:
        """The target's curve whose offset it is about; nothing where it is about something else."""
        return self.quantity.removesuffix(_OFFSET) if self.owner == "target" and self.quantity.endswith(_OFFSET) else ""

    @classmethod
    def of_offset(cls, target: str, curve: str, sigma_m: float) -> Prior:
        """What is known of a curve that lies beside its drawing."""
        return cls("target", target, f"{curve}{_OFFSET}", (0.0,), (sigma_m,))


TYPES: dict[str, type[np.generic]] = {
    "view": np.int32,
    "feature": np.int32,
    "pixels": np.float64,
    "sigma_px": np.float64,
    "side": np.int8,
}


class Columns(Rows):
    """Columns of observations, read-only: index of the view, index into the target's names, pixel, its sigma."""

    view: Indices32
    feature: Indices32
    pixels: Array
    sigma_px: Array

    def __post_init__(self) -> None:
        for name, values in vars(self).items():
            if isinstance(values, np.memmap) or _is_kept(values, TYPES[name]):  # which stays in its file, or as it is
                continue
            column = np.array(values, dtype=TYPES[name], order="C")  # the compiled kernels take no other order
            column.setflags(write=False)
            object.__setattr__(self, name, column)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)})"


def _is_kept(values: AnyArray, dtype: type) -> bool:
    """Whether a column is one already: of its type, row by row in memory, by itself, and read-only."""
    return (
        isinstance(values, np.ndarray)
        and values.dtype == dtype
        and values.flags.c_contiguous
        and values.flags.owndata
        and not values.flags.writeable
    )


class Points(Columns):
    """The point observations."""


class Curves(Columns):
    """The curve observations; `side` is 0 for the centre of the paint, +1 for left, -1 for right."""

    side: Codes


_BLOCK = 1 << 20  # rows at once: what is made of them stays small beside very many
_NOBODY, _NOWHERE = np.empty(0, np.int32), np.empty((0, 2))
NO_POINTS = Points(_NOBODY, _NOBODY, _NOWHERE, np.empty(0))
NO_CURVES = Curves(_NOBODY, _NOBODY, _NOWHERE, np.empty(0), np.empty(0, np.int8))
_ROW_NS = 10.0  # of what is looked at in a block
C = TypeVar("C")
T = TypeVar("T")


def taken(columns: C, rows: Indices | Indices32 | Mask) -> C:
    """Points, curves, or columns of another kind, at these rows only: their numbers, or True for each that stays."""
    return type(columns)(**{name: _taken(column, rows) for name, column in vars(columns).items()})


def joined(parts: Sequence[C]) -> C:
    """Columns of one kind, one after the other."""
    return type(parts[0])(**{name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])})


def _taken(column: AnyArray, rows: Indices | Indices32 | Mask) -> AnyArray:
    """Rows of a column; of one in a file, where they lie side by side, without mapping what is around them."""
    most_runs = 10_000  # of rows side by side that are read one by one
    if not isinstance(column, np.memmap):
        return column[rows]
    numbers = np.flatnonzero(rows) if rows.dtype == bool else rows
    starts = np.flatnonzero(np.diff(numbers, prepend=-2) != 1)
    if not len(numbers) or len(starts) > most_runs:
        return np.array(column[rows])
    runs = zip(numbers[starts].tolist(), np.diff(starts, append=len(numbers)).tolist(), strict=True)
    return np.concatenate([read_rows(rows_of(column, start, start + count)) for start, count in runs])


class FileRows(Frozen, eq=True):
    """Rows of a column in a file, which are read without becoming part of the process's memory for good."""

    path: str
    offset: int
    dtype: str
    shape: tuple[int, ...]

    def read(self) -> AnyArray:
        """The rows.

        Raises:
            InputError: the file is not there, or ends too early.
        """
        size = math.prod(self.shape)
        try:
            with Path(self.path).open("rb") as file:
                values = np.fromfile(file, self.dtype, size, offset=self.offset)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error.strerror}") from None
        if values.size != size:
            raise InputError(f"{self.path}: it ends before its observations do: write it again")
        values.shape = self.shape  # not a view of it: nobody else has it
        values.setflags(write=False)
        return values


def rows_of(column: AnyArray, start: int, stop: int) -> AnyArray | FileRows:
    """Some rows of a column, where they are."""
    rows = column[start:stop]
    if not isinstance(column, np.memmap):
        return rows
    offset = int(column.offset) + start * int(column.strides[0])
    return FileRows(str(column.filename), offset, column.dtype.str, rows.shape)


def read_rows(rows: AnyArray | FileRows) -> AnyArray:
    """The rows, in memory."""
    return rows.read() if isinstance(rows, FileRows) else rows


def in_blocks(columns: C) -> Iterator[tuple[int, C]]:
    """The columns, or a single one, block by block, each in memory, with the number of its first row: at least one."""
    return (_block(columns, number) for number in range(_blocks(columns)))


def each_block(function: Callable[[int, C], T], columns: C) -> list[T]:
    """function(number of its first row, block) of every block, in their order; some of them at the same time."""

    def part(first: int, last: int) -> list[T]:
        return [function(*_block(columns, number)) for number in range(first, last)]

    count = _blocks(columns)
    parts = parts_of(count, count * _BLOCK, _ROW_NS) if count > 1 else [0, 1]
    return list(chain.from_iterable(run_parts(part, parts)))


def _blocks(columns: Any) -> int:
    return max(-(-len(columns) // _BLOCK), 1)


def _block(columns: Any, number: int) -> tuple[int, Any]:
    first, stop = number * _BLOCK, (number + 1) * _BLOCK
    if isinstance(columns, np.ndarray):
        return first, read_rows(rows_of(columns, first, stop))
    rows = {name: read_rows(rows_of(array, first, stop)) for name, array in vars(columns).items()}
    return first, type(columns)(**rows)


def view_label(number: int, views: Sequence[View]) -> str:
    """How messages name a view."""
    return f"view {number} (frame {views[number].frame!r})"


# ---- priors in files ------------------------------------------------------------------------------------------------


def prior_to_json(prior: Prior) -> dict[str, Any]:
    """A prior as the files have it: `{"station": "a", "height_m": 4.02, "sigma_m": 0.01}`; null: nothing is known."""
    value, sigma = (v[0] if len(v) == 1 else list(v) for v in (prior.value, prior.sigma))
    return {prior.owner: prior.name, prior.quantity: value, _sigma_of(prior.owner): None if prior.is_open else sigma}


def _sigma_of(owner: str) -> str:
    return "sigma" if owner == "camera" else "sigma_m"


def prior_from_json(entry: Mapping[str, Any], where: str) -> Prior:
    """The prior that a file describes.

    Raises:
        InputError: naming `where`, when the entry does not name one owner, one quantity and one sigma.
    """
    rest = dict(entry)
    owners = [key for key in PRIOR_OWNERS if key in rest]
    if len(owners) != 1:
        raise InputError(f'{where}: a prior names one "camera" or one "station", or one "target"')
    name, sigma_key = rest.pop(owners[0]), _sigma_of(owners[0])
    sigma = rest.pop(sigma_key, msgspec.UNSET)
    if sigma is None and owners[0] == "target":
        sigma = np.inf
    if sigma in (None, msgspec.UNSET) or len(rest) != 1:
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
