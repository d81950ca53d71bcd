"""Inputs and outputs of commands: files are checked before any long work; results are written all or none."""

from __future__ import annotations

import os
import re
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ceres_cal import base, detect, diagnostics, observations, report, scene
from ceres_cal.base import CalibrationError, InputError, attempt, image_files, no_such
from ceres_cal.cli.arguments import ReportArguments, is_described, parse_board, parse_priors
from ceres_cal.cli.terminal import ProgressBar
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration, LensChoice
    from ceres_cal.observations import Observations
    from ceres_cal.problem.quantities import Range

T = TypeVar("T")


def _is_chessboard(text: str) -> bool:
    return re.fullmatch(r"\d+x\d+x.+", text) is not None


def is_board(text: str) -> bool:
    """Whether a target is spelled as a chessboard, or describes a movable target."""
    return _is_chessboard(text) or (is_described(text) and read_target(text, "field").movable)


def read_board(text: str) -> scene.Target:
    """Return the board of `--board`: COLUMNSxROWSxMM, or described as for `--target`."""
    return read_target(text, "board", "--board") if is_described(text) else scene.checkerboard(*parse_board(text))


def spelled_target(text: str, where: str) -> scene.Target | None:
    """Return a target that is spelled out, as a chessboard such as 9x6x25mm or as `{"kind": ...}`; None for anything
    else, such as a name or a file.
    """
    if _is_chessboard(text):
        return scene.checkerboard(*parse_board(text))
    if not text.lstrip().startswith("{"):
        return None
    return scene.target_from_spec(base.parse_json(text.encode(), where), where)


def require_file_of_targets(text: str, names: Iterable[str]) -> Path:
    """Return the file to read a target from; InputError, which says how targets are named, if there is none."""
    if Path(text).suffix or Path(text).exists():
        return Path(text)
    raise InputError(f"{no_such('target', text, names)} (or a board such as 9x6x25mm, or a file)")


def read_target(text: str, name: str, where: str = "--target") -> scene.Target:
    """Return the target of `--target`: by name, spelled out, or from a file, alone or by this name among several."""
    if (spelled := spelled_target(text, where)) is not None:
        return spelled
    if (known := scene.target_named(text)) is not None:
        return known
    content = json_object(require_file_of_targets(text, scene.targets_by_name()))
    named = content.get("targets")
    spec = named.get(name) if isinstance(named, dict) else content
    if not isinstance(spec, dict):
        raise InputError(f"{text}: it holds no target named {name!r}")
    return scene.target_from_spec(spec, text)


def require_shown(
    images: Sequence[Path],
    target: str | None,
    board: str | None,
    priors: Sequence[str],
    cameras: Sequence[str] = ("camera",),
    lens: str = "auto",
) -> scene.Target | None:
    """Return the field that photographs are to show. Raise InputError, before any photograph is searched, where what is
    stated of the field, the board or the camera is impossible.
    """
    from ceres_cal.problem import Options, camera_ranges, floor_of, place_ranges

    least = 0.1  # least size of a field that can be found, as a share of the picture's diagonal
    if board is not None:
        detect.finder_of(read_board(board))
    field = None if target is None else read_target(target, "field")
    for prior in parse_priors(priors, {"station": cameras, "camera": cameras}, Options(lens=lens)):
        bounds: list[Range] = []
        if field is not None and prior.owner == "station":
            ranges = place_ranges(field.places, least, "a tenth of the picture", floor_of(field.places))
            bounds = list(ranges[-len(prior.value) :])
        elif images and prior.owner == "camera":
            height, width = detect.read_colour(images[0]).shape[:2]
            bounds = list(camera_ranges(prior.quantity, (width, height), None))
        for bound, value in zip(bounds, prior.value, strict=False):
            bound.require(value, f"the prior on {prior.quantity}")
    return field


def json_object(path: Path) -> Mapping[str, Any]:
    """Return the JSON object in a file; InputError where it is none."""
    content = base.parse_json(base.read_bytes(path), str(path))
    if not isinstance(content, dict):
        raise InputError(f"{path}: it must hold one JSON object")
    return content


def require_different(files: Iterable[str | Path]) -> None:
    """Raise InputError for a file that is given twice: its observations would seem better than they are."""
    given: set[str] = set()
    for file in files:
        place = os.path.realpath(file)
        if place in given:
            raise InputError(f"{file}: given twice: name every file once")
        given.add(place)


def require_frames_apart(images: Iterable[Path]) -> None:
    """Raise InputError for two photographs of a camera with one name: a report could not tell their frames apart."""
    named: dict[str, Path] = {}
    for image in images:
        if (other := named.setdefault(base.frame_of(image), image)) != image:
            raise InputError(f"{image}: has the same name as {other}: rename or remove one, as names identify frames")


def read_calibration(path: Path) -> Calibration:
    """Load the calibration of a file."""
    from ceres_cal.calibration import Calibration

    return Calibration.load(path)


def read_observations(paths: Iterable[str | Path]) -> Observations:
    """Load and combine files of observations."""
    from ceres_cal.observations import Observations

    return observations.combine([Observations.load(path) for path in paths])


def station_of(path: Path, station: str | None, calibration: Calibration, camera: str | None = None) -> str:
    """Return the name of the station in --station, or of the only one in a calibration from a file, or of --camera."""
    stations = calibration.estimate.stations
    if camera is not None and camera not in calibration.cameras:
        raise InputError(no_such("camera", camera, calibration.cameras))
    if station is not None:
        calibration.station(station)  # raises InputError that lists the stations
    fitting = [name for name, one in stations.items() if station in (None, name) and camera in (None, one.camera)]
    if station is not None and not fitting:
        raise InputError(f"station {station!r} is of camera {stations[station].camera!r}: leave out --camera")
    if len(fitting) > 1:
        raise InputError(f"{path} has several stations, name one: --station {' or '.join(fitting)}")
    return fitting[0]


# ---- files ----------------------------------------------------------------------------------------------------------


def require_output(path: Path | None, inputs: Iterable[str | Path], what: str = "", *endings: str) -> None:
    """Raise InputError, before any long work, where a result cannot be written, would replace an input, or has an
    ending that is not supported; `what` such as "the table is".
    """
    if path is None:
        return
    if not path.parent.is_dir():
        raise InputError(f"{path}: cannot be written: there is no folder {str(path.parent)!r}: make it first")
    if path.is_dir():
        raise InputError(f"{path}: cannot be written: it is a folder: name a file in it")
    if not os.access(path.parent, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
        raise InputError(f"{path}: cannot be written: Permission denied: name another place")
    if path.exists() and any(Path(given).exists() and path.samefile(given) for given in inputs):
        raise InputError(f"{path}: is an input, and the output would replace it: name another file")
    if what and path.suffix not in endings:
        known = " or ".join(filter(None, (", ".join(endings[:-1]), endings[-1])))
        raise InputError(f"{path}: {what} written as {known}: give {'one of these endings' if endings[1:] else 'that'}")


def require_folder(path: Path) -> None:
    """Raise InputError, before any long work, where a folder for results is a file."""
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file: name a folder")


@contextmanager
def folder_of_results(folder: Path) -> Iterator[None]:
    """Context that creates missing folders, and removes these at the end if nothing was written into them."""
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    base.make_folder(folder)
    try:
        yield
    finally:
        for one in missing:
            if not any(one.iterdir()):
                one.rmdir()


def require_observations_output(path: Path, inputs: Iterable[str | Path]) -> None:
    """Apply `require_output` to a file of observations."""
    require_output(path, inputs, "observations are", ".json", ".npz")


def require_outputs(args: ReportArguments, inputs: Sequence[str | Path]) -> None:
    """Apply `require_output` to output and report; they must be two files, and the report must end like a page."""
    require_output(args.output, inputs)
    if args.output and args.report and os.path.realpath(args.output) == os.path.realpath(args.report):
        raise InputError(f"{args.report}: is named as output and as report: give them two names")
    require_output(args.report, inputs, "a report is", ".html", ".htm")


@contextmanager
def finishing() -> Iterator[None]:
    """Context in which Ctrl-C and SIGTERM are ignored while results are written: an interrupted command has written
    nothing.
    """
    if threading.current_thread() is not threading.main_thread():  # Ctrl-C does not arrive in other threads
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def save(path: Path, made: Any) -> None:
    """Write a result whole or not at all: bytes, a mapping as JSON, or an object that saves itself."""
    with finishing():
        if isinstance(made, bytes):
            base.write_bytes(path, made)
        elif isinstance(made, Mapping):
            base.write_json(path, made)
        else:
            made.save(path)


def write_results(args: ReportArguments, save: Callable[[Path], None], page: str | None) -> tuple[Section, Section]:
    """Write the output by `save`, and the page of the report if there is one. The first section says why the report
    could not be written (see `attempted`), the second names the files.
    """
    report, unwritten = None if page is None else args.report, Section()
    with finishing():
        if args.output is not None:
            save(args.output)
        if page is not None and report is not None:
            _, unwritten = attempted("report", partial(base.write_bytes, report, page.encode()))
    paths = {"output": args.output, "report": None if unwritten.data else report}
    named = {name: None if path is None else str(path) for name, path in paths.items()}
    return unwritten, Section("written", [path for path in named.values() if path is not None], named)


def attempted(what: str, make: Callable[[], T]) -> tuple[T | None, Section]:
    """Make something after the answer is known. If that fails, the answer is kept and the section reports the failure;
    otherwise the section is empty.

    A command whose section is not empty ends with exit code 1.
    """
    made = attempt(make)  # reads: "error     no report: ..."
    if isinstance(made, CalibrationError):
        return None, Section("error", [f"no {what}: {made}"], {"not_made": {what: str(made)}})
    return made, Section()


# ---- the report -----------------------------------------------------------------------------------------------------


def report_photographs(
    args: ReportArguments,
    observations: Observations,
    before: Calibration | None = None,
    detected_in: Sequence[Path] = (),
) -> report.FramePhotographs | None:
    """Return the photographs of `--report PAGE --images FOLDER` that belong to the observations' frames; None without
    any.

    Args:
        detected_in: photographs in which the observations were just detected: a report shows them without being asked.

    Raises:
        InputError: no image has the name of a frame, or two images have the name of one frame.
    """
    images = image_files(args.images) if args.images else list(detected_in)
    if not images or args.report is None:
        return None

    known = report.photographs_of(images, observations)
    if not known:
        raise InputError(
            f"none of the {len(images)} images is called like a frame of the observations, such as "
            f"{observations.views[0].frame!r}: --images takes the photographs that were observed"
        )
    return report.FramePhotographs(known, before)


def report_page(
    args: ReportArguments,
    calibration: Calibration,
    observations: Observations,
    photographs: report.FramePhotographs | None,
    diagnosis: diagnostics.Diagnosis | None = None,
    choices: Mapping[str, LensChoice] | None = None,
) -> tuple[str | None, Section]:
    """Return the page that --report asks for, or None; see `attempted`."""
    if args.report is None:
        return None, Section()

    with ProgressBar(args.silent) as bar:
        make = partial(report.make_report, calibration, observations, diagnosis, choices, photographs, bar.update)
        return attempted("report", make)


def calibrated(
    args: ReportArguments,
    calibration: Calibration,
    observations: Observations,
    photographs: report.FramePhotographs | None,
    names: Sequence[str],
    *before: Section,
    is_observed_now: bool = False,
) -> Document:
    """Write a calibration and its report; return the document on it. `names`: of the observations, or of photographs
    where these are observed now. `before`: sections that come first.
    """
    page, unmade = report_page(args, calibration, observations, photographs)
    quality = report.quality_of(calibration, observations)
    answer = report.calibration_sections(quality, names, is_observed_now=is_observed_now)
    unwritten, written = write_results(args, calibration.save, page)
    return Document((*before, *answer, unmade, unwritten, written), 1 if unmade.data or unwritten.data else 0)
