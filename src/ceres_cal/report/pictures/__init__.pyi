from ceres_cal.report.pictures import frames as frames
from ceres_cal.report.pictures import model as model
from ceres_cal.report.pictures import overlay as overlay
from ceres_cal.report.pictures import straight as straight
from ceres_cal.report.pictures import warp as warp
