"""Image files as people name them: single ones, folders, patterns and videos."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path

from ceres_cal.base.errors import InputError

Images = str | PathLike[str] | Sequence[str | PathLike[str]]
"""A photograph, a folder, a pattern such as "board_*.png", a video, or several of them."""
IMAGE_ENDINGS = {".bmp", ".jp2", ".jpeg", ".jpg", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"}
VIDEO_ENDINGS = {".3gp", ".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".ogv", ".webm", ".wmv"}


def image_files(given: Images) -> list[Path]:
    """The files that are named; those of folders, and of patterns, in the order of their names.

    Raises:
        InputError: there is no such file, no image in a folder, or nothing at all.
    """
    each = [given] if isinstance(given, str | PathLike) else given
    if not each:
        raise InputError("no photograph is given: name files, folders, or videos")
    return [path for name in each for path in _files(str(name))]


def _files(name: str) -> Iterable[Path]:
    path = Path(name)
    if path.is_dir():
        inside = _inside(path)
        if not inside:
            folders = ", ".join(folder.name for folder in folders_of_cameras([name]))
            raise InputError(
                f"{name}: there are no images in this folder{f', but in its {folders}' if folders else ''}"
            )
        return inside
    if path.exists():
        return [path]
    matches = sorted(glob.glob(name))  # noqa: PTH207, Path.glob refuses absolute patterns
    if not matches:
        raise InputError(f"{name}: no such file")
    return map(Path, matches)


def _inside(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in IMAGE_ENDINGS and file.is_file())


def folders_of_cameras(given: Sequence[str]) -> list[Path]:
    """The folders with images of the one folder that is given, where it has none itself: one for each camera."""
    alone = [Path(name) for name in given if len(given) == 1]
    inside = (folder for path in alone if path.is_dir() and not _inside(path) for folder in path.iterdir())
    return sorted(folder for folder in inside if folder.is_dir() and _inside(folder))


def images_and_videos(given: Images) -> tuple[list[Path], list[Path]]:
    """The images as `image_files` has them, and the videos among what is given."""
    files = image_files(given)
    videos = [path for path in files if path.suffix.lower() in VIDEO_ENDINGS]
    return [path for path in files if path not in videos], videos
