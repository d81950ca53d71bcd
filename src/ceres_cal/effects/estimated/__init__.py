"""Effects whose size `calibrate` estimates: it solves for them, and states no number better than with them in doubt.

Every module of this folder adds its rows, in its EFFECTS. They stand apart from the rows of `effects.table` that
residuals are only tested for, so that a calibration reads no more modules than it needs.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ceres_cal.effects.effect import Effect


def rows_of(package: str, path: Iterable[str]) -> dict[str, Effect]:
    """The effects of every module of a folder, by kind."""
    modules = (import_module(f"{package}.{module.name}") for module in iter_modules(path))
    return {effect.kind: effect for module in modules for effect in module.EFFECTS}


ESTIMATED = rows_of(__name__, __path__)
