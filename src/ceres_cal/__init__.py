"""ceres-cal: calibrate a camera over a flat field, to the millimetre and honestly.

The names are loaded when they are first used, so that `import ceres_cal` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ceres_cal.advice import advise as advise
    from ceres_cal.base.errors import CalibrationError as CalibrationError
    from ceres_cal.base.errors import DegenerateError as DegenerateError
    from ceres_cal.base.errors import InputError as InputError
    from ceres_cal.base.errors import SolutionError as SolutionError
    from ceres_cal.base.transforms import Pose as Pose
    from ceres_cal.calibrating import calibrate as calibrate
    from ceres_cal.calibration import Calibration as Calibration
    from ceres_cal.model.parameters import Options as Options
    from ceres_cal.moves import RefitOptions as RefitOptions
    from ceres_cal.moves import check as check
    from ceres_cal.moves import compare as compare
    from ceres_cal.moves import refit as refit
    from ceres_cal.observations import Observations as Observations
    from ceres_cal.observations import Prior as Prior
    from ceres_cal.report import write_report as write_report
    from ceres_cal.scene.camera import Camera as Camera

_HOME = {
    "advise": "advice",
    "calibrate": "calibrating",
    "Calibration": "calibration",
    "Camera": "scene.camera",
    "CalibrationError": "base.errors",
    "DegenerateError": "base.errors",
    "InputError": "base.errors",
    "SolutionError": "base.errors",
    "refit": "moves",
    "RefitOptions": "moves",
    "check": "moves",
    "compare": "moves",
    "Observations": "observations",
    "Prior": "observations",
    "Options": "model.parameters",
    "Pose": "base.transforms",
    "write_report": "report",
}
__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ceres_cal' has no attribute {name!r}")
    value = getattr(import_module(f"ceres_cal.{_HOME[name]}"), name)
    globals()[name] = value
    return value
