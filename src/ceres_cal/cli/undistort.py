"""`ceres-cal undistort`: straight images, top views to scale, and photographs with the model drawn into them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ceres_cal import detect, posterior, report, scene
from ceres_cal.base import InputError, frame_of, image_files
from ceres_cal.cli import arguments
from ceres_cal.cli.command import QuietArguments, argument, command, flag, given, option, switch
from ceres_cal.cli.files import read_calibration, read_observations, require_folder, save, station_of
from ceres_cal.cli.terminal import ProgressBar
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.base.arrays import Image
    from ceres_cal.calibration import Calibration

_STRAIGHT, _TOP, _OVERLAY = "straight images (default)", "the field from above", "the model in the photograph"
_straight_option = partial(option, group=_STRAIGHT)
_top_option = partial(option, group=_TOP, beside=("top_view",))
_overlay_option = partial(option, group=_OVERLAY, beside=("overlay",))
Area = tuple[float, float, float, float]
"""x0, y0, x1 and y1, m."""


def _size(text: str) -> tuple[int, int]:
    across, by, down = text.lower().partition("x")
    if not (by and across.isdecimal() and down.isdecimal()):
        raise InputError(f"--size {text!r}: write WIDTHxHEIGHT in px, such as 1280x960")
    return int(across), int(down)


def _area(text: str) -> Area:
    numbers = arguments.parse_lengths(text, f"--area {text!r}")
    if len(numbers) != 4:
        raise InputError(f"--area {text!r}: write X0,Y0,X1,Y1 in metres, such as -4.5,-3,0,3")
    return numbers[0], numbers[1], numbers[2], numbers[3]


class UndistortArguments(QuietArguments):
    """Photographs, and which pictures are made of them."""

    calibration: Path = arguments.calibration_argument()
    images: tuple[str, ...] = argument("IMAGE", "photographs of one camera, or folders of them")
    output: Path = arguments.output_option("the pictures; made if missing", metavar="FOLDER")
    camera: str | None = arguments.camera_option("which camera; may be left out where there is only one", None)
    station: str | None = arguments.station_option()
    format: Literal["png", "jpg"] = option("default: png, which loses nothing", default="png", elsewhere=("to",))
    crop: bool = switch("the largest rectangle without black (default)", group=_STRAIGHT, alone="shape")
    whole: bool = switch("everything that the photograph shows, black around it", group=_STRAIGHT, alone="shape")
    size: tuple[int, int] | None = _straight_option(
        "size of the straight image, px; default: the photograph's", "WxH", read=_size, alone="scale"
    )
    phi: float | None = _straight_option(
        "focal length of the straight image in px, instead of its size; the camera's own keeps the scale",
        "PX",
        alone="scale",
    )
    angle: float | None = _straight_option(
        "widest angle of view; default: 150 with --whole, else as far as detail goes", "DEG"
    )
    top_view: bool = switch("the field from straight above, to scale", group=_TOP)
    mm_per_px: float | None = _top_option("scale of the top view; default: 5", "MM", read=arguments.length("mm"))
    area: Area | None = _top_option("area in metres; default: the field and 0.3 m around it", "X0,Y0,X1,Y1", read=_area)
    overlay: bool = switch("draw the calibrated lines and boards into photographs", group=_OVERLAY)
    before: Path | None = _overlay_option("draw an earlier calibration too", "CALIBRATION")
    observations: Path | None = _overlay_option("say what each frame shows, and draw them too", "OBS")
    height_mm: float | None = arguments.height_option(
        "plane of the top view, or of a second drawing in an overlay", beside=("top_view", "overlay")
    )


@command(
    "undistort",
    "straight images, top views to scale, the model in a photograph",
    "calibration.json photographs/ -o straight/",
    "calibration.json photographs/ -o top/ --top-view --mm-per-px 5 --height-mm 150",
    "calibration.json photographs/ -o look/ --overlay --before old.json",
)
def _run(args: UndistortArguments) -> Document:
    format, version = "ceres-cal/pictures", 1
    require_fitting(args)
    images = image_files(args.images)
    kind = "top" if args.top_view else "overlay" if args.overlay else "straight"
    outputs = _outputs(images, args.output, f"-{kind}.{args.format}", f"{kind}.json")
    calibration = read_calibration(args.calibration)
    make, facts, words = {"top": _top_view, "overlay": _overlay, "straight": _straight}[kind](args, calibration)
    lines: list[str] = []
    written: list[dict[str, Any]] = []
    about = args.output / f"{kind}.json"
    with ProgressBar(args.silent) as bar:
        for number, (path, output) in enumerate(outputs.items(), start=1):
            picture, own, line = make(path)
            args.output.mkdir(parents=True, exist_ok=True)
            _write(output, picture)
            lines.append(f"{output}: {line}")
            written.append({"image": str(path), "output": str(output), **own})
            bar.update(number, len(outputs), path.name)
    first = {"format": format, "version": version, "calibration": str(args.calibration), "kind": kind}
    data = {**first, **facts, "pictures": written}
    save(about, data)
    return Document((Section("", [*lines, f"{about}: {words}"], {**data, "output": str(about)}),))


# ---- options --------------------------------------------------------------------------------------------------------


def require_fitting(args: UndistortArguments) -> None:
    """Raise InputError where options for different kinds of pictures are mixed."""
    if args.top_view and args.overlay:
        raise InputError("--top-view and --overlay are two kinds of pictures: make one at a time")
    straight = [name for name, about in given(args).items() if about.get("group") == _STRAIGHT]
    if straight and (args.top_view or args.overlay):
        raise InputError(f"{flag(straight[0])} is for straight images: leave it out, or ask for that")


def _outputs(images: list[Path], folder: Path, ending: str, about: str) -> dict[Path, Path]:
    """Return the path of each image's picture; InputError where two would have one name, or would replace an input."""
    require_folder(folder)
    outputs: dict[Path, Path] = {}
    taken: dict[Path, Path] = {}
    for image in images:
        outputs[image] = folder / f"{image.stem}{ending}"
        if taken.setdefault(outputs[image], image) != image:
            raise InputError(f"{image} and {taken[outputs[image]]} would both become {outputs[image]}: one at a time")
    for output in (*outputs.values(), folder / about):
        if output.exists() and any(output.samefile(image) for image in images):
            raise InputError(f"{output}: is an input, and the output would replace it: name another folder")
    return outputs


def _camera(args: UndistortArguments, calibration: Calibration) -> tuple[str, str | None, scene.Camera]:
    """Return the names of the camera and its station (None if ambiguous), and the camera, posed if it has a station."""
    owners = {name: station.camera for name, station in calibration.estimate.stations.items()}
    wanted = set(calibration.cameras) if args.camera is None else {args.camera}
    if args.station is None and len(wanted) == 1 and list(owners.values()).count(*wanted) > 1:
        (name,) = wanted
        return name, None, calibration.cameras[name]  # several stations: straight images need no pose
    station = station_of(args.calibration, args.station, calibration, args.camera)
    return owners[station], station, calibration.stations[station]


# ---- pictures -------------------------------------------------------------------------------------------------------


_PictureMaker = tuple[Callable[[Path], tuple["Image", dict[str, Any], str]], Mapping[str, Any], str]
"""Function from a path to a picture, facts and a line about it; facts on all pictures; and a description of these."""


def _read(path: Path, camera: scene.Camera, name: str) -> Image:
    return report.read_photograph(path, camera.image_size, name)


def _write(path: Path, picture: Image) -> None:
    jpeg_quality = 95

    picture = report.in_8_bit_colour(picture) if path.suffix == ".jpg" else picture
    save(path, detect.encoded(picture, path.suffix, jpeg_quality))


def _straight(args: UndistortArguments, calibration: Calibration) -> _PictureMaker:
    name, station, camera = _camera(args, calibration)
    straight = report.straighten(camera, whole=args.whole, size=args.size, phi=args.phi, angle_deg=args.angle)
    pose = straight.camera.cam_from_world
    posed = {"rotation": pose.rotation, "translation_m": pose.translation, "position_m": pose.position}
    facts = {
        "camera": name,
        "station": station,
        "matrix": straight.camera.matrix.tolist(),
        **scene.camera_to_json(straight.camera),
        **({} if station is None else posed),
        "view_deg": list(straight.view_deg),
        "shown": straight.share,
        "limit_deg": straight.limit_deg,
        "black_px": straight.warp.black,
    }
    (width, height), (across, down) = straight.camera.image_size, straight.view_deg
    line = (
        f"{width} x {height} px, phi {straight.camera.phi:.2f} px, {across:.1f} x {down:.1f} degrees, "
        f"{100.0 * straight.share:.1f} % of the photograph, {_black(straight.warp.size, straight.warp.black)}"
    )
    if args.whole and straight.limit_deg is not None:
        line += f"; nothing from {straight.limit_deg:.1f} degrees off the axis on"
    words = "the straight image's camera: its matrix K, no distortion" + ("" if station is None else ", its pose")
    return lambda path: (straight.warp.apply(_read(path, camera, name)), {}, line), facts, words


def _black(size: tuple[int, int], count: int) -> str:
    return "nothing black" if count == 0 else f"{count} px ({100.0 * count / (size[0] * size[1]):.1f} %) black"


def _top_view(args: UndistortArguments, calibration: Calibration) -> _PictureMaker:
    station = station_of(args.calibration, args.station, calibration, args.camera)
    camera, name = calibration.stations[station], calibration.estimate.stations[station].camera
    area = args.area or _field(calibration)
    mm_per_px = 5.0 if args.mm_per_px is None else args.mm_per_px
    grid = report.make_grid(area, mm_per_px / 1000.0, arguments.metres(args.height_mm))
    warp = report.top_view(camera, grid)
    x0, y0, x1, y1 = grid.area_m
    facts = {
        "camera": name,
        "station": station,
        "image_size": list(grid.size),
        "mm_per_px": mm_per_px,
        "area_m": [x0, y0, x1, y1],
        "height_m": grid.height_m,
        "top_left_pixel_m": grid.places([[0.0, 0.0]])[0].tolist(),
        "black_px": warp.black,
    }
    line = (
        f"{grid.size[0]} x {grid.size[1]} px of {mm_per_px:g} mm, x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m "
        f"at {1e3 * grid.height_m:g} mm, {_black(grid.size, warp.black)}"
    )
    return (lambda path: (warp.apply(_read(path, camera, name)), {}, line), facts, "scale and area: x right, y up")


def _field(calibration: Calibration) -> Area:
    margin_m = 0.3  # margin around the field in a top view

    try:
        x, y = posterior.field_grid(calibration.targets)
    except InputError:
        raise InputError("the calibration has no field to be seen from above: say --area X0,Y0,X1,Y1") from None
    ends = (x[0] - margin_m, y[0] - margin_m, x[-1] + margin_m, y[-1] + margin_m)
    x0, y0, x1, y1 = (round(float(end), 9) for end in ends)
    return x0, y0, x1, y1


def _overlay(args: UndistortArguments, calibration: Calibration) -> _PictureMaker:
    station = station_of(args.calibration, args.station, calibration, args.camera)
    height = arguments.metres(args.height_mm)
    camera, name = calibration.stations[station], calibration.estimate.stations[station].camera
    before = None if args.before is None else read_calibration(args.before)
    observations = None if args.observations is None else read_observations([args.observations])
    known = {} if observations is None else {f.name: f for f in report.frames_of(observations) if f.station == station}

    def picture(path: Path) -> tuple[Image, dict[str, Any], str]:
        image, called = _read(path, camera, name), frame_of(path)
        if observations is not None and called not in known:
            raise InputError(f"{path}: {args.observations} has no frame {called!r} of station {station!r}")
        frame = known.get(called) or report.frame_by_name(calibration, station, called)
        layers, model = list[report.Layer](), report.model_of(calibration, frame)
        facts: dict[str, Any] = {"shown": [list(one) for one in frame.shown], "in_view": model.in_view}
        line = f"{', '.join(target for target, _ in frame.shown)}: {model.in_view} lines and points in view"
        if before is not None:
            earlier = report.model_of(before, frame)
            layers.append(report.Layer(earlier, f"before: {Path(args.before or '').name}", "before"))
            facts["moved_px"] = moved = model.apart_px(earlier)
            line += f"; {moved[0]:.2f} px from before in the median, {moved[1]:.2f} px at most"
        if height:
            lifted = report.model_of(calibration, frame, height)
            layers.append(report.Layer(lifted, f"{1e3 * height:g} mm above", "lifted"))
        layers.append(report.Layer(model, args.calibration.name, "after"))
        layers += () if observations is None else report.marks_of(calibration, observations, frame)
        return report.draw_overlay(image, layers), facts, line

    return picture, {"camera": name, "station": station}, "what was drawn"
