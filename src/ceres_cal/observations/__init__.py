"""Observations: what the frames show, as columns, in memory and in files."""

from ceres_cal.observations.columns import NO_CURVES, NO_POINTS, Columns, Curves, Points, Prior, View, taken
from ceres_cal.observations.files import FORMAT, VERSION, prior_from_json, prior_to_json
from ceres_cal.observations.observations import Observations, combine

__all__ = [
    "FORMAT",
    "NO_CURVES",
    "NO_POINTS",
    "VERSION",
    "Columns",
    "Curves",
    "Observations",
    "Points",
    "Prior",
    "View",
    "combine",
    "prior_from_json",
    "prior_to_json",
    "taken",
]
