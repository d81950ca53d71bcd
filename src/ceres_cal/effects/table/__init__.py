"""The table of effects: every module of this package adds rows to it, by its EFFECTS.

Also the joint result of all effects that are found.
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
    """The effects of all modules of this package, by kind."""
    modules = (import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__))
    return {effect.kind: effect for module in modules for effect in module.EFFECTS}


EFFECTS = rows()


def estimated(observations: Observations) -> list[Effect]:
    """Effects whose sizes `calibrate` estimates for some observations: it solves for them or widens by them."""
    return [effect for effect in EFFECTS.values() if effect.prior is not None and effect.concerns(observations)]


def columns_of_all(case: Case) -> list[EffectColumns]:
    """The columns of all effects."""
    return [columns for effect in EFFECTS.values() for columns in effect.columns(case)]


# ---- the joint step -------------------------------------------------------------------------------------------------


# One step of least squares with all effects that the residuals support shows what a calibration with them would be.
# Causes that look alike share what they explain according to their priors, and what one moves another may undo.


class JointStep(Frozen):
    """All errors of the model of a case, together.

    Attributes:
        causes: groups of effects, with their likeliest amounts (Q,).
    """

    case: Case
    causes: tuple[tuple[ScoreTest, Array], ...]

    @cached_property
    def moves(self) -> dict[Key, float]:
        """The change of each free number: rejected observations did not move it."""
        keys = free_keys(self.case.estimate, self.case.problem.layout, self.case.problem.private)
        steps = [self.case.as_solved.taken_by(score.columns) @ amount for score, amount in self.causes]
        return dict(zip(keys, np.sum(steps, axis=0).tolist(), strict=True)) if steps else {}

    def displaced(self, camera: str, pixels: Array) -> Array:
        """(N, 2) px displacements of a camera at pixels (N, 2), beside those of its own model."""
        total = np.zeros((len(pixels), 2))
        for score, amount in self.causes:
            displacement = EFFECTS[score.effect.kind].displacement
            if displacement is not None and score.subject == camera:
                by = displacement(self.case, camera, pixels)
                total += 0.0 if by is None else by @ amount[: by.shape[2]]
        return total


def joint_step(case: Case, selection: Selection, solved: Collection[tuple[str, str, str | None]]) -> JointStep:
    """The step with the chosen effects. An effect with an implausible amount is replaced by its rivals; if it has none,
    it moves nothing, but what it shows is still wrong.

    Args:
        solved: effects, by kind, subject and frame, that the calibration has solved for: further amounts of them are
            free and no fault.
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
