from ceres_cal.base import words as words
from ceres_cal.base.archives import *
from ceres_cal.base.arrays import *
from ceres_cal.base.errors import *
from ceres_cal.base.executing import *
from ceres_cal.base.files import *
from ceres_cal.base.frozen import *
from ceres_cal.base.images import *
from ceres_cal.base.shown import *
from ceres_cal.base.tails import *
from ceres_cal.base.threads import *
from ceres_cal.base.transforms import *
from ceres_cal.base.typed import *
from ceres_cal.base.words import *

__version__: str
