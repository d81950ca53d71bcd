"""One step of least squares with everything at once that the residuals speak for: what a calibration would then be.

Causes that look alike share what they explain by what is expected of them, and what one moves another may take back.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.frozen import Frozen, cached_property
from ceres_cal.effects.effect import CameraEffect, Case
from ceres_cal.effects.score_tests import ScoreTest, Selection
from ceres_cal.effects.table import EFFECTS
from ceres_cal.problem.information import Key
from ceres_cal.problem.quantities import free_keys


class JointStep(Frozen):
    """What is wrong with the model of a case, all at once.

    Attributes:
        causes: groups of effects, with their likeliest amounts (Q,).
    """

    case: Case
    causes: tuple[tuple[ScoreTest, Array], ...]

    @cached_property
    def moves(self) -> dict[Key, float]:
        """By how much the free numbers move."""
        keys = free_keys(self.case.estimate, self.case.problem.layout, self.case.problem.private)
        steps = [self.case.model.taken_by(score.columns) @ amount for score, amount in self.causes]
        return dict(zip(keys, np.sum(steps, axis=0).tolist(), strict=True)) if steps else {}

    def displaced(self, camera: str, pixels: Array) -> Array:
        """(N, 2) px by which a camera displaces besides what it shows at pixels (N, 2)."""
        total = np.zeros((len(pixels), 2))
        for score, amount in self.causes:
            effect = EFFECTS[score.effect.kind]
            if isinstance(effect, CameraEffect) and score.subject == camera:
                by = effect.displacement(self.case, camera, pixels)
                total += 0.0 if by is None else by @ amount[: by.shape[2]]
        return total


def joint_step(case: Case, selection: Selection, solved: Collection[tuple[str, str, str | None]]) -> JointStep:
    """The step with the chosen effects, and with what an amount that is not to be expected may be instead.

    Args:
        solved: effects by kind, subject and frame that are in the calibration already: what more is asked of them is
            free, and no fault.
    """
    every = list(selection.chosen)
    for score in selection.chosen:
        if EFFECTS[score.effect.kind].is_implausible(case, score):
            known = {(one.effect.kind, one.subject) for one in every}
            every += [rival for rival in score.rivals if (rival.effect.kind, rival.subject) not in known]
    if not every:
        return JointStep(case, ())
    variances = [EFFECTS[score.effect.kind].variances(case, score) for score in every]
    together = case.model.freed(np.hstack([score.columns for score in every])).under(np.concatenate(variances))
    amounts = np.split(together, np.cumsum([len(one) for one in variances])[:-1])
    is_known = [(one.effect.kind, one.subject, one.frame) in solved for one in every]
    causes = zip(every, amounts, is_known, strict=True)
    wrong = [(one, by) for one, by, is_in in causes if EFFECTS[one.effect.kind].wrong == "model" and not is_in]
    return JointStep(case, tuple(wrong))
