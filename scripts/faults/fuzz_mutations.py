"""Mutations for scripts/fuzz.py: JSON trees, columns of archives, text, images, bytes, and words of a command line."""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

Rng = np.random.Generator

NUMBER = re.compile(rb"-?[0-9]+(\.[0-9]+)?(e-?[0-9]+)?")
WORD = re.compile(rb'"(?:[^"\\]|\\.)*"|-?[0-9][0-9.eE+-]*|true|false|null|[\[\]{}:,]')
TOKENS = b'0 -1 1 2 1e400 -0.0 1e308 5e-324 NaN -Infinity 9000000000 1e24 null true [] {} "" "a"'.split()
TOKENS += [b'"\\ud800"', b'"\\u0000"', b'"' + b"x" * 300 + b'"', b"[" * 500, b"1" + b"0" * 400, b"[[1,2],[3]]"]
TOKENS += [b"1:2:3.5", b"1:" * 40 + b"1", b"0x10", b".inf", b"2001-01-01", b"~", b"!!binary aGk="]
FACTORS = (-1.0, 0.0, 0.5, 1.0 + 1e-9, 1.02, 1.1, 2.0, 1e-3, 1e3, 1e-12, 1e7, 1e200)
NUMBERS = (0, -1, 1, 2, 0.5, -0.0, 1e7, 1e-12, 1e-300, 1e308, 2**31, 2**63, 10**30, float("nan"), float("inf"))
TEXTS = ("", " ", "a", "x" * 300, "é\n\u2028", "../../etc/passwd", "-1", "nan", "a/b", "a.b", "*", "\x00", "\x1b[31m")
OTHERS: tuple[Any, ...] = (None, True, False, [], {}, [[]], [1, 2, 3], {"a": 1}, [None], [[1, 2], [3]])
SIZES = ((1, 1), (1, 2), (2, 1), (3, 3), (8, 8), (1, 60000), (60000, 1), (2, 5000), (5000, 3), (64, 48), (400, 300))
_LARGE = 2_000_000  # bytes, so that code slower than linear takes long
_JSON = (".json", ".columns/header.json")
_TEXT = (".yml", ".yaml", ".xml", ".cameramodel", ".txt", ".vnl", ".csv", ".toml", ".jsonl")
IMAGES = (".png", ".jpg", ".bmp", ".tif", ".webp", ".pgm", ".ppm", ".jp2")


def one_of(choices: Sequence[Any], rng: Rng) -> Any:
    return choices[int(rng.integers(0, len(choices)))]


def mutated(name: str, content: bytes, rng: Rng) -> bytes:
    """The content of a file of this name, with one to three changes of a kind suitable for its format."""
    kinds = next((kinds for endings, kinds in _KINDS if name.endswith(endings)), (bytes_changed,))
    kind = bytes_changed if rng.random() < 0.15 else one_of(kinds, rng)
    try:
        return bytes(kind(content, rng))
    except (ValueError, zipfile.BadZipFile):  # an earlier change has damaged its format
        return bytes_changed(content, rng)


# ---- bytes ----------------------------------------------------------------------------------------------------------


def bytes_changed(content: bytes, rng: Rng) -> bytes:
    out = bytearray(content)
    for _ in range(int(rng.integers(1, 5))):
        at, length = int(rng.integers(0, len(out) + 1)), int(rng.integers(1, 40))
        kind = rng.integers(0, 6)
        if kind == 0 and at < len(out):
            out[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            out[at : at + length] = rng.bytes(length)
        elif kind == 2:
            del out[at : at + length]
        elif kind == 3:
            out[at:at] = out[at : at + length]
        elif kind == 4:
            out[at : at + 4] = rng.choice([b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f"])
        else:
            del out[at:]
    return bytes(out)


# ---- text -----------------------------------------------------------------------------------------------------------


def words_changed(content: bytes, rng: Rng) -> bytes:
    """Text with some of its words exchanged, repeated, removed or replaced by odd ones."""
    places = [match.span() for match in WORD.finditer(content)]
    for _ in range(int(rng.integers(1, 4)) if places else 0):
        first, last = one_of(places, rng)
        other = content[slice(*one_of(places, rng))]
        if NUMBER.fullmatch(content[first:last]):
            other = repr(float(content[first:last]) * one_of(FACTORS, rng)).encode()
        word = one_of([one_of(TOKENS, rng), other, b"", content[first:last] * 2], rng)
        content = content[:first] + word + content[last:]
        places = [(a, b) for a, b in places if b <= first] or places[:1]
    return bytes(content)


def lines_changed(content: bytes, rng: Rng) -> bytes:
    """Text with a line removed, repeated, exchanged with another one, or repeated until the text is large."""
    lines = content.splitlines(keepends=True) or [b""]
    a, b = (int(rng.integers(0, len(lines))) for _ in range(2))
    kind = rng.integers(0, 6)
    if kind == 0:
        del lines[a]
    elif kind == 1:
        lines.insert(b, lines[a])
    elif kind == 2:
        lines[a], lines[b] = lines[b], lines[a]
    elif kind == 3:
        lines[a : a + 1] = [lines[a]] * (_LARGE // max(len(lines[a]), 1))
    elif kind == 4:
        lines = [one_of([b"\xef\xbb\xbf", b"\xff", b"\r\n", b"\0"], rng), *lines]
    else:
        old, new = one_of([(b",", b";"), (b":", b"="), (b" ", b"\t"), (b"\n", b"\r"), (b".", b",")], rng)
        return content.replace(old, new)
    return b"".join(lines)


def long_number(content: bytes, rng: Rng) -> bytes:
    """Text with one very long number, in base 10, or in base 60 as in old YAML."""
    places = [match.span() for match in NUMBER.finditer(content)]
    if not places:
        return content
    first, last = one_of(places, rng)
    piece: bytes = one_of([b"1", b"1:", b"0.", b"1e", b"-"], rng)
    return content[:first] + piece * (_LARGE // len(piece)) + b"1" + content[last:]


# ---- JSON -----------------------------------------------------------------------------------------------------------


def tree_changed(content: bytes, rng: Rng) -> bytes:
    """JSON with one to three of its values and names changed; the result is JSON as Python writes it."""
    tree: list[Any] = [json.loads(content)]
    for _ in range(int(rng.integers(1, 4))):
        parent, key = _place(tree, rng)
        if isinstance(parent, dict) and rng.random() < 0.15:
            _names_changed(parent, key, rng)
        else:
            parent[key] = value_changed(parent[key], rng)
    return json.dumps(tree[0]).encode()


def _place(tree: list[Any], rng: Rng) -> tuple[Any, Any]:
    """A random place in a tree; each level has the same probability, for any number of values."""
    parent: Any = tree
    key: Any = 0
    while True:
        inside: Any = parent[key]
        if not (isinstance(inside, dict | list) and inside) or rng.random() < 0.12:
            return parent, key
        parent = inside
        key = one_of(list(inside) if isinstance(inside, dict) else range(len(inside)), rng)


def _names_changed(owner: dict[str, Any], key: str, rng: Rng) -> None:
    kind, other = rng.integers(0, 4), one_of(list(owner), rng)
    if kind == 0:
        del owner[key]
    elif kind == 1:
        owner[one_of(TEXTS, rng)] = owner.pop(key)
    elif kind == 2:
        owner[key], owner[other] = owner[other], owner[key]
    else:
        owner[one_of([*TEXTS, key + "2", other + key], rng)] = owner[key]


def value_changed(value: Any, rng: Rng) -> Any:
    """Another value, in most cases of the same type."""
    if rng.random() < 0.06:
        return one_of([*OTHERS, *NUMBERS, *TEXTS], rng)
    if isinstance(value, bool) or value is None:
        return one_of([True, False, None, 0, 1, "true"], rng)
    if isinstance(value, int | float):
        odd = [one_of(NUMBERS, rng), str(value), [value], -value, *(value * factor for factor in FACTORS)]
        return one_of(odd, rng)
    if isinstance(value, str):
        return one_of([one_of(TEXTS, rng), value + "2", value.upper(), value * 100, [value], 5], rng)
    if isinstance(value, dict):
        return one_of([{}, list(value.values()), {**value, "x": 1}, dict.fromkeys(value)], rng)
    return _list_changed(list(value), rng)


def _list_changed(values: list[Any], rng: Rng) -> Any:
    count = len(values)
    kind, at = rng.integers(0, 11), int(rng.integers(0, count + 1))
    if kind == 0:
        return values[:at]
    if kind == 1:
        return values[::-1]
    if kind == 2:
        return values + values[:at]
    if kind == 3:
        return [values[int(i)] for i in rng.permutation(count)]
    if kind == 4:
        return values[:at] * min(1000, 200_000 // max(at, 1))
    if kind == 5:
        return values[:1] * count
    if kind == 6:
        return [values]
    if kind == 7:
        return [entry[::-1] if isinstance(entry, list) else entry for entry in values]
    if kind == 8:
        factor = one_of(FACTORS, rng)
        return json.loads(json.dumps(values), parse_float=lambda text: float(text) * factor)
    if kind == 9:
        return [*values[:at], *values[at + 1 :]]
    return [*values[:at], value_changed(values[at], rng), *values[at + 1 :]] if at < count else [*values, None]


# ---- archives -------------------------------------------------------------------------------------------------------


def columns_changed(content: bytes, rng: Rng) -> bytes:
    """An archive with other columns: bytes, headers, numbers; its check sums are correct."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as new:
        names = old.namelist()
        chosen = one_of(names, rng)
        for name in names:
            column = old.read(name)
            new.writestr(name, column_changed(column, rng) if name == chosen else column)
    return stream.getvalue()


def column_changed(column: bytes, rng: Rng) -> bytes:
    """A .npy file with other numbers, type, order or shape, or a damaged one."""
    kind = rng.integers(0, 5)
    if kind == 0:
        return bytes_changed(column, rng)
    if kind == 1:
        return header_changed(column, rng)
    array, stream = np.load(io.BytesIO(column)), io.BytesIO()
    with np.errstate(all="ignore"):
        np.save(stream, array_changed(array, rng))
    return stream.getvalue()


def array_changed(array: Any, rng: Rng) -> Any:
    """Other numbers, order, type or shape."""
    if array.dtype == np.uint8 and array.ndim == 1 and array[:1].tobytes() == b"{":
        return np.frombuffer(tree_changed(array.tobytes(), rng), np.uint8)
    changes: list[Callable[[Any], Any]] = [
        lambda a: np.asfortranarray(a),
        lambda a: a[::-1],
        lambda a: a[..., ::-1],
        lambda a: a[: len(a) // 2],
        lambda a: a[:0],
        lambda a: np.concatenate([a, a]),
        lambda a: np.swapaxes(a, 0, -1),
        lambda a: a[..., None],
        lambda a: a.astype(one_of(["<f4", "<i8", "<u1", ">f8", "<c16", "<U5", "<i4", "<f8"], rng)),
        lambda a: np.where(rng.random(a.shape) < rng.random() ** 3, one_of(NUMBERS[:12], rng), a),
        lambda a: np.where(rng.random(a.shape) < rng.random() ** 3, np.nan, a),
        lambda a: (a * one_of(FACTORS, rng)).astype(a.dtype),
        lambda a: rng.permutation(a),
    ]
    try:
        return one_of(changes, rng)(array)
    except (TypeError, ValueError, IndexError, OverflowError):  # not every change applies to text or to a single number
        return array[..., None]


def header_changed(column: bytes, rng: Rng) -> bytes:
    words = b"<f8 <i8 |O <U9 True (1000000000000,) (-1,) () (0,) (2,2) <M8[s]".split()
    old = re.findall(rb"'[<|>][a-zA-Z][0-9]*'|False|\([0-9, ]*\)", column[:120]) or [b"{"]
    chosen, word = one_of(old, rng), one_of(words, rng)
    return column.replace(chosen, word if word[:1] in b"(T" else b"'" + word + b"'", 1)


# ---- images ---------------------------------------------------------------------------------------------------------


def image_changed(content: bytes, rng: Rng) -> bytes:
    """A picture of another size, empty, of noise, or of another depth."""
    image: Any = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    size, level = one_of(SIZES, rng), int(one_of([0, 1, 128, 255], rng))
    changes: list[Callable[[Any], Any]] = [
        lambda i: cv2.resize(i, size),
        lambda i: np.full((*size[::-1], 3), level, np.uint8),
        lambda i: np.full_like(i, level),
        lambda i: rng.integers(0, 256, i.shape).astype(np.uint8),
        lambda i: np.linspace(0, 255, i.size).reshape(i.shape).astype(np.uint8),
        lambda i: np.swapaxes(i, 0, 1),
        lambda i: 255 - i,
        lambda i: i // 64,
        lambda i: i[::-1],
        lambda i: np.roll(i, 40, axis=1),
        lambda i: i.astype(np.uint16) * 257,
        lambda i: np.dstack([i.reshape(*i.shape[:2], -1)[:, :, :1]] * 4),
        lambda i: i[int(rng.integers(0, len(i))) :],
        lambda i: np.where(rng.random(i.shape) < 0.02, 255, i).astype(np.uint8),
    ]
    ok, encoded = cv2.imencode(".png", one_of(changes, rng)(image))
    return encoded.tobytes() if ok else b""


# ---- words ----------------------------------------------------------------------------------------------------------


def word_changed(word: str, rng: Rng) -> str:
    """A word of a command line, such as 4.02:0.01, a,b or 9x6x100, with a changed number or letter, or another word."""
    if word.startswith("{") and rng.random() < 0.8:
        return tree_changed(word.encode(), rng).decode()
    spans = [match.span() for match in re.finditer(r"-?[0-9]+(\.[0-9]+)?", word)]
    if spans and rng.random() < 0.6:
        first, last = one_of(spans, rng)
        number = one_of([str(one_of(NUMBERS, rng)), repr(float(word[first:last]) * one_of(FACTORS, rng))], rng)
        return word[:first] + str(number) + word[last:]
    at = int(rng.integers(0, len(word) + 1))
    letter = one_of([*".,:=x-/* \n", "é", "\udce9", "mm", "1" * 30], rng)
    if rng.random() < 0.4:
        return str(one_of([*TEXTS[:-2], "1" * 30, "9" * 5000, "1e400", "-0", "0", "{}", "[]", "?", "\udce9.json"], rng))
    return word[:at] + str(letter) + word[at + int(rng.integers(0, 2)) :]


_KINDS: tuple[tuple[tuple[str, ...], tuple[Callable[[bytes, Rng], bytes], ...]], ...] = (
    (_JSON, (tree_changed,) * 4 + (words_changed,)),
    ((".npz",), (columns_changed,)),
    ((".npy",), (column_changed,)),
    (_TEXT, (words_changed, words_changed, words_changed, lines_changed, long_number)),
    (IMAGES, (image_changed,)),
)
