"""What `refit` and `check` take: a calibration and files of observations, or photographs of one of its stations."""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.command import plural
from ceres_cal.cli.detect import image_files, parse_names
from ceres_cal.cli.progress import ProgressBar

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.observations import Observations
    from ceres_cal.photographs import KnownDetections

_OBSERVATIONS = (".json", ".npz")


def add_inputs(parser: ArgumentParser) -> None:
    """A calibration, files of observations or photographs, and what is to be said of photographs."""
    add = parser.add_argument
    add("calibration", metavar="CALIBRATION", type=Path, help="the calibration from before")
    add(
        "inputs",
        nargs="+",
        metavar="OBS|IMAGE",
        help="files of new observations (.json, .npz), taken together; or photographs, or folders of them",
    )
    add("--station", metavar="NAME", help="station that took the photographs; default: the only one")
    add("--not-painted", default="", metavar="NAME,...", help="lines that the photographed field does not have")
    add("--quiet", action="store_true", help="no progress")


def read_calibration(args: Namespace) -> Calibration:
    """The calibration that `add_inputs` names."""
    from ceres_cal.calibration import Calibration

    return Calibration.load(args.calibration)


def photographs_in(args: Namespace) -> list[Path]:
    """The photographs that are named, each once; none where observations are."""
    from ceres_cal.cli.calibrate import require_different

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
    images = list(image_files(args.inputs))
    require_different([str(path) for path in images])
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # what it warns of in an image, we say ourselves
    return images


def read_observations(args: Namespace) -> Observations:
    """All files of observations as one."""
    from ceres_cal.observations import Observations, combine

    return combine([Observations.load(path) for path in args.inputs])


def not_painted(args: Namespace) -> list[str]:
    """The names in --not-painted."""
    return parse_names(args.not_painted)


def progress_bar(args: Namespace) -> ProgressBar:
    """Shows how far a search through photographs is."""
    return ProgressBar(silent=args.quiet or args.json)


def photographs_data(found: KnownDetections | None) -> dict[str, Any]:
    """What photographs showed, for --json; nothing where none were given."""
    if found is None:
        return {}
    missed = [{"image": path, "reason": reason} for path, reason in found.missed]
    return {"photographs": {"images": found.images, "shown": dict(found.shown), "missed": missed}}


def photographs_text(found: KnownDetections | None) -> list[str]:
    """The same for people: one section, or none."""
    if found is None:
        return []
    from ceres_cal.cli.summary import section

    shown = ", ".join(f"{name} in {count}" for name, count in found.shown.items())
    missed = [f"{path}: {reason}" for path, reason in found.missed]
    return [section("images", [f"{plural(found.images, 'photograph')} of station {found.station}: {shown}", *missed])]
