"""How long work says how far it is."""

from __future__ import annotations

from collections.abc import Callable

StepProgress = Callable[[int, int, str], None]
"""Called after each step with (steps done, steps in all, what was done)."""
ImageProgress = StepProgress
"""Steps are images, named by their files."""
