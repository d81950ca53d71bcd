"""`ceres-cal detect board`: from images to observations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ceres_cal.base.errors import InputError
from ceres_cal.base.images import images_and_videos
from ceres_cal.cli.arguments import frames_option, length
from ceres_cal.cli.command import command
from ceres_cal.cli.files import finishing, read_target, require_observations_output
from ceres_cal.cli.options import QuietArguments, argument, flag, option, switch
from ceres_cal.cli.photographs import DetectArguments, detected, missed_section
from ceres_cal.cli.terminal import progress_bar
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.detect.boards import BoardDetections
    from ceres_cal.scene.targets import Target


@dataclass(frozen=True, kw_only=True)
class BoardArguments(QuietArguments, DetectArguments):
    """Photographs, and the board in them."""

    images: tuple[str, ...] = argument("IMAGE", "images of one camera, folders of them, or videos")
    columns: int | None = option("inner corners, or circles, along a row of the board", "N")
    rows: int | None = option("inner corners, or circles, along a column of it", "N")
    target: str | None = option(
        "in place of these and of the sizes: a board, or markers of known place, spelled out "
        "('{\"kind\": \"markers\", ...}': `ceres-cal targets`), or a JSON file with it or with a target named 'board'",
        "TARGET",
    )
    square: float | None = option("side of a square in metres, or such as 25mm", "M", read=length("m"))
    april_grid: float | None = option(
        "Kalibr's AprilGrid: side of a tag likewise; columns and rows are of tags", "M", read=length("m")
    )
    gap: float | None = option("with --april-grid: between tags, over their side (tagSpacing)", "SHARE")
    circles: float | None = option("a grid of circles, so far apart, instead of squares", "M", read=length("m"))
    asymmetric: bool = switch("with --circles: every other row half a step aside, M as in OpenCV")
    diameter: float | None = option("with --circles: of a circle", "M", read=length("m"))
    charuco: str | None = option("the board has markers of this OpenCV dictionary, such as DICT_4X4_50", "DICT")
    marker: float | None = option("side of a marker likewise, with --charuco", "M", read=length("m"))
    legacy: bool = switch("with --charuco: made with OpenCV before 4.6")
    corner_fit: Literal["saddle", "opencv"] = option(
        "measure corners by the saddle around each (default), also of boards partly out of the picture, or as "
        "OpenCV does, whole boards alone",
        default="saddle",
    )
    frames: int = frames_option()


@command(
    "detect board",
    "chessboards, ChArUco, AprilGrid and circle boards, and markers, in images",
    "photographs/ --columns 9 --rows 6 --square 25mm -o board.json",
    "photographs/ --columns 9 --rows 6 --square 40mm --charuco DICT_4X4_50 --marker 30mm -o board.json",
    "photographs/ --columns 6 --rows 6 --april-grid 88mm --gap 0.3 -o april.json",
    "photographs/ --columns 7 --rows 5 --circles 30mm --diameter 20mm -o circles.json",
    "0001.png --target markers.json -o floor.json",
)
def _run_board(args: BoardArguments) -> Document:
    images, videos = images_and_videos(args.images)
    require_observations_output(args.output, [*images, *videos])
    from ceres_cal.detect.boards import detect_boards
    from ceres_cal.detect.charuco import CharucoSpec
    from ceres_cal.detect.video import frames_of_videos

    corners: str | CharucoSpec = args.corner_fit
    if args.charuco is not None and args.marker is not None:
        corners = CharucoSpec(args.charuco, args.marker, args.legacy)
    elif args.charuco is not None or args.marker is not None:
        raise InputError("--charuco DICT and --marker M belong together: give both or neither")
    board = _board(args)
    with progress_bar(args) as bar:
        taken = partial(frames_of_videos, videos, args.frames, args.output.parent, bar.update)
        images += detected(args.timeout, taken)
        found = partial(detect_boards, images, board, args.camera, args.station, corners, bar.update)
        detections = detected(args.timeout, found)
    with finishing():
        detections.observations.save(args.output)
    return _document(detections, args.output)


_OF_A_BOARD = ("columns", "rows", "square", "april_grid", "gap", "circles", "diameter")


def _board(args: BoardArguments) -> Target:
    from ceres_cal.scene.targets import april_grid, checkerboard, circle_grid

    if args.target is not None:
        if given := [flag(name) for name in _OF_A_BOARD if getattr(args, name) is not None]:
            raise InputError(f"--target says what the board is: leave out {' and '.join(given)}")
        return read_target(args.target, "board")
    if args.columns is None or args.rows is None:
        raise InputError("--columns N and --rows N, or --target TARGET: say what the board is")
    if sum(size is not None for size in (args.square, args.circles, args.april_grid)) != 1:
        raise InputError("--square M, --circles M or --april-grid M, by the kind of board: give one of them")
    if args.square is not None:
        return checkerboard(args.columns, args.rows, args.square)
    if args.charuco is not None:
        raise InputError("--charuco is for a board of squares: give --square M")
    if args.april_grid is not None:
        if args.gap is None:
            raise InputError("--april-grid M needs --gap SHARE")
        return april_grid(args.columns, args.rows, args.april_grid, args.gap)
    if args.circles is None or args.diameter is None:
        raise InputError("--circles M needs --diameter M")
    return circle_grid(args.columns, args.rows, args.circles, args.diameter, asymmetric=args.asymmetric)


def _document(detections: BoardDetections, output: Path) -> Document:
    corners, found, missed = len(detections.observations.points), detections.found, detections.missed
    said = f"{len(found)} of {len(found) + len(missed)} images show the board, {corners} corners in all"
    return Document(
        (
            Section("", [said], {"corners": corners, "found": found}),
            missed_section(missed),
            Section("", [f"written to {output}"], {"output": str(output)}),
        )
    )
