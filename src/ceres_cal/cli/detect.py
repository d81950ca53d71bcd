"""`ceres-cal detect board`: from images to observations."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import add_detection, add_quiet
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.detection import detected
from ceres_cal.cli.inputs import image_files
from ceres_cal.cli.outputs import finishing, require_observations_output
from ceres_cal.cli.photographs import missed_data, missed_text
from ceres_cal.cli.progress import progress_bar

if TYPE_CHECKING:
    from ceres_cal.detect.boards import BoardDetections


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
        choices=("saddle", "opencv"),
        default="saddle",
        help="measure corners by the saddle around each (default), also of boards partly out of the picture, or as "
        "OpenCV does, whole boards alone",
    )
    add_detection(parser)
    add_quiet(parser)


def _run_board(args: Namespace) -> Answer:
    images = image_files(args.images)
    require_observations_output(args.output, images)
    if (args.charuco is None) != (args.marker is None):
        raise InputError("--charuco DICT and --marker M go together: give both or neither")
    from ceres_cal.detect.boards import CharucoSpec, detect_boards
    from ceres_cal.scene.targets import checkerboard

    board = checkerboard(args.columns, args.rows, args.square)
    corners = args.corner_fit if args.charuco is None else CharucoSpec(args.charuco, args.marker)
    with progress_bar(args) as bar:
        found = partial(detect_boards, images, board, args.camera, args.station, corners, bar.update)
        detections = detected(args, found)
    with finishing():
        detections.observations.save(args.output)
    return Answer(_data(detections, args.output), lambda: _text(detections, args.output))


COMMANDS = (Command("detect board", "corners of chessboards and ChArUco boards in images", _add_board, _run_board),)


def _data(detections: BoardDetections, output: Path) -> dict[str, Any]:
    return {
        "output": str(output),
        "corners": len(detections.observations.points),
        "found": detections.found,
        "missed": missed_data(detections.missed),
    }


def _text(detections: BoardDetections, output: Path) -> str:
    number, every = len(detections.found), len(detections.found) + len(detections.missed)
    first = f"{number} of {every} images show the board, {len(detections.observations.points)} corners in all"
    return "\n".join([first, *missed_text(detections.missed), f"written to {output}"])
