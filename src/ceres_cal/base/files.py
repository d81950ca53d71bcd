"""Reading and writing files: one line of error that names the file, and never half a file."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec

from ceres_cal.base.errors import InputError

T = TypeVar("T")
Units = Literal["metres, radians, pixels"]
PixelOrigin = Literal["centre of the top-left pixel"]
UNITS: Units = "metres, radians, pixels"
PIXEL_ORIGIN: PixelOrigin = "centre of the top-left pixel"
"""What files of ours state, and are refused for where they state anything else."""


def read_bytes(path: str | Path) -> bytes:
    """The content of a file.

    Raises:
        InputError: it is missing or cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file beside its place and rename it, so that a crash leaves the old file or the new one, never half.

    Raises:
        InputError: the folder is missing or cannot be written.
    """
    try:
        target = Path(path).resolve()  # behind a symbolic link, which stays
        if target.exists() and not target.is_file():
            raise InputError(f"{path}: cannot be written: it is a folder or a device")
        handle, beside = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        Path(beside).chmod(0o644)
        Path(beside).replace(target)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        Path(beside).unlink(missing_ok=True)


def read_json(path: str | Path, format_name: str, version: int) -> dict[str, Any]:
    """A JSON file of ours as plain data, its format and version checked.

    Raises:
        InputError: not JSON, cut short, of another format, or of a version this package does not know.
    """
    return check_header(parse_json(read_bytes(path), str(path)), str(path), format_name, version)


def parse_json(content: bytes, where: str) -> Any:
    """JSON text as plain data; InputError naming `where` if it is none.

    NaN and Infinity, as Python's own writer spells them, are let through to the checks that can name their place.
    """
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: not valid JSON (cut short?): {error}") from None


def check_header(data: Any, where: str, format_name: str, version: int) -> dict[str, Any]:
    """The same data once its "format" and "version" are known to be ours; InputError naming `where` otherwise."""
    stated = data.get("format") if isinstance(data, dict) else None
    if stated != format_name:
        raise InputError(f'{where}: "format" must be "{format_name}", not {stated!r}')
    if data.get("version") != version:
        raise InputError(
            f"{where}: version {data.get('version')!r} is not known here, only {version}: update ceres-cal"
        )
    return dict(data)


def convert(data: Any, kind: type[T], where: str) -> T:
    """Plain data as a typed structure; InputError naming `where` and the place inside it."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {error}") from None


def write_json(path: str | Path, data: Any) -> None:
    """Data as readable JSON; numbers keep every digit."""
    write_bytes(path, msgspec.json.format(msgspec.json.encode(data), indent=1) + b"\n")


def make_folder(folder: str | Path) -> Path:
    """A folder, made where it is missing; InputError where it cannot be."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made: {error.strerror}") from None
    return folder
