"""The table of effects: every module of this folder adds its rows, in its EFFECTS."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from ceres_cal.effects.columns import EffectColumns
from ceres_cal.effects.effect import Case, Effect


def _rows() -> list[Effect]:
    modules = (import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__))
    return [effect for module in modules for effect in module.EFFECTS]


EFFECTS: dict[str, Effect] = {effect.kind: effect for effect in _rows()}


def columns_of_all(case: Case) -> list[EffectColumns]:
    """The columns of every effect."""
    return [columns for effect in EFFECTS.values() for columns in effect.columns(case)]
