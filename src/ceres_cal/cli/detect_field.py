"""`ceres-cal detect field`: painted lines, arcs, corners and crossings of a field in photographs of one station."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal import calibration, detect, report, scene
from ceres_cal.base import InputError, images_and_videos, plural
from ceres_cal.cli import arguments, files
from ceres_cal.cli.command import QuietArguments, argument, command, option, switch
from ceres_cal.cli.photographs import detected, median_path, median_text, missed_section, turned_section, write_median
from ceres_cal.cli.terminal import ProgressBar
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration

_CORNER = "TopLeftCorner=102,88"


class FieldArguments(QuietArguments):
    """Photographs, the field in them, and the initial estimate."""

    images: tuple[str, ...] = argument(
        "IMAGE", "photographs that one camera took at one station, folders of them, or a video"
    )
    median: bool = switch(
        "use the median of all of them (of 25 at most), as always with a video: it removes robots and people that "
        "move; pictures that are blurred, or taken after the camera was moved, are left out and named"
    )
    target: str | None = option(
        "a field by its name (such as ssl-b, vss-3: `ceres-cal targets`), spelled out "
        '(\'{"kind": "vss-field", "size": "3v3", "field_length_m": 1.6}\'), or a JSON file with a target or with a '
        "target named 'field'; default: that of the calibration to start from",
        "TARGET",
    )
    start: Path | None = option("an earlier calibration, or a file of corners (ceres-cal/corners)", "FILE")
    corner: tuple[str, ...] = option(
        f"instead of --start: four points or more where they are seen, roughly, such as {_CORNER}",
        "NAME=X,Y",
        repeatable=True,
    )
    auto: bool = switch(
        "without any start: find the field in the photograph; with --start CALIBRATION, however far it has moved"
    )
    keep_start: bool = switch(
        "the start is accurate to 12 px: nothing farther away is searched", beside=("start", "corner")
    )
    facing: tuple[str, ...] = option(
        "with --auto: orientation of a field that looks the same turned: the side of the picture (left, "
        f"right, top, bottom, top-left, ...) that a line or point lies towards, such as {arguments.FACING_EXAMPLE}; it "
        "need not be in the picture",
        "NAME=SIDE",
        repeatable=True,
        beside=("auto",),
    )
    estimate: tuple[str, ...] = arguments.estimate_option()
    not_painted: str = arguments.not_painted_option("lines of the target that this field does not have")
    mask: Path | None = option("a picture of the same size: what is black in it is left out (hall, people)", "FILE")
    picture: Path | None = option("draw what was seen in the first photograph that is refused", "FILE")
    edges: bool = switch("both edges of each line instead of its middle")
    points: bool = switch(
        "detect corners and crossings, too, for programs that take no lines; lines alone are more accurate"
    )
    camera: str | None = arguments.camera_option(
        "name of the camera; default: that of the calibration, or camera", None
    )
    station: str | None = arguments.station_option("name of the station, to start from and to write; default: likewise")
    output: Path = arguments.output_option("the observations (.json or .npz)")
    timeout: float | None = arguments.timeout_option()


@command(
    "detect field",
    "painted lines and crossings of a field in photographs",
    "photographs/ --target ssl-b --auto --facing LeftGoalLine=top -o field.json",
    "game.mp4 --target ssl-b --auto --facing LeftGoalLine=top -o field.json",
    "0001.png --start calibration.json -o field.json",
    "0001.png --target ssl-b --auto --facing LeftGoalLine=top --estimate length,width -o field.json",
    "0001.png --target ssl-a --start corners.json -o field.json",
)
def _run(args: FieldArguments) -> Document:
    images, videos = images_and_videos(args.images)
    files.require_observations_output(args.output, [*images, *videos, *([args.start] if args.start else [])])
    files.require_output(args.picture, [*images, *videos], "pictures are", ".png")
    one = median_path(args.output, [*images, *videos]) if videos or args.median else None
    _require_fitting(args)
    from ceres_cal.calibration import Calibration
    from ceres_cal.functions import detect_field, field_of

    start = _corners(args.corner) if args.corner else None if args.start is None else _start(args.start, auto=args.auto)
    target = files.read_target(args.target, "field") if args.target else None
    if target is None and isinstance(start, Calibration):
        target = field_of(start)
    if target is None:
        raise InputError("name the field with --target, such as --target ssl-b")
    bar, merged = ProgressBar(args.silent), {}

    def pictures() -> list[Path]:
        if one is not None:
            merged.update(write_median(one, images, videos, bar))
        return images if one is None else [one]

    same = ("auto", "mask", "edges", "points", "keep_start", "camera", "station")
    how: dict[str, Any] = {name: getattr(args, name) for name in same}
    look = partial(
        detect_field,
        pictures,
        target=target,
        start=start,
        facing=arguments.parse_facing(args.facing),
        not_painted=arguments.parse_names(args.not_painted),
        estimate=arguments.parse_estimates(args.estimate, {"field": target}),
        refused=_drawing(args.picture, target),
        progress=bar.update,
        **how,
    )
    with bar:
        detections = detected(args.timeout, look)
    files.save(args.output, detections.observations)
    return Document(tuple(_sections(detections, merged, args.output, [*images, *videos] if merged else [])))


def _drawing(picture: Path | None, target: scene.Target) -> Callable[[Path, detect.SearchResult], None] | None:
    """Return a function that draws what was seen in the first photograph that is refused; None without a picture."""
    if picture is None:
        return None

    drawn: list[Path] = []

    def draw(path: Path, result: detect.SearchResult) -> None:
        if not drawn:
            files.save(
                picture, detect.encoded(report.draw_seen(detect.read_colour(path), result.seen, target), ".png", 90)
            )
            drawn.append(path)

    return draw


def _require_fitting(args: FieldArguments) -> None:
    """Raise InputError unless exactly one way to start was chosen."""
    if (args.start is not None) + bool(args.corner) != 1 and not (args.auto and not args.corner):
        raise InputError(f"say where to start: --start FILE, or --corner {_CORNER} four times, or --auto")
    if args.auto and args.corner:
        raise InputError("--corner says where to start and --auto to do without: give one of them")


# ---- where to start -------------------------------------------------------------------------------------------------


def _start(path: Path, *, auto: bool) -> Calibration | detect.Clicks:
    from ceres_cal.calibration import Calibration

    if files.json_object(path).get("format") == calibration.FORMAT:
        return Calibration.load(path)
    if auto:
        raise InputError(f"{path}: --auto takes a calibration as start, no corners: leave out --auto, or the file")
    return detect.load_clicks(path)


def _corners(specs: Sequence[str]) -> detect.Clicks:
    form = f"NAME=X,Y, such as {_CORNER}"

    def pixel(text: str, where: str) -> tuple[float, float]:
        numbers = arguments.parse_numbers(text, where)
        if len(numbers) != 2:
            raise InputError(f"{where}: write {form}")
        return numbers[0], numbers[1]

    return detect.Clicks(arguments.named_values("--corner", form, pixel, specs))


# ---- the answer -----------------------------------------------------------------------------------------------------


def _sections(
    detections: detect.FieldDetections, merged: dict[str, Any], output: Path, given: Sequence[Path] = ()
) -> Iterator[Section]:
    """Yield the answer; `given`: the pictures that the one picture was made of."""
    observations, images = detections.observations, [_image_data(path, detections) for path in detections.found]
    points, curves = len(observations.points), len(observations.curves)
    every, missed = len(images) + len(detections.missed), missed_section(detections.missed)
    lengths = {prior.quantity: prior.value[0] for prior in observations.priors if prior.dimension}
    seen = f"{len(images)} of {every} images show the field"
    met = f", {plural(points, 'corner')} and crossings" if points else ""
    first = f"{seen}: {plural(curves, 'line observation')}{met}"
    yield Section("", [first], {"points": points, "curves": curves, "found": images})
    said = ", ".join(f"{name} {length:.3f}" for name, length in lengths.items())
    rough = [f"lengths, roughly, for `calibrate` to solve for: {said} m"] if lengths else []
    yield Section("", rough, {"lengths_m": lengths})
    if merged:
        yield Section("", [median_text(merged)], {"median": merged})
    yield Section("", tuple(_image_lines(images)))
    yield turned_section(path for path in (*given, *map(Path, detections.found)) if path.is_file())
    yield missed
    yield Section("", [f"written to {output}"], {"output": str(output)})


def _image_data(path: str, detections: detect.FieldDetections) -> dict[str, Any]:
    lines = detections.found[path].lines
    sigmas = sorted(lines.sigma_px[lines.found])
    data = {
        "image": path,
        "places": len(lines.found),
        "found": len(sigmas),
        "sigma_px": float(sigmas[len(sigmas) // 2]),
        "blur_px": lines.blur_px,
        "width_factor": lines.stretch,
        "not_as_drawn": list(detections.found[path].built.words()),
        "lacking": list(detections.found[path].lacking),
    }
    if _stretched(camera := detections.found[path].camera):
        data["aspect"] = camera.aspect
    if path in detections.searched:
        searched = detections.searched[path]
        data["searched"] = {"ways": searched.ways, "settled_by": searched.chosen_by or None}
    return data


def _stretched(camera: scene.Camera) -> bool:
    """Whether its pixels are less square than those of usual cameras."""
    square = 0.005  # largest deviation of fy / fx from 1 for usual cameras
    return abs(camera.aspect - 1.0) > square


def _image_lines(images: Sequence[dict[str, Any]]) -> Iterator[str]:
    for one in images:
        yield (
            f"{one['image']}: paint at {one['found']} of {one['places']} places, accurate to {one['sigma_px']:.3f} px; "
            f"blur {one['blur_px']:.2f} px, lines {one['width_factor']:.2f} times as wide as the target says"
        )
    for one in images:
        if "searched" in one:
            yield f"{one['image']}: found without a start, {_ways(one['searched'])}"
    for one in images:
        if "aspect" in one:
            yield (
                f"{one['image']}: its pixels are not square, fy / fx is {one['aspect']:.3f}: if the picture was "
                "stretched, use the original"
            )
    yield from (f"{one['image']}: {words}" for one in images for words in one["not_as_drawn"])
    yield from (f"{one['image']}: {', '.join(one['lacking'])} not found" for one in images if one["lacking"])


def _ways(searched: dict[str, Any]) -> str:
    """Words on how many ways a photograph could be taken for the field, and what chose one."""
    if searched["settled_by"] is None:
        return "in the only possible orientation"
    by = {"facing": "--facing", "before": "the earlier calibration"}[searched["settled_by"]]
    return f"in one of {searched['ways']} possible orientations, chosen by {by}"
