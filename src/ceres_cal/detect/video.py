"""Photographs from a video: frames spread over it, or the sharpest frame of each stretch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np

from ceres_cal.base import (
    VIDEO_ENDINGS,
    Frozen,
    Image,
    ImageProgress,
    InputError,
    make_folder,
    read_bytes,
    require_room,
    write_bytes,
)
from ceres_cal.detect.headers import viewers_turn_deg
from ceres_cal.detect.images import encoded

MOST_FRAMES = 200_000
"""Largest number of frames of a video, an hour and a half: each has to be passed over."""


class Video(Frozen):
    """A video that OpenCV can read, and its number of frames, as stated in the file or else counted."""

    path: Path
    capture: cv2.VideoCapture
    total: int

    def frames(self, step: int, progress: ImageProgress | None = None) -> Iterator[tuple[int, Image]]:
        """Yield every `step`-th frame with its number, all of one size; the others are passed over without decoding.
        Progress is reported when the next one is asked for.

        Raises:
            InputError: none can be read.
        """
        shape: tuple[int, ...] | None = None
        for number in range(self.total):
            if not self.capture.grab():
                break
            if number % step == 0:
                read, frame = self.capture.retrieve()
                if read and frame.shape == (shape or frame.shape):
                    shape = frame.shape
                    yield number, np.asarray(frame)
                    if progress is not None:
                        progress(number + 1, self.total, self.path.name)
        if shape is None:
            raise InputError(f"{self.path}: none of its {self.total} frames can be read: convert it to MP4")


def open_video(path: Path) -> Video:
    """Open a video for reading.

    Raises:
        InputError: OpenCV cannot read it as a video; or it has more than MOST_FRAMES, or frames that are too large.
    """
    capture = _opened(path)
    width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
    require_room(int(6 * width * height), f"{path}: frames of {width:.0f} x {height:.0f} px")
    total = int(min(max(capture.get(cv2.CAP_PROP_FRAME_COUNT), 0.0), 1e9))
    if not total:  # some formats do not state it
        while total <= MOST_FRAMES and capture.grab():
            total += 1
        capture = _opened(path)
    if not total:
        raise _not_a_video(path)
    if total > MOST_FRAMES:
        raise InputError(f"{path}: more than {MOST_FRAMES} frames: cut out the part that shows what is to be detected")
    return Video(path, capture, total)


def _opened(path: Path) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(path)) if path.is_file() else None
    if capture is None or not capture.isOpened():
        raise _not_a_video(path)
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0.0)  # pixels as the sensor stored them, as for photographs
    return capture


def _not_a_video(path: Path) -> InputError:
    return InputError(f"{path}: not a video that OpenCV can read: give photographs, or convert it to MP4")


def spread_frames(video: Path, count: int, progress: ImageProgress | None = None) -> Iterator[tuple[str, Image]]:
    """Yield at most `count` frames, evenly spread over a video, with their names for messages.

    Raises:
        InputError: see `open_video` and `Video.frames`.
    """
    opened = open_video(video)
    for number, frame in opened.frames(-(-opened.total // count), progress):
        yield f"frame {number} of {video.name}", frame


def sharpest_frames(video: Path, folder: Path, count: int, progress: ImageProgress | None = None) -> list[Path]:
    """Write the sharpest frame of each of `count` equal stretches of a video into a folder, as PNG; return their paths.

    Raises:
        InputError: see `open_video` and `Video.frames`.
    """
    sampled = 10  # frames examined in each stretch: a hand that holds a board stops in between
    opened = open_video(video)
    stretches = min(count, opened.total)
    written: list[Path] = []
    frames = opened.frames(max(1, opened.total // (stretches * sampled)), progress)
    for _, stretch in groupby(frames, key=lambda one: one[0] * stretches // opened.total):
        _, sharpest = max(stretch, key=lambda one: _sharpness(one[1]))
        written.append(make_folder(folder) / f"{len(written) + 1:04d}.png")
        write_bytes(written[-1], encoded(sharpest, ".png", 100))
    return written


def _sharpness(frame: Image) -> float:
    """Variance of the Laplacian in the frame reduced to at most half a megapixel: smaller blur does not matter."""
    judged_px = 5e5
    scale = min(1.0, float(np.sqrt(judged_px / (frame.shape[0] * frame.shape[1]))))
    small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(np.var(cv2.Laplacian(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), cv2.CV_32F)))


def frames_of_videos(
    videos: Sequence[Path], count: int, folder: Path, progress: ImageProgress | None = None
) -> list[Path]:
    """Write the sharpest frames of each video into a folder of its own (see `folder_of_frames`); return their paths.

    Raises:
        InputError: a video cannot be read, two would have one folder, or count is below 1.
    """
    if count < 1:
        raise InputError(f"--frames must be at least 1, not {count}")
    folders = [folder_of_frames(one, folder) for one in videos]
    for number, one in enumerate(videos):
        if folders[number] in folders[:number]:
            raise InputError(f"{one}: another video is called {one.stem!r}, too: rename one")
    each = zip(videos, folders, strict=True)
    return [path for one, own in each for path in sharpest_frames(one, own, count, progress)]


def turned_words(path: Path) -> str:
    """Return a remark on a photograph or video whose file tells viewers to turn it; "" for any other.

    Pixels are used as the sensor stored them, however the camera was held: intrinsics belong to these.
    """
    is_video = path.suffix.lower() in VIDEO_ENDINGS
    degrees = _opened(path).get(cv2.CAP_PROP_ORIENTATION_META) if is_video else viewers_turn_deg(read_bytes(path))
    return f"its file tells viewers to turn it by {degrees:.0f} degrees, but it is used as stored" if degrees else ""


def folder_of_frames(video: Path, folder: Path) -> Path:
    """Return the folder for frames taken from a video; a folder of photographs may already have the video's name."""
    return folder / f"{video.stem}_frames"
