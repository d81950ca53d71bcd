"""The model as a photograph should show it: the lines and points of targets as built, as pixels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from msgspec import Struct

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.transforms import Pose
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.structure import BuiltTarget
from ceres_cal.scene.camera import Camera, in_image
from ceres_cal.scene.curves import along_track
from ceres_cal.scene.targets import Target


class CurveOutline(Struct, frozen=True, eq=False):
    """One curve: its middle (S, 2) px, NaN where the camera does not show it, and both edges of wide paint."""

    middle: Array
    edges: tuple[Array, ...] = ()


class Model(Struct, frozen=True, eq=False):
    """What is drawn into a photograph of `image_size`: lines, and points (N, 2) px."""

    image_size: tuple[int, int]
    lines: tuple[CurveOutline, ...]
    points: Array

    @property
    def in_view(self) -> int:
        """How many of its lines and points the photograph shows, lines in part at least."""
        lines = sum(bool(np.any(self._inside(line.middle))) for line in self.lines)
        return lines + int(np.count_nonzero(self._inside(self.points)))

    def apart_px(self, other: Model) -> tuple[float, float]:
        """How far the places of another model of the same things lie from these, px: median and largest.

        NaN where the photograph shows no place of both.
        """
        pairs = [(a.middle, b.middle) for a, b in zip(self.lines, other.lines, strict=True)]
        pairs.append((self.points, other.points))
        apart = np.concatenate([np.linalg.norm(a - b, axis=1)[self._inside(a)] for a, b in pairs])
        apart = apart[np.isfinite(apart)]
        return (float(np.median(apart)), float(np.max(apart))) if len(apart) else (np.nan, np.nan)

    def _inside(self, pixels: Array) -> Mask:
        return in_image(pixels, self.image_size)


def model_seen(
    estimate: Estimate,
    targets: Mapping[str, Target],
    station: str,
    shown: Sequence[tuple[str, str | None]],
    height_m: float = 0.0,
) -> Model:
    """The model of what a station sees.

    Args:
        estimate: cameras, poses and targets as built. targets: those that it was made for, as drawn.
        shown: target and placement of each thing; placement None for what lies in the world.
        height_m: everything is lifted by so much along its target's z.
    """
    built = estimate.structure.built(targets)
    lift = Pose(np.eye(3), np.array([0.0, 0.0, height_m]))
    lines: list[CurveOutline] = []
    points = [np.empty((0, 2))]
    for name, placement in shown:
        camera = estimate.camera_at(station, placement)
        camera = camera.at(camera.cam_from_world @ lift)
        lines += _lines(built[name], camera)
        points.append(camera.project(built[name].points))
    return Model(estimate.camera_at(station).image_size, tuple(lines), np.concatenate(points))


def _lines(built: BuiltTarget, camera: Camera) -> Iterator[CurveOutline]:
    wide_px = 5.0  # paint that appears wider is drawn by its two edges, so that it stays in sight
    steps = 240  # along a curve
    target = built.target
    for number, curve in enumerate(target.curves.values()):
        s, is_arc = np.linspace(*curve.parameter_range, steps), bool(target.is_arc[number])
        middle, left, right = (
            camera.project(along_track(built.tracks[side, number], is_arc, s)) for side in (0, 1, -1)
        )
        width = np.linalg.norm(left - right, axis=1)[in_image(middle, camera.image_size)]
        wide = len(width) > 0 and float(np.median(width)) >= wide_px
        yield CurveOutline(middle, (left, right) if wide else ())
    if target.grid is not None:
        grid = built.points.reshape(target.grid.rows, -1, 3)
        yield from (CurveOutline(camera.project(_between(row))) for row in (*grid, *grid.swapaxes(0, 1)))


def _between(corners: Array) -> Array:
    """Corners (C, 3) and places on the straight lines from each to the next."""
    between = 12  # steps from one corner of a board to the next
    at = np.linspace(0.0, len(corners) - 1.0, between * (len(corners) - 1) + 1)
    return np.column_stack([np.interp(at, np.arange(len(corners)), axis) for axis in corners.T])
