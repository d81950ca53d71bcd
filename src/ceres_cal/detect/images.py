"""Image files, read and written."""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from ceres_cal.base import (
    VIDEO_ENDINGS,
    AnyArray,
    Array32,
    Image,
    InputError,
    Mask,
    median,
    quantile,
    read_bytes,
    require_room,
)
from ceres_cal.detect.headers import claimed_size

_BYTES_PER_PIXEL = 3
# Of the pixels of a colour sensor, those that see blue, green and red.
_OF_MOSAIC = np.array([0.25, 0.5, 0.25], np.float32)
_AS_SEEN = np.array([0.114, 0.587, 0.299], np.float32)  # by eyes: the light of ITU-R BT.601, in JPEG files and videos
_AROUND_PX = (301, 101, 31)  # over which what is left out is filled, ever nearer
_LEAST_PX = 16  # of either side: what is looked at around a corner or across a line is wider
_PIXELS_PER_BYTE = 8 * 1032  # the most that PNG's compression makes of a byte, at a bit each


def read_grey(path: str | Path) -> Image:
    """An image as (height, width) grey levels of its own depth, its pixels as stored (any noted rotation ignored).

    Raises:
        InputError: the file is missing or no image.
    """
    return _decoded(path, cv2.IMREAD_GRAYSCALE)


def read_light(path: str | Path) -> Array32:
    """An image as (height, width) grey levels in which each pixel of a colour sensor counts alike: see `light`.

    Raises:
        InputError: as of `read_grey`.
    """
    return light(read_colour(path))


def light(image: Image) -> Array32:
    """(height, width) grey levels of an image (height, width) or (height, width, 3) blue, green, red: their mean, green
    twice.

    A sensor sees red in every other row of pixels and blue in the others. Of a line two pixels wide, most cameras' file
    has red drawn towards the one and blue towards the other; as human eyes weigh them that leaves up to 0.13 px of a
    whole line. Weighed as the sensor's pixels are, what is white or grey stays where it is. Most JPEG files and videos
    keep the colours of two by two pixels only, and draw blue aside by that: then it is what they keep of each pixel.
    """
    if image.ndim == 2:
        return image.astype(np.float32)
    colours = image.astype(np.float32)
    seen = np.asarray(cv2.transform(colours, _AS_SEEN[None, :]), dtype=np.float32)
    every = seen if _is_colour_coarse(colours[..., 0], seen) else cv2.transform(colours, _OF_MOSAIC[None, :])
    return np.asarray(every, dtype=np.float32)


def _is_colour_coarse(blue: Array32, seen: Array32) -> bool:
    """Whether the colours (blue beside what eyes see) of an image lack the detail that its light has."""
    kernel, coarse = np.array([1.0, -2.0, 1.0], np.float32), 0.2  # 0.03 to 0.13 of JPEG files, else 0.34 and more
    every = 4  # rows of which one is asked
    fine, colour = (np.abs(cv2.sepFilter2D(one, -1, kernel, kernel)[::every]) for one in (seen, blue - seen))
    clear = fine >= quantile(fine.ravel(), 0.99)
    return bool(np.mean(colour[clear]) < coarse * np.mean(fine[clear]))


def read_colour(path: str | Path) -> Image:
    """An image as (height, width) grey levels or (height, width, 3) blue, green and red; otherwise as `read_grey`."""
    return _decoded(path, cv2.IMREAD_ANYCOLOR)


def _decoded(path: str | Path, channels: int) -> Image:
    if Path(path).suffix.lower() in VIDEO_ENDINGS:
        raise InputError(f"{path}: not an image but a video: give frames of it, as PNG")
    content = read_bytes(path)
    flags = channels | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = None
    with suppress(cv2.error, struct.error):  # reads: "not an image that OpenCV can read (cut short?) ..."
        if size := claimed_size(content):
            _require_believable(size, len(content), str(path))
            packed = np.frombuffer(content, np.uint8)
            image = cv2.imdecode(packed, flags)
            if image is None or image.dtype.itemsize > 2:  # of which OpenCV makes no grey
                image = _in_levels(cv2.imdecode(packed, flags | cv2.IMREAD_ANYCOLOR), channels, str(path))
    if image is None:
        raise InputError(f"{path}: {_not_an_image(content)}")
    return image


def _not_an_image(content: bytes) -> str:
    """What is wrong with a file that is no image, and what to do."""
    if not content:
        return "not an image but an empty file: leave it out"
    with suppress(UnicodeDecodeError):  # reads: "not an image that OpenCV can read ..."
        if "\0" not in content.decode():
            return "not an image but text: give photographs (files of observations end in .json or .npz)"
    return "not an image that OpenCV can read (cut short?): convert it to PNG or leave it out"


def _in_levels(image: AnyArray | None, channels: int, path: str) -> Image | None:
    """A picture of floats, or of long numbers, as levels from 0 to 255, in grey where asked."""
    if image is None:
        return None
    if not np.isfinite(image).all():
        raise InputError(f"{path}: some of its pixels are no finite numbers: convert it to PNG")
    levels = image.astype(np.float32) * np.float32(255.0 / max(float(np.max(image)), 1e-9))
    return cv2.cvtColor(levels, cv2.COLOR_BGR2GRAY) if levels.ndim == 3 and channels == cv2.IMREAD_GRAYSCALE else levels


def _require_believable(size: tuple[int, int], length: int, path: str) -> None:
    """Raise InputError where a header claims more pixels than there is room for, or than its file can hold, or too few
    for anything to be seen in them.
    """
    if min(size) < _LEAST_PX:
        raise InputError(
            f"{path}: {size[0]} x {size[1]} px is no photograph: at least {_LEAST_PX} px are needed each way"
        )
    pixels = size[0] * size[1]
    require_room(_BYTES_PER_PIXEL * pixels, f"{path}: an image of {size[0]} x {size[1]} px")
    if pixels > _PIXELS_PER_BYTE * length:
        raise InputError(f"{path}: {size[0]} x {size[1]} px, as it says, do not fit into {length} bytes: leave it out")


def filled(grey: Array32, left_out: Mask) -> Array32:
    """A photograph (height, width) whose pixels under a mask are as light as what is around them, without a line."""
    shown, plane = (~left_out).astype(np.float32), grey.copy()
    plane[left_out] = median(grey[~left_out]) if not left_out.all() else 0.0
    for size in _AROUND_PX:
        weight = np.asarray(cv2.blur(shown, (size, size)))
        light = np.asarray(cv2.blur(grey * shown, (size, size)))
        near = left_out & (weight > 1e-3)
        plane[near] = light[near] / weight[near]
    return plane


def negative(grey: Array32) -> Array32:
    """The negative of a photograph: lines that are darker than the floor are lighter in it."""
    return np.asarray(np.max(grey) - grey, dtype=np.float32)


def encoded(image: Image, ending: str, jpeg_quality: int) -> bytes:
    """The content of an image file: ".png" as it is, ".jpg" in so much quality, 1 to 100.

    Raises:
        InputError: OpenCV cannot write such an image.
    """
    done, content = cv2.imencode(ending, image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if ending == ".jpg" else [])
    if not done:
        raise InputError(f"a picture of {image.shape[1]} x {image.shape[0]} px cannot be written as {ending}")
    return bytes(content)
