"""`--frames`: photographs out of videos of boards."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

from ceres_cal.base.errors import InputError
from ceres_cal.cli.progress import ProgressBar


def add_frames(parser: ArgumentParser) -> None:
    """The option --frames N."""
    parser.add_argument(
        "--frames",
        type=int,
        default=30,
        metavar="N",
        help="how many photographs to take out of a video, the sharpest of as many stretches; default: 30",
    )


def frames_of_videos(args: Namespace, videos: Sequence[Path], folder: Path, bar: ProgressBar) -> list[Path]:
    """The sharpest frames of videos, each written into a folder of its name.

    Raises:
        InputError: what cannot be read, or --frames below 1.
    """
    if args.frames < 1:
        raise InputError(f"--frames must be at least 1, not {args.frames}")
    if not videos:
        return []
    from ceres_cal.detect.video import sharpest_frames

    return [path for one in videos for path in sharpest_frames(one, folder / one.stem, args.frames, bar.update)]
