"""Observations as a folder of columns, for sets that do not fit in memory: plain .npy files and a header in JSON.

The columns stay in their files: they are mapped, and read block by block.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base.archives import Column, require_columns
from ceres_cal.base.arrays import AnyArray
from ceres_cal.base.errors import InputError
from ceres_cal.base.files import opened
from ceres_cal.observations.columns import Columns, read_rows, rows_of

ENDING, HEADER = ".columns", "header.json"


def write_folder(path: Path, header: Any, columns: Mapping[str, Columns]) -> None:
    """Write a header and the columns of each kind beside the place, and rename the folder.

    Raises:
        InputError: it is there already, or cannot be written.
    """
    if path.exists():
        raise InputError(f"{path}: is there already: remove it, or give another name")
    beside = path.with_name(f".{path.name}.part")
    try:
        beside.mkdir()
        (beside / HEADER).write_bytes(msgspec.json.encode(header))
        for kind, column in columns.items():
            for name, array in vars(column).items():
                _write(beside / f"{kind}_{name}.npy", array)
        beside.rename(path)
    except OSError as error:
        shutil.rmtree(beside, ignore_errors=True)
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
    """The columns of a folder, mapped.

    Raises:
        InputError: a column is missing, cut short, or of another type or shape.
    """
    arrays: dict[str, AnyArray] = {}
    for name in columns:
        file = path / f"{name}.npy"
        if not file.exists():
            raise InputError(f"{path}: column {name} is missing: write the folder again")
        with opened(file):  # which refuses a pipe, where NumPy would wait for ever
            pass
        try:
            arrays[name] = np.lib.format.open_memmap(file, mode="r")
        except Exception as error:  # NumPy raises half a dozen kinds for a broken header
            raise InputError(f"{file}: cannot be read, it is cut short or no column ({error})") from None
        if not arrays[name].flags.c_contiguous:
            raise InputError(f"{file}: its rows do not lie one by one (Fortran order): save it in C order")
    require_columns(arrays, columns, str(path))
    return arrays
