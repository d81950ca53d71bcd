"""Parts of observations: views, priors, and columns of points and curves."""

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
    """The view of one target in one frame. `placement` is None for a target in the world, such as a field."""

    frame: str
    camera: str
    station: str
    target: str
    placement: str | None = None


_OFFSET, COMA = ".offset_m", "coma"
PRIOR_OWNERS = ("camera", "station", "target")


class Prior(Frozen, eq=True):
    """Prior knowledge: `quantity` of a camera, station or target is `value` with standard deviation `sigma`.

    Quantities of a station are height_m and position_m (m). Those of a camera are phi, principal_point (px), aspect,
    and the lens's coefficients by name in the units of the files. Those of a target are its dimensions (m), which are
    then estimated; an infinite sigma says that the value is only an initial estimate. CURVE.offset_m of a target is the
    offset of a misplaced curve from its drawing; the value is 0, and it is estimated, too. COMA of a camera is how far
    its lens's coma displaces all observations outwards, by the square of the radius, px at half a diagonal of the
    image; the value is 0.

    Raises:
        InputError: on construction: an unknown owner, numbers that are not finite, a sigma that is not above 0.
    """

    owner: str
    """"camera", "station" or "target"."""
    name: str
    quantity: str
    value: tuple[float, ...]
    """A number alone is taken as well; as a sigma, for each number of the value."""
    sigma: tuple[float, ...]
    gives_way: bool = False
    """Whether it counts less the farther off it is; no prior in a file does."""

    def __post_init__(self) -> None:
        held, several = vars(self), (tuple, list, np.ndarray)
        held["value"] = self.value if isinstance(self.value, several) else (self.value,)
        held["sigma"] = self.sigma if isinstance(self.sigma, several) else (self.sigma,) * len(self.value)
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
        """Whether nothing is known of a target's dimension."""
        return self.owner == "target" and self.sigma == (np.inf,)

    @property
    def is_coma(self) -> bool:
        """Whether it is on the displacement by a camera's coma."""
        return self.owner == "camera" and self.quantity == COMA

    @property
    def dimension(self) -> str:
        """The "target/dimension" that the prior is on; "" for other priors."""
        return f"{self.name}/{self.quantity}" if self.owner == "target" and not self.curve else ""

    @property
    def curve(self) -> str:
        """The target's curve on whose offset the prior is; "" for other priors."""
        return self.quantity.removesuffix(_OFFSET) if self.owner == "target" and self.quantity.endswith(_OFFSET) else ""

    @classmethod
    def of_offset(cls, target: str, curve: str, sigma_m: float) -> Prior:
        """Make the prior on the offset of a curve from its drawing."""
        return cls("target", target, f"{curve}{_OFFSET}", (0.0,), (sigma_m,))


TYPES: dict[str, type[np.generic]] = {
    "view": np.int32,
    "feature": np.int32,
    "pixels": np.float64,
    "sigma_px": np.float64,
    "side": np.int8,
}


class Columns(Rows):
    """Columns of observations, read-only: number of the view, number among the target's names, pixel, its sigma."""

    view: Indices32
    feature: Indices32
    pixels: Array
    sigma_px: Array

    def __post_init__(self) -> None:
        for name, values in vars(self).items():
            # The column stays in its file, or is suitable already.
            if isinstance(values, np.memmap) or _is_kept(values, TYPES[name]):
                continue
            column = np.array(values, dtype=TYPES[name], order="C")  # the compiled kernels require this order
            column.setflags(write=False)
            object.__setattr__(self, name, column)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)})"


def _is_kept(values: AnyArray, dtype: type) -> bool:
    """Whether an array is suitable as it is: of the column's type, in C order, owning its memory, and read-only."""
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


_BLOCK = 1 << 20  # rows processed at once, so that temporary arrays stay small for very large sets
_NOBODY, _NOWHERE = np.empty(0, np.int32), np.empty((0, 2))
NO_POINTS = Points(_NOBODY, _NOBODY, _NOWHERE, np.empty(0))
NO_CURVES = Curves(_NOBODY, _NOBODY, _NOWHERE, np.empty(0), np.empty(0, np.int8))
_ROW_NS = 10.0  # ns, processor time for a row of a block
C = TypeVar("C")
T = TypeVar("T")


def taken(columns: C, rows: Indices | Indices32 | Mask) -> C:
    """Select rows of points, curves, or columns of another kind, by number or by a mask."""
    return type(columns)(**{name: _taken(column, rows) for name, column in vars(columns).items()})


def joined(parts: Sequence[C]) -> C:
    """Concatenate columns of one kind."""
    return type(parts[0])(**{name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])})


def _taken(column: AnyArray, rows: Indices | Indices32 | Mask) -> AnyArray:
    """Select rows of a column; runs of rows of a column in a file are read without mapping what is around them."""
    most_runs = 10_000  # largest number of runs of rows that are read one by one
    if not isinstance(column, np.memmap):
        return column[rows]
    numbers = np.flatnonzero(rows) if rows.dtype == bool else rows
    starts = np.flatnonzero(np.diff(numbers, prepend=-2) != 1)
    if not len(numbers) or len(starts) > most_runs:
        return np.array(column[rows])
    runs = zip(numbers[starts].tolist(), np.diff(starts, append=len(numbers)).tolist(), strict=True)
    return np.concatenate([read_rows(rows_of(column, start, start + count)) for start, count in runs])


class FileRows(Frozen, eq=True):
    """Rows of a column in a file, which are read without remaining in the process's memory."""

    path: str
    offset: int
    dtype: str
    shape: tuple[int, ...]

    def read(self) -> AnyArray:
        """Read the rows.

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
        values.shape = self.shape  # reshaped in place, as nothing else refers to it
        values.setflags(write=False)
        return values


def rows_of(column: AnyArray, start: int, stop: int) -> AnyArray | FileRows:
    """Return some rows of a column, in memory or in its file as the column is."""
    rows = column[start:stop]
    if not isinstance(column, np.memmap):
        return rows
    offset = int(column.offset) + start * int(column.strides[0])
    return FileRows(str(column.filename), offset, column.dtype.str, rows.shape)


def read_rows(rows: AnyArray | FileRows) -> AnyArray:
    """Return the rows in memory."""
    return rows.read() if isinstance(rows, FileRows) else rows


def in_blocks(columns: C) -> Iterator[tuple[int, C]]:
    """Yield the columns, or a single one, block by block in memory, with the number of each block's first row; at least
    one block.
    """
    return (_block(columns, number) for number in range(_blocks(columns)))


def each_block(function: Callable[[int, C], T], columns: C) -> list[T]:
    """Return function(number of the first row, block) for every block, in their order; several run at the same time."""

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
    """Name of a view in messages."""
    return f"view {number} (frame {views[number].frame!r})"


# ---- priors in files ------------------------------------------------------------------------------------------------


def prior_to_json(prior: Prior) -> dict[str, Any]:
    """A prior in the form of the files: `{"station": "a", "height_m": 4.02, "sigma_m": 0.01}`; sigma null: nothing is
    known.
    """
    value, sigma = (v[0] if len(v) == 1 else list(v) for v in (prior.value, prior.sigma))
    return {prior.owner: prior.name, prior.quantity: value, _sigma_of(prior.owner): None if prior.is_open else sigma}


def _sigma_of(owner: str) -> str:
    return "sigma" if owner == "camera" else "sigma_m"


def prior_from_json(entry: Mapping[str, Any], where: str) -> Prior:
    """Return the prior that a file describes.

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
    if not isinstance(value, list):
        needed = "a number, such as 4.6" if size == 1 else f"a list of {size} numbers"
        raise InputError(f"{where} must be {needed}, not {value!r}")
    numbers = convert(value, list[float], where)
    if len(numbers) != size:
        raise InputError(f"{where}: {size} numbers are needed, not {len(numbers)}")
    return tuple(numbers)
