"""The table of effects: every module of this folder adds its rows, in its EFFECTS.

And what all of them that are found say together.
"""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module
from pkgutil import iter_modules

import numpy as np

from ceres_cal.base import Array, Frozen, cached_property
from ceres_cal.effects.columns import EffectColumns, ScoreTest, Selection
from ceres_cal.effects.effect import Case, Effect
from ceres_cal.observations import Observations
from ceres_cal.problem import Key, free_keys


def rows() -> dict[str, Effect]:
    """The effects of every module of the folder, by kind."""
    modules = (import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__))
    return {effect.kind: effect for module in modules for effect in module.EFFECTS}


EFFECTS = rows()


def estimated(observations: Observations) -> list[Effect]:
    """Those that `calibrate` solves for in some observations, and widens by."""
    return [effect for effect in EFFECTS.values() if effect.prior is not None and effect.concerns(observations)]


def columns_of_all(case: Case) -> list[EffectColumns]:
    """The columns of every effect."""
    return [columns for effect in EFFECTS.values() for columns in effect.columns(case)]


# ---- all of them at once --------------------------------------------------------------------------------------------


# One step of least squares with everything that the residuals speak for: what a calibration would then be. Causes that
# look alike share what they explain by what is expected of them, and what one moves another may take back.


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
            displacement = EFFECTS[score.effect.kind].displacement
            if displacement is not None and score.subject == camera:
                by = displacement(self.case, camera, pixels)
                total += 0.0 if by is None else by @ amount[: by.shape[2]]
        return total


def joint_step(case: Case, selection: Selection, solved: Collection[tuple[str, str, str | None]]) -> JointStep:
    """The step with the chosen effects, and in place of one whose amount is not to be expected with what it may be
    instead. Where nothing else is known to look like it, it moves nothing: what it shows stays wrong all the same.

    Args:
        solved: effects by kind, subject and frame that are in the calibration already: what more is asked of them is
            free, and no fault.
    """
    every = list(selection.chosen)
    unlike = [score for score in every if EFFECTS[score.effect.kind].is_implausible(case, score)]
    for score in unlike:
        known = {(one.effect.kind, one.subject) for one in every}
        every += [rival for rival in score.rivals if (rival.effect.kind, rival.subject) not in known]
    if not every:
        return JointStep(case, ())
    variances = [EFFECTS[score.effect.kind].variances(case, score) for score in every]
    together = case.model.freed(np.hstack([score.columns for score in every])).under(np.concatenate(variances))
    amounts = np.split(together, np.cumsum([len(one) for one in variances])[:-1])
    causes = tuple(
        (one, by)
        for one, by in zip(every, amounts, strict=True)
        if one not in unlike
        and EFFECTS[one.effect.kind].wrong == "model"
        and (one.effect.kind, one.subject, one.frame) not in solved
    )
    return JointStep(case, causes)
