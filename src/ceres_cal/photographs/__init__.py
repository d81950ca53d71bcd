"""From photographs of a field to its observations: detection and refitting of the camera, in turn, until they agree."""

from ceres_cal.photographs.clicks import Clicks, load_clicks
from ceres_cal.photographs.field import FieldDetections, detect_field
from ceres_cal.photographs.follow import Followed, follow
from ceres_cal.photographs.known import KnownDetections, check_photographs, detect_known

__all__ = [
    "Clicks",
    "FieldDetections",
    "Followed",
    "KnownDetections",
    "check_photographs",
    "detect_field",
    "detect_known",
    "follow",
    "load_clicks",
]
