"""Where in a photograph something is that should be measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.diagnostics.advice import Measurement
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import curve_points
from ceres_cal.scene.targets import Target

_PIECES = 30


def places_in_picture(
    measurement: Measurement, targets: Mapping[str, Target], camera: Camera
) -> Iterator[tuple[str, Array]]:
    """What is drawn, with a label, (N, 2) px each: the outline of a board, a pole from its foot to its top, a line, or
    the place beneath a camera whose height is to be measured.
    """
    if measurement.kind == "tape":
        yield "measure the height here", camera.project((camera.position * (1.0, 1.0, 0.0))[None])
    for view in measurement.views:
        target = {**targets, **measurement.targets}[view.target]
        if measurement.kind == "board" and view.placement is not None and target.grid is not None:
            rows = target.point_array.reshape(target.grid.rows, target.grid.columns, 3)
            edge = np.array([rows[0, 0], rows[0, -1], rows[-1, -1], rows[-1, 0], rows[0, 0]])
            yield "a board here", camera.project(measurement.placements[view.placement].transform(edge))
        elif measurement.kind == "pole":
            top = target.point_array[0]
            yield "a pole here", camera.project(np.array([top * (1.0, 1.0, 0.0), top]))
        elif measurement.kind == "line":
            for name in view.curves or ():
                yield "this line", camera.project(curve_points(target.curves[name], 0, _PIECES))
