"""Photographs out of image files, and pictures as bytes of them."""

from __future__ import annotations

from pathlib import Path

import cv2

from ceres_cal.base.arrays import Image
from ceres_cal.base.errors import InputError
from ceres_cal.detect.images import encoded, read_colour
from ceres_cal.report.pictures.overlay import in_8_bit_colour

_QUALITIES = (90, 80, 70, 55, 40, 25)


def read_photograph(path: Path, image_size: tuple[int, int], camera: str) -> Image:
    """A camera's photograph as (height, width) or (height, width, 3), pixels as stored.

    Raises:
        InputError: no image, or of another size than the camera's.
    """
    image = read_colour(path)
    size = (image.shape[1], image.shape[0])
    if size != image_size:
        raise InputError(
            f"{path}: {size[0]} x {size[1]} px, but camera {camera!r} has {image_size[0]} x {image_size[1]}: "
            "give photographs of the size that was calibrated"
        )
    return image


def jpeg_of_at_most(picture: Image, widest_px: int, most_bytes: int) -> bytes:
    """A JPEG no wider than that, as good as the bytes allow."""
    width, height = picture.shape[1], picture.shape[0]
    if width > widest_px:
        size = (widest_px, max(1, round(height * widest_px / width)))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    for quality in _QUALITIES:
        content = encoded(in_8_bit_colour(picture), ".jpg", quality)
        if len(content) <= most_bytes:
            break
    return content
