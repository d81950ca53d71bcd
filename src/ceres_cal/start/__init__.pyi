from ceres_cal.start.closed_forms import *
from ceres_cal.start.initialise import USUAL_PHI as USUAL_PHI
from ceres_cal.start.initialise import USUAL_PHI_FACTOR as USUAL_PHI_FACTOR
from ceres_cal.start.initialise import Start as Start
from ceres_cal.start.initialise import posed_sights as posed_sights
from ceres_cal.start.planes import *
from ceres_cal.start.same_labels import Labels as Labels
from ceres_cal.start.same_labels import open_words as open_words
from ceres_cal.start.same_labels import symmetries as symmetries
from ceres_cal.start.same_labels import with_same_labels as with_same_labels
from ceres_cal.start.same_moments import *
from ceres_cal.start.sightlines import *
from ceres_cal.start.world import *
