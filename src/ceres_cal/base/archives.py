"""Columns of numbers in NPZ files, checked against the archive's own headers before they are read."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Mapping
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from ceres_cal.base.arrays import AnyArray
from ceres_cal.base.errors import InputError
from ceres_cal.base.files import require_room

if TYPE_CHECKING:
    import zipfile

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


Column = tuple[Any, tuple[int | str, ...]]
"""Type and lengths that a column must have; a letter stands for a length that is the same in all columns."""


def read_npz(content: bytes, columns: Mapping[str, Column] | None, where: str) -> dict[str, AnyArray]:
    """Read the columns of an NPZ file, each as it is described; None: whatever a file of another program has.

    Raises:
        InputError: no NPZ file, cut short, pickled objects, a column that is missing, unknown, duplicated, too large,
            or of another type or shape.
    """
    import zipfile

    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive, warnings.catch_warnings(action="ignore"):
            names, known = _names(archive, columns, where), columns or {}
            arrays = {name: _column(archive, name, known.get(name), where) for name in names}
            _require_fitting(arrays, known, where)
            return arrays
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib, lzma and NumPy raise a dozen types of errors for a broken archive
        raise InputError(f"{where}: cannot be read: cut short or not an NPZ file ({error}): write it again") from None


def _names(archive: zipfile.ZipFile, columns: Mapping[str, Column] | None, where: str) -> list[str]:
    names = [entry.filename.removesuffix(".npy") for entry in archive.infolist()]
    for name in names:
        if columns is not None and name not in columns:
            raise InputError(f"{where}: unknown column {name[:100]!r}")
    if len(set(names)) < len(names):
        raise InputError(f"{where}: a column is there twice: write it again")
    for name in columns or ():
        if name not in names:
            raise InputError(f"{where}: column {name} is missing: is this another kind of file?")
    require_room(sum(entry.file_size for entry in archive.infolist()), where)
    return names


def _column(archive: zipfile.ZipFile, name: str, column: Column | None, where: str) -> AnyArray:
    """Read one column: its header first, then as many bytes as the header states."""
    entry = next(entry for entry in archive.infolist() if entry.filename.removesuffix(".npy") == name)
    with archive.open(entry) as stream:
        shape, in_columns, dtype = _header(stream)
        if dtype.hasobject:
            raise InputError(f"{where}: cannot be read, it holds pickled objects: write it again")
        if column is not None:
            _require_type(name, dtype, shape, column, where)
        size = math.prod(shape) * dtype.itemsize
        data = stream.read() if size == entry.file_size - stream.tell() else b""
    if size != len(data):
        raise ValueError(f"{name} does not hold as many numbers as its header states")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if in_columns else "C")


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, Any]:
    read = _HEADERS.get(np.lib.format.read_magic(stream))
    if read is None:
        raise ValueError("an unknown version of a NumPy array")
    shape, in_columns, dtype = read(stream)
    return tuple(shape), in_columns, dtype


def require_columns(arrays: Mapping[str, AnyArray], columns: Mapping[str, Column], where: str) -> None:
    """Raise InputError where a column is of another type or shape than it must be."""
    for name, column in columns.items():
        _require_type(name, arrays[name].dtype, arrays[name].shape, column, where)
    _require_fitting(arrays, columns, where)


def _require_type(name: str, dtype: Any, shape: tuple[int, ...], column: Column, where: str) -> None:
    wanted, lengths = np.dtype(column[0]), column[1]
    same = dtype.kind == "U" if wanted.kind == "U" else dtype == wanted
    if not same or len(shape) != len(lengths) or dtype.itemsize == 0:
        kind = "text" if wanted.kind == "U" else wanted
        raise InputError(
            f"{where}: column {name} must be {kind} in {len(lengths)} dimensions, not {dtype} in {len(shape)}"
        )


def _require_fitting(arrays: Mapping[str, AnyArray], columns: Mapping[str, Column], where: str) -> None:
    lengths: dict[int | str, int] = {}
    for name, (_, shape) in columns.items():
        for wanted, length in zip(shape, arrays[name].shape, strict=True):
            if (lengths.setdefault(wanted, length) if isinstance(wanted, str) else wanted) != length:
                raise InputError(f"{where}: column {name} has a shape, {arrays[name].shape}, that does not fit others")
