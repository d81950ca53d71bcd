"""Reading what is left over: a table, what it says of the model."""

from ceres_cal.diagnostics.checks import Noise as Noise
from ceres_cal.diagnostics.diagnose import FALSE_ALARM_RATE as FALSE_ALARM_RATE
from ceres_cal.diagnostics.diagnose import Diagnosis as Diagnosis
from ceres_cal.diagnostics.diagnose import diagnose as diagnose
from ceres_cal.diagnostics.table import ResidualTable as ResidualTable
from ceres_cal.effects.effect import Finding as Finding
