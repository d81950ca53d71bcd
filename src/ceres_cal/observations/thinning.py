"""Some of the observations, evenly, where all of them would take too long."""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import AnyArray, Indices, distinct
from ceres_cal.observations.observations import Observations

MANY = 2_000_000
"""Observations of the world from which on a part decides, and the rest answers with sums."""


def is_bulk(observations: Observations) -> bool:
    """Whether a part is to decide."""
    if len(observations.points) + len(observations.curves) <= MANY:
        return False
    world = np.array([view.placement is None for view in observations.views])
    return sum(int(np.diff(ends)[world].sum()) for ends in observations.ends) > MANY


def column_of(observations: Observations, name: str) -> AnyArray:
    """(N + M,) one column of the points, then of the curves."""
    return np.concatenate([getattr(observations.points, name), getattr(observations.curves, name)])


def frames_of(observations: Observations) -> tuple[tuple[str, ...], Indices]:
    """Names of the frames that show anything, and (N + M,) the frame's number of each observation."""
    views = column_of(observations, "view")
    names = dict.fromkeys(observations.views[int(view)].frame for view in distinct(views))
    order = {name: number for number, name in enumerate(names)}
    return tuple(names), np.array([order.get(view.frame, -1) for view in observations.views])[views]


def thinned(observations: Observations, most: int, fewest_frames: int = 40) -> Observations:
    """Evenly spread frames, and of these evenly spread observations, about `most` in all."""
    total = len(observations.points) + len(observations.curves)
    if total <= most:
        return observations
    names, frame = frames_of(observations)
    count = max(min(fewest_frames, len(names)), int(len(names) * most / total))
    taken = np.zeros(len(names), dtype=bool)
    taken[np.linspace(0, len(names) - 1, count).round().astype(int)] = True
    chosen = taken[frame]
    step = max(1, round(np.count_nonzero(chosen) / most))
    masks = np.split(chosen, [len(observations.points)])
    for mask in masks:
        mask[np.flatnonzero(mask)[np.arange(np.count_nonzero(mask)) % step > 0]] = False
    return observations.part(*masks)
