"""Groups of observations that may not belong, as a whole: effects whose sizes are large.

A curve in one frame, a feature over all frames of a static camera; a frame of a static camera, a placement. Each may
lie aside by a few modes (an offset and a turn of a line, another pose or shape of a board); all of them may lie aside a
little. What residuals say of all their offsets together is the evidence that competing explanations are weighed by
(`robust/competing.py`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Indices32, Mask, distinct, median, numbers_of, replace, two_digits
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

FEWEST_VIEWS = 4  # of which one may not belong


class ObservationGroups(Frozen, ABC):
    """The groups of one kind, by number, each of which may lie aside. There are numbers of which nothing was observed.

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

    def among(self, numbers: Indices | Sequence[int]) -> Mask:
        """(N + M,) the observations of some of them."""
        chosen = np.zeros(self.size + 1, dtype=bool)  # whose last is that of -1
        chosen[np.asarray(numbers, dtype=np.int64)] = True
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
        return EffectColumns(every, np.asarray(group), tuple(map(str, chosen.tolist())), kind=self.kind)

    def name(self, number: int) -> str:
        """What one of them is, as in "line 'HalfwayLine' in frame '0003'"."""
        row = int(np.argmax(self.of == number))
        at = int(column_of(self.observations, "view")[row])
        view, several = self.observations.views[at], len(self.observations.stations) > 1
        seen_by = f" of station {view.station!r}" if several else ""
        return self.called(view, row, int(self.frames[at]), seen_by)

    @abstractmethod
    def modes(self, equations: Equations, group: Indices) -> Array:
        """(E, K) the ways to lie aside, by group (E,), -1 for none."""

    @abstractmethod
    def called(self, view: View, row: int, frames: int, seen_by: str) -> str:
        """The name of the group of an observation of a view, which so many frames go with."""


class FeatureGroups(ObservationGroups):
    """Features, in a frame or in all frames of a static camera.

    A line may lie aside along its image's normal and be turned, an arc also be bent, a point lie aside either way.
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

    One may be a view from elsewhere, or of a target that is longer, wider, askew or bowed.
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


def groups_of(sights: Sights) -> Iterator[ObservationGroups]:
    """Curves in single frames; where a static camera has several, curves and points over all of them; then frames and
    placements, where there are enough.
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
    """Of features by owner (V,) of their views, -1 for none; of single frames only curves."""
    view, feature = (column_of(observations, name).astype(np.int64) for name in ("view", "feature"))
    is_curve = np.arange(len(view)) >= len(observations.points)
    takes_part = (owner[view] >= 0) & (is_curve | (frames[view] > 1))
    targets, names = len(observations.targets), int(feature.max(initial=0)) + 1
    target = numbers_of((one.target for one in observations.views), observations.targets)
    number = ((owner[view] * 2 + is_curve) * targets + target[view]) * names + feature  # each target's begin with 0
    return FeatureGroups(
        observations,
        np.where(takes_part, number, -1).astype(np.int32),
        (int(owner.max()) + 1) * 2 * targets * names,
        frames,
    )


# ---- what is said of all of them -----------------------------------------------------------------------------------


class Offsets(Frozen):
    """What residuals say of the offsets of G groups.

    Attributes:
        effects: their modes as random effects. modes: (G, R, M) what an offset of each group does to them.
        prior: of a group that does not belong, and of its offset.
    """

    effects: RandomEffects
    modes: Array
    prior: SizePrior

    def log_evidence(self, wrong: Sequence[int] = ()) -> float:
        """Of these groups not belonging, all others scattering alike."""
        return float(self._log_evidence(self._together(wrong)[None], len(wrong))[0])

    def log_evidence_with_each(self, wrong: Sequence[int] = ()) -> Array:
        """(G,) the same with each one of the groups besides; -inf for those that are there already."""
        known = np.broadcast_to(self._together(wrong), (len(self.modes), *self._together(wrong).shape))
        evidence = self._log_evidence(np.concatenate([known, self.modes], axis=2), len(wrong) + 1)
        evidence[list(wrong)] = -np.inf
        return evidence

    def odds(self, one: int, wrong: Sequence[int]) -> tuple[float, int | None]:
        """Log odds that one of the wrong groups does not belong, against that it does, or another one in its place:
        then which.
        """
        others = [other for other in wrong if other != one]
        each, none = self.log_evidence_with_each(others), self.log_evidence(others)
        evidence, each[one] = float(each[one]), -np.inf
        rival = int(np.argmax(each))
        return evidence - max(none, float(each[rival])), rival if each[rival] > none else None

    def next(self, wrong: Sequence[int]) -> int | None:
        """The group that does not belong, either, when these do not; None where there is none."""
        each = self.log_evidence_with_each(wrong)
        best = int(np.argmax(each))
        return best if each[best] > self.log_evidence(wrong) else None

    def _together(self, groups: Sequence[int]) -> Array:
        """(R, K) modes of some groups side by side."""
        return np.concatenate([np.zeros((self.modes.shape[1], 0)), *self.modes[list(groups)]], axis=1)

    def _log_evidence(self, modes: Array, count: int) -> Array:
        """(H,) of hypotheses with so many wrong groups, whose modes (H, R, K) have offsets of their own."""
        sizes, scatter = self.prior.sizes[: None if count else 1], OFFSETS_SCATTER.scatter
        logs = self.effects.log_evidence(modes, scatter, np.array(sizes))
        priors = np.tile(OFFSETS_SCATTER.probabilities / len(sizes), len(sizes))
        total = logsum(logs.reshape(len(modes), -1) + np.log(priors))
        return np.asarray(total + count * np.log((1.0 - self.prior.absent) / len(self.modes)))


def measure_offsets(model: Linearised, effect: EffectColumns, prior: SizePrior) -> Offsets:
    """What a model's residuals say of offsets.

    Args:
        effect: its columns, here in standard deviations of an equation, of order one. prior: of a group that does not
            belong.
    """
    columns, group = effect.columns, effect.group
    groups, width = int(group.max()) + 1, columns.shape[1]
    rows = np.flatnonzero((group >= 0) & model.used)
    every = SparseColumns.of_groups(model, columns, group, groups)
    there = np.flatnonzero(every.summed(every.values))
    normal, slope, _ = every.left_of(model)
    normal, slope = normal[np.ix_(there, there)], slope[there]
    least = 1e-5 * float(np.bincount(group[rows]).max())  # what the model leaves of directions that can be judged
    effects = RandomEffects.of(normal, slope, least)
    rest = float(np.sum(model.left_over[model.used] ** 2) - effects.value @ effects.value)
    exact = model.spare * (LEAST_PX * median(model.weight[rows])) ** 2
    modes = effects.modes(np.eye(groups * width)[there]).reshape(-1, groups, width)
    effects = replace(effects, rest=max(rest, exact), freedom=float(model.spare))
    return Offsets(effects, np.swapaxes(modes, 0, 1), prior)


DOUBTFUL = 3.0
"""Log odds between which both explanations are named: 19 to 1."""


class Explanation(Frozen):
    """That a group of observations does not belong.

    Attributes:
        name: of the group. rows: (N + M,) its observations, points by row and then curves by row. aside_px: how far it
            lies aside, the median. log_odds: natural logarithm of the odds that it does not belong.
        remedy: what to look at. other: the estimate of the less probable explanation.
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
        """Whether both explanations are to be named."""
        return abs(self.log_odds) < DOUBTFUL

    @property
    def is_taken(self) -> bool:
        """Whether it is the more probable one, and its observations are taken out."""
        return self.log_odds > 0.0

    @property
    def words(self) -> str:
        """What it says."""
        return f"the whole of {self.name}: {np.count_nonzero(self.rows)} rows, {two_digits(self.aside_px)} px off"

    @property
    def warning(self) -> str:
        """What to know before the calibration is used."""
        if not self.is_doubtful:
            return f"{self.words}: taken out together; {self.remedy}"
        where = f"{self.name} may be {two_digits(self.aside_px)} px off its nominal position"
        sure = f"probability {100.0 * (1.0 - self.doubt if self.is_taken else self.doubt):.0f} %"
        how = "taken out together" if self.is_taken else "used"
        return (
            f"{where} ({sure}; {np.count_nonzero(self.rows)} rows, {how}). The stated uncertainties include this. "
            "Look at it in the picture, or observe more"
        )
