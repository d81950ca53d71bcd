"""Photographs out of a video: the sharpest frame of each stretch of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from ceres_cal.base.arrays import Image
from ceres_cal.base.errors import InputError
from ceres_cal.base.files import make_folder, require_room, write_bytes
from ceres_cal.base.progress import ImageProgress
from ceres_cal.detect.images import encoded

_LOOKED_AT = 10  # frames of each stretch: a hand that holds a board comes to rest in between


def sharpest_frames(video: Path, folder: Path, count: int, progress: ImageProgress | None = None) -> list[Path]:
    """Write the sharpest frames of `count` even stretches of a video into a folder, as PNG; their paths.

    How sharp a frame is, is told by the variance of its Laplacian.

    Raises:
        InputError: OpenCV cannot read it as a video.
    """
    capture = cv2.VideoCapture(str(video)) if video.is_file() else None
    total = 0 if capture is None else int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    if capture is None or total <= 0:
        raise InputError(f"{video}: not a video that OpenCV can read: give photographs, or convert it to MP4")
    width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
    require_room(int(6 * width * height), f"{video}: frames of {width:.0f} x {height:.0f} px")
    stretches = min(count, total)
    best: dict[int, tuple[float, Path]] = {}
    make_folder(folder)
    for number, frame in _frames(capture, total, max(1, total // (stretches * _LOOKED_AT))):
        stretch = number * stretches // total
        sharpness = float(np.var(cv2.Laplacian(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), cv2.CV_32F)))
        path = folder / f"{stretch + 1:04d}.png"
        if stretch not in best or sharpness > best[stretch][0]:
            best[stretch] = (sharpness, path)
            write_bytes(path, encoded(frame, ".png", 100))
        if progress is not None:
            progress(number + 1, total, video.name)
    if not best:
        raise InputError(f"{video}: none of its {total} frames can be read: convert it to MP4")
    return [path for _, path in best.values()]


def _frames(capture: cv2.VideoCapture, total: int, step: int) -> Iterator[tuple[int, Image]]:
    """Every so many-th frame with its number; the rest is passed over without decoding it."""
    for number in range(total):
        if not capture.grab():
            return
        if number % step == 0:
            read, frame = capture.retrieve()
            if read:
                yield number, np.asarray(frame)
