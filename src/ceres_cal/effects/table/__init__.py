"""The table of effects: every module of this folder adds its rows, in its EFFECTS."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from ceres_cal.effects.columns import EffectColumns
from ceres_cal.effects.effect import Case, Effect
from ceres_cal.observations import Observations


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
