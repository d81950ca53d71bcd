from ceres_cal.calibration.calibration import Calibration as Calibration
from ceres_cal.calibration.file import FORMAT as FORMAT
from ceres_cal.calibration.file import CalibrationFile as CalibrationFile
from ceres_cal.calibration.file import Fit as Fit
from ceres_cal.calibration.file import LensChoice as LensChoice
from ceres_cal.calibration.file import RefitRecord as RefitRecord
from ceres_cal.calibration.file import TriedLens as TriedLens
from ceres_cal.calibration.file import package_versions as package_versions
