"""Observations that belong, or not, as a group, and which of them are compared with one another.

A curve in one frame, a feature over all frames of a static camera; a frame of a static camera, a placement. Whether one
does not belong rests on a few rows of a few views: of those that stand out, and of others, evenly. So of very many
observations a part is compared, with all rows of the views that stand out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import AnyArray, Array, Indices, Indices32, Mask, distinct, median
from ceres_cal.base.frozen import Frozen, replace
from ceres_cal.effects.columns import EffectColumns
from ceres_cal.effects.evidence import FEATURE_ASIDE, VIEW_ASIDE, SizePrior
from ceres_cal.observations import Columns, Observations, View
from ceres_cal.observations.sights import Sights, column_of
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.residuals import Equations
from ceres_cal.robust.robust import RobustSolution
from ceres_cal.scene.targets import Arc

FEWEST_VIEWS = 4  # of which one may not belong
FEWEST = 3  # observations of a group: two numbers of a line's offset, and one left over


class ObservationGroups(Frozen, ABC):
    """The groups of one kind, by number, each of which may lie aside: an effect whose size is large. There are numbers
    of which nothing was observed.

    Attributes:
        kind: of the effect. prior: of one that lies aside. most_views: that are compared with one another. remedy: what
            to look at where one does not belong.
        observations: all of them. of: (N + M,) number of the group of each, points by row and then curves by row; -1
            for none. size: how many numbers there are. frames: (V,) how many go with each view.
    """

    kind: ClassVar[str]
    prior: ClassVar[SizePrior]
    most_views: ClassVar[int]
    remedy: ClassVar[str]
    observations: Observations
    of: Indices32
    size: int
    frames: Indices

    def count(self, rows: Mask) -> Indices:
        """(size,) how many of these observations (N + M,) each has."""
        return np.bincount(np.where(rows, self.of, -1) + 1, minlength=self.size + 1)[1:]

    def among(self, numbers: Indices) -> Mask:
        """(N + M,) the observations of some of them."""
        chosen = np.zeros(self.size + 1, dtype=bool)  # whose last is that of -1
        chosen[numbers] = True
        return np.asarray(chosen[self.of])

    def columns(self, equations: Equations, chosen: Indices) -> EffectColumns:
        """How each of the chosen may lie aside, in standard deviations of an equation, columns of order one."""
        place = np.full(self.size + 1, -1)
        place[chosen] = np.arange(len(chosen))
        group = place[self.of[equations.observation]]
        every = self.modes(equations, group)
        for number in range(len(chosen)):
            rows = np.flatnonzero(group == number)
            sizes = np.sqrt(np.mean(every[rows] ** 2, axis=0)) if len(rows) else np.ones(every.shape[1])
            every[rows] /= np.where(sizes > 0.0, sizes, 1.0)
        return EffectColumns(self.kind, every, np.asarray(group), tuple(map(str, chosen.tolist())))

    @abstractmethod
    def modes(self, equations: Equations, group: Indices) -> Array:
        """(E, K) the ways to lie aside, by group (E,), -1 for none."""

    @abstractmethod
    def name(self, number: int) -> str:
        """What one of them is, as in "line 'HalfwayLine' in frame '0003'"."""

    @abstractmethod
    def standing_out(self, end: RobustSolution, taking_part: Mask) -> Array:
        """(V,) how far what they are, or have, in each view stands out."""


class FeatureGroups(ObservationGroups):
    """Features, in a frame or in all frames of a static camera.

    A line may lie aside along its image's normal and be turned, an arc also be bent, a point lie aside either way.
    """

    kind = "feature aside"
    prior = FEATURE_ASIDE
    most_views = 8
    remedy = "check the label, and where it is painted"

    def modes(self, equations: Equations, group: Indices) -> Array:
        every = np.zeros((len(equations), 3))
        for number in distinct(group[group >= 0]):
            rows = np.flatnonzero(group == number)
            every[rows] = _feature_modes(equations, rows)
        return every

    def name(self, number: int) -> str:
        observations, row = self.observations, int(np.argmax(self.of == number))
        points = len(observations.points)
        kind, row = ("curve", row - points) if row >= points else ("point", row)
        at = int((observations.curves if kind == "curve" else observations.points).view[row])
        view, feature = observations.views[at], observations.feature_name(kind, row)
        if kind == "curve":
            kind = "arc" if isinstance(observations.targets[view.target].curves[feature], Arc) else "line"
        where = f"frame {view.frame!r}" if self.frames[at] == 1 else f"all {self.frames[at]} frames"
        return f"{kind} {feature!r} in {where}{_seen_by(observations, view)}"

    def standing_out(self, end: RobustSolution, taking_part: Mask) -> Array:
        return _largest(self.observations, end)


class ViewGroups(ObservationGroups):
    """Frames of a static camera, and placements.

    One may be a view from elsewhere, or of a target that is longer, wider, askew or bowed.
    """

    kind = "view aside"
    prior = VIEW_ASIDE
    most_views = 24
    remedy = "look at its picture: did the camera or the target move, or was it bent?"

    def modes(self, equations: Equations, group: Indices) -> Array:
        return _view_modes(equations)

    def name(self, number: int) -> str:
        observations, row = self.observations, int(np.argmax(self.of == number))
        points = len(observations.points)
        column: Columns = observations.curves if row >= points else observations.points
        view = observations.views[int(column.view[row - points if row >= points else row])]
        if view.placement is not None:
            return f"placement {view.placement!r}"
        return f"frame {view.frame!r}{_seen_by(observations, view)}"

    def standing_out(self, end: RobustSolution, taking_part: Mask) -> Array:
        return excess(self, end, taking_part)[_owner(self, column_of(self.observations, "view"))]


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


def groups_of(observations: Observations, sights: Sights) -> Iterator[ObservationGroups]:
    """Curves in single frames; where a static camera has several, curves and points over all of them; then frames and
    placements, where there are enough.
    """
    views = np.arange(len(observations.views))
    together, frames = np.full(len(views), -1), np.zeros_like(views)
    for number, (key, own) in enumerate(zip(sights.keys, sights.views, strict=True)):
        if key.placement is None and len(own) > 1:
            together[list(own)], frames[list(own)] = number, len(own)
    if len(observations.curves):
        yield _features(observations, views, np.ones_like(views))
        if np.any(frames):
            yield _features(observations, together, frames)
    placed: dict[str, int] = {}
    owner = views.copy()
    for number, view in enumerate(observations.views):
        if view.placement is not None:
            owner[number] = len(views) + placed.setdefault(view.placement, len(placed))
    owner[(owner < len(views)) & (frames == 0)] = -1
    if len(distinct(owner[owner >= 0])) >= FEWEST_VIEWS:
        of = owner[column_of(observations, "view")]
        yield ViewGroups(observations, of.astype(np.int32), len(views) + len(placed), frames)


def _features(observations: Observations, owner: Indices, frames: Indices) -> FeatureGroups:
    """Of features by owner (V,) of their views, -1 for none; of single frames only curves."""
    columns = (observations.points, observations.curves)
    view, feature = (
        np.concatenate([getattr(column, name) for column in columns]).astype(np.int64) for name in ("view", "feature")
    )
    is_curve = np.arange(len(view)) >= len(observations.points)
    takes_part = (owner[view] >= 0) & (is_curve | (frames[view] > 1))
    targets = {name: number for number, name in enumerate(observations.targets)}  # each counts its features from 0
    target = np.array([targets[one.target] for one in observations.views])
    names = int(feature.max(initial=0)) + 1
    number = ((owner[view] * 2 + is_curve) * len(targets) + target[view]) * names + feature
    return FeatureGroups(
        observations,
        np.where(takes_part, number, -1).astype(np.int32),
        (int(owner.max()) + 1) * 2 * len(targets) * names,
        frames,
    )


# Share of a group's observations in use below which it is compared in any case: its other rows are good by chance.
_LEFT = 0.5
# Observations that are asked, and views of them: what the free numbers take up is projected out of the few rows that
# are compared, so a solve has but to end in the right valley.
_MOST_ASKED, _FEWEST_ASKED = 200_000, 200


class Subproblem(Frozen):
    """The observations that are asked, with their problem and its end.

    Attributes:
        kinds: of groups, numbered as among all of them.
    """

    problem: Problem
    observations: Observations
    end: RobustSolution
    kinds: Sequence[ObservationGroups]

    def of_rows(self, rows: Mask) -> Problem:
        """The problem of these (n + m,)."""
        points = len(self.observations.points)
        return self.problem.used(rows[:points], rows[points:])

    def without(self, rows: Mask) -> Problem:
        """The problem of the others: no placement that they do not show is free."""
        others = self.of_rows(~rows)
        return replace(others, layout=others.layout.of(others.sights.keys))


def compared_part(every: Subproblem) -> Subproblem:
    """All observations, or of very many some: of views that stand out, and of others evenly."""
    most_rejected = 4  # such groups of a kind, whose views are asked
    observations, sights = every.observations, every.problem.sights
    if len(sights.point_rows) + len(sights.curve_rows) <= _MOST_ASKED:
        return every
    points = len(observations.points)
    there = np.zeros(points + len(observations.curves), dtype=bool)
    there[sights.point_rows] = there[points + sights.curve_rows] = True
    view = column_of(observations, "view")
    chosen = np.zeros(len(observations.views), dtype=bool)
    chosen[some_views(np.bincount(view[there], minlength=len(chosen)), _MOST_ASKED, _FEWEST_ASKED)] = True
    for groups in every.kinds:
        gone = mostly_rejected(groups, every.end, there)
        worst = np.argsort(-gone, kind="stable")[: min(most_rejected, np.count_nonzero(gone))]
        chosen |= views_compared(groups, every.end, there, groups.among(worst) & there)
    there &= chosen[view]
    rows = np.flatnonzero(there)[:: max(1, int(np.count_nonzero(there)) // (2 * _MOST_ASKED))]
    return _part(every, rows, int(np.searchsorted(rows, points)))


def some_views(counts: Indices, most: int, fewest: int) -> Indices:
    """Numbers of some of the views that show anything, so many observations (V,) each, evenly: as many as hold what is
    asked, and no fewer than a few.
    """
    shown = np.flatnonzero(counts)
    taken = min(max(fewest, len(shown) * most // int(counts.sum())), len(shown))
    return np.asarray(shown[np.linspace(0, len(shown) - 1, taken).astype(np.int64)])


def _part(every: Subproblem, rows: Indices, split: int) -> Subproblem:
    """Some rows (n + m,) of all, the first of them points, as if there were no others."""
    p, c = rows[:split], rows[split:] - len(every.observations.points)
    observations, problem = every.observations.part(p, c), every.problem.of_rows(p, c)
    there, inliers = every.end.residuals.of_rows(p, c), every.end.inliers.of_rows(p, c)
    weighting = every.end.problem.weighting
    used = replace(problem.used(inliers.points, inliers.curves), weighting=weighting, feet=there.feet)
    end = replace(every.end, problem=used, inliers=inliers, residuals=there)
    kinds = [replace(groups, observations=observations, of=groups.of[rows]) for groups in every.kinds]
    return Subproblem(problem, observations, end, kinds)


# ---- what is compared ----------------------------------------------------------------------------------------------


def rows_compared(groups: ObservationGroups, end: RobustSolution, taking_part: Mask, recalled: Mask) -> Mask:
    """(N + M,) of some views, and of each group in them some.

    Args:
        taking_part: (N + M,) all that may be. recalled: (N + M,) what is compared whether or not it is an inlier.
    """
    inside, view = taking_part & (end.inliers.rows | recalled), column_of(groups.observations, "view")
    rows = np.flatnonzero(inside & views_compared(groups, end, inside, recalled)[view])
    inside[:] = False
    key = groups.of[rows].astype(np.int64) * len(groups.frames) + view[rows]
    inside[_thinned(rows, key, groups.of[rows] >= 0)] = True
    return inside


def views_compared(groups: ObservationGroups, end: RobustSolution, taking_part: Mask, recalled: Mask) -> Mask:
    """(V,) those with what is recalled, those that stand out, some of the others, and some without any group."""
    most_others = 16  # views besides, which tell the lens
    view = column_of(groups.observations, "view")
    shows_some = np.bincount(view[taking_part & (groups.of >= 0)], minlength=len(groups.frames))
    largest, most = groups.standing_out(end, taking_part), groups.most_views
    with_some, others = np.flatnonzero(shows_some), np.flatnonzero(shows_some == 0)
    chosen = np.zeros(len(shows_some), dtype=bool)
    chosen[distinct(view[recalled])[:most]] = True
    chosen[with_some[np.argsort(-largest[with_some], kind="stable")][: most // 2]] = True
    chosen[with_some[:: max(1, 2 * len(with_some) // most)]] = True
    chosen[others[:: max(1, len(others) // most_others)]] = True
    return chosen


def groups_compared(
    groups: ObservationGroups, end: RobustSolution, rows: Mask, recalled: Sequence[int]
) -> tuple[Indices, float]:
    """The numbers of those that have enough of the rows (N + M,), and which share of them that is.

    Of very many those that are recalled, those that stand out, and others evenly.
    """
    most_together = 256  # groups, at the cube of the number: 8 views of a field of 32 lines; 1350 took 25 s
    every = np.flatnonzero(groups.count(rows) >= FEWEST)
    if len(every) <= most_together:
        return every, 1.0
    standing_out = every[np.argsort(-excess(groups, end, rows)[every], kind="stable")]
    some = every[:: -(-2 * len(every) // most_together)]
    back = np.intersect1d(every, np.array(recalled, dtype=np.int64))
    chosen = distinct(np.concatenate([back, standing_out[: most_together // 2], some]))
    return chosen, len(chosen) / len(every)


def mostly_rejected(groups: ObservationGroups, end: RobustSolution, taking_part: Mask) -> Indices:
    """(size,) how many observations of each group are outliers, where most of them are; else 0."""
    counts, used = groups.count(taking_part), groups.count(end.inliers.rows & taking_part)
    return np.where((counts > FEWEST) & (used < _LEFT * counts), counts - used, 0)


def excess(groups: ObservationGroups, end: RobustSolution, taking_part: Mask) -> Array:
    """(size + 1,) by how many standard deviations the mean square residual of each view or placement is above the
    median one.
    """
    lengths = end.inliers.sigmas
    points, size = len(groups.observations.points), groups.size + 1
    of = np.where(end.inliers.rows & taking_part & (groups.of >= 0), groups.of, np.int64(groups.size))
    spare = 2.0 * np.bincount(of[:points], minlength=size) + np.bincount(of[points:], minlength=size)
    square = np.bincount(of, lengths**2, minlength=size)
    spare[-1] = square[-1] = 0.0  # of what is in none
    square, there = square / np.maximum(spare, 1.0), spare > 0.0
    middle = median(square[there]) if np.any(there) else 1.0
    return np.asarray((square / max(middle, 1e-12) - 1.0) / np.sqrt(2.0 / np.maximum(spare, 1.0)) * there)


def _owner(groups: ObservationGroups, view: AnyArray) -> Indices:
    """(V,) number of the group that each view is of; the last for none."""
    owner = np.full(len(groups.frames), groups.size)
    owner[view[groups.of >= 0]] = groups.of[groups.of >= 0]
    return owner


def _largest(observations: Observations, end: RobustSolution) -> Array:
    """(V,) the largest mean offset of a curve in each view, in standard deviations where errors are independent."""
    curves, names = observations.curves, int(observations.curves.feature.max(initial=0)) + 1
    own = curves.view * names + curves.feature
    sigmas = end.residuals.curves / (end.inliers.curve_scale * curves.sigma_px)
    inside = np.where(end.inliers.curves & np.isfinite(sigmas), sigmas, 0.0)
    size = len(observations.views) * names
    count = np.bincount(own, end.inliers.curves, minlength=size)
    mean = np.abs(np.bincount(own, inside, minlength=size)) / np.sqrt(np.maximum(count, 1.0))
    return np.asarray(mean.reshape(-1, names).max(axis=1))


def _thinned(rows: Indices, key: Indices, of_group: Mask) -> Indices:
    """Of rows with the same key some, evenly, where they are of a group."""
    most_rows = 40  # of a group in one view
    order = np.argsort(key, kind="stable")
    _, starts, count = np.unique(key[order], return_index=True, return_counts=True)
    place, size = np.arange(len(order)) - np.repeat(starts, count), np.repeat(count, count)
    most = np.where(of_group[order], np.minimum(size, most_rows), size)
    return np.asarray(rows[order[(place * most) // size != ((place - 1) * most) // size]])
