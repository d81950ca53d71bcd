"""Observations: what the frames show, as columns, in memory and in files; and `sights`, as the method takes them.

A view is what one frame shows of one target; a sight is what one camera at one station sees of one rigid frame, over
all its views, and so what one pose projects (see `observations.sights`).
"""

from ceres_cal.observations.columns import (
    NO_CURVES,
    NO_POINTS,
    Columns,
    Curves,
    Points,
    Prior,
    View,
    prior_from_json,
    prior_to_json,
    taken,
)
from ceres_cal.observations.files import FORMAT, VERSION
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
