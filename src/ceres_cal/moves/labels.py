"""The same observations under other names: a field turned by half a turn, mirrored, or of other dimensions; features
that were seen under the name of another.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Codes, Indices, distinct
from ceres_cal.calibration import Calibration
from ceres_cal.observations import Observations
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import Curve, along_curve, nearest_on_curve
from ceres_cal.scene.symmetry import counterparts
from ceres_cal.scene.targets import target_from_spec

TURNED, MIRRORED = np.array([-1.0, -1.0, 1.0]), np.array([-1.0, 1.0, 1.0])


def relabelled(observations: Observations, image: Array) -> Observations | None:
    """The observations of what lies in the world, renamed after the features that x, y, z times `image` sends theirs
    to; None where one has no such feature.
    """
    in_world = {view.target for view in observations.views if view.placement is None}
    maps = {name: counterparts(observations.targets[name], image) for name in in_world}
    points, curves = observations.points, observations.curves
    p, c, side = points.feature.copy(), curves.feature.copy(), curves.side.copy()
    for number, view in enumerate(observations.views):
        if view.placement is not None:
            continue
        to_point, to_curve, flips = maps[view.target]
        rows = np.flatnonzero(points.view == number)
        p[rows] = to_point[points.feature[rows]]
        rows = np.flatnonzero(curves.view == number)
        c[rows] = to_curve[curves.feature[rows]]
        side[rows] = curves.side[rows] * flips[curves.feature[rows]]
    if np.any(p < 0) or np.any(c < 0):
        return None
    return replace(observations, points=replace(points, feature=p), curves=replace(curves, feature=c, side=side))


def mistaken_targets(observations: Observations) -> dict[str, Observations]:
    """The observations as if a target were one of those that it may be mistaken for, such as the other division's
    field; by what that is, in words.
    """
    return {
        words: replace(observations, targets={**observations.targets, name: target_from_spec(spec, words)})
        for name, target in observations.targets.items()
        for words, spec in target.mistaken_for.items()
    }


# ---- wrong names ----------------------------------------------------------------------------------------------------

_LEAST_ROWS = 2  # of a curve: one place lies on some curve by chance


@dataclass(frozen=True, eq=False)
class Renaming:
    """What was seen of a feature in one view and lies where another one does.

    Attributes:
        kind: "point" or "curve". name, right: as it was named, and as it lies. rows: (N,) of its column. feature: the
            number of the right one in the target.
    """

    kind: str
    view: str
    name: str
    right: str
    rows: Indices
    feature: int

    @property
    def words(self) -> str:
        return f"frame {self.view!r}: {self.kind} {self.name!r} is seen where {self.right!r} lies"


def renamings(observations: Observations, calibration: Calibration) -> Iterator[Renaming]:
    """Features of the world that were taken out whole and lie within the bound of outliers from another one."""
    scales = calibration.fit.point_scale, calibration.fit.curve_scale
    columns, out = (observations.points, observations.curves), calibration.outlier_masks(observations)
    for kind, column, gone, scale in zip(("point", "curve"), columns, out, scales, strict=True):
        for number, feature in distinct(np.column_stack([column.view, column.feature])[gone], axis=0):
            view, rows = (
                observations.views[number],
                np.flatnonzero((column.view == number) & (column.feature == feature)),
            )
            if view.placement is not None or not gone[rows].all() or (kind == "curve" and len(rows) < _LEAST_ROWS):
                continue
            target, camera = observations.targets[view.target], calibration.estimate.camera_at(view.station)
            if kind == "point":
                names, seen = target.point_names, camera.project(target.point_array)
                off = np.linalg.norm(seen[:, None] - column.pixels[rows], axis=2)
            else:
                names, sides = target.curve_names, observations.curves.side[rows]
                off = np.array([_off_curve(camera, one, column.pixels[rows], sides) for one in target.curves.values()])
            limit = calibration.options.reject_sigma * scale * column.sigma_px[rows]
            worst = np.nan_to_num(np.max(off / limit, axis=1), nan=np.inf)
            best = int(np.argmin(worst))
            if worst[best] < 1.0 and best != feature:
                yield Renaming(kind, view.frame, names[feature], names[best], rows, best)


def _off_curve(camera: Camera, curve: Curve, pixels: Array, sides: Codes) -> Array:
    """(N,) px from pixels to the nearest place between a curve's ends; NaN where its plane is not seen."""
    height = float(curve.track()[0, 2])
    places = np.column_stack([camera.locate(pixels, height), np.full(len(pixels), height)])
    s, off = nearest_on_curve(curve, places), np.full(len(pixels), np.nan)
    for side in distinct(sides):
        own = sides == side
        off[own] = np.linalg.norm(camera.project(along_curve(curve, s[own], int(side))) - pixels[own], axis=1)
    return off


def mended(observations: Observations, wrong: tuple[Renaming, ...]) -> Observations:
    """The observations with the right names."""
    features = {"point": observations.points.feature.copy(), "curve": observations.curves.feature.copy()}
    for one in wrong:
        features[one.kind][one.rows] = one.feature
    points, curves = observations.points, observations.curves
    return replace(
        observations,
        points=replace(points, feature=features["point"]),
        curves=replace(curves, feature=features["curve"]),
    )
