"""Observations that belong, or not, as a whole: a curve in one frame, a feature over all frames of a static camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.model.equations import Equations
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.scene.targets import Arc

FEWEST = 3  # observations of a whole: two numbers of a line's offset, and one left over


@dataclass(frozen=True, eq=False)
class Wholes:
    """The wholes of one kind, by number; there are numbers of which nothing was observed.

    Attributes:
        observations: all of them. of: (N + M,) number of the whole of each, points by row and then curves by row; -1
            for none. size: how many numbers there are. frames: (V,) how many go with each view.
    """

    observations: Observations
    of: Indices
    size: int
    frames: Indices

    def count(self, rows: Mask) -> Indices:
        """(size,) how many of these observations (N + M,) each has."""
        return np.bincount(self.of[rows & (self.of >= 0)], minlength=self.size)

    def among(self, numbers: Indices) -> Mask:
        """(N + M,) the observations of some of them."""
        chosen = np.zeros(self.size + 1, dtype=bool)  # whose last is that of -1
        chosen[numbers] = True
        return np.asarray(chosen[self.of])

    def modes(self, equations: Equations, chosen: Indices) -> tuple[Array, Indices]:
        """How each of the chosen may lie aside, columns (E, 3) of order one; its place among them (E,), -1 for none.

        A line may lie aside along its image's normal and be turned, an arc also be bent, a point lie aside either way.
        """
        place = np.full(self.size + 1, -1)
        place[chosen] = np.arange(len(chosen))
        group, columns = place[self.of[equations.observation]], np.zeros((len(equations), 3))
        arc = equations.sights.is_arc
        for number in range(len(chosen)):
            rows = np.flatnonzero(group == number)
            if not len(rows):
                continue
            if not equations.is_curve[rows[0]]:
                columns[rows, :2] = equations.direction[rows]
                continue
            away = equations.pixel[rows] - np.mean(equations.pixel[rows], axis=0)
            axes = 2 if arc[equations.feature[rows[0]]] else 1
            along = away @ np.linalg.eigh(away.T @ away)[1][:, ::-1][:, :axes]
            columns[rows, 0] = 1.0
            columns[rows, 1 : 1 + axes] = along / np.maximum(np.sqrt(np.mean(along**2, axis=0)), 1e-9)
        return columns, np.asarray(group)

    def name(self, number: int) -> str:
        """What one of them is, as in "line 'HalfwayLine' in frame '0003'"."""
        observations, row = self.observations, int(np.argmax(self.of == number))
        points = len(observations.points)
        kind, row = ("curve", row - points) if row >= points else ("point", row)
        at = int((observations.curves if kind == "curve" else observations.points).view[row])
        view, feature = observations.views[at], observations.feature_name(kind, row)
        if kind == "curve":
            kind = "arc" if isinstance(observations.targets[view.target].curves[feature], Arc) else "line"
        where = f"frame {view.frame!r}" if self.frames[at] == 1 else f"all {self.frames[at]} frames"
        seen_by = f" of station {view.station!r}" if len(observations.stations) > 1 else ""
        return f"{kind} {feature!r} in {where}{seen_by}"


def wholes_of(observations: Observations, sights: Sights) -> Iterator[Wholes]:
    """Of curves in single frames; then, where a static camera has several, of curves and points over all of them."""
    views = np.arange(len(observations.views))
    yield _wholes(observations, views, np.ones_like(views))
    together, frames = np.full(len(views), -1), np.zeros_like(views)
    for number, (key, own) in enumerate(zip(sights.keys, sights.views, strict=True)):
        if key.placement is None and len(own) > 1:
            together[list(own)], frames[list(own)] = number, len(own)
    if np.any(frames):
        yield _wholes(observations, together, frames)


def _wholes(observations: Observations, owner: Indices, frames: Indices) -> Wholes:
    """Of features by owner (V,) of their views, -1 for none; of single frames only curves."""
    columns = (observations.points, observations.curves)
    view, feature = (
        np.concatenate([getattr(column, name) for column in columns]).astype(np.int64) for name in ("view", "feature")
    )
    is_curve = np.arange(len(view)) >= len(observations.points)
    takes_part = (owner[view] >= 0) & (is_curve | (frames[view] > 1))
    names = int(feature.max(initial=0)) + 1
    number = (owner[view] * 2 + is_curve) * names + feature
    return Wholes(observations, np.where(takes_part, number, -1), (int(owner.max()) + 1) * 2 * names, frames)
