"""The heights above the floor that matter: where a robot's cover and the ball are located."""

from __future__ import annotations

ROBOT_TOP_M = 0.15
"""As high as the league lets robots be, and where vision looks for the markers on their covers."""
HEIGHTS_M = (0.0, ROBOT_TOP_M)
"""At which maps, errors and movements are stated: what holds at both holds between them."""


def at_height(height_m: float) -> str:
    """How people say it: "on the floor", "at 150 mm"."""
    return "on the floor" if height_m == 0.0 else f"at {1e3 * height_m:.0f} mm"
