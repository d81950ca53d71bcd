from ceres_cal.posterior.assess import with_doubts as with_doubts
from ceres_cal.posterior.assess import with_other_lenses as with_other_lenses
from ceres_cal.posterior.bent import *
from ceres_cal.posterior.files import *
from ceres_cal.posterior.maps import *
from ceres_cal.posterior.mixture import *
from ceres_cal.posterior.other_lenses import *
from ceres_cal.posterior.posterior import *
from ceres_cal.posterior.seam import *
from ceres_cal.posterior.uncertainty import *
