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

from ceres_cal.base.arrays import Array, Indices, median
from ceres_cal.effects.columns import SparseColumns
from ceres_cal.effects.evidence import RandomEffects, logsum
from ceres_cal.effects.linearised import Linearised

# Probability, before anything was seen, that some feature does not belong (lines are painted by hand), or some view.
# From half to double the log odds change by 0.7, of a line 3 px aside they are 10 to 20. At 0.1 two of 200 sound
# fields come into doubt; at 0.01 a quarter of the lines four standard deviations aside go unseen that need not.
_FAULTY_FEATURE, _FAULTY_VIEW = 0.05, 0.01
# Probability, before anything was seen, that errors do not go together along features. The log odds change by as much.
_INDEPENDENT = 0.5
# Standard deviations of offsets in those of one observation's noise: of what belongs; of what does not; of features
# that do not, besides.
_SCATTER = np.concatenate([[0.0], np.geomspace(0.1, 60.0, 14)])
_SCATTER_PRIOR = np.where(_SCATTER == 0.0, _INDEPENDENT, (1.0 - _INDEPENDENT) / (len(_SCATTER) - 1))
_ASIDE = (10.0, 40.0, 160.0)
_LEAST_ASIDE = 3.0
_LEAST_PX = 1e-3  # noise that nothing is measured better than: of exact observations rounding is no offset
_DETERMINED = 1e-5  # of the largest squared length of a mode: what the model leaves of directions that can be judged


@dataclass(frozen=True)
class Fault:
    """What is expected of groups that do not belong, before anything was seen.

    Attributes:
        probability: that there is one. sizes: standard deviations of its offset, each as likely, in those of one
            observation's noise.
    """

    probability: float
    sizes: tuple[float, ...]


def fault_of(features: bool) -> Fault:
    """Of features, or of views and placements."""
    return Fault(_FAULTY_FEATURE, (_LEAST_ASIDE, *_ASIDE)) if features else Fault(_FAULTY_VIEW, _ASIDE)


@dataclass(frozen=True, eq=False)
class Offsets:
    """What residuals say of the offsets of G groups.

    Attributes:
        effects: their modes as random effects. modes: (G, R, M) what an offset of each group does to them.
        fault: of groups that do not belong.
    """

    effects: RandomEffects
    modes: Array
    fault: Fault

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
        sizes = self.fault.sizes[: None if count else 1]
        logs = np.stack([self.effects.log_evidence(aside * modes, _SCATTER) for aside in sizes], axis=1)
        every = logs.reshape(len(modes), -1)
        priors = np.tile(_SCATTER_PRIOR / len(sizes), len(sizes))
        total = logsum(every + np.log(priors))
        return np.asarray(total + count * np.log(self.fault.probability / len(self.modes)))


def measure_offsets(model: Linearised, columns: Array, group: Indices, fault: Fault) -> Offsets:
    """What a model's residuals say of offsets.

    Args:
        columns: (E, M) of the modes, in standard deviations, of order one. group: (E,) of each equation, -1 in none.
        fault: of groups that do not belong.
    """
    groups, width = int(group.max()) + 1, columns.shape[1]
    rows = np.flatnonzero((group >= 0) & model.used)
    every = SparseColumns.of_groups(model, columns, group, groups)
    there = np.flatnonzero(every.summed(every.values))
    normal, slope = every.left_of(model)
    normal, slope = normal[np.ix_(there, there)], slope[there]
    effects = RandomEffects.of(normal, slope, _DETERMINED * float(np.bincount(group[rows]).max()))
    rest = float(np.sum(model.left_over[model.used] ** 2) - effects.value @ effects.value)
    least = model.spare * (_LEAST_PX * median(model.weight[rows])) ** 2
    modes = effects.modes(np.eye(groups * width)[there]).reshape(-1, groups, width)
    effects = replace(effects, rest=max(rest, least), freedom=float(model.spare))
    return Offsets(effects, np.swapaxes(modes, 0, 1), fault)
