"""Targets given in full, by points, segments and arcs."""

from __future__ import annotations

from collections.abc import Mapping
from math import hypot
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base import InputError, checked, convert
from ceres_cal.scene.curves import Arc, Curve, Segment, with_crossings, xyz
from ceres_cal.scene.targets.target import HANDY_M, Target, TargetKind, require_places


class _CustomSpec(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    kind: str
    points: dict[str, tuple[float, float, float]] = {}
    segments: dict[str, Segment] = {}
    arcs: dict[str, Arc] = {}
    movable: bool = False


@checked
def custom(
    points: Mapping[str, tuple[float, float, float]] | None = None,
    curves: Mapping[str, Curve] | None = None,
    *,
    movable: bool = False,
) -> Target:
    """Return a target given in full; crossings of its curves, such as "edge*circle", are further points.

    Args:
        movable: whether it is a board that somebody holds up, not the world. A flat one may be warped.

    Raises:
        InputError: no features at all, a number that is not finite, a curve without length, or paint that covers the
            centre of its arc.
    """
    points, curves = {name: xyz(place, f"point {name!r}") for name, place in (points or {}).items()}, dict(curves or {})
    if not points and not curves:
        raise InputError("custom target: give at least one point, segment or arc")
    require_places("custom target", points, curves)
    segments = {name: curve for name, curve in curves.items() if isinstance(curve, Segment)}
    arcs = {name: curve for name, curve in curves.items() if isinstance(curve, Arc)}
    spec = msgspec.to_builtins(_CustomSpec("custom", points, segments, arcs, movable))
    curves = {**segments, **arcs}  # in the order in which a file would give them back
    every = with_crossings(points, curves)
    return Target(spec, every, curves, movable=movable, bows=movable and not curves and _is_flat(every))


def of_places(points: Mapping[str, tuple[float, float, float]], *, moves: bool) -> Target:
    """Return a custom target of points only: a board if it moves, unless it is too large for anybody to hold."""
    return custom(points, movable=moves and all(hypot(*place) <= HANDY_M for place in points.values()))


def _is_flat(points: Mapping[str, tuple[float, float, float]]) -> bool:
    """Return whether points lie on one level, and not on one line along x or y."""
    x, y, z = np.ptp(np.array(list(points.values())), axis=0).tolist()
    return bool(z == 0.0 and x > 0.0 and y > 0.0)


def _from_spec(spec: dict[str, Any], where: str) -> Target:
    given = convert(spec, _CustomSpec, where)
    if both := given.segments.keys() & given.arcs.keys():
        raise InputError(f"two curves are named {min(both)!r}")
    return custom(given.points, {**given.segments, **given.arcs}, movable=given.movable)


def _example() -> dict[str, Target]:
    edge, circle = Segment((0, 0, 0), (4, 0, 0), 0.01), Arc((0, 0, 0), 0.5, width_m=0.01)
    return {"custom": custom({"pole_top": (1.0, 2.0, 1.0)}, {"edge": edge, "circle": circle})}


KIND = TargetKind(
    "custom",
    "anything flat or not, given in full",
    "points (name: x, y, z), segments (from, to, width_m), arcs (centre, radius_m, from_rad, to_rad, width_m), "
    "movable (a board that is held up, which may be warped)",
    'as named there, and points "A*B" where curves A and B cross ("A*B#1" and "A*B#2" where they do so twice)',
    _example,
    _from_spec,
)
