"""The table of effects: every module of this folder adds its rows, in its EFFECTS, beside those that are estimated."""

from __future__ import annotations

from collections import ChainMap

from ceres_cal.effects.columns import EffectColumns
from ceres_cal.effects.effect import Case
from ceres_cal.effects.estimated import ESTIMATED, rows_of

EFFECTS = ChainMap(rows_of(__name__, __path__), ESTIMATED)


def columns_of_all(case: Case) -> list[EffectColumns]:
    """The columns of every effect."""
    return [columns for effect in EFFECTS.values() for columns in effect.columns(case)]
