"""`ceres-cal detect board` and `detect rings`: from images to observations."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, Literal

from ceres_cal import detect, scene
from ceres_cal.base.errors import InputError
from ceres_cal.base.images import images_and_videos
from ceres_cal.cli.arguments import frames_option, length, number, parse_length, parse_lengths
from ceres_cal.cli.command import REQUIRED, QuietArguments, argument, command, flag, option, switch
from ceres_cal.cli.files import read_target, require_observations_output, save
from ceres_cal.cli.photographs import DetectArguments, detected, missed_section
from ceres_cal.cli.terminal import progress_bar
from ceres_cal.report.document import Document, Section


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
        "Kalibr's AprilGrid: side of a tag likewise; columns and rows are of tags",
        "M",
        read=length("m"),
        beside=("gap",),
    )
    gap: float | None = option(
        "with --april-grid: between tags, over their side (tagSpacing)",
        "SHARE",
        read=number("--gap"),
        beside=("april_grid",),
    )
    circles: float | None = option(
        "a grid of circles, so far apart, instead of squares", "M", read=length("m"), beside=("diameter",)
    )
    asymmetric: bool = switch("with --circles: every other row half a step aside, M as in OpenCV", beside=("circles",))
    diameter: float | None = option("with --circles: of a circle", "M", read=length("m"), beside=("circles",))
    charuco: str | None = option(
        "the board has markers of this OpenCV dictionary, such as DICT_4X4_50", "DICT", beside=("marker",)
    )
    marker: float | None = option(
        "side of a marker likewise, with --charuco", "M", read=length("m"), beside=("charuco",)
    )
    legacy: bool = switch("with --charuco: made with OpenCV before 4.6", beside=("charuco",))
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
    from ceres_cal.functions import detect_board

    same = ("camera", "station", "corner_fit", "charuco", "legacy", "frames")
    how: dict[str, Any] = {name: getattr(args, name) for name in same}
    how |= {"marker_m": args.marker, "folder": args.output.parent}
    with progress_bar(args.silent) as bar:
        detections = detected(
            args.timeout, partial(detect_board, args.images, _board(args), **how, progress=bar.update)
        )
    save(args.output, detections.observations)
    return _document(detections, args.output)


_OF_A_BOARD = ("columns", "rows", "square", "april_grid", "gap", "circles", "diameter")


def _board(args: BoardArguments) -> scene.Target:
    if args.target is not None:
        if given := [flag(name) for name in _OF_A_BOARD if getattr(args, name) is not None]:
            raise InputError(f"--target says what the board is: leave out {' and '.join(given)}")
        return read_target(args.target, "board")
    if args.columns is None or args.rows is None:
        raise InputError("--columns N and --rows N, or --target TARGET: say what the board is")
    if sum(size is not None for size in (args.square, args.circles, args.april_grid)) != 1:
        raise InputError("--square M, --circles M or --april-grid M, by the kind of board: give one of them")
    if args.square is not None:
        return scene.checkerboard(args.columns, args.rows, args.square)
    if args.charuco is not None:
        raise InputError("--charuco is for a board of squares: give --square M")
    if args.april_grid is not None:
        return scene.april_grid(args.columns, args.rows, args.april_grid, args.gap or 0.0)
    distance, diameter = args.circles or 0.0, args.diameter or 0.0
    return scene.circle_grid(args.columns, args.rows, distance, diameter, asymmetric=args.asymmetric)


def _document(detections: detect.BoardDetections, output: Path) -> Document:
    corners, found, missed = len(detections.observations.points), detections.found, detections.missed
    said = f"{len(found)} of {len(found) + len(missed)} images show the board, {corners} corners in all"
    return Document(
        (
            Section("", [said], {"corners": corners, "found": found}),
            missed_section(missed),
            Section("", [f"written to {output}"], {"output": str(output)}),
        )
    )


def _radii(text: str) -> tuple[float, ...]:
    most_rings = 10_000
    where = f"--radii {text!r}"
    if ":" not in text:
        return parse_lengths(text, where)
    parts = text.split(":")
    if len(parts) != 3:
        raise InputError(f"{where}: write FROM:TO:STEP, such as 0.01:0.36:0.01, or the radii between commas")
    first, last, step = (parse_length(part, where) for part in parts)
    if not (0.0 < first <= last and step > 0.0 and (last - first) / step < most_rings):
        raise InputError(f"{where}: FROM must be above 0, TO not below it, and STEP above 0")
    return tuple(first + i * step for i in range(round((last - first) / step) + 1))


@command("detect rings", "edges of concentric rings in a photograph", "rings.png --radii 10mm:360mm:10mm -o rings.json")
def _run(
    args: DetectArguments,
    image: str = argument("IMAGE", "photograph of the rings, taken about from the front"),
    radii: tuple[float, ...] = option(
        "radii in metres of all edges between dark and bright, from the inside out; FROM:TO:STEP for even ones, "
        "such as 0.01:0.36:0.01",
        "M,M,...",
        REQUIRED,
        read=_radii,
    ),
) -> Document:
    require_observations_output(args.output, [image])

    detection = detected(args.timeout, partial(detect.detect_rings, image, radii, args.camera, args.station))
    save(args.output, detection.observations)
    return _rings_document(detection, image, len(radii), args.output)


def _rings_document(detection: detect.RingsDetection, image: str, asked: int, output: Path) -> Document:
    a1, a2, a3 = detection.polynomial.tolist()
    (x, y), edges, lens = detection.centre.tolist(), len(detection.observations.curves), {"a2": a2 / a1, "a3": a3 / a1}
    lines = [
        f"{detection.rings} of {asked} rings around ({x:.1f}, {y:.1f}), "
        f"{edges} edges, blurred by {detection.blur_px:.2f} px",
        "the paper's polynomial r' = a1 r + a2 r^2 + a3 r^3, px, the first ring being as large as it is seen:",
        *(f"    {name} {value!r}" for name, value in (("a1", a1), ("a2", a2), ("a3", a3))),
        f"    with a1 = 1, as a lens has it: a2 {lens['a2']!r}, a3 {lens['a3']!r}; rms {detection.rms_px:.3f} px",
        f"written to {output}",
    ]
    data = {
        "image": image,
        "output": str(output),
        "rings": detection.rings,
        "radii_given": asked,
        "observations": edges,
        "centre": [x, y],
        "polynomial": {"a1": a1, "a2": a2, "a3": a3},
        "lens": lens,
        "rms_px": detection.rms_px,
        "blur_px": detection.blur_px,
    }
    return Document((Section("", lines, data),))
