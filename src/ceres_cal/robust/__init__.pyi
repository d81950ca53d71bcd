from ceres_cal.robust import noise as noise
from ceres_cal.robust.as_built import *
from ceres_cal.robust.bulk import *
from ceres_cal.robust.competing import *
from ceres_cal.robust.conflicts import *
from ceres_cal.robust.effects import *
from ceres_cal.robust.noise import *
from ceres_cal.robust.other_minima import *
from ceres_cal.robust.robust import *
from ceres_cal.robust.stated import *
from ceres_cal.robust.unsteady import *
from ceres_cal.robust.usable import *
