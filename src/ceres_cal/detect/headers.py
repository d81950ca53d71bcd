"""Sizes and orientations of images as file headers state them; sizes are read before a decoder allocates memory."""

from __future__ import annotations

import re
import struct

_COMMENT = rb"(?:\s+|#[^\n]*\n)+"
_PNM = re.compile(rb"P[1-6]" + _COMMENT + rb"(\d{1,9})" + _COMMENT + rb"(\d{1,9})")
_JPEG_SIZES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers of frame headers; the excluded ones are tables
_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}  # byte order of a TIFF, by its first bytes
# Number of the tag, and the clockwise turn, in degrees, by which viewers show each of its values.
_ORIENTATION, _TURNED_DEG = 274, {3: 180, 6: 90, 8: 270}
_EXIF = b"Exif\0\0"  # precedes the TIFF that holds a JPEG's metadata


def claimed_size(content: bytes) -> tuple[int, int] | None:
    """(width, height) of a PNG, JPEG, BMP, TIFF, WebP, JPEG 2000 or PNM file; None where it is none of them.

    Raises:
        struct.error: its header is cut short.
    """
    if content.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png(content)
    if content.startswith(b"BM"):
        width, height = _unpack("<HH" if content[14:15] == b"\x0c" else "<ii", content, 18)
        return width, abs(height)  # negative for rows stored from the top down
    if content.startswith(b"\xff\xd8\xff"):
        return _jpeg(content)
    if order := _ORDERS.get(content[:4]):
        width, height = _tags(content, order, 256, 257)
        return width, height
    if content.startswith(b"RIFF") and content[8:12] == b"WEBP":
        return _webp(content)
    if content.startswith(b"\xff\x4f\xff\x51"):
        return _jpeg_2000(content, 8)
    if content[4:8] == b"jP  " and (start := content.find(b"\xff\x4f\xff\x51", 0, 100_000)) > 0:
        return _jpeg_2000(content, start + 8)
    match = _PNM.match(content[:10_000])
    return (int(match[1]), int(match[2])) if match else None


def count_pages(content: bytes) -> int:
    """Return the number of pictures in a TIFF that are as large as its first one (smaller ones are previews of it), and
    1 for other files.

    Raises:
        struct.error: it is cut short.
    """
    order, pages = _ORDERS.get(content[:4], ""), dict[int, list[int]]()
    at = struct.unpack_from(order + "I", content, 4)[0] if order else 0
    while at and at not in pages:
        pages[at] = _tags(content, order, 256, 257, at=at)
        (count,) = struct.unpack_from(order + "H", content, at)
        (at,) = struct.unpack_from(order + "I", content, at + 2 + 12 * count)
    sizes = [*pages.values()]
    return sizes.count(sizes[0]) if sizes else 1


def viewers_turn_deg(content: bytes) -> int:
    """Return the clockwise turn with which a JPEG or TIFF tells viewers to show it: 0, 90, 180 or 270 degrees."""
    notes = content.partition(_EXIF)[2] if content.startswith(b"\xff\xd8\xff") else content
    try:
        order = _ORDERS.get(notes[:4])
        return _TURNED_DEG.get(_tags(notes, order, _ORIENTATION)[0], 0) if order else 0
    except struct.error:  # quiet: notes that are cut short turn nothing
        return 0


def _unpack(form: str, content: bytes, at: int) -> tuple[int, int]:
    first, second = struct.unpack_from(form, content, at)
    return first, second


def _png(content: bytes) -> tuple[int, int] | None:
    """Size from the header; None where a chunk claims more than the file has, for which the decoder would allocate
    memory.
    """
    at = 8
    while at + 8 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        at += 12 + length
        if at > len(content):
            return None
    return _unpack(">II", content, 16)


def _jpeg(content: bytes) -> tuple[int, int] | None:
    at = 2
    while True:
        mark, code, length = struct.unpack_from(">BBH", content, at)
        if mark != 0xFF:
            return None
        if code in _JPEG_SIZES:
            height, width = _unpack(">HH", content, at + 5)
            return width, height
        at += 1 if code == 0xFF else 2 + length  # a header may begin with several bytes 0xFF


def _tags(content: bytes, order: str, *wanted: int, at: int = 0) -> list[int]:
    """Return the values of some tags of a TIFF's first page, or of the one whose table begins `at`; the largest where a
    tag occurs twice, 0 where it does not occur.
    """
    values = dict.fromkeys(wanted, 0)
    start = at or struct.unpack_from(order + "I", content, 4)[0]
    (count,) = struct.unpack_from(order + "H", content, start)
    for number in range(count):
        tag, kind = struct.unpack_from(order + "HH", content, start + 2 + 12 * number)
        if tag in values:
            (value,) = struct.unpack_from(order + ("H" if kind == 3 else "I"), content, start + 10 + 12 * number)
            values[tag] = max(values[tag], value)
    return list(values.values())


def _webp(content: bytes) -> tuple[int, int] | None:
    kind = content[12:16]
    if kind == b"VP8X":
        return int.from_bytes(content[24:27], "little") + 1, int.from_bytes(content[27:30], "little") + 1
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", content, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    width, height = _unpack("<HH", content, 26)
    return width & 0x3FFF, height & 0x3FFF


def _jpeg_2000(content: bytes, at: int) -> tuple[int, int]:
    right, bottom, left, top = struct.unpack_from(">4I", content, at)
    return right - left, bottom - top
