from ceres_cal.diagnostics.advice.candidates import Ground as Ground
from ceres_cal.diagnostics.advice.candidates import Measurement as Measurement
from ceres_cal.diagnostics.advice.outlook import Errors as Errors
from ceres_cal.diagnostics.advice.outlook import Outlook as Outlook
from ceres_cal.diagnostics.advice.ranking import Advice as Advice
from ceres_cal.diagnostics.advice.ranking import Promise as Promise
from ceres_cal.diagnostics.advice.ranking import advise as advise
from ceres_cal.diagnostics.advice.ranking import promised as promised
