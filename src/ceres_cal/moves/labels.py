"""The same observations under other names: a field turned by half a turn, mirrored, or of other dimensions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceres_cal.base.arrays import Array, Codes, Indices32
from ceres_cal.observations import Observations
from ceres_cal.scene.targets import Arc, Segment, Target, ssl_field

TURNED, MIRRORED = np.array([-1.0, -1.0, 1.0]), np.array([-1.0, 1.0, 1.0])
_SAME_M = 1e-6


def relabelled(observations: Observations, image: Array) -> Observations | None:
    """The observations of what lies in the world, renamed after the features that x, y, z times `image` sends theirs
    to; None where one has no such feature.
    """
    in_world = {view.target for view in observations.views if view.placement is None}
    maps = {name: _counterparts(observations.targets[name], image) for name in in_world}
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


def _counterparts(target: Target, image: Array) -> tuple[Indices32, Indices32, Codes]:
    """For each point and each curve the one it is sent to (-1: none), and 1 or -1 for the curve's side."""
    places = target.point_array
    to_point = np.full(len(places), -1, dtype=np.int32)
    for number, sent in enumerate(places * image):
        near = np.flatnonzero(np.all(np.abs(places - sent) < _SAME_M, axis=1))
        to_point[number] = near[0] if len(near) else -1
    curves = list(target.curves.values())
    to_curve, flips = np.full(len(curves), -1, dtype=np.int32), np.ones(len(curves), dtype=np.int8)
    mirrored = np.sign(image[0] * image[1])
    for number, curve in enumerate(curves):
        for other, candidate in enumerate(curves):
            way = _sends(curve, candidate, image)
            if way:
                to_curve[number], flips[number] = other, 1 if isinstance(curve, Arc) else way * mirrored
                break
    return to_point, to_curve, flips


def _sends(curve: Segment | Arc, other: Segment | Arc, image: Array) -> int:
    """1 where the image sends a curve to the other one, -1 where it runs the other way then, 0 where it does not."""
    if isinstance(curve, Arc) or isinstance(other, Arc):
        if not (isinstance(curve, Arc) and isinstance(other, Arc)):
            return 0
        there = np.allclose(np.multiply(curve.centre, image), other.centre, atol=_SAME_M)
        return int(there and abs(curve.radius_m - other.radius_m) < _SAME_M)
    ends = np.multiply([curve.start, curve.end], image)
    for way, found in ((1, [other.start, other.end]), (-1, [other.end, other.start])):
        if np.allclose(ends, found, atol=_SAME_M):
            return way
    return 0


def other_divisions(observations: Observations) -> dict[str, Observations]:
    """The observations as if a league's field were one of the other division."""
    found = {}
    for name, target in observations.targets.items():
        if target.kind == "ssl-field" and "division" in target.spec:
            division = "A" if target.spec["division"] == "B" else "B"
            targets = {**observations.targets, name: ssl_field(division)}
            found[f"a division {division} field"] = replace(observations, targets=targets)
    return found
