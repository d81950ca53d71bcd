"""Observations that belong, or not, as a whole.

A curve in one frame, a feature over all frames of a static camera; a frame of a static camera, a placement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Indices32, Mask, distinct
from ceres_cal.model.equations import Equations
from ceres_cal.observations import Columns, Observations, View
from ceres_cal.observations.sights import Sights
from ceres_cal.scene.targets import Arc

FEWEST_VIEWS = 4  # of which one may not belong
FEWEST = 3  # observations of a whole: two numbers of a line's offset, and one left over


@dataclass(frozen=True, eq=False)
class Wholes:
    """The wholes of one kind, by number; there are numbers of which nothing was observed.

    Attributes:
        observations: all of them. of: (N + M,) number of the whole of each, points by row and then curves by row; -1
            for none. size: how many numbers there are. frames: (V,) how many go with each view.
        of_features: whether they are features, or views and placements.
    """

    observations: Observations
    of: Indices32
    size: int
    frames: Indices
    of_features: bool = True

    def count(self, rows: Mask) -> Indices:
        """(size,) how many of these observations (N + M,) each has."""
        return np.bincount(np.where(rows, self.of, -1) + 1, minlength=self.size + 1)[1:]

    def among(self, numbers: Indices) -> Mask:
        """(N + M,) the observations of some of them."""
        chosen = np.zeros(self.size + 1, dtype=bool)  # whose last is that of -1
        chosen[numbers] = True
        return np.asarray(chosen[self.of])

    def modes(self, equations: Equations, chosen: Indices) -> tuple[Array, Indices]:
        """How each of the chosen may lie aside, columns (E, K) of order one; its place among them (E,), -1 for none.

        A line may lie aside along its image's normal and be turned, an arc also be bent, a point lie aside either way;
        a view may be one from elsewhere, or of a target that is longer, wider, askew or bowed.
        """
        place = np.full(self.size + 1, -1)
        place[chosen] = np.arange(len(chosen))
        group = place[self.of[equations.observation]]
        every = np.zeros((len(equations), 3)) if self.of_features else _view_modes(equations)
        for number in range(len(chosen)):
            rows = np.flatnonzero(group == number)
            if self.of_features and len(rows):
                every[rows] = _feature_modes(equations, rows)
            sizes = np.sqrt(np.mean(every[rows] ** 2, axis=0)) if len(rows) else np.ones(every.shape[1])
            every[rows] /= np.where(sizes > 0.0, sizes, 1.0)
        return every, np.asarray(group)

    def name(self, number: int) -> str:
        """What one of them is, as in "line 'HalfwayLine' in frame '0003'"."""
        observations, row = self.observations, int(np.argmax(self.of == number))
        if not self.of_features:
            return self._view_name(row)
        points = len(observations.points)
        kind, row = ("curve", row - points) if row >= points else ("point", row)
        at = int((observations.curves if kind == "curve" else observations.points).view[row])
        view, feature = observations.views[at], observations.feature_name(kind, row)
        if kind == "curve":
            kind = "arc" if isinstance(observations.targets[view.target].curves[feature], Arc) else "line"
        where = f"frame {view.frame!r}" if self.frames[at] == 1 else f"all {self.frames[at]} frames"
        return f"{kind} {feature!r} in {where}{_seen_by(observations, view)}"

    def _view_name(self, row: int) -> str:
        observations = self.observations
        points = len(observations.points)
        column: Columns = observations.curves if row >= points else observations.points
        view = observations.views[int(column.view[row - points if row >= points else row])]
        if view.placement is not None:
            return f"placement {view.placement!r}"
        return f"frame {view.frame!r}{_seen_by(observations, view)}"


def _seen_by(observations: Observations, view: View) -> str:
    return f" of station {view.station!r}" if len(observations.stations) > 1 else ""


def _feature_modes(equations: Equations, rows: Indices) -> Array:
    """(N, 3) of a line, an arc or a point."""
    modes = np.zeros((len(rows), 3))
    if not equations.is_curve[rows[0]]:
        modes[:, :2] = equations.direction[rows]
        return modes
    away = equations.pixel[rows] - np.mean(equations.pixel[rows], axis=0)
    axes = 2 if equations.sights.is_arc[equations.feature[rows[0]]] else 1
    modes[:, 0] = 1.0
    modes[:, 1 : 1 + axes] = away @ np.linalg.eigh(away.T @ away)[1][:, ::-1][:, :axes]
    return modes


def _view_modes(equations: Equations) -> Array:
    """(E, 11) of another pose, and of a target that is stretched, sheared or bowed.

    Not twisted or wavy: with five shapes to choose from a good board of a real set came into doubt.
    """
    rotations = equations.poses[equations.sight][:, :, :3]
    along = np.einsum("ei,eij->ej", equations.motion, rotations[:, :, :2])
    x, y = equations.place[:, :2].T
    stretch = np.column_stack([along[:, 0] * x, along[:, 1] * y, along[:, 0] * y])
    bows = np.where(equations.is_curve[:, None], 0.0, equations.built[:, 2:4])
    return np.hstack([equations.pose, stretch, bows])


def wholes_of(observations: Observations, sights: Sights) -> Iterator[Wholes]:
    """Curves in single frames; where a static camera has several, curves and points over all of them; then frames and
    placements, where there are enough.
    """
    views = np.arange(len(observations.views))
    together, frames = np.full(len(views), -1), np.zeros_like(views)
    for number, (key, own) in enumerate(zip(sights.keys, sights.views, strict=True)):
        if key.placement is None and len(own) > 1:
            together[list(own)], frames[list(own)] = number, len(own)
    if len(observations.curves):
        yield _wholes(observations, views, np.ones_like(views))
        if np.any(frames):
            yield _wholes(observations, together, frames)
    placed: dict[str, int] = {}
    owner = views.copy()
    for number, view in enumerate(observations.views):
        if view.placement is not None:
            owner[number] = len(views) + placed.setdefault(view.placement, len(placed))
    owner[(owner < len(views)) & (frames == 0)] = -1
    if len(distinct(owner[owner >= 0])) >= FEWEST_VIEWS:
        of = owner[np.concatenate([observations.points.view, observations.curves.view])]
        yield Wholes(observations, of.astype(np.int32), len(views) + len(placed), frames, of_features=False)


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
    return Wholes(
        observations, np.where(takes_part, number, -1).astype(np.int32), (int(owner.max()) + 1) * 2 * names, frames
    )
