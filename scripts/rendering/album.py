"""Photographs of simulated observations: image files, what is hidden in them, and their truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ceres_cal.base.arrays import Indices32, Mask
from ceres_cal.base.errors import InputError
from ceres_cal.base.files import make_folder, write_bytes
from ceres_cal.detect.images import encoded
from ceres_cal.observations import taken
from ceres_cal.simulate.files import write_simulation
from ceres_cal.simulate.simulation import Simulation, Truth
from rendering.photograph import Photograph, frames, photograph
from rendering.photography import photography_of

FOLDER = "photographs"
ENDINGS = ("png", "jpg")


@dataclass(frozen=True, eq=False)
class Album:
    """Photographs of a simulation, ready to be written.

    Attributes:
        simulation: without the observations that a robot or a ball hides in its photograph.
        images: name of the file below the folder -> its content.
        truth: for each image the robots, balls and shadows, and the hidden parts of every curve in metres along it.
    """

    simulation: Simulation
    images: Mapping[str, bytes]
    truth: Mapping[str, Any]

    def write(self, folder: str | Path) -> None:
        """Write images, observations and truth; InputError where a file cannot be written."""
        folder = make_folder(folder)
        for name, content in self.images.items():
            make_folder((folder / name).parent)
            write_bytes(folder / name, content)
        write_simulation(self.simulation, folder, {"photographs": self.truth})


def take_album(
    simulation: Simulation, ending: str = "png", progress: Callable[[int, int, str], None] | None = None
) -> Album:
    """Photograph every frame of a simulation.

    Images are `photographs/FRAME.png`, or `photographs/STATION/FRAME.png` where there are several stations.

    Args:
        ending: "png", or "jpg"; then the scene's photography gives the quality, 95 by default.
        progress: called after each image with (images done, images in all, file name).

    Raises:
        InputError: an ending that is none of ENDINGS.
    """
    if ending not in ENDINGS:
        raise InputError(f"images are written as {' or '.join(ENDINGS)}, not as {ending!r}")
    scene, every = simulation.scene, frames(simulation.scene)
    how = photography_of(scene)
    taken = replace(how, jpeg_quality=0) if ending == "jpg" else how  # not compressed twice
    images, truth = {}, {}
    points = np.ones(len(simulation.observations.points), dtype=bool)
    curves = np.ones(len(simulation.observations.curves), dtype=bool)
    for number, (station, frame) in enumerate(every, start=1):
        shot = photograph(scene, station, frame, taken, simulation.seed)
        name = "/".join([FOLDER, *([station] if len(scene.stations) > 1 else []), f"{frame}.{ending}"])
        images[name] = encoded(shot.image, f".{ending}", how.jpeg_quality or 95)
        truth[name] = _truth(shot)
        points &= ~_hidden_rows(simulation, shot, simulation.points, simulation.observations.points.view)
        curves &= ~_hidden_rows(simulation, shot, simulation.curves, simulation.observations.curves.view)
        if progress is not None:
            progress(number, len(every), name)
    return Album(_without(simulation, points, curves), images, truth)


def _hidden_rows(simulation: Simulation, shot: Photograph, truth: Truth, view: Indices32) -> Mask:
    """Rows of observations that are hidden in a photograph."""
    here = np.array([(v.station, v.frame) == (shot.station, shot.frame) for v in simulation.observations.views])
    rows = here[view]
    rows[rows] = shot.hides(truth.pixels[rows])
    return np.asarray(rows)


def _without(simulation: Simulation, points: Mask, curves: Mask) -> Simulation:
    return replace(
        simulation,
        observations=simulation.observations.part(points, curves),
        points=taken(simulation.points, points),
        curves=taken(simulation.curves, curves),
    )


def _truth(shot: Photograph) -> dict[str, Any]:
    return {
        "station": shot.station,
        "frame": shot.frame,
        "things": [{"kind": type(thing).__name__.lower(), **_rounded(vars(thing))} for thing in shot.things],
        "shadows": [_rounded(vars(shadow)) for shadow in shot.shadows],
        "hidden_m": {
            target: {curve: [_rounded(stretch) for stretch in covered] for curve, covered in stretches.items()}
            for target, stretches in shot.hidden.items()
        },
    }


def _rounded(values: Any) -> Any:
    if isinstance(values, dict):
        return {name: _rounded(value) for name, value in values.items()}
    if isinstance(values, tuple):
        return [_rounded(value) for value in values]
    return round(values, 6) if isinstance(values, float) else values
