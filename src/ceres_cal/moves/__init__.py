"""After a move: refit, check and compare calibrations."""

from ceres_cal.moves.refitting import movements, refit

__all__ = ["movements", "refit"]
