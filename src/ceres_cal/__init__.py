"""ceres-cal: calibrate a camera over a flat field, to the millimetre and honestly.

The names are loaded when they are first used, so that `import ceres_cal` costs nothing.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ceres_cal.advice import advise as advise
    from ceres_cal.calibrate import calibrate as calibrate
    from ceres_cal.calibration import Calibration as Calibration
    from ceres_cal.camera import Camera as Camera
    from ceres_cal.errors import CalibrationError as CalibrationError
    from ceres_cal.errors import DegenerateError as DegenerateError
    from ceres_cal.errors import InputError as InputError
    from ceres_cal.errors import SolutionError as SolutionError
    from ceres_cal.moves import check as check
    from ceres_cal.moves import compare as compare
    from ceres_cal.moves import refit as refit
    from ceres_cal.observations import Observations as Observations
    from ceres_cal.observations import Prior as Prior
    from ceres_cal.parameters import Options as Options
    from ceres_cal.report import write_report as write_report
    from ceres_cal.transforms import Pose as Pose

_HOME = {
    "advise": "advice",
    "calibrate": "calibrate",
    "Calibration": "calibration",
    "Camera": "camera",
    "CalibrationError": "errors",
    "DegenerateError": "errors",
    "InputError": "errors",
    "SolutionError": "errors",
    "refit": "moves",
    "check": "moves",
    "compare": "moves",
    "Observations": "observations",
    "Prior": "observations",
    "Options": "parameters",
    "Pose": "transforms",
    "write_report": "report",
}
__all__ = list(_HOME)


class _Package(ModuleType):
    """Python puts a module that is imported into its package under its name: one that is called like the function in it
    must not take the function's place.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ceres_cal' has no attribute {name!r}")
    value = getattr(import_module(f"ceres_cal.{_HOME[name]}"), name)
    globals()[name] = value
    return value
