"""From photographs of a field to its observations: detection and refitting of the camera, in turn, until they agree."""

from ceres_cal.detect.photographs.candidates import Auto as Auto
from ceres_cal.detect.photographs.clicks import Clicks as Clicks
from ceres_cal.detect.photographs.clicks import load_clicks as load_clicks
from ceres_cal.detect.photographs.facing import Facing as Facing
from ceres_cal.detect.photographs.field import FieldDetections as FieldDetections
from ceres_cal.detect.photographs.field import FieldOptions as FieldOptions
from ceres_cal.detect.photographs.field import detect_field as detect_field
from ceres_cal.detect.photographs.follow import follow as follow
from ceres_cal.detect.photographs.known import KnownDetections as KnownDetections
from ceres_cal.detect.photographs.known import check_photographs as check_photographs
from ceres_cal.detect.photographs.known import detect_known as detect_known
from ceres_cal.detect.photographs.search import SearchResult as SearchResult
