"""From photographs of a field to its observations: detection and refitting of the camera, in turn, until they agree."""

from ceres_cal.photographs.clicks import Clicks, load_clicks
from ceres_cal.photographs.facing import SIDES, Facing
from ceres_cal.photographs.field import FieldDetections, FieldOptions, detect_field
from ceres_cal.photographs.follow import follow
from ceres_cal.photographs.followed import Followed
from ceres_cal.photographs.known import KnownDetections, check_photographs, detect_known
from ceres_cal.photographs.search import Auto, SearchResult

__all__ = [
    "SIDES",
    "Auto",
    "Clicks",
    "Facing",
    "FieldDetections",
    "FieldOptions",
    "Followed",
    "KnownDetections",
    "SearchResult",
    "check_photographs",
    "detect_field",
    "detect_known",
    "follow",
    "load_clicks",
]
