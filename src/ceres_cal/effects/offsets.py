"""Offsets of whole features: which of them lies farther aside than the others scatter, and how surely.

Each group of equations (a line in one frame, say) may lie aside by a few modes: an offset along all of it, a turn. The
model takes up some of that, and what it leaves of all modes together, u with covariance V where errors are independent,
is all that the residuals say of offsets. Errors that go together along a line offset it, too: offsets of variance tau^2
in all groups make the covariance of u

    V + tau^2 V V,    with V = U S U^T that of w = S^-1/2 U^T u    1 + tau^2 S,

so along each direction by itself. A group that does not belong has an offset of much larger variance besides. Both
explanations are weighed by their evidence (marginal likelihood; Kass and Raftery, JASA 90, 1995) with tau, the size of
the wrong offset and the noise integrated out: nothing is a fault that the scatter of the others explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, median
from ceres_cal.effects.columns import EffectColumns, SparseColumns
from ceres_cal.effects.evidence import LEAST_PX, OFFSETS_SCATTER, RandomEffects, SizePrior, logsum
from ceres_cal.effects.linearised import Linearised

_DETERMINED = 1e-5  # of the largest squared length of a mode: what the model leaves of directions that can be judged


@dataclass(frozen=True, eq=False)
class Offsets:
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

    def _together(self, groups: Sequence[int]) -> Array:
        """(R, K) modes of some groups side by side."""
        return np.concatenate([np.zeros((self.modes.shape[1], 0)), *self.modes[list(groups)]], axis=1)

    def _log_evidence(self, modes: Array, count: int) -> Array:
        """(H,) of hypotheses with so many wrong groups, whose modes (H, R, K) have offsets of their own."""
        sizes, scatter = self.prior.sizes[: None if count else 1], OFFSETS_SCATTER.scatter
        logs = np.stack([self.effects.log_evidence(aside * modes, scatter) for aside in sizes], axis=1)
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
    normal, slope = every.left_of(model)
    normal, slope = normal[np.ix_(there, there)], slope[there]
    effects = RandomEffects.of(normal, slope, _DETERMINED * float(np.bincount(group[rows]).max()))
    rest = float(np.sum(model.left_over[model.used] ** 2) - effects.value @ effects.value)
    least = model.spare * (LEAST_PX * median(model.weight[rows])) ** 2
    modes = effects.modes(np.eye(groups * width)[there]).reshape(-1, groups, width)
    effects = replace(effects, rest=max(rest, least), freedom=float(model.spare))
    return Offsets(effects, np.swapaxes(modes, 0, 1), prior)
