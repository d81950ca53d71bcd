"""What `refit` and `check` take: a calibration and files of observations, or photographs of one of its stations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.base.words import plural
from ceres_cal.cli.arguments import calibration_argument, not_painted_option, station_option
from ceres_cal.cli.inputs import image_files, require_different
from ceres_cal.cli.options import Quiet, argument
from ceres_cal.cli.outputs import section

if TYPE_CHECKING:
    from ceres_cal.photographs import KnownDetections

_OBSERVATIONS = (".json", ".npz")


@dataclass(frozen=True, kw_only=True)
class Seen(Quiet):
    """A calibration, files of observations or photographs, and what is to be said of photographs."""

    calibration: Path = calibration_argument("the calibration from before")
    inputs: tuple[str, ...] = argument(
        "OBS|IMAGE", "files of new observations (.json, .npz), taken together; or photographs, or folders of them"
    )
    station: str | None = station_option("station that took the photographs; default: the only one")
    not_painted: str = not_painted_option("lines that the photographed field does not have")


def photographs_in(args: Seen) -> list[Path]:
    """The photographs that are named, each once; none where observations are."""
    observed = [name for name in args.inputs if Path(name).suffix.lower() in _OBSERVATIONS]
    if len(observed) == len(args.inputs):
        require_different(observed)
        if args.station is not None or args.not_painted:
            raise InputError("--station and --not-painted are of photographs, which were not given: leave them out")
        return []
    if observed:
        raise InputError(
            f"{observed[0]}: observations beside photographs: give one kind, `ceres-cal detect field` makes "
            "observations of photographs"
        )
    images = image_files(args.inputs)
    require_different(images)
    return images


def photographs_data(detections: KnownDetections | None) -> dict[str, Any]:
    """What photographs showed, for --json; nothing where none were given."""
    if detections is None:
        return {}
    images = {"images": detections.images, "shown": detections.shown, "missed": missed_data(detections.missed)}
    return {"photographs": images}


def photographs_text(detections: KnownDetections | None) -> list[str]:
    """The same for people: one section, or none."""
    if detections is None:
        return []
    counts = ", ".join(f"{name} in {count}" for name, count in detections.shown.items())
    first = f"{plural(detections.images, 'photograph')} of station {detections.station}: {counts}"
    return [section("images", [first, *missed_text(detections.missed)])]


def missed_data(missed: tuple[tuple[str, str], ...]) -> list[dict[str, str]]:
    """Images in which nothing was detected, for --json."""
    return [{"image": path, "reason": reason} for path, reason in missed]


def missed_text(missed: tuple[tuple[str, str], ...]) -> list[str]:
    """The same for people, a line each."""
    return [f"{path}: {reason}" for path, reason in missed]
