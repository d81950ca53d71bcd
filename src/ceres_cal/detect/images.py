"""Reading and writing of image files."""

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
from ceres_cal.detect.headers import claimed_size, count_pages

_BYTES_PER_PIXEL = 3
# Shares of a colour sensor's pixels that see blue, green and red.
_OF_MOSAIC = np.array([0.25, 0.5, 0.25], np.float32)
# Weights of human vision: luma of ITU-R BT.601, in JPEG files and videos.
_AS_SEEN = np.array([0.114, 0.587, 0.299], np.float32)
_AROUND_PX = (301, 101, 31)  # widths of the windows over which masked pixels are filled, ever nearer
_LEAST_PX = 16  # least width and height: the windows around a corner or across a line are wider
_PIXELS_PER_BYTE = 8 * 1032  # the most that PNG's compression makes of a byte, at one bit a pixel


def read_grey(path: str | Path) -> Image:
    """Read an image as (height, width) grey levels of its own depth, with pixels as stored (any noted rotation is
    ignored).

    Raises:
        InputError: the file is missing or no image.
    """
    return _decoded(path, cv2.IMREAD_GRAYSCALE)


def read_light(path: str | Path) -> Array32:
    """Read an image as (height, width) grey levels, 0 to 255 whatever its depth, in which all pixels of a colour sensor
    have equal weight: see `light`. Files of 16 bits may hold the 8, 10 or 12 bits of a sensor; a picture in which all
    16 are used is brighter.

    Raises:
        InputError: see `read_grey`.
    """
    picture, depths = read_colour(path), (8, 10, 12, 16)
    levels = next(2**bits for bits in depths if np.max(picture) < 2**bits)  # floats end at 255, but for rounding
    return light(picture) * np.float32(255.0 / (levels - 1))


def light(image: Image) -> Array32:
    """Return (height, width) grey levels of an image (height, width) or (height, width, 3) blue, green, red: the mean
    of the colours, with green counted twice.

    A sensor sees red in every other row of pixels and blue in the others. In most cameras' files, red of a line two
    pixels wide is displaced towards one row and blue towards the other; with the weights of human vision the whole line
    is up to 0.13 px off. With the weights of the sensor's pixels, a white or grey line is not displaced. Most JPEG
    files and videos keep the colours of two by two pixels only, which displaces blue; for these the luma that they keep
    for each pixel is used.
    """
    if image.ndim == 2:
        return image.astype(np.float32)
    colours = image.astype(np.float32)
    seen = np.asarray(cv2.transform(colours, _AS_SEEN[None, :]), dtype=np.float32)
    every = seen if _is_colour_coarse(colours[..., 0], seen) else cv2.transform(colours, _OF_MOSAIC[None, :])
    return np.asarray(every, dtype=np.float32)


def _is_colour_coarse(blue: Array32, seen: Array32) -> bool:
    """Whether the colours of an image (blue minus luma) lack the detail that its luma has."""
    # Limit of the ratio of colour detail to luma detail: 0.03 to 0.13 for JPEG files, 0.34 or more otherwise.
    kernel, coarse = np.array([1.0, -2.0, 1.0], np.float32), 0.2
    every = 4  # one row of so many is examined
    fine, colour = (np.abs(cv2.sepFilter2D(one, -1, kernel, kernel)[::every]) for one in (seen, blue - seen))
    clear = fine >= quantile(fine.ravel(), 0.99)
    return bool(np.mean(colour[clear]) < coarse * np.mean(fine[clear]))


def read_colour(path: str | Path) -> Image:
    """Read an image as (height, width) grey levels or (height, width, 3) blue, green, red; otherwise as `read_grey`."""
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
            if (pages := count_pages(content)) > 1:
                raise InputError(f"{path}: a TIFF of {pages} pages, of which one can be read: save each page as a file")
            packed = np.frombuffer(content, np.uint8)
            image = cv2.imdecode(packed, flags)
            if image is None or image.dtype.itemsize > 2:  # OpenCV does not convert these to grey
                image = _in_levels(cv2.imdecode(packed, flags | cv2.IMREAD_ANYCOLOR), channels, str(path))
    if image is None:
        raise InputError(f"{path}: {_not_an_image(content)}")
    return image


def _not_an_image(content: bytes) -> str:
    """Return what is wrong with a file that is no image, and what to do."""
    if not content:
        return "not an image but an empty file: leave it out"
    with suppress(UnicodeDecodeError):  # reads: "not an image that OpenCV can read ..."
        if "\0" not in content.decode():
            return "not an image but text: give photographs (files of observations end in .json or .npz)"
    return "not an image that OpenCV can read (cut short?): convert it to PNG or leave it out"


def _in_levels(image: AnyArray | None, channels: int, path: str) -> Image | None:
    """Scale a picture of floats, or of long integers, to levels from 0 to 255, in grey where `channels` asks for it."""
    if image is None:
        return None
    if not np.isfinite(image).all():
        raise InputError(f"{path}: some of its pixels are not finite: convert it to PNG")
    levels = image.astype(np.float32) * np.float32(255.0 / max(float(np.max(image)), 1e-9))
    return cv2.cvtColor(levels, cv2.COLOR_BGR2GRAY) if levels.ndim == 3 and channels == cv2.IMREAD_GRAYSCALE else levels


def _require_believable(size: tuple[int, int], length: int, path: str) -> None:
    """Raise InputError where a header claims more pixels than there is memory for or than its file can hold, or too few
    to show anything.
    """
    if min(size) < _LEAST_PX:
        raise InputError(f"{path}: {size[0]} x {size[1]} px is too small: at least {_LEAST_PX} px are needed each way")
    pixels = size[0] * size[1]
    require_room(_BYTES_PER_PIXEL * pixels, f"{path}: an image of {size[0]} x {size[1]} px")
    if pixels > _PIXELS_PER_BYTE * length:
        raise InputError(f"{path}: {size[0]} x {size[1]} px cannot be stored in its {length} bytes: leave it out")


def filled(grey: Array32, left_out: Mask) -> Array32:
    """Fill the masked pixels of a photograph (height, width) with the light around them, so that they show no line."""
    shown, plane = (~left_out).astype(np.float32), grey.copy()
    plane[left_out] = median(grey[~left_out]) if not left_out.all() else 0.0
    for size in _AROUND_PX:
        weight = np.asarray(cv2.blur(shown, (size, size)))
        light = np.asarray(cv2.blur(grey * shown, (size, size)))
        near = left_out & (weight > 1e-3)
        plane[near] = light[near] / weight[near]
    return plane


def negative(grey: Array32) -> Array32:
    """Return the negative of a photograph, in which lines darker than the floor become lighter than it."""
    return np.asarray(np.max(grey) - grey, dtype=np.float32)


def encoded(image: Image, ending: str, jpeg_quality: int) -> bytes:
    """Encode an image as the content of a file: ".png" without loss, ".jpg" with the given quality, 1 to 100.

    Raises:
        InputError: OpenCV cannot write such an image.
    """
    done, content = cv2.imencode(ending, image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if ending == ".jpg" else [])
    if not done:
        raise InputError(f"a picture of {image.shape[1]} x {image.shape[0]} px cannot be written as {ending}")
    return bytes(content)
