"""Sheets with the paper's concentric circles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from ceres_cal.base import InputError, checked
from ceres_cal.scene.curves import Arc, Curve
from ceres_cal.scene.targets.target import Paper, Shape, Target, TargetKind, from_arguments


@checked
def rings(radii_m: Sequence[float]) -> Target:
    """Return the paper's concentric circles (section 2): edges "ring_1", "ring_2", ... outwards, and point "centre".

    Raises:
        InputError: no radius, or radii that do not increase from above 0.
    """
    radii = [float(r) for r in radii_m]
    if not radii or not np.all(np.isfinite(radii)) or np.any(np.diff([0.0, *radii]) <= 0.0):
        raise InputError(f"rings: radii_m must increase and be positive, not {radii}")
    arcs: dict[str, Curve] = {f"ring_{i}": Arc((0.0, 0.0, 0.0), r) for i, r in enumerate(radii, start=1)}
    border = 1.05 * radii[-1]
    paper = Paper((-border, -border), (border, border), partial(_shapes, radii, border))
    return Target({"kind": "rings", "radii_m": radii}, {"centre": (0.0, 0.0, 0.0)}, arcs, movable=True, paper=paper)


def _shapes(radii: Sequence[float], border: float) -> Iterator[Shape]:
    """Yield discs from the outside in, each on the one before; outside an even number of rings it is dark, too."""
    if len(radii) % 2 == 0:
        yield Shape((-border, -border), 2.0 * border)
    for number in reversed(range(len(radii))):
        yield Shape((0.0, 0.0), radii[number], is_round=True, is_dark=number % 2 == 0)


KIND = TargetKind(
    "rings",
    "concentric circles",
    "radii_m, from the inside out",
    'curves "ring_1", "ring_2", ... from the inside out, point "centre"',
    lambda: {"rings": rings((0.05, 0.1, 0.15))},
    from_arguments("rings", rings),
)
