"""Pictures as bytes of image files."""

from __future__ import annotations

import cv2

from ceres_cal.errors import InputError
from ceres_cal.pictures.overlay import in_8_bit_colour
from ceres_cal.pictures.warp import Image


def encoded(picture: Image, ending: str, jpeg_quality: int) -> bytes:
    """The content of an image file: ".png" as it is, ".jpg" in 8 bit.

    Raises:
        InputError: OpenCV cannot write such a picture.
    """
    plain = in_8_bit_colour(picture) if ending == ".jpg" else picture
    done, content = cv2.imencode(ending, plain, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if ending == ".jpg" else [])
    if not done:
        raise InputError(f"a picture of {picture.shape[1]} x {picture.shape[0]} px cannot be written as {ending}")
    return bytes(content)
