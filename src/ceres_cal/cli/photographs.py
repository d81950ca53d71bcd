"""Photographs and videos as inputs of commands: beside observations, merged into one picture, and detection with a time
limit.

Also `ceres-cal detect board` and `detect rings`: from images to observations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

from ceres_cal import base, detect, scene
from ceres_cal.base import InputError, first_of, image_files, images_and_videos, plural
from ceres_cal.cli import arguments
from ceres_cal.cli.arguments import frames_option, length, parse_length, parse_lengths
from ceres_cal.cli.command import REQUIRED, Arguments, QuietArguments, argument, command, flag, option, switch
from ceres_cal.cli.files import read_target, require_different, require_observations_output, require_output, save
from ceres_cal.cli.terminal import ProgressBar
from ceres_cal.report.document import Document, Section

_T = TypeVar("_T")
_OBSERVATIONS = (".json", ".npz")


class InputArguments(QuietArguments):
    """A calibration, files of observations or photographs, and settings for photographs."""

    calibration: Path = arguments.calibration_argument("the calibration from before")
    inputs: tuple[str, ...] = argument(
        "OBS|IMAGE", "files of new observations (.json, .npz), taken together; or photographs, or folders of them"
    )
    station: str | None = arguments.station_option("station that took the photographs; default: the only one")
    not_painted: str = arguments.not_painted_option("lines that the photographed field does not have")


class DetectArguments(Arguments):
    """Arguments that `detect board` and `detect rings` share."""

    timeout: float | None = arguments.timeout_option()
    camera: str = arguments.camera_option()
    station: str | None = arguments.station_option("name of the station; default: that of the camera")
    output: Path = arguments.output_option("the observations (.json or .npz)")


def photographs_in(args: InputArguments) -> list[Path]:
    """Return the photographs that are named, each once; empty if observations are named."""
    observed = [name for name in args.inputs if Path(name).suffix.lower() in _OBSERVATIONS]
    if len(observed) == len(args.inputs):
        require_different(observed)
        if args.station is not None or args.not_painted:
            raise InputError("--station and --not-painted are of photographs, which were not given: leave them out")
        return []
    if observed:
        raise InputError(
            f"{observed[0]}: observations cannot be mixed with photographs: give one kind; `ceres-cal detect field` "
            "makes observations from photographs"
        )
    images = image_files(args.inputs)
    require_different(images)
    return images


def shown(detections: detect.KnownDetections | None) -> Section:
    """Section on what photographs showed; empty where none were given."""
    if detections is None:
        return Section()
    missed = missed_section(detections.missed)
    counts = ", ".join(f"{name} in {count}" for name, count in detections.shown.items())
    first = f"{plural(detections.images, 'photograph')} of station {detections.station}: {counts}"
    images = {"images": detections.images, "shown": detections.shown, **missed.data}
    return Section("images", [first, *missed.lines], {"photographs": images})


def missed_section(missed: tuple[tuple[str, str], ...]) -> Section:
    """Section with a line for each image in which nothing was detected."""
    data = {"missed": [{"image": path, "reason": reason} for path, reason in missed]}
    return Section("", [f"{path}: {reason}" for path, reason in missed], data)


def turned_section(paths: Iterable[Path]) -> Section:
    """Section with a line for each photograph and video that viewers show turned."""
    words = ((path, detect.turned_words(path)) for path in dict.fromkeys(paths))
    said = [f"{path}: {one}: --facing and pixels refer to the picture as stored" for path, one in words if one]
    return Section("warning", said)


# ---- detection ------------------------------------------------------------------------------------------------------


def detected(timeout: float | None, detect: Callable[[], _T]) -> _T:
    """Return the result of `detect`; InputError where it takes longer than --timeout."""
    if timeout is not None and not timeout > 0.0:
        raise InputError(f"--timeout must be above 0 seconds, not {timeout:g}")

    try:
        return base.interruptibly(detect, timeout)
    except TimeoutError:
        raise InputError(
            f"--timeout: not done after {timeout:g} s, {base.noted_words()}: give fewer images, or more time"
        ) from None


# ---- videos and medians ---------------------------------------------------------------------------------------------


def median_path(output: Path, inputs: Sequence[Path]) -> Path:
    """Return where the one picture is written, beside the observations; InputError where that is one of the inputs."""
    path = output.with_name(f"{output.stem}_median.png")
    require_output(path, inputs)
    return path


def write_median(path: Path, images: Sequence[Path], videos: Sequence[Path], bar: ProgressBar) -> dict[str, Any]:
    """Write the one picture made from photographs and videos, in 16 bits; return which were used and left out, for
    --json.

    Raises:
        InputError: see `detect.median.merged`; an image or a video that cannot be read.
    """
    import numpy as np

    found: detect.MedianPicture = detect.merged(_pictures(images, videos, bar))
    levels = np.round(found.picture * (65535 // found.white)).astype(np.uint16)
    save(path, detect.encoded(np.asarray(levels), ".png", 100))
    left_out = [{"image": name, "reason": reason} for name, reason in found.left_out]
    shaken_px = round(found.shaken_px, 1)
    return {"picture": str(path), "used": list(found.used), "left_out": left_out, "shaken_px": shaken_px}


def _pictures(images: Sequence[Path], videos: Sequence[Path], bar: ProgressBar) -> Iterator[tuple[str, base.Image]]:
    # of each video, and of the photographs together
    each = max(1, detect.MOST_PICTURES // (len(videos) + bool(images)))
    for path in images[:: -(-len(images) // each) or 1]:
        yield str(path), detect.read_colour(path)
    for video in videos[: detect.MOST_PICTURES]:
        yield from detect.spread_frames(video, each, bar.update)


def median_text(data: dict[str, Any]) -> str:
    """Summarise in one line which pictures were used, and whether the camera shook."""
    used, left_out = len(data["used"]), data["left_out"]
    reasons: dict[str, list[str]] = {}
    for one in left_out:
        reasons.setdefault(one["reason"], []).append(one["image"])
    said = [f"{len(names)} left out, {reason} ({first_of(names)})" for reason, names in reasons.items()]
    if shaken_px := data["shaken_px"]:
        said.append(
            f"the others were moved back by {shaken_px} px: the camera shakes, so each picture is off by as much"
        )
    return "; ".join([f"{data['picture']}: the median of {plural(used, 'picture')} of {used + len(left_out)}", *said])


# ---- boards and rings -----------------------------------------------------------------------------------------------


def _side(what: str, *beside: str) -> Any:
    """An option for a length in metres, which needs others."""
    return option(what, "M", read=length("m"), beside=beside)


class BoardArguments(QuietArguments, DetectArguments):
    """Photographs, and the board in them."""

    images: tuple[str, ...] = argument("IMAGE", "images of one camera, folders of them, or videos")
    columns: int | None = option("inner corners, or circles, along a row of the board", "N")
    rows: int | None = option("inner corners, or circles, along a column of it", "N")
    target: str | None = option(
        "in place of these and of the sizes: a board such as 9x6x25mm, or one of another kind or markers of known "
        'place, spelled out (\'{"kind": "markers", ...}\': `ceres-cal targets`), or a JSON file with it or with a '
        "target named 'board'",
        "TARGET",
        elsewhere=("board",),
    )
    square: float | None = _side("side of a square in metres, or such as 25mm")
    april_grid: float | None = _side("Kalibr's AprilGrid: side of a tag likewise; columns and rows are of tags", "gap")
    gap: float | None = option(
        "with --april-grid: gap between tags divided by their side (tagSpacing)",
        "SHARE",
        beside=("april_grid",),
    )
    circles: float | None = _side("a grid of circles at this distance, instead of squares", "diameter")
    asymmetric: bool = switch("with --circles: every other row half a step off, M as in OpenCV", beside=("circles",))
    diameter: float | None = _side("with --circles: of a circle", "circles")
    charuco: str | None = option(
        "the board has markers of this OpenCV dictionary, such as DICT_4X4_50", "DICT", beside=("marker",)
    )
    marker: float | None = _side("side of a marker likewise, with --charuco", "charuco")
    legacy: bool = switch("with --charuco: made with OpenCV before 4.6", beside=("charuco",))
    corner_fit: Literal["saddle", "opencv"] = option(
        "measure corners by a saddle fit (default), also of boards partly outside the picture, or as OpenCV does, "
        "of whole boards only",
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

    how: dict[str, Any] = {name: getattr(args, name) for name in ("camera", "station", "corner_fit", "frames")}
    how |= {"folder": args.output.parent}
    with ProgressBar(args.silent) as bar:
        detections = detected(
            args.timeout, partial(detect_board, args.images, _board(args), **how, progress=bar.update)
        )
    save(args.output, detections.observations)
    corners, found, missed = len(detections.observations.points), detections.found, detections.missed
    said = f"{len(found)} of {len(found) + len(missed)} images show the board, {corners} corners in all"
    first = Section("", [said], {"corners": corners, "found": found})
    written = Section("", [f"written to {args.output}"], {"output": str(args.output)})
    return Document((first, missed_section(missed), written))


_OF_A_BOARD = ("columns", "rows", "square", "april_grid", "gap", "circles", "diameter", "charuco", "marker")


def _board(args: BoardArguments) -> scene.Target:
    if args.target is not None:
        if given := [flag(name) for name in _OF_A_BOARD if getattr(args, name) is not None]:
            raise InputError(f"--target says what the board is: leave out {' and '.join(given)}")
        return read_target(args.target, "board")
    if args.columns is None or args.rows is None:
        raise InputError("--columns N and --rows N, or --target TARGET: say what the board is")
    if sum(size is not None for size in (args.square, args.circles, args.april_grid)) != 1:
        raise InputError("--square M, --circles M or --april-grid M, by the kind of board: give one of them")
    if args.charuco is not None:
        if args.square is None:
            raise InputError("--charuco is for a board of squares: give --square M")
        marker_m = args.marker or 0.0  # required beside --charuco
        return scene.charuco(args.columns, args.rows, args.square, marker_m, args.charuco, legacy=args.legacy)
    if args.square is not None:
        return scene.checkerboard(args.columns, args.rows, args.square)
    if args.april_grid is not None:
        return scene.april_grid(args.columns, args.rows, args.april_grid, args.gap or 0.0)
    distance, diameter = args.circles or 0.0, args.diameter or 0.0
    return scene.circle_grid(args.columns, args.rows, distance, diameter, asymmetric=args.asymmetric)


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
