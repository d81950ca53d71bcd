from ceres_cal.robust.noise import USUAL_EQUATIONS as USUAL_EQUATIONS
from ceres_cal.robust.noise import Inliers as Inliers
from ceres_cal.robust.noise import judge as judge
from ceres_cal.robust.other_minima import minima_of as minima_of
from ceres_cal.robust.other_minima import with_lost_boards_posed as with_lost_boards_posed
from ceres_cal.robust.robust import RobustSolution as RobustSolution
from ceres_cal.robust.stated import Conflict as Conflict
from ceres_cal.robust.stated import Conflicts as Conflicts
