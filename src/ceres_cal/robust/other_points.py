"""Targets whose points are others than those that are drawn: listed in another order, or of another kind of grid."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ceres_cal.effects import AsBuilt
from ceres_cal.scene.targets import Target

# Of the distance between neighbours, root mean square of offsets along one axis. Where the points of a grid are listed
# in another order, or are those of another kind of grid, it is 0.17 to 0.5; boards are built to a hundredth.
_NOT_BUILT = 0.1


def is_another(one: AsBuilt, target: Target) -> bool:
    """Whether points lie so far aside that they are others than those that are drawn."""
    most_probes = 500  # points whose neighbours are sought
    if one.kind != "points":
        return False
    places = target.point_array
    away = np.linalg.norm(places[:: -(-len(places) // most_probes), None] - places, axis=2)
    return one.rms_m > _NOT_BUILT * float(np.median(np.partition(away, 1, axis=1)[:, 1]))


def misnamed(every: Sequence[AsBuilt], targets: Mapping[str, Target]) -> Iterator[str]:
    """A warning of each target whose points are others than those that are drawn."""
    for one in every:
        if is_another(one, targets[one.target]):
            yield (
                f"target {one.target!r}: {one.words}, by more than a tenth of the distance between neighbours. Targets "
                "are built more accurately: check the order of its points, and its kind, columns, rows and dimensions"
            )
