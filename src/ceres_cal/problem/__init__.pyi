from ceres_cal.problem.bundle import *
from ceres_cal.problem.costs import *
from ceres_cal.problem.engines import *
from ceres_cal.problem.information import *
from ceres_cal.problem.parameters import *
from ceres_cal.problem.priors import *
from ceres_cal.problem.problem import *
from ceres_cal.problem.quantities import *
from ceres_cal.problem.reduced import ReducedInformation as ReducedInformation
from ceres_cal.problem.residuals import Equations as Equations
from ceres_cal.problem.residuals import Residuals as Residuals
from ceres_cal.problem.residuals import camera_optics as camera_optics
from ceres_cal.problem.residuals import equations_of as equations_of
from ceres_cal.problem.residuals import relative_lengths as relative_lengths
from ceres_cal.problem.residuals import whole_structure as whole_structure
from ceres_cal.problem.residuals import write_equations as write_equations
from ceres_cal.problem.shares import *
from ceres_cal.problem.structure import *

solver_version: str
