"""What commands read: images, calibrations, observations; all of it checked before any long work."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.observations import Observations
    from ceres_cal.scene.targets import Target

IMAGE_ENDINGS = {".bmp", ".jp2", ".jpeg", ".jpg", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"}


VIDEO_ENDINGS = {".3gp", ".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".ogv", ".webm", ".wmv"}


def images_and_videos(given: Iterable[str]) -> tuple[list[Path], list[Path]]:
    """The images as `image_files` has them, and the videos among what is given."""
    files = image_files(given)
    videos = [path for path in files if path.suffix.lower() in VIDEO_ENDINGS]
    return [path for path in files if path not in videos], videos


def image_files(given: Iterable[str]) -> list[Path]:
    """The files named; those of folders, and of patterns that no shell expanded, in the order of their names."""
    return [path for name in given for path in _files(name)]


def _files(name: str) -> Iterator[Path]:
    path = Path(name)
    if path.is_dir():
        inside = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGE_ENDINGS and file.is_file())
        if not inside:
            raise InputError(f"{name}: there are no images in this folder")
        yield from inside
    elif path.exists():
        yield path
    else:
        matches = sorted(glob.glob(name))  # noqa: PTH207, Path.glob refuses absolute patterns
        if not matches:
            raise InputError(f"{name}: no such file")
        yield from map(Path, matches)


def spelled_target(text: str, where: str) -> Target | None:
    """The target that somebody spelled out as `{"kind": ...}`; None for anything else, such as a name or a file."""
    if not text.lstrip().startswith("{"):
        return None
    from ceres_cal.base.files import parse_json
    from ceres_cal.scene.targets import target_from_spec

    return target_from_spec(parse_json(text.encode(), where), where)


def read_target(text: str, name: str) -> Target:
    """The target of `--target`: by its name, spelled out, or in a file, alone or as one of that name among several."""
    from ceres_cal.scene.targets import target_from_spec, targets_by_name

    if (spelled := spelled_target(text, "--target")) is not None:
        return spelled
    by_name = targets_by_name()
    if text in by_name:
        return by_name[text]
    if not Path(text).exists():
        raise InputError(f"--target {text!r}: neither {' nor '.join(by_name)}, nor a file")
    content = json_object(Path(text))
    named = content.get("targets")
    spec = named.get(name) if isinstance(named, dict) else content
    if not isinstance(spec, dict):
        raise InputError(f"{text}: it holds no target named {name!r}")
    return target_from_spec(spec, text)


def json_object(path: Path) -> Mapping[str, Any]:
    """What a file holds; InputError where it is no JSON object."""
    from ceres_cal.base.files import parse_json, read_bytes

    content = parse_json(read_bytes(path), str(path))
    if not isinstance(content, dict):
        raise InputError(f"{path}: it must hold one JSON object")
    return content


def require_different(files: Iterable[str | Path]) -> None:
    """A file that counts twice would make its observations look better than they are."""
    given: set[str] = set()
    for file in files:
        place = os.path.realpath(file)
        if place in given:
            raise InputError(f"{file}: given twice: name every file once")
        given.add(place)


def read_calibration(path: Path) -> Calibration:
    """The calibration of a file."""
    from ceres_cal.calibration import Calibration

    return Calibration.load(path)


def read_observations(paths: Iterable[str]) -> Observations:
    """All files of observations as one."""
    from ceres_cal.observations import Observations, combine

    return combine([Observations.load(path) for path in paths])


def station_of(path: Path, station: str | None, calibration: Calibration) -> str:
    """Name of the station in --station, or of the only one there is in a calibration out of a file."""
    if station is None and len(calibration.stations) > 1:
        raise InputError(f"{path} has several stations, name one: --station {' or '.join(calibration.stations)}")
    calibration.station(station)  # or says which there are
    return station or next(iter(calibration.stations))
