"""Image files as users name them: single files, folders, patterns and videos."""

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
    """Return the named files; those of folders and patterns are sorted by name.

    Raises:
        InputError: there is no such file, no image in a folder, or nothing at all.
    """
    each = [given] if isinstance(given, str | PathLike) or not isinstance(given, Iterable) else list(given)
    for one in each:
        if not isinstance(one, str | PathLike):
            raise InputError(
                f"photographs must be file names, not {type(one).__name__}; `Observations.from_points` takes pixels"
            )
    if not each:
        raise InputError("no photograph is given: name files, folders, or videos")
    return [path for name in each for path in _files(str(name))]


def _files(name: str) -> Iterable[Path]:
    path = Path(name)
    if path.is_dir():
        inside = _inside(path)
        if not inside:
            folders = ", ".join(folder.name for folder in each_camera([name]))
            raise InputError(
                f"{name}: this folder contains no images{f'; there are some in {folders}' if folders else ''}"
            )
        return inside
    if path.exists():
        return [path]
    matches = sorted(glob.glob(name))  # noqa: PTH207, Path.glob refuses absolute patterns
    if not matches:
        raise InputError(f"{name}: no such file")
    return map(Path, matches)


def _inside(folder: Path) -> list[Path]:
    """The images of a folder, or its videos where there are no images; hidden files, as Macs add, are no images."""
    files = sorted(file for file in folder.iterdir() if file.is_file() and not file.name.startswith("."))
    images, videos = ([f for f in files if f.suffix.lower() in endings] for endings in (IMAGE_ENDINGS, VIDEO_ENDINGS))
    return images or videos


def each_camera(given: Sequence[str]) -> list[Path]:
    """Return the folder or video of each camera: several that are given, or those in a single given folder that has no
    images itself; empty if all files are of one camera.
    """
    shown = [Path(name) for name in given]
    if len(shown) > 1:
        apart = all(path.is_dir() or path.suffix.lower() in VIDEO_ENDINGS for path in shown)
        return shown if apart else []
    alone = [path for path in shown if path.is_dir()]
    files = [path for folder in alone for path in _inside(folder)]
    if any(path.suffix.lower() in IMAGE_ENDINGS for path in files):
        return []
    folders = [path for folder in alone for path in folder.iterdir() if path.is_dir() and _inside(path)]
    return sorted([*folders, *files]) if folders or len(files) > 1 else []


def images_and_videos(given: Images) -> tuple[list[Path], list[Path]]:
    """Return the images that `image_files` finds, and the videos separately."""
    files = image_files(given)
    videos = [path for path in files if path.suffix.lower() in VIDEO_ENDINGS]
    return [path for path in files if path not in videos], videos
