"""Observations for `refit` and `check`: what photographs show of the targets that a calibration knows."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path

from ceres_cal.base import Frozen, ImageProgress, InputError, NothingShownError, replace
from ceres_cal.calibration import Calibration
from ceres_cal.detect.boards import BoardDetections, detect_boards
from ceres_cal.detect.photographs.field import FieldDetections, FieldOptions, detect_field
from ceres_cal.detect.photographs.follow import FAR_PX
from ceres_cal.moves.agreement import FALSE_ALARMS, Agreements, require_posterior
from ceres_cal.moves.checks import check, not_found
from ceres_cal.observations import Observations, combine
from ceres_cal.scene import Camera, Target

_REACH = f"{FAR_PX:.0f} px or 5 degrees"


class KnownDetections(Frozen):
    """Result of `detect_known`.

    Attributes:
        station: where the photographs were taken.
        observations: under the names of the calibration; None where no photograph shows anything.
        shown: name of a target -> how many photographs show it.
        missed: path and reason of every photograph that shows nothing.
        images: number of photographs.
    """

    station: str
    observations: Observations | None
    shown: dict[str, int]
    missed: tuple[tuple[str, str], ...]
    images: int

    def require(self) -> Observations:
        """Return the observations; NothingShownError where there are none."""
        if self.observations is None:
            path, reason = self.missed[0]
            raise NothingShownError(
                f"no target of the calibration was found in {_counted(self.images)} within {_REACH} of its predicted "
                f"position: after a larger move detect the field from its corners first; {path}: {reason}",
                self.missed,
            )
        return self.observations


def detect_known(
    calibration: Calibration,
    images: Sequence[Path],
    station: str | None = None,
    *,
    not_painted: Collection[str] = (),
    boards: bool = True,
    progress: ImageProgress | None = None,
) -> KnownDetections:
    """Search photographs of one station for everything of the calibration's targets that can be detected.

    Painted fields are found by `detect_field`, from where the station stood (it may have moved by up to 130 px, or 5
    degrees), chessboards by `detect_boards`. The search adapts its own camera to the picture, but the results are
    pixels and the names of what they show: a move of the camera remains visible in them.

    Args:
        images: files of any kind OpenCV reads.
        station: by default the only one there is.
        not_painted: curves that the field does not have.
        boards: whether chessboards are searched as well as painted fields.
        progress: called after each image and target with (steps done, steps in all, file name).

    Raises:
        InputError: an image cannot be read or has another size than the camera, the calibration has no such station, no
            such curve, or no target that can be detected in photographs.
    """
    paths, posed = [Path(path) for path in images], calibration.station(station)
    name = station or next(iter(calibration.stations))
    options = FieldOptions(calibration.estimate.stations[name].camera, name)
    wanted = {
        what: target
        for what, target in calibration.targets.items()
        if is_painted(target) or (boards and target.grid is not None and target.grid.checkered)
    }
    if not wanted:
        raise InputError(
            f"the calibration's targets ({', '.join(calibration.targets)}) have no painted lines"
            f"{' and are not chessboards' if boards else ''}: give a file of observations instead of images"
        )
    known = {curve for target in calibration.targets.values() for curve in target.curves}
    if unknown := sorted(set(not_painted) - known):
        raise InputError(f"curve {unknown[0]!r} is not one of the calibration's targets': see `ceres-cal targets`")
    parts: list[Observations] = []
    shown: dict[str, int] = {}
    reasons: dict[str, list[str]] = {str(path): [] for path in paths}
    for turn, (what, target) in enumerate(wanted.items()):
        report = partial(_count_on, progress, turn, len(wanted))
        painted = [curve for curve in target.curves if curve not in not_painted]
        try:
            found = _searched(paths, target, posed, painted, options, report)
            parts.append(_renamed(found.observations, what))
            missed = found.missed
        except NothingShownError as error:  # reads: "..." beside each photograph that shows nothing
            missed = error.missed
        shown[what] = len(paths) - len(missed)
        for path, reason in missed:
            reasons[path].append(reason)
    nothing = tuple((path, "; ".join(why)) for path, why in reasons.items() if len(why) == len(wanted))
    return KnownDetections(name, combine(parts) if parts else None, shown, nothing, len(paths))


def _searched(
    paths: list[Path], target: Target, posed: Camera, painted: list[str], options: FieldOptions, report: ImageProgress
) -> FieldDetections | BoardDetections:
    """Detect one target in the images."""
    if is_painted(target):
        return detect_field(paths, target, posed, painted, options, report)
    return detect_boards(paths, target, options.camera, options.station, progress=report)


def check_photographs(
    calibration: Calibration,
    images: Sequence[Path],
    station: str | None = None,
    false_alarms: float = FALSE_ALARMS,
    *,
    checks: int = 1,
    not_painted: Collection[str] = (),
    progress: ImageProgress | None = None,
) -> tuple[Agreements, KnownDetections]:
    """Apply `check` to photographs of one station; boards, which may lie anywhere, are not searched.

    Where no photograph shows the field near where the calibration predicts it, the station does not hold, and its words
    say why: the camera has moved far, or nothing is visible. Raises what `detect_known` and `check` raise.
    """
    require_posterior(calibration)  # before any photograph is read
    detections = detect_known(calibration, images, station, not_painted=not_painted, boards=False, progress=progress)
    if detections.observations is not None:
        return check(calibration, detections.observations, false_alarms, checks), detections
    words = (
        f"not found: no field within {_REACH} of its predicted position in {_counted(len(images))}: the camera moved "
        "farther, or it sees no field (dark, covered, other lines): look at the picture"
    )
    return Agreements({detections.station: not_found(detections.station, words)}, false_alarms, checks), detections


def is_painted(target: Target) -> bool:
    """Whether a target has lines that can be found in photographs: those with a width."""
    return bool(target.painted)


def _counted(images: int) -> str:
    return "the photograph" if images == 1 else f"any of {images} photographs"


def _count_on(progress: ImageProgress | None, turn: int, turns: int, done: int, images: int, name: str) -> None:
    """Report the progress of one of several searches through the same images."""
    if progress is not None:
        progress(turn * images + done, turns * images, name)


def _renamed(detected: Observations, target: str) -> Observations:
    (known,) = detected.targets.values()
    views = tuple(replace(view, target=target) for view in detected.views)
    return replace(detected, targets={target: known}, views=views)
