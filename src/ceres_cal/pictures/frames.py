"""Which photograph shows what: frames by their names, what lies in them, and what was observed there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import InputError
from ceres_cal.calibration import Calibration
from ceres_cal.observations import Observations
from ceres_cal.pictures.model import Model, model_seen
from ceres_cal.pictures.overlay import TAKEN_OUT, USED, Marks

Shown = tuple[tuple[str, str | None], ...]
"""Target and placement of each thing that a frame shows."""


@dataclass(frozen=True)
class Frame:
    """One photograph: its frame's name, the station that took it, what it shows, and numbers of its views."""

    name: str
    station: str
    shown: Shown
    views: tuple[int, ...] = ()


def frames_of(observations: Observations) -> tuple[Frame, ...]:
    """The frames of each station, in the order of their views."""
    found: dict[tuple[str, str], list[int]] = {}
    for number, view in enumerate(observations.views):
        found.setdefault((view.frame, view.station), []).append(number)
    return tuple(
        Frame(
            name,
            station,
            tuple((view.target, view.placement) for view in map(observations.views.__getitem__, rows)),
            tuple(rows),
        )
        for (name, station), rows in found.items()
    )


def frame_by_name(calibration: Calibration, station: str, name: str) -> Frame:
    """What a photograph shows as far as the calibration alone tells: what lies in the world, and the board or rings
    whose placement has the photograph's name.

    Raises:
        InputError: there is neither.
    """
    movable = [target for target, one in calibration.targets.items() if one.movable]
    shown: list[tuple[str, str | None]] = [(target, None) for target in calibration.targets if target not in movable]
    if name in calibration.placements and len(movable) == 1:
        shown.append((movable[0], name))
    if not shown:
        raise InputError(
            f"there is nothing to draw into {name!r}: the calibration has no field, and no one board placed under that "
            "name: give the observations, which say what each frame shows"
        )
    return Frame(name, station, tuple(shown))


def photographs_by_frame(images: Iterable[Path]) -> dict[str, Path]:
    """Image files by their stem, which is their frame's name.

    Raises:
        InputError: two images of one stem.
    """
    found: dict[str, Path] = {}
    for path in images:
        if found.setdefault(path.stem, path) != path:
            raise InputError(f"{path}: has the same name as {found[path.stem]}: give the images of one folder")
    return found


def model_of(calibration: Calibration, frame: Frame, height_m: float = 0.0) -> Model:
    """The calibration's model of a frame.

    Raises:
        InputError: the calibration does not know the frame's station, or a target or placement of it.
    """
    known: tuple[tuple[str, Mapping[str, object], Sequence[str | None]], ...] = (
        ("station", calibration.stations, [frame.station]),
        ("target", calibration.targets, [target for target, _ in frame.shown]),
        ("placement", calibration.placements, [placement for _, placement in frame.shown]),
    )
    for kind, names, wanted in known:
        for name in wanted:
            if name is not None and name not in names:
                raise InputError(f"frame {frame.name!r}: the calibration has no {kind} {name!r}")
    return model_seen(calibration.estimate, calibration.targets, frame.station, frame.shown, height_m)


def marks_of(calibration: Calibration, observations: Observations, frame: Frame) -> tuple[Marks, ...]:
    """What was observed in a frame: what took part and, where the calibration was made from these observations, what
    was taken out.
    """
    own = observations.digest == calibration.digest
    pixels: list[Array] = []
    out: list[Mask] = []
    for kind, columns in (("point", observations.points), ("curve", observations.curves)):
        rejected = np.zeros(len(columns), dtype=bool)
        rejected[[entry.row for entry in calibration.outliers if own and entry.kind == kind]] = True
        here = np.isin(columns.view, frame.views)
        pixels.append(columns.pixels[here])
        out.append(rejected[here])
    every, taken_out = np.concatenate(pixels), np.concatenate(out)
    found = (
        Marks(every[~taken_out], "observed", USED),
        Marks(every[taken_out], "taken out", TAKEN_OUT, crosses=True),
    )
    return tuple(marks for marks in found if len(marks.pixels))
