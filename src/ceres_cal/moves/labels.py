"""The same observations under other names: a field turned by half a turn, mirrored, or of other dimensions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.observations import Observations
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
