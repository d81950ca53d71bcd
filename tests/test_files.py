"""Files: errors in one line that names the file, and always either the old or the new file on disk."""

import errno
import io
import os
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceres_cal.base.errors import InputError
from ceres_cal.base.files import check_header, convert, parse_json, read_bytes, read_json, write_bytes, write_json

quick = settings(deadline=None, max_examples=40)


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def refused(error: pytest.ExceptionInfo[BaseException], path: Path) -> str:
    """The message: one line that names the file first."""
    text = str(error.value)
    assert text.startswith(f"{path}: ") and "\n" not in text
    return text


# ---- writing --------------------------------------------------------------------------------------------------------


def test_a_file_is_written_whole_and_readable(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_bytes(path, b"old")
    write_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o644
    assert names_in(tmp_path) == ["a.json"]


@pytest.mark.parametrize("step", ["fsync", "write", "replace"])
@pytest.mark.parametrize(
    "failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt(), MemoryError()]
)
def test_a_crash_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, failure: BaseException
) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"old")

    def fail(*_: Any) -> None:
        raise failure

    class FullDisk(io.FileIO):
        def write(self, content: Any) -> int:
            super().write(content[:10])
            raise failure

    if step == "fsync":
        monkeypatch.setattr(os, "fsync", fail)
    elif step == "replace":
        monkeypatch.setattr(Path, "replace", fail)
    else:
        monkeypatch.setattr(os, "fdopen", lambda handle, _: FullDisk(handle, "w"))
    expected = InputError if isinstance(failure, OSError) else type(failure)
    with pytest.raises(expected) as raised:
        write_bytes(path, b"new" * 100_000)
    monkeypatch.undo()
    assert path.read_bytes() == b"old"
    assert names_in(tmp_path) == ["a.json"]
    if isinstance(failure, OSError):
        assert refused(raised, path) == f"{path}: cannot be written: No space left on device"


def test_a_first_file_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(InputError):
        write_bytes(tmp_path / "a.json", b"new")
    assert names_in(tmp_path) == []


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    for path, reason in (
        (tmp_path / "no" / "a.json", "No such file or directory"),
        (tmp_path, "it is a folder or a device"),
        (tmp_path / "file" / "a.json", "Not a directory"),
        (Path(os.devnull), "it is a folder or a device"),
    ):
        with pytest.raises(InputError) as raised:
            write_bytes(path, b"new")
        assert refused(raised, path) == f"{path}: cannot be written: {reason}"


def test_a_symbolic_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    link, place = tmp_path / "link.json", tmp_path / "there" / "a.json"
    place.write_bytes(b"old")
    link.symlink_to(place)
    write_bytes(link, b"new")
    assert link.is_symlink() and place.read_bytes() == b"new"
    assert names_in(tmp_path / "there") == ["a.json"]


# ---- reading --------------------------------------------------------------------------------------------------------


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    for path, reason in (
        (tmp_path / "none.json", "no such file"),
        (tmp_path, "cannot be read: it is a folder: name a file in it"),
    ):
        with pytest.raises(InputError) as raised:
            read_bytes(path)
        assert refused(raised, path) == f"{path}: {reason}"


HEADER = {"format": "ceres-cal/test", "version": 3}


@pytest.mark.parametrize(
    "content, message",
    [
        (b"", "not valid JSON (cut short?)"),
        (b"%PDF-1.4\n%\xe2\xe3", "not valid JSON"),
        (b'{"format": "ceres-cal/test", "ver', "not valid JSON (cut short?)"),
        (b"[" * 100_000, "not valid JSON (cut short?)"),
        (b"[1, 2]", '"format" must be "ceres-cal/test", not None'),
        (b'{"version": 3}', '"format" must be "ceres-cal/test", not None'),
        (b'{"format": "ceres-cal/other", "version": 3}', "not 'ceres-cal/other'"),
        (b'{"format": "a\\nb", "version": 3}', "not 'a\\nb'"),
        (b'{"format": "ceres-cal/test"}', "version None is not known here, only 3: update ceres-cal"),
        (b'{"format": "ceres-cal/test", "version": 4}', "version 4 is not known here, only 3: update ceres-cal"),
        (b'{"format": "ceres-cal/test", "version": "3"}', "version '3' is not known here"),
    ],
)
def test_what_is_no_file_of_ours_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(InputError) as raised:
        read_json(path, "ceres-cal/test", 3)
    assert message in refused(raised, path)


def test_numbers_that_are_not_finite_reach_the_checks() -> None:
    # As Python's own writer writes them: only later checks know which number it is.
    assert [str(v) for v in parse_json(b"[NaN, Infinity, -Infinity]", "here")] == ["nan", "inf", "-inf"]


@pytest.mark.parametrize("letter", ["a", "é", "\\u4e2d"])
def test_plain_letters_take_a_byte_of_memory_each(letter: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # The posterior of a board of 484 corners as built has 70 MB of digits, for which 512 MB are enough.
    monkeypatch.setenv("CERES_CAL_MOST_MB", "1")
    content = f'["{letter}{"a" * 300_000}"]'.encode()
    if letter == "a":
        assert len(parse_json(content, "here")[0]) == 300_001
    else:
        with pytest.raises(InputError, match="here: would take 1 MB"):
            parse_json(content, "here")


@quick
@given(st.dictionaries(st.text(), st.floats(allow_nan=False, allow_infinity=False) | st.text() | st.integers(0, 2**53)))
def test_json_comes_back_to_the_last_bit(tmp_path_factory: pytest.TempPathFactory, content: dict[str, Any]) -> None:
    path = tmp_path_factory.mktemp("files") / "a.json"
    write_json(path, HEADER | {"content": content})
    back = read_json(path, "ceres-cal/test", 3)["content"]
    assert repr(back) == repr(content)  # repr tells -0.0 from 0.0 and 1 from 1.0


class Shape(msgspec.Struct, forbid_unknown_fields=True):
    size: tuple[int, int]


def test_convert_names_the_place() -> None:
    assert convert({"size": [3, 4]}, Shape, "here").size == (3, 4)
    with pytest.raises(InputError, match=r"^a.json: camera: Expected a whole number, got a text, in size\[1\]$"):
        convert({"size": [3, "b"]}, Shape, "a.json: camera")
    with pytest.raises(InputError, match=r"^here: there is no field 'a b': remove it, or correct its name$"):
        convert({"size": [3, 4], "a\nb": 1}, Shape, "here")


class Shapes(msgspec.Struct, forbid_unknown_fields=True):
    shape: dict[str, Shape]
    sizes: list[Shape] = []


@pytest.mark.parametrize(
    "data, words",
    [
        ({"shapes": {}}, r"'shapes': did you mean 'shape'\?"),
        ({"shape": {"a": {"sise": [3, 4]}}}, r"'sise' in shape.a: did you mean 'size'\?"),
        ({"shape": {}, "sizes": [{"size": [3, 4], "siz": 1}]}, r"'siz' in sizes\[0\]: remove it, or correct its name"),
        ({"shape": {}, "size": []}, r"'size': did you mean 'sizes'\?"),
    ],
)
def test_a_misspelt_field_is_told_by_those_beside_it(data: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=f"^here: there is no field {words}$"):
        convert(data, Shapes, "here")


def test_check_header_hands_the_data_on() -> None:
    assert check_header(HEADER | {"a": 1}, "here", "ceres-cal/test", 3) == HEADER | {"a": 1}
