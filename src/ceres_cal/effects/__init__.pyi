from ceres_cal.effects import aside as aside
from ceres_cal.effects.aside import *
from ceres_cal.effects.columns import *
from ceres_cal.effects.dependence import *
from ceres_cal.effects.effect import *
from ceres_cal.effects.evidence import *
from ceres_cal.effects.groups import *
from ceres_cal.effects.likelihood import *
from ceres_cal.effects.linearised import *
from ceres_cal.effects.smoothness import *
from ceres_cal.effects.strands import *
