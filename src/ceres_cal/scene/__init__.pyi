from ceres_cal.scene.camera import *
from ceres_cal.scene.curves import *
from ceres_cal.scene.foreign import *
from ceres_cal.scene.lens import LENSES as LENSES
from ceres_cal.scene.lens import Lens as Lens
from ceres_cal.scene.lens import Radial as Radial
from ceres_cal.scene.lens import make_lens as make_lens
from ceres_cal.scene.symmetry import *
from ceres_cal.scene.targets import *
