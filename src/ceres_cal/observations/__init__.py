"""Observations: what the frames show, as columns, in memory and in files; and `sights`, as the method takes them.

A view is what one frame shows of one target; a sight is what one camera at one station sees of one rigid frame, over
all its views, and so what one pose projects (see `observations.sights`).
"""

from ceres_cal.observations.columns import COMA as COMA
from ceres_cal.observations.columns import NO_CURVES as NO_CURVES
from ceres_cal.observations.columns import NO_POINTS as NO_POINTS
from ceres_cal.observations.columns import Columns as Columns
from ceres_cal.observations.columns import Curves as Curves
from ceres_cal.observations.columns import Points as Points
from ceres_cal.observations.columns import Prior as Prior
from ceres_cal.observations.columns import View as View
from ceres_cal.observations.columns import joined as joined
from ceres_cal.observations.columns import prior_from_json as prior_from_json
from ceres_cal.observations.columns import prior_to_json as prior_to_json
from ceres_cal.observations.columns import taken as taken
from ceres_cal.observations.files import FORMAT as FORMAT
from ceres_cal.observations.files import VERSION as VERSION
from ceres_cal.observations.observations import Observations as Observations
from ceres_cal.observations.observations import combine as combine
