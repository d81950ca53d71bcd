from ceres_cal.observations import columns as columns
from ceres_cal.observations import same_frame as same_frame
from ceres_cal.observations.columns import *
from ceres_cal.observations.files import FORMAT as FORMAT
from ceres_cal.observations.files import VERSION as VERSION
from ceres_cal.observations.observations import *
from ceres_cal.observations.sights import *
