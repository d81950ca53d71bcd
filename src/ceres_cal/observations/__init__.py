"""Observations: what the frames show, as columns, in memory and in files."""

from ceres_cal.observations.columns import Columns, Curves, Points, Prior, View, no_curves, no_points, taken
from ceres_cal.observations.files import FORMAT, VERSION, prior_from_json, prior_to_json
from ceres_cal.observations.observations import Observations, combine

__all__ = [
    "FORMAT",
    "VERSION",
    "Columns",
    "Curves",
    "Observations",
    "Points",
    "Prior",
    "View",
    "combine",
    "no_curves",
    "no_points",
    "prior_from_json",
    "prior_to_json",
    "taken",
]
