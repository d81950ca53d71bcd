"""The commands as functions, with their options: photographs and observations in, Python objects out."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Literal, NoReturn

from ceres_cal import detect, moves, start
from ceres_cal.base import ImageProgress, Images, InputError, checked, image_files, images_and_videos, no_such
from ceres_cal.calibration import Calibration
from ceres_cal.moves.agreement import FALSE_ALARMS, Agreements
from ceres_cal.observations import Observations, Prior, combine
from ceres_cal.scene import Camera, Target, target_named, targets_by_name

if TYPE_CHECKING:
    from ceres_cal.problem.bundle import SolveProgress

# ---- detection ------------------------------------------------------------------------------------------------------


@checked
def detect_board(
    images: Images,
    board: Target,
    *,
    camera: str = "camera",
    station: str | None = None,
    corner_fit: str = "saddle",
    frames: int = 30,
    folder: str | PathLike[str] | None = None,
    progress: ImageProgress | None = None,
) -> detect.BoardDetections:
    """Find a board in photographs or videos of one camera: `detect_board("photographs/", checkerboard(9, 6, 0.025))`.

    Args:
        images: photographs, folders, patterns or videos. board: a checkerboard, ChArUco board, circle grid,
            AprilGrid or markers.
        camera: its name in the observations. station: its name there, by default the camera's.
        corner_fit: "saddle", which also measures boards partly out of the picture, or "opencv".
        frames: number of frames to extract from each video.
        folder: where these are kept; by default they are not.
        progress: called after each image with (steps done, steps in all, file name).

    Raises:
        InputError: an image cannot be read, or no image shows the board.
    """
    detect.finder_of(board, corner_fit)  # raises for what does not fit, before any video is read
    photographs, videos = images_and_videos(images)
    with nullcontext(folder) if folder else TemporaryDirectory() as place:
        photographs += detect.frames_of_videos(videos, frames, Path(place), progress)
        return detect.detect_boards(photographs, board, camera, station, corner_fit, progress)


@checked
def detect_field(
    images: Images | Callable[[], Images],
    target: Target | str | None = None,
    start: Calibration | Camera | detect.Clicks | Mapping[str, tuple[float, float]] | None = None,
    *,
    auto: bool = False,
    facing: Mapping[str, str] | None = None,
    not_painted: Sequence[str] = (),
    estimate: Sequence[Prior] = (),
    mask: str | PathLike[str] | None = None,
    edges: bool = False,
    points: bool = False,
    keep_start: bool = False,
    camera: str | None = None,
    station: str | None = None,
    refused: Callable[[Path, detect.SearchResult], None] | None = None,
    progress: ImageProgress | None = None,
) -> detect.FieldDetections:
    """Find the painted lines of a field in photographs of one station.

    Args:
        images: photographs that one camera took at one station, or a function that returns them, which is called after
            all other arguments were checked. target: the field, such as `ssl_field("B")` or "ssl-b"; by default that of
            the calibration to start from.
        start: where the camera was before, or four or more named points with their approximate pixels. Without a start
            the field is found in the photograph.
        auto: whether to find the field also where a calibration is given as start, however far the camera has moved.
        facing: orientation of a symmetric field: a line or point -> the side of the picture towards which it lies, such
            as {"LeftGoalLine": "top"}.
        not_painted: lines of the target that this field does not have. estimate: dimensions to solve for.
        mask: a picture of the same size; its black parts are left out. edges: whether to measure both edges of each
            line.
        points: whether to measure corners and crossings, too, where the lines lead to. keep_start: the start is
            accurate to 12 px.
        camera: its name in the observations, by default that of the calibration, or "camera". station: its name there,
            by default that of the calibration, or the camera's.
        refused: called with the path of each image that does not show the field, and what was seen in it.
        progress: called after each image with (steps done, steps in all, file name).

    Raises:
        InputError: an image cannot be read, or a name does not fit. NothingShownError: no image shows the field.
    """
    sides = facing or {}
    if sides and not auto and start is not None:
        raise InputError("facing is for a search without a start: a start says which way round the field is")
    posed: Camera | detect.Clicks | detect.Auto
    if isinstance(start, Calibration):
        posed, station = start.station(station), start.estimate.station_name(station)
        camera = camera or start.estimate.stations[station].camera
        target = target or field_of(start)
    elif isinstance(start, Mapping):
        if auto:
            raise InputError("auto looks for the field without points: leave out auto, or the points")
        posed = detect.Clicks(dict(start))
    elif start is not None:
        posed = start
    if start is None or auto:
        before = None if start is None or not isinstance(posed, Camera) else posed
        posed = detect.Auto(tuple(detect.Facing(*one) for one in sides.items()), before)
    if isinstance(target, str):
        target = target_named(target) or _no_target(target)
    if target is None:
        raise InputError("target is missing: name the field, such as ssl_field('B')")
    painted = lines_to_find(target, sides, not_painted, estimate)
    options = detect.FieldOptions(
        camera or "camera",
        station or camera or "camera",
        points=points,
        edges=edges,
        lengths=tuple(estimate),
        left_out=None if mask is None else detect.read_grey(Path(mask)) == 0,
        keep_start=keep_start,
        refused=refused,
    )
    if isinstance(posed, detect.Clicks):
        posed.require_names(target)
    paths = image_files(images() if callable(images) else images)
    return detect.detect_field(paths, target, posed, painted, options, progress)


def _no_target(name: str) -> NoReturn:
    raise InputError(no_such("target", name, targets_by_name()))


def lines_to_find(
    target: Target, facing: Mapping[str, str], not_painted: Sequence[str] = (), lengths: Sequence[Prior] = ()
) -> list[str]:
    """Return the lines of a field that are searched for in photographs.

    Raises:
        InputError: an argument does not fit the field: see `detect_field`.
    """
    sides = [detect.Facing(*one) for one in facing.items()]
    for name in not_painted:
        if name not in target.curves:
            raise InputError(f"not_painted: {no_such('line', name, target.curves)}")
    painted = [name for name in target.curves if name not in not_painted]
    detect.require_findable(target, painted, lengths)
    detect.require_sides(sides, target, painted)
    return painted


def field_of(calibration: Calibration) -> Target | None:
    """Return the only target of a calibration with painted lines; None where there are several, or none."""
    fields = [one for one in calibration.targets.values() if detect.is_painted(one)]
    return fields[0] if len(fields) == 1 else None


# ---- observations and calibrations ----------------------------------------------------------------------------------


def join(*observations: Observations, same_frame: str | None = None) -> Observations:
    """Combine the observations of a rig's cameras, with board labels that agree between the cameras.

    Args:
        same_frame: rule for frames of one moment, such as "left*,right*" or "index"; by default, frames of one name.

    Raises:
        InputError: sets that contradict one another, or a rule that fits no frames.
    """
    from ceres_cal.observations.same_frame import with_same_frames

    if not observations or not all(isinstance(one, Observations) for one in observations):
        raise InputError("join(): give Observations, one or more: read files with Observations.load")
    every = combine(observations)
    labels = start.with_same_labels(every if same_frame is None else with_same_frames(every, same_frame))
    for name in labels.open:
        warnings.warn(start.open_words(name), stacklevel=2)
    return labels.observations


@checked
def check(
    calibration: Calibration,
    observations: Observations | Images,
    false_alarms: float = FALSE_ALARMS,
    checks: int = 1,
    *,
    station: str | None = None,
    not_painted: Sequence[str] = (),
    progress: ImageProgress | None = None,
) -> Agreements:
    """Test whether a calibration still holds, by new observations of its stations or by photographs of one.

    A yes means that no movement is seen, not that there is none: each answer says how large it may be.

    Args:
        observations: new observations; or photographs, which are searched for the field of the calibration.
        false_alarms: probability that unmoved cameras are reported as moved, in so many `checks` together.
        station: that took the photographs; may be omitted where there is only one.
        not_painted: lines that the photographed field does not have. progress: called after each photograph.

    Raises:
        InputError: a station that the calibration does not have, or an image that cannot be read.
        SolutionError: another camera or another field than those calibrated.
    """
    if isinstance(observations, Observations):
        return moves.check(calibration, observations, false_alarms, checks)

    images = image_files(observations)
    how = {"checks": checks, "not_painted": not_painted, "progress": progress}
    return detect.check_photographs(calibration, images, station, false_alarms, **how)[0]  # type: ignore[arg-type]


@checked
def refit(
    calibration: Calibration,
    observations: Observations | Images,
    what: Literal["auto", "pose", "pose-only", "zoom", "iris", "everything"] = "auto",
    *,
    moved: Sequence[str] | None = None,
    options: moves.RefitOptions | None = None,
    progress: SolveProgress | None = None,
    station: str | None = None,
    not_painted: Sequence[str] = (),
) -> Calibration:
    """Calibrate again after cameras were moved, from few new observations or photographs and all that was known.

    Args:
        observations: new observations; or photographs of one station, searched for the targets of the calibration.
        what: what is free. "pose": poses, with the posterior of the intrinsics as a prior; "pose-only": poses alone;
            "zoom": phi, too; "iris": the lens's coefficients, too; "everything": all intrinsics, too; "auto": as
            "pose", or as "zoom" or "iris" where the observations say so.
        moved: observed stations that moved; by default all. progress: called at every iteration of every solve.
        station: that took the photographs. not_painted: lines that the photographed field does not have.

    Raises:
        InputError: names that do not fit, or a calibration without a posterior.
        DegenerateError: the observations do not determine a pose.
        SolutionError: nothing explains the observations, or something does that `what` does not allow.
    """
    if not isinstance(observations, Observations):
        images = image_files(observations)
        observations = detect.detect_known(calibration, images, station, not_painted=not_painted).require()
    return moves.refit(calibration, observations, what, moved=moved, options=options, progress=progress)
