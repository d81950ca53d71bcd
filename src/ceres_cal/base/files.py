"""Reading and writing of files, in one place: an error is one line that names the file, and no file is half written.

Files come from other people. Only regular files are read, and the memory that the content would take is estimated from
its size, headers and marks before it is allocated: more than `most_bytes` is refused.
"""

from __future__ import annotations

import codecs
import fcntl
import json
import math
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Literal, TypeVar, cast

import msgspec

from ceres_cal.base.errors import InputError, note
from ceres_cal.base.threads import writing
from ceres_cal.base.words import did_you_mean, printable

T = TypeVar("T")
Units = Literal["metres, radians, pixels"]
PixelOrigin = Literal["centre of the top-left pixel"]
UNITS: Units = "metres, radians, pixels"
PIXEL_ORIGIN: PixelOrigin = "centre of the top-left pixel"
"""Stated by the package's files, which are refused where they state anything else."""

LIMIT = "CERES_CAL_MOST_MB"
_NOT_MARKS = bytes(set(range(256)) - set(b"{}[]:,"))
_NOT_KEYS = bytes(set(range(256)) - set(b"{}:"))
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")


_HOLDING = {
    "ceres-cal/calibration": "a calibration",
    "ceres-cal/observations": "observations",
    "ceres-cal/corners": "corners to start from",
    "ceres-cal/truth": "the truth of a simulation",
    "ceres-cal/scene": "a scene",
}
_KINDS = {
    **{"array": "a list", "object": "names with values", "float": "a number", "int": "a whole number"},
    **{"str": "a text", "bool": "true or false", "null": "nothing"},
}
"""Plain words for msgspec's names of types."""
_MEANING = {  # meanings of fields that may be missing
    "format": "what the file holds, such as ceres-cal/observations",
    "version": "of the file's format, 1",
    "targets": "what was observed, by name",
    "cameras": "each camera by name",
    "views": "what each frame shows",
    "image_size": "width and height in px",
    "frame": "name of the photograph",
    "camera": "name of the camera that saw it",
    "target": "name of what is seen",
    "features": "names of the points or lines",
    "pixels": "x and y of each observation, px",
    "kind": "of the target or the lens",
    "phi": "the focal length in px",
    "principal_point": "cx and cy in px",
    "lens": "its kind and coefficients",
    "stations": "where each camera stands",
    "rotation": "a 3 x 3 matrix",
    "translation_m": "three numbers in m",
}


# ---- limits ---------------------------------------------------------------------------------------------------------


def most_bytes() -> float:
    """Largest memory for the content of one file: 512 MB, or as CERES_CAL_MOST_MB states."""
    # Enough for 10 million observations in NPZ, one million in JSON, or a grey photograph of 500 megapixels.
    most_mb = 512
    text = os.environ.get(LIMIT, str(most_mb))
    if not text.isdecimal() or int(text) < 1:
        raise InputError(f"{LIMIT} is {text!r}: give a whole number of megabytes")
    return 1e6 * int(text)


def require_room(needed: float, where: str) -> None:
    """Raise InputError, before any memory is allocated, where content would take more than `most_bytes`."""
    if needed > most_bytes():
        raise InputError(
            f"{where}: would take {needed / 1e6:.0f} MB, more than the limit of {most_bytes() / 1e6:.0f} MB: "
            f"give less at a time, or set {LIMIT}={math.ceil(needed / 1e6)} to allow it"
        )


# ---- reading --------------------------------------------------------------------------------------------------------


def read_bytes(path: str | Path) -> bytes:
    """Read a file; text in UTF-16, as Windows writes it, is converted to UTF-8.

    Raises:
        InputError: it is missing, cannot be read, is no regular file, or is too large.
    """
    with opened(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        require_room(size, str(path))
        content = stream.read(size)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        with suppress(UnicodeDecodeError):  # quiet: it is no text, and read as it is
            return content.decode("utf-16").encode()
    return content


@contextmanager
def opened(path: str | Path) -> Iterator[IO[bytes]]:
    """Open a file for reading.

    Raises:
        InputError: it is missing, cannot be read, or is no regular file (reading a pipe or a device may never end).
    """
    try:
        # O_NONBLOCK keeps the opening of a pipe from waiting for its writer; regular files ignore it.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(handle, "rb") as stream:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise InputError(f"{path}: cannot be read: it is a pipe or a device: save its content to a file first")
            yield stream
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: cannot be read: it is a folder: name a file in it") from None
    except TypeError:
        raise InputError(f"path must be a path, not {type(path).__name__}") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_json(path: str | Path, format_name: str, version: int) -> dict[str, Any]:
    """Read a JSON file of the package as plain data, with its format and version checked and its numbers finite.

    Raises:
        InputError: not JSON, cut short, of another format, or of a version this package does not know.
    """
    data = check_header(parse_json(read_bytes(path), str(path)), str(path), format_name, version)
    _require_finite(data, "$", str(path))
    return data


def parse_json(content: bytes, where: str) -> Any:
    """Parse JSON text as plain data; InputError naming `where` if it is invalid, too large, or has a duplicate name.

    NaN and Infinity, as Python's own writer spells them, are accepted here; later checks can name their place.
    """
    if not content.strip():
        raise InputError(f"{where}: not valid JSON (cut short?): it is empty")
    _require_few_marks(content, where)
    try:
        data = json.loads(content.decode("utf-8-sig"), parse_int=_whole)
        if _SURROGATE.search(content):
            msgspec.json.encode(data)  # half a surrogate pair could not be written again
    except UnicodeDecodeError as error:
        raise InputError(
            f"{where}: not valid JSON: byte {error.start} is not UTF-8: save it in this encoding"
        ) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: not valid JSON (cut short?): {error}") from None
    _require_unique_keys(content, where)
    return data


def _whole(text: str) -> int | float:
    """A whole number; as a float if it exceeds a machine word, so that later checks can name its place."""
    return int(text) if len(text) < 19 else float(text)


_LONG_WHOLE = re.compile(rb"[:\[,]\s*-?\d{19}")  # msgspec accepts any length, plain data as `_whole` does


def decode_json(
    content: bytes, kind: type[T], where: str, format_name: str, version: int, *, finite: bool = False
) -> T:
    """Decode JSON text of the package, with a "format" and a "version", as a typed structure, several times as fast as
    by plain data, which say where the text does not fit.

    Args:
        finite: whether numbers that are not finite are refused here; else the caller names their place.

    Raises:
        InputError: see `read_json`, and `convert`.
    """
    _require_few_marks(content, where)
    try:
        if _LONG_WHOLE.search(content):
            raise msgspec.DecodeError
        data: Any = msgspec.json.decode(content, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        # quiet: plain data are read instead, and say where they do not fit
        plain = check_header(parse_json(content, where), where, format_name, version)
        if finite:
            _require_finite(plain, "$", where)
        return convert(plain, kind, where)
    _require_unique_keys(content, where)
    check_header({"format": data.format, "version": data.version}, where, format_name, version)
    return cast("T", data)


def _require_few_marks(content: bytes, where: str) -> None:
    is_plain = content.isascii() and b"\\u" not in content
    bytes_per_letter = 1 if is_plain else 4  # bytes of memory for each letter of a string with any rare letter
    bytes_per_mark = 80  # bytes of memory for each value between two commas, colons or brackets of JSON
    marks = len(content.translate(None, _NOT_MARKS))
    require_room(bytes_per_letter * len(content) + bytes_per_mark * marks, where)


def _require_unique_keys(content: bytes, where: str) -> None:
    """Raise InputError where an object of valid JSON has a key twice, of which parsers silently take the last one."""
    plain = content.replace(rb"\\", b"\0").replace(rb"\"", b"\1")  # valid JSON contains no control characters
    parts = plain.split(b'"')  # strings have odd indices, the text between them even ones
    objects: list[set[str]] = []
    for number in range(0, len(parts), 2):
        between = parts[number]
        if between == b",":
            continue
        for mark in between.translate(None, _NOT_KEYS):
            if mark == ord("{"):
                objects.append(set())
            elif mark == ord("}"):
                objects.pop()
            else:
                key = parts[number - 1].replace(b"\0", rb"\\").replace(b"\1", rb"\"")
                name = json.loads(b'"' + key + b'"') if b"\\" in key else key.decode()
                if name in objects[-1]:
                    raise InputError(f"{where}: {name!r} is given twice in one object: keep one of them")
                objects[-1].add(name)


def _require_finite(value: Any, place: str, where: str) -> None:
    if isinstance(value, float):
        if not math.isfinite(value):
            raise InputError(f"{where}: {value} is not a finite number - at `{place}`")
    elif isinstance(value, dict):
        for name, entry in value.items():
            _require_finite(entry, f"{place}.{name}", where)
    elif isinstance(value, list):
        for number, entry in enumerate(value):
            _require_finite(entry, f"{place}[{number}]", where)


def check_header(data: Any, where: str, format_name: str, version: int) -> dict[str, Any]:
    """Return the data if its "format" and "version" are as expected; InputError naming `where` otherwise."""
    stated = data.get("format") if isinstance(data, dict) else None
    meant = _HOLDING.get(format_name, format_name)
    if isinstance(stated, str) and stated in _HOLDING and stated != format_name:
        raise InputError(
            f"{where}: it holds {_HOLDING[stated]}, where {meant} must be given: were two arguments exchanged?"
        )
    if stated != format_name:
        raise InputError(f'{where}: "format" must be "{format_name}", not {_clipped(stated)}: give {meant}')
    if data.get("version") != version:
        raise InputError(
            f"{where}: version {_clipped(data.get('version'))} is not known here, only {version}: update ceres-cal"
        )
    return dict(data)


def body_of(data: Any, where: str, format_name: str, version: int) -> dict[str, Any]:
    """Return the data without the header, which is checked."""
    checked = check_header(data, where, format_name, version)
    return {name: value for name, value in checked.items() if name not in ("format", "version")}


def _clipped(value: Any) -> str:
    return f"{value!r:.100}"


def convert(data: Any, kind: type[T], where: str) -> T:
    """Convert plain data to a typed structure; an InputError names `where` and the place in it."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {_in_plain_words(str(error), data, kind)}") from None


def _in_plain_words(message: str, data: Any, kind: type[Any]) -> str:
    """Reword msgspec's message, with the place as a path of names and the meaning of a missing field."""
    said, _, path = message.partition(" - at `$")
    names, there = _path(path.rstrip("`"), message, data, kind)
    place = "".join(f"[{name}]" if isinstance(name, int) else f".{name}" for name in names).lstrip(".")
    if found := re.fullmatch(r"Object missing required field `(\w+)`", said):
        meaning = _MEANING.get(found[1])
        text = f"{found[1]!r} is missing{f' ({meaning})' if meaning else ''}"
        return f"{text} in {place}" if place else text
    if found := re.fullmatch(r"Object contains unknown field `(.+)`", " ".join(said.split())):
        meant = _meant(found[1], there, kind) or ": remove it, or correct its name"
        return f"there is no field {found[1]!r}{f' in {place}' if place else ''}{meant}"
    if found := re.fullmatch(r"Invalid enum value (.*)", said):
        must = {"units": UNITS, "pixel_origin": PIXEL_ORIGIN}.get(str(names[-1]) if names else "")
        said = f"{found[1]} cannot be read" + (f": give the file in {must!r}" if must else "")
    for theirs in set(re.findall(r"`([^`]+)`", said)):
        said = said.replace(f"`{theirs}`", " or ".join(_KINDS.get(one, one) for one in theirs.split(" | ")))
    return f"{said}, in {place}" if place else said


def _meant(name: str, there: Any, kind: type[Any]) -> str:
    """Return a known field similar to an unknown one, from the structures that share most of the fields beside it."""
    every = msgspec.json.schema_components([kind])[1].values()
    fields = [{*one["properties"]} for one in every if name not in one.get("properties", {name})]
    most = max((len(one & {*there}) for one in fields), default=0)
    return did_you_mean(name, set().union(*(one for one in fields if len(one & {*there}) == most)) - {*there})


def _path(path: str, message: str, data: Any, kind: type[Any]) -> tuple[list[str | int], Any]:
    """Return the names on msgspec's path, with [...] as the key without which the data are valid, and what is there."""
    names: list[str | int] = []
    here: Any = data
    for part in re.findall(r"\.(\w+)|\[(\d+)\]|\[(\.\.\.)\]", path):
        if part[2] and isinstance(here, dict):
            names.append(next((key for key in here if not _is_well(data, names, key, kind, message)), "..."))
        elif not part[2]:
            names.append(int(part[1]) if part[1] else part[0])
        is_there = names[-1] in here if isinstance(here, dict) else isinstance(here, list)
        here = here[names[-1]] if is_there else None
    return names, here


def _is_well(data: Any, names: list[str | int], key: str, kind: type[Any], message: str) -> bool:
    """Whether the data raise another error, or none, if only this entry is kept at a place."""

    def alone(value: Any, rest: list[str | int]) -> Any:
        if not rest:
            return {key: value[key]}
        copied: Any = dict(value) if isinstance(value, dict) else list(value)
        copied[rest[0]] = alone(value[rest[0]], rest[1:])
        return copied

    try:
        msgspec.convert(alone(data, names), kind)
    except msgspec.ValidationError as error:  # quiet: this entry is not the one that the message is about
        return str(error) != message
    return True


# ---- writing --------------------------------------------------------------------------------------------------------


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file beside its place and rename it, so that a crash leaves the old file or the new one, never half.

    A replaced file keeps its mode and, as far as the system allows, its owner; a new one follows the umask. Temporary
    files of killed runs are removed.

    Raises:
        InputError: the folder is missing or cannot be written, or the file exists and may not be written.
    """
    try:
        target = Path(os.path.realpath(path))  # where a symbolic link points to; the link is kept
        if target.exists() and not target.is_file():
            raise InputError(f"{path}: cannot be written: it is a folder or a device")
        if target.exists() and not os.access(target, os.W_OK):
            raise InputError(f"{path}: cannot be written: Permission denied")
        with writing(), _beside(target) as (handle, beside), os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(handle)
            _keep_owner(handle, target)
            beside.replace(target)
        note(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from None


@contextmanager
def _beside(target: Path) -> Iterator[tuple[int, Path]]:
    """Create a new file beside the target, and remove it at the end if it was not renamed.

    It is locked while it is written: a file without a lock was left by a killed run.
    """
    start, end = f".{target.name[:150]}.", ".part"
    for entry in os.scandir(target.parent):
        if entry.name.startswith(start) and entry.name.endswith(end):
            _remove_stale(target.parent / entry.name)
    while True:
        beside = target.parent / f"{start}{os.urandom(6).hex()}{end}"
        handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        with suppress(OSError):  # quiet: a file system without locks; what a killed run leaves then stays
            fcntl.flock(handle, fcntl.LOCK_EX)
        if os.fstat(handle).st_nlink:  # otherwise another run has just removed it as stale
            break
        os.close(handle)
    try:
        yield handle, beside
    finally:
        beside.unlink(missing_ok=True)


def _remove_stale(path: Path) -> None:
    with suppress(OSError):  # quiet: another run writes it, or it is gone
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()
        finally:
            os.close(handle)


def _keep_owner(handle: int, target: Path) -> None:
    if not target.exists():
        return
    before = target.stat()
    with suppress(OSError):  # quiet: some file systems have no modes, and only root may give files away
        os.fchmod(handle, stat.S_IMODE(before.st_mode))
        os.fchown(handle, before.st_uid, before.st_gid)


def write_json(path: str | Path, data: Any) -> None:
    """Write `json_text`."""
    write_bytes(path, json_text(data).encode() + b"\n")


def json_text(data: Any) -> str:
    """Format data as readable JSON. Numbers keep every digit, arrays become lists, infinity and NaN become null."""
    try:
        encoded = msgspec.json.encode(data, enc_hook=_plain)
    except UnicodeEncodeError:  # quiet: a file's name that is no UTF-8 has its bytes spelt out
        encoded = msgspec.json.encode(_all_printable(msgspec.to_builtins(data, enc_hook=_plain)))
    return msgspec.json.format(encoded, indent=1).decode()


def _plain(value: Any) -> Any:
    """Convert NumPy's arrays and numbers to Python's."""
    return value.tolist()


def _all_printable(data: Any) -> Any:
    if isinstance(data, dict):
        return {_all_printable(name): _all_printable(value) for name, value in data.items()}
    if isinstance(data, list):
        return [_all_printable(value) for value in data]
    return printable(data) if isinstance(data, str) else data


def make_folder(folder: str | Path) -> Path:
    """Create a folder unless it exists; InputError where that fails."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made: {error.strerror}") from None
    return folder
