"""`--frames`: photographs out of videos of boards."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ceres_cal.base.errors import InputError
from ceres_cal.cli.progress import ProgressBar


def frames_of_videos(videos: Sequence[Path], count: int, folder: Path, bar: ProgressBar) -> list[Path]:
    """The sharpest frames of videos, each written into a folder of its name.

    Args:
        count: of each, --frames.

    Raises:
        InputError: what cannot be read, or --frames below 1.
    """
    if count < 1:
        raise InputError(f"--frames must be at least 1, not {count}")
    if not videos:
        return []
    from ceres_cal.detect.video import sharpest_frames

    return [path for one in videos for path in sharpest_frames(one, folder / one.stem, count, bar.update)]
