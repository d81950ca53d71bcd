"""From photographs of a field to its observations: detection and refitting of the camera, in turn, until they agree."""

from ceres_cal.detect.photographs.clicks import Clicks, load_clicks
from ceres_cal.detect.photographs.facing import SIDES, Facing
from ceres_cal.detect.photographs.field import FieldDetections, FieldOptions, detect_field
from ceres_cal.detect.photographs.follow import follow
from ceres_cal.detect.photographs.followed import Followed
from ceres_cal.detect.photographs.known import KnownDetections, check_photographs, detect_known
from ceres_cal.detect.photographs.search import Auto, SearchResult

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
