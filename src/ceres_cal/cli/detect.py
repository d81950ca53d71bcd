"""`ceres-cal detect board`: from images to observations."""

from __future__ import annotations

import glob
import os
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.command import Answer, Command, add_output, finishing, require_output
from ceres_cal.cli.progress import ProgressBar

if TYPE_CHECKING:
    from ceres_cal.detect.boards import BoardDetections

IMAGE_ENDINGS = {".bmp", ".jp2", ".jpeg", ".jpg", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"}


def _add_board(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("images", nargs="+", metavar="IMAGE", help="images of one camera, or folders of them")
    add("--columns", type=int, required=True, metavar="N", help="inner corners along a row of the board")
    add("--rows", type=int, required=True, metavar="N", help="inner corners along a column of it")
    add("--square", type=float, required=True, metavar="M", help="side of a square in metres")
    add("--charuco", metavar="DICT", help="the board has markers of this OpenCV dictionary, such as DICT_4X4_50")
    add("--marker", type=float, metavar="M", help="side of a marker in metres, with --charuco")
    add(
        "--corner-fit",
        choices=("opencv", "saddle"),
        default="opencv",
        help="measure corners as OpenCV does (default), or by the saddle around each: finer where squares are large",
    )
    add("--camera", default="camera", metavar="NAME", help="name of the camera; default: camera")
    add("--station", metavar="NAME", help="name of the station; default: that of the camera")
    add_output(parser, "the observations (.json or .npz)", required=True)
    add("--quiet", action="store_true", help="no progress")


def _run_board(args: Namespace) -> Answer:
    images = list(image_files(args.images))
    require_output(args.output, images)
    require_observations_file(args.output)
    if (args.charuco is None) != (args.marker is None):
        raise InputError("--charuco DICT and --marker M go together: give both or neither")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # what it warns of in an image, we say ourselves
    from ceres_cal.detect.boards import CharucoSpec, detect_boards
    from ceres_cal.scene.targets import checkerboard

    board = checkerboard(args.columns, args.rows, args.square)
    charuco = None if args.charuco is None else CharucoSpec(args.charuco, args.marker)
    with ProgressBar(silent=args.quiet or args.json) as bar:
        found = detect_boards(
            images,
            board,
            camera=args.camera,
            station=args.station,
            charuco=charuco,
            corner_fit=args.corner_fit,
            progress=bar.update,
        )
    with finishing():
        found.observations.save(args.output)
    return Answer(_data(found, args.output), lambda: _text(found, args.output))


COMMANDS = (Command("detect board", "corners of chessboards and ChArUco boards in images", _add_board, _run_board),)


def require_observations_file(path: Path) -> None:
    """Raise InputError where a file's ending is none of those that observations are written to."""
    if path.suffix not in (".json", ".npz"):
        raise InputError(f"{path}: observations are written as .json or .npz: give one of these endings")


def image_files(given: Iterable[str]) -> Iterator[Path]:
    """The files named; those of folders, and of patterns that no shell expanded, in the order of their names."""
    for name in given:
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


def parse_names(text: str) -> list[str]:
    """Names between commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def _data(found: BoardDetections, output: Path) -> dict[str, Any]:
    return {
        "output": str(output),
        "corners": len(found.observations.points),
        "found": list(found.found),
        "missed": [{"image": path, "reason": reason} for path, reason in found.missed],
    }


def _text(found: BoardDetections, output: Path) -> str:
    shown, every = len(found.found), len(found.found) + len(found.missed)
    lines = [f"{shown} of {every} images show the board, {len(found.observations.points)} corners in all"]
    lines += [f"{path}: {reason}" for path, reason in found.missed]
    return "\n".join([*lines, f"written to {output}"])
