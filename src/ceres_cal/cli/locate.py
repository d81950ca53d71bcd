"""`ceres-cal locate` and `ceres-cal project`: use of a calibration, from pixels to metres and back."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ceres_cal import base, scene
from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import calibration_argument, height_option, metres, parse_number, station_option
from ceres_cal.cli.command import Arguments, argument, command, option
from ceres_cal.cli.files import read_calibration, station_of
from ceres_cal.report.document import Document, Section


def _rows_argument(rows: str, example: str) -> Any:
    return argument(rows, f"such as {example}; - reads lines of these from standard input", (), read=str)


class PlacesArguments(Arguments):
    """A calibration, and the file from which places or pixels may come."""

    calibration: Path = calibration_argument()
    file: str | None = option("read lines of these from a file instead", "CSV")
    station: str | None = station_option()


@command(
    "locate",
    "where on the field, or at a height above it, pixels lie (m)",
    "calibration.json 640,480 100,100 --height-mm 150",
    "calibration.json --file pixels.csv --json",
)
def _locate(
    args: PlacesArguments,
    rows: tuple[str, ...] = _rows_argument("X,Y", "640.5,480.2 (px)"),
    height_mm: float | None = height_option(
        "height of what is seen above the field, 150 or 0.15m; default: 0, the floor"
    ),
) -> Document:
    import numpy as np

    pixels = _read_rows(rows, args.file, (2,))
    height = metres(height_mm)
    name, camera = _station(args)
    inside = scene.in_image(pixels, camera.image_size)
    points = np.where(inside[:, None], camera.locate(pixels, height), np.nan)  # the lens is unknown outside the image
    lost = {row: _why_not_located(camera, pixels[row], height) for row in _rows_without_answer(points)}
    data = {"station": name, "height_m": height, "pixels": pixels.tolist()}
    return _answer({**data, "points_m": _or_null(points)}, points, lost)


@command("project", "where points of the world appear in the image (px)", "calibration.json -2.5,1.0 -2.5,1.0,0.15")
def _project(
    args: PlacesArguments, rows: tuple[str, ...] = _rows_argument("X,Y[,Z]", "-2.5,1.0 or -2.5,1.0,0.15 (m)")
) -> Document:
    points = _read_rows(rows, args.file, (2, 3))
    name, camera = _station(args)
    pixels = camera.project(points)
    lost = {row: _why_not_projected(camera, points[row]) for row in _rows_without_answer(pixels)}
    data = {"station": name, "points_m": points.tolist()}
    return _answer({**data, "pixels": _or_null(pixels)}, pixels, lost)


def _station(args: PlacesArguments) -> tuple[str, scene.Camera]:
    calibration = read_calibration(args.calibration)
    name = station_of(args.calibration, args.station, calibration)
    return name, calibration.stations[name]


# ---- reading --------------------------------------------------------------------------------------------------------


def _read_rows(given: Sequence[str], file: str | None, sizes: tuple[int, ...]) -> base.Array:
    """(N, largest size) numbers from the arguments, a file or standard input; a missing number is 0."""
    import numpy as np

    rows = [_numbers(text, sizes, where) for where, text in _texts(given, file)]
    if not rows:
        raise InputError("nothing was given: name at least one place, or --file")
    return np.array([row + [0.0] * (max(sizes) - len(row)) for row in rows])


def _texts(given: Sequence[str], file: str | None) -> Iterator[tuple[str, str]]:
    """Yield the texts to read numbers from, each with its name in messages."""
    if file is not None and given:
        raise InputError("give places as arguments or by --file, not both")
    if file == "-" or tuple(given) == ("-",):
        yield from _lines(sys.stdin, "standard input")
    elif file is not None:
        yield from _lines(base.read_bytes(file).decode("utf-8-sig", errors="replace").splitlines(), file)
    else:
        yield from ((f"argument {text!r}", text) for text in _places(given))


def _places(arguments: Iterable[str]) -> list[str]:
    """Return a text for each place, wherever spaces are: 640,480 or 640, 480 or 640 480; several places need commas."""
    typed = re.sub(r"\s*,\s*", ",", " ".join(arguments)).split()
    return typed if any("," in text for text in typed) else [" ".join(typed)] if typed else []


def _lines(lines: Iterable[str], where: str) -> Iterator[tuple[str, str]]:
    """Yield the lines with numbers: without empty lines, comments (#), and a header of names."""
    for number, line in enumerate(lines, start=1):
        text = line.partition("#")[0].strip()
        is_header = number == 1 and all(part.strip().isidentifier() for part in re.split("[,;\t]", text))
        if text and not is_header:
            yield f"{where}, line {number}", text


def _numbers(text: str, sizes: tuple[int, ...], where: str) -> list[float]:
    if ";" in text:  # as in spreadsheets with decimal commas
        text = text.replace(",", ".").replace(";", ",")
    parts = text.split(",") if "," in text else text.split()
    if len(parts) not in sizes:
        example = "640,480" if sizes == (2,) else "-2.5,1.0"
        raise InputError(f"{where}: give {' or '.join(map(str, sizes))} numbers with commas between, such as {example}")
    return [parse_number(part, where) for part in parts]


# ---- answering ------------------------------------------------------------------------------------------------------


def _rows_without_answer(values: base.Array) -> list[int]:
    import numpy as np

    return [int(row) for row in np.flatnonzero(np.isnan(values[:, 0]))]


def _or_null(values: base.Array) -> list[list[float] | None]:
    return [None if row[0] != row[0] else row for row in values.tolist()]


def _why_not_located(camera: scene.Camera, pixel: base.Array, height_m: float) -> str:
    import numpy as np

    radius = camera.lens.monotone_radius(camera.phi)
    if camera.rays(pixel[None])[0, 0] != camera.rays(pixel[None])[0, 0]:
        reach = f"more than {radius:.0f} px from the principal point, where the lens cannot be inverted"
        return f"it lies {reach if radius < np.inf else 'too far outside the image for the lens'}"
    if not scene.in_image(pixel, camera.image_size):
        return "it lies outside the image of {} x {} px: check its coordinates".format(*camera.image_size)
    return f"its ray does not meet the plane z = {height_m:g} m in front of the camera"


def _why_not_projected(camera: scene.Camera, point: base.Array) -> str:
    if camera.cam_from_world.transform(point)[2] <= 0.0:
        return "it lies behind the camera"
    return "it lies outside the field of view of the lens"


def _answer(data: dict[str, Any], values: base.Array, lost: dict[int, str]) -> Document:
    lines = [f"{x:.4f} {y:.4f}" for x, y in values.tolist()]
    for row, reason in lost.items():
        lines[row] = f"no answer: {reason}"
    reasons = [{"row": row, "reason": reason} for row, reason in lost.items()]
    return Document((Section("", lines, {**data, "no_answer": reasons}),), 1 if lost else 0)
