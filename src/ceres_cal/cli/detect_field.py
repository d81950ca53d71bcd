"""`ceres-cal detect field`: painted lines, arcs, corners and crossings of a field in photographs of one station."""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.command import Answer, Command, add_output, finishing, parse_numbers, plural, require_output
from ceres_cal.cli.detect import image_files, parse_names, require_observations_file
from ceres_cal.cli.progress import ProgressBar

if TYPE_CHECKING:
    from ceres_cal.photographs import Auto, Clicks, Facing, FieldDetections
    from ceres_cal.scene.camera import Camera
    from ceres_cal.scene.targets import Target

_CORNER = "TopLeftCorner=102,88"
_FACING = "LeftGoalLine=top"


def _add_arguments(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "images", nargs="+", metavar="IMAGE", help="photographs that one camera took at one station, or folders of them"
    )
    add(
        "--target",
        metavar="TARGET",
        help="a field by its name (such as ssl-a, ssl-b: `ceres-cal targets`), or a JSON file with a target "
        "({'kind': ...}) or with a target named 'field'; default: that of the calibration to start from",
    )
    add("--start", metavar="FILE", type=Path, help="a calibration of before, or a file of corners (ceres-cal/corners)")
    add(
        "--corner",
        action="append",
        default=[],
        metavar="NAME=X,Y",
        help=f"instead of --start: four points or more where they are seen, roughly, such as {_CORNER}; repeatable",
    )
    add(
        "--auto",
        action="store_true",
        help="without any start: find the field in the photograph; with --start CALIBRATION, however far it has moved",
    )
    add(
        "--facing",
        action="append",
        default=[],
        metavar="NAME=SIDE",
        help="with --auto: which way round a field is that looks alike turned, by the side of the picture (left, "
        f"right, top, bottom, top-left, ...) that a line or point lies towards, such as {_FACING}; it need not be in "
        "the picture; repeatable",
    )
    add("--not-painted", default="", metavar="NAME,...", help="lines of the target that this field does not have")
    add("--edges", action="store_true", help="both edges of each line instead of its middle")
    add("--lines-only", action="store_true", help="no corners and crossings")
    add("--camera", metavar="NAME", help="name of the camera; default: that of the calibration, or camera")
    add("--station", metavar="NAME", help="name of the station, to start from and to write; default: likewise")
    add_output(parser, "the observations (.json or .npz)", required=True)
    add("--quiet", action="store_true", help="no progress")


def _run(args: Namespace) -> Answer:
    images = list(image_files(args.images))
    require_output(args.output, [*images, *([args.start] if args.start else [])])
    require_observations_file(args.output)
    if (args.start is not None) + bool(args.corner) != 1 and not (args.auto and not args.corner):
        raise InputError(f"say where to start: --start FILE, or --corner {_CORNER} four times, or --auto")
    if args.auto and args.corner:
        raise InputError("--corner says where to start and --auto to do without: give one of them")
    if args.facing and not args.auto:
        raise InputError("--facing goes with --auto: a start says which way round the field is")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # what it warns of in an image, we say ourselves
    from ceres_cal.photographs import detect_field

    start = _start(args)
    target = start.target if args.target is None else _target(args.target)
    if target is None:
        raise InputError("name the field with --target, such as --target ssl-b")
    left_out = parse_names(args.not_painted)
    if unknown := sorted(set(left_out) - target.curves.keys()):
        raise InputError(f"--not-painted: curve {unknown[0]!r} is not one of the target's: see `ceres-cal targets`")
    with ProgressBar(silent=args.quiet or args.json) as bar:
        found = detect_field(
            images,
            target,
            start.start,
            [name for name in target.curves if name not in left_out],
            camera=start.camera,
            station=start.station,
            with_points=not args.lines_only,
            edges=args.edges,
            progress=bar.update,
        )
    with finishing():
        found.observations.save(args.output)
    data = _data(found, args.output)
    return Answer(data, lambda: _text(data))


COMMANDS = (Command("detect field", "painted lines and crossings of a field in photographs", _add_arguments, _run),)


# ---- where to start -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Start:
    start: Camera | Clicks | Auto
    camera: str
    station: str
    target: Target | None


def _start(args: Namespace) -> _Start:
    camera = args.camera or "camera"
    if args.start is None and args.auto:
        return _Start(_auto(args.facing, None), camera, args.station or camera, None)
    if args.start is None:
        return _Start(_corners(args.corner), camera, args.station or camera, None)
    from ceres_cal.calibration import FORMAT, Calibration
    from ceres_cal.photographs.clicks import load_clicks
    from ceres_cal.photographs.known import is_painted

    if _json(args.start).get("format") != FORMAT:
        if args.auto:
            raise InputError(f"{args.start}: with --auto only a calibration is of use: leave out --auto, or the file")
        return _Start(load_clicks(args.start), camera, args.station or camera, None)
    calibration = Calibration.load(args.start)
    posed = calibration.station(args.station)
    station = args.station or next(iter(calibration.stations))
    fields = [target for target in calibration.targets.values() if is_painted(target)]
    name = args.camera or calibration.estimate.stations[station].camera
    start = _auto(args.facing, posed) if args.auto else posed
    return _Start(start, name, station, fields[0] if len(fields) == 1 else None)


def _auto(facing: list[str], before: Camera | None) -> Auto:
    from ceres_cal.photographs import Auto

    return Auto(tuple(_facing(spec) for spec in facing), before)


def _facing(spec: str) -> Facing:
    from ceres_cal.photographs import SIDES, Facing

    name, equals, side = (part.strip() for part in spec.partition("="))
    if not (name and equals and side in SIDES):
        raise InputError(f"--facing {spec!r}: write NAME=SIDE, such as {_FACING}; a side is one of {', '.join(SIDES)}")
    return Facing(name, side)


def _corners(specs: list[str]) -> Clicks:
    from ceres_cal.photographs import Clicks

    points: dict[str, tuple[float, float]] = {}
    for spec in specs:
        where = f"--corner {spec!r}"
        name, equals, place = spec.partition("=")
        numbers = parse_numbers(place, where) if equals else ()
        if len(numbers) != 2:
            raise InputError(f"{where}: write NAME=X,Y, such as {_CORNER}")
        if name.strip() in points:
            raise InputError(f"{where}: {name.strip()} is given twice")
        points[name.strip()] = (numbers[0], numbers[1])
    return Clicks(points)


def _target(text: str) -> Target:
    from ceres_cal.scene.targets import target_from_spec, targets_by_name

    by_name = targets_by_name()
    if text in by_name:
        return by_name[text]
    if not Path(text).exists():
        raise InputError(f"--target {text!r}: neither {' nor '.join(by_name)}, nor a file")
    content = _json(Path(text))
    named = content.get("targets")
    spec = named.get("field") if isinstance(named, dict) else content
    if not isinstance(spec, dict):
        raise InputError(f"{text}: it holds no target named 'field'")
    return target_from_spec(spec, text)


def _json(path: Path) -> Mapping[str, Any]:
    from ceres_cal.base.files import parse_json, read_bytes

    content = parse_json(read_bytes(path), str(path))
    if not isinstance(content, dict):
        raise InputError(f"{path}: it must hold one JSON object")
    return content


# ---- the answer -----------------------------------------------------------------------------------------------------


def _data(found: FieldDetections, output: Path) -> dict[str, Any]:
    images = []
    for path, followed in found.found.items():
        lines = followed.lines
        images.append(
            {
                "image": path,
                "places": len(lines.found),
                "found": int(lines.found.sum()),
                "sigma_px": float(sorted(lines.sigma_px[lines.found])[int(lines.found.sum()) // 2]),
                "blur_px": lines.blur_px,
                "width_factor": lines.stretch,
            }
        )
        if path in found.searched:
            ways, settled_by = found.searched[path].ways, found.searched[path].settled_by
            images[-1]["searched"] = {"ways": ways, "settled_by": settled_by or None}
    return {
        "output": str(output),
        "points": len(found.observations.points),
        "curves": len(found.observations.curves),
        "found": images,
        "missed": [{"image": path, "reason": reason} for path, reason in found.missed],
    }


def _text(data: dict[str, Any]) -> str:
    shown, every = len(data["found"]), len(data["found"]) + len(data["missed"])
    lines = [
        f"{shown} of {every} images show the field: {plural(data['curves'], 'line observation')}, "
        f"{plural(data['points'], 'corner')} and crossings"
    ]
    lines += [
        f"{one['image']}: paint at {one['found']} of {one['places']} places, good to {one['sigma_px']:.3f} px; "
        f"blur {one['blur_px']:.2f} px, lines {one['width_factor']:.2f} times as wide as the target says"
        for one in data["found"]
    ]
    lines += [
        f"{one['image']}: found without a start, {_ways(one['searched'])}" for one in data["found"] if "searched" in one
    ]
    lines += [f"{one['image']}: {one['reason']}" for one in data["missed"]]
    return "\n".join([*lines, f"written to {data['output']}"])


def _ways(searched: dict[str, Any]) -> str:
    """In how many ways a photograph could be taken for the field, and what chose one."""
    if searched["settled_by"] is None:
        return "in the one way it can be seen"
    by = {"facing": "--facing", "before": "the calibration of before"}[searched["settled_by"]]
    return f"in one of the {searched['ways']} ways it can be seen: {by} says which"
