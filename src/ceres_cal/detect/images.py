"""Image files, read and written."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ceres_cal.base.arrays import Image
from ceres_cal.base.errors import InputError
from ceres_cal.base.files import read_bytes


def read_grey(path: str | Path) -> Image:
    """An image as (height, width) grey levels of its own depth, its pixels as stored (any noted rotation ignored).

    Raises:
        InputError: the file is missing or no image.
    """
    return _decoded(path, cv2.IMREAD_GRAYSCALE)


def read_colour(path: str | Path) -> Image:
    """An image as (height, width) grey levels or (height, width, 3) blue, green and red; otherwise as `read_grey`."""
    return _decoded(path, cv2.IMREAD_ANYCOLOR)


def _decoded(path: str | Path, channels: int) -> Image:
    content = np.frombuffer(read_bytes(path), np.uint8)
    flags = channels | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(content, flags) if content.size else None
    if image is None:
        raise InputError(f"{path}: not an image that OpenCV can read (cut short?): convert it to PNG or leave it out")
    return image


def encoded(image: Image, ending: str, jpeg_quality: int) -> bytes:
    """The content of an image file: ".png" as it is, ".jpg" in so much quality, 1 to 100.

    Raises:
        InputError: OpenCV cannot write such an image.
    """
    done, content = cv2.imencode(ending, image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if ending == ".jpg" else [])
    if not done:
        raise InputError(f"a picture of {image.shape[1]} x {image.shape[0]} px cannot be written as {ending}")
    return bytes(content)
