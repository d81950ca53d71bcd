"""Groups of observations that may be wrong as a whole: effects whose sizes are large.

A group is a curve in one frame, a feature over all frames of a static camera, a frame of a static camera, or a
placement. Each may be displaced in a few modes (an offset and a rotation of a line, another pose or shape of a board),
and all of them may be displaced a little. What the residuals say of all their offsets together is the evidence by which
explanations are compared (`robust/competing.py`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np

from ceres_cal.base import (
    Array,
    Frozen,
    Indices,
    Indices32,
    Mask,
    distinct,
    eigh,
    median,
    numbers_of,
    replace,
    two_digits,
)
from ceres_cal.effects.columns import EffectColumns, SparseColumns
from ceres_cal.effects.evidence import (
    FEATURE_ASIDE,
    LEAST_PX,
    OFFSETS_SCATTER,
    VIEW_ASIDE,
    RandomEffects,
    SizePrior,
    logsum,
)
from ceres_cal.effects.linearised import Linearised
from ceres_cal.observations import Observations, Sights, View, column_of
from ceres_cal.problem import Equations, Estimate
from ceres_cal.scene.targets import Arc

FEWEST_VIEWS = 4  # views from which on one of them may be found wrong


class ObservationGroups(Frozen, ABC):
    """The groups of one kind, by number, each of which may be misplaced. Some numbers may have no observations.

    Attributes:
        kind: of the effect. prior: on the offset of a misplaced group. most_views: number of views compared with one
            another. remedy: what to check if a group is wrong.
        observations: all of them. of: (N + M,) number of each observation's group, points by row and then curves by
            row; -1 for none. size: number of groups. frames: (V,) number of frames in the group of each view.
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
        """(size,) numbers of the given observations (N + M,) in each group."""
        return np.bincount(np.where(rows, self.of, -1) + 1, minlength=self.size + 1)[1:]

    def among(self, numbers: Indices | Sequence[int]) -> Mask:
        """(N + M,) mask of the observations of some groups."""
        chosen = np.zeros(self.size + 1, dtype=bool)  # the last entry stands for group -1
        chosen[np.asarray(numbers, dtype=np.int64)] = True
        return np.asarray(chosen[self.of])

    def columns(self, equations: Equations, chosen: Indices) -> EffectColumns:
        """Columns, of order one, of how the chosen groups may be displaced, in standard deviations of an equation."""
        place = np.full(self.size + 1, -1)
        place[chosen] = np.arange(len(chosen))
        group = place[self.of[equations.observation]]
        every = self.modes(equations, group)
        for number in range(len(chosen)):
            rows = np.flatnonzero(group == number)
            sizes = np.sqrt(np.mean(every[rows] ** 2, axis=0)) if len(rows) else np.ones(every.shape[1])
            every[rows] /= np.where(sizes > 0.0, sizes, 1.0)
        return EffectColumns(every, np.asarray(group), tuple(map(str, chosen.tolist())), kind=self.kind)

    def name(self, number: int) -> str:
        """The name of a group, as in "line 'HalfwayLine' in frame '0003'"."""
        row = int(np.argmax(self.of == number))
        at = int(column_of(self.observations, "view")[row])
        view, several = self.observations.views[at], len(self.observations.stations) > 1
        seen_by = f" of station {view.station!r}" if several else ""
        return self.called(view, row, int(self.frames[at]), seen_by)

    @abstractmethod
    def modes(self, equations: Equations, group: Indices) -> Array:
        """(E, K) the modes of displacement, by group (E,), -1 for none."""

    @abstractmethod
    def called(self, view: View, row: int, frames: int, seen_by: str) -> str:
        """The name of the group of an observation of a view; `frames` is the number of frames in the group."""


class FeatureGroups(ObservationGroups):
    """Features, in a frame or in all frames of a static camera.

    A line may be displaced along its normal in the image and rotated, an arc also bent, and a point displaced along
    both axes.
    """

    kind = "feature aside"
    prior = FEATURE_ASIDE
    most_views = 8
    remedy = "check the label, where it is painted, and the target's dimensions"

    def modes(self, equations: Equations, group: Indices) -> Array:
        every = np.zeros((len(equations), 3))
        for number in distinct(group[group >= 0]):
            rows = np.flatnonzero(group == number)
            every[rows] = _feature_modes(equations, rows)
        return every

    def called(self, view: View, row: int, frames: int, seen_by: str) -> str:
        observations, points = self.observations, len(self.observations.points)
        kind, row = ("curve", row - points) if row >= points else ("point", row)
        feature = observations.feature_name(kind, row)
        if kind == "curve":
            kind = "arc" if isinstance(observations.targets[view.target].curves[feature], Arc) else "line"
        where = f"frame {view.frame!r}" if frames == 1 else f"all {frames} frames"
        return f"{kind} {feature!r} in {where}{seen_by}"


class ViewGroups(ObservationGroups):
    """Frames of a static camera, and placements.

    One of them may be a view from elsewhere, or of a target that is longer, wider, sheared or bowed.
    """

    kind = "view aside"
    prior = VIEW_ASIDE
    most_views = 24
    remedy = "look at its picture: did the camera or the target move, or was it bent?"

    def modes(self, equations: Equations, group: Indices) -> Array:
        return _view_modes(equations)

    def called(self, view: View, row: int, frames: int, seen_by: str) -> str:
        return f"frame {view.frame!r}{seen_by}" if view.placement is None else f"placement {view.placement!r}"


def _feature_modes(equations: Equations, rows: Indices) -> Array:
    """(N, 3) modes of a line, an arc or a point."""
    modes = np.zeros((len(rows), 3))
    if not equations.is_curve[rows[0]]:
        modes[:, :2] = equations.direction[rows]
        return modes
    away = equations.pixel[rows] - np.mean(equations.pixel[rows], axis=0)
    axes = 2 if equations.sights.is_arc[equations.feature[rows[0]]] else 1
    modes[:, 0] = 1.0
    modes[:, 1 : 1 + axes] = away @ eigh(away.T @ away)[1][:, ::-1][:, :axes]
    return modes


def _view_modes(equations: Equations) -> Array:
    """(E, 11) modes of another pose, and of a target that is stretched, sheared or bowed.

    A twist and waves are left out: with five shapes to choose from, a good board of a real set became doubtful.
    """
    rotations = equations.poses[equations.sight][:, :, :3]
    along = np.einsum("ei,eij->ej", equations.motion, rotations[:, :, :2])
    x, y = equations.place[:, :2].T
    stretch = np.column_stack([along[:, 0] * x, along[:, 1] * y, along[:, 0] * y])
    bows = np.where(equations.is_curve[:, None], 0.0, equations.built[:, 2:4])
    return np.hstack([equations.pose, stretch, bows])


def groups_of(sights: Sights) -> Iterator[ObservationGroups]:
    """Curves in single frames; curves and points over all frames of a static camera; then frames and placements, if
    there are enough of them.
    """
    observations = sights.observations
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
    """Features by the owner (V,) of their views, -1 for none; in single frames only curves."""
    view, feature = (column_of(observations, name).astype(np.int64) for name in ("view", "feature"))
    is_curve = np.arange(len(view)) >= len(observations.points)
    takes_part = (owner[view] >= 0) & (is_curve | (frames[view] > 1))
    targets, names = len(observations.targets), int(feature.max(initial=0)) + 1
    target = numbers_of((one.target for one in observations.views), observations.targets)
    number = ((owner[view] * 2 + is_curve) * targets + target[view]) * names + feature  # feature: from 0 per target
    return FeatureGroups(
        observations,
        np.where(takes_part, number, -1).astype(np.int32),
        (int(owner.max()) + 1) * 2 * targets * names,
        frames,
    )


# ---- offsets of all groups ------------------------------------------------------------------------------------------


class Offsets(Frozen):
    """The information of residuals on the offsets of G groups.

    Attributes:
        effects: the modes of the groups as random effects. modes: (G, R, M) the effect of an offset of each group on
            them.
        prior: that a group is wrong, and the size of its offset.
    """

    effects: RandomEffects
    modes: Array
    prior: SizePrior

    def log_evidence(self, wrong: Sequence[int] = ()) -> float:
        """Log evidence that these groups are wrong, and all others scatter alike."""
        return float(self._log_evidence(self._together(wrong)[None], len(wrong))[0])

    def log_evidence_with_each(self, wrong: Sequence[int] = ()) -> Array:
        """(G,) log evidence with each one of the groups wrong as well; -inf for those that already are."""
        known = np.broadcast_to(self._together(wrong), (len(self.modes), *self._together(wrong).shape))
        evidence = self._log_evidence(np.concatenate([known, self.modes], axis=2), len(wrong) + 1)
        evidence[list(wrong)] = -np.inf
        return evidence

    def odds(self, one: int, wrong: Sequence[int]) -> tuple[float, int | None]:
        """Log odds that one of the wrong groups is wrong, against that none, or another group in its place, is wrong;
        and the number of that other group, or None.
        """
        others = [other for other in wrong if other != one]
        each, none = self.log_evidence_with_each(others), self.log_evidence(others)
        evidence, each[one] = float(each[one]), -np.inf
        rival = int(np.argmax(each))
        return evidence - max(none, float(each[rival])), rival if each[rival] > none else None

    def next(self, wrong: Sequence[int]) -> int | None:
        """The group that is also wrong, if these are; None where there is none."""
        each = self.log_evidence_with_each(wrong)
        best = int(np.argmax(each))
        return best if each[best] > self.log_evidence(wrong) else None

    def _together(self, groups: Sequence[int]) -> Array:
        """(R, K) modes of some groups side by side."""
        return np.concatenate([np.zeros((self.modes.shape[1], 0)), *self.modes[list(groups)]], axis=1)

    def _log_evidence(self, modes: Array, count: int) -> Array:
        """(H,) log evidence of hypotheses with `count` wrong groups, whose modes (H, R, K) have offsets of
        their own.
        """
        sizes, scatter = self.prior.sizes[: None if count else 1], OFFSETS_SCATTER.scatter
        logs = self.effects.log_evidence(modes, scatter, np.array(sizes))
        priors = np.tile(OFFSETS_SCATTER.probabilities / len(sizes), len(sizes))
        total = logsum(logs.reshape(len(modes), -1) + np.log(priors))
        return np.asarray(total + count * np.log((1.0 - self.prior.absent) / len(self.modes)))


def measure_offsets(model: Linearised, effect: EffectColumns, prior: SizePrior) -> Offsets:
    """Measure the offsets of groups from a model's residuals.

    Args:
        effect: its columns, here in standard deviations of an equation, of order one. prior: that a group is wrong, and
            the size of its offset.
    """
    columns, group = effect.columns, effect.group
    groups, width = int(group.max()) + 1, columns.shape[1]
    rows = np.flatnonzero((group >= 0) & model.used)
    every = SparseColumns.of_groups(model, columns, group, groups)
    there = np.flatnonzero(every.summed(every.values))
    normal, slope, _ = every.left_of(model)
    normal, slope = normal[np.ix_(there, there)], slope[there]
    least = 1e-5 * float(np.bincount(group[rows]).max())  # what the model must leave of a direction to be judged
    effects = RandomEffects.of(normal, slope, least)
    rest = float(np.sum(model.left_over[model.used] ** 2) - effects.value @ effects.value)
    exact = model.spare * (LEAST_PX * median(model.weight[rows])) ** 2
    modes = effects.modes(np.eye(groups * width)[there]).reshape(-1, groups, width)
    effects = replace(effects, rest=max(rest, exact), freedom=float(model.spare))
    return Offsets(effects, np.swapaxes(modes, 0, 1), prior)


DOUBTFUL = 3.0
"""Log odds below which both explanations are reported: 20 to 1, a probability of 95 %."""


class Explanation(Frozen):
    """The explanation that a group of observations is wrong.

    Attributes:
        name: of the group. rows: (N + M,) its observations, points by row and then curves by row. aside_px: median
            distance from its nominal position. log_odds: natural logarithm of the odds that it is wrong.
        remedy: what to check. other: the estimate under the less probable explanation.
    """

    name: str
    rows: Mask
    aside_px: float
    log_odds: float
    remedy: str
    other: Estimate

    @property
    def doubt(self) -> float:
        """Probability of the less probable explanation."""
        return float(1.0 / (1.0 + np.exp(abs(self.log_odds))))

    @property
    def is_doubtful(self) -> bool:
        """Whether both explanations are to be reported."""
        return abs(self.log_odds) < DOUBTFUL

    @property
    def is_taken(self) -> bool:
        """Whether it is the more probable explanation, so that its observations are left out."""
        return self.log_odds > 0.0

    @property
    def words(self) -> str:
        """The explanation in words."""
        return f"the whole of {self.name}: {np.count_nonzero(self.rows)} rows, {two_digits(self.aside_px)} px off"

    @property
    def warning(self) -> str:
        """The warning for users of the calibration."""
        if not self.is_doubtful:
            return f"{self.words}: taken out together; {self.remedy}"
        where = f"{self.name} may be {two_digits(self.aside_px)} px off its nominal position"
        sure = f"probability {100.0 * (1.0 - self.doubt if self.is_taken else self.doubt):.0f} %"
        how = "taken out together" if self.is_taken else "used"
        return (
            f"{where} ({sure}; {np.count_nonzero(self.rows)} rows, {how}). The stated uncertainties include this. "
            "Look at it in the picture, or observe more"
        )
