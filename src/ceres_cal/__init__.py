"""ceres-cal: calibrate a camera over a flat field, to the millimetre and honestly.

The names are loaded when they are first used, so that `import ceres_cal` costs nothing.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ceres_cal.base.frozen import names_of

if TYPE_CHECKING:
    from ceres_cal.base.errors import CalibrationError as CalibrationError
    from ceres_cal.base.errors import DegenerateError as DegenerateError
    from ceres_cal.base.errors import InputError as InputError
    from ceres_cal.base.errors import SolutionError as SolutionError
    from ceres_cal.base.transforms import Pose as Pose
    from ceres_cal.calibration import Calibration as Calibration
    from ceres_cal.calibration.calibrating import calibrate as calibrate
    from ceres_cal.cli.run_in_python import run as run
    from ceres_cal.diagnostics.advice import advise as advise
    from ceres_cal.diagnostics.diagnose import Diagnosis as Diagnosis
    from ceres_cal.diagnostics.diagnose import diagnose as diagnose
    from ceres_cal.formats import export as export
    from ceres_cal.formats import import_calibration as import_calibration
    from ceres_cal.formats import import_observations as import_observations
    from ceres_cal.functions import check as check
    from ceres_cal.functions import detect_board as detect_board
    from ceres_cal.functions import detect_field as detect_field
    from ceres_cal.functions import join as join
    from ceres_cal.functions import refit as refit
    from ceres_cal.moves.audits import audit as audit
    from ceres_cal.moves.comparisons import compare as compare
    from ceres_cal.moves.refit_plan import RefitOptions as RefitOptions
    from ceres_cal.moves.scores import score as score
    from ceres_cal.observations import Curves as Curves
    from ceres_cal.observations import Observations as Observations
    from ceres_cal.observations import Points as Points
    from ceres_cal.observations import Prior as Prior
    from ceres_cal.observations import View as View
    from ceres_cal.problem.parameters import Options as Options
    from ceres_cal.report import write_report as write_report
    from ceres_cal.scene.camera import Camera as Camera
    from ceres_cal.scene.targets import Arc as Arc
    from ceres_cal.scene.targets import Marker as Marker
    from ceres_cal.scene.targets import Segment as Segment
    from ceres_cal.scene.targets import Target as Target
    from ceres_cal.scene.targets import april_grid as april_grid
    from ceres_cal.scene.targets import checkerboard as checkerboard
    from ceres_cal.scene.targets import circle_grid as circle_grid
    from ceres_cal.scene.targets import custom as custom
    from ceres_cal.scene.targets import markers as markers
    from ceres_cal.scene.targets import painted_field as painted_field
    from ceres_cal.scene.targets import rings as rings
    from ceres_cal.scene.targets import ssl_field as ssl_field
    from ceres_cal.scene.targets import tape_grid as tape_grid

_HOME = {
    "advise": "diagnostics.advice",
    "calibrate": "calibration.calibrating",
    "Calibration": "calibration",
    "Camera": "scene.camera",
    "CalibrationError": "base.errors",
    "DegenerateError": "base.errors",
    "InputError": "base.errors",
    "SolutionError": "base.errors",
    "RefitOptions": "moves.refit_plan",
    **dict.fromkeys(("check", "detect_board", "detect_field", "join", "refit"), "functions"),
    **dict.fromkeys(("Diagnosis", "diagnose"), "diagnostics.diagnose"),
    "run": "cli.run_in_python",
    "audit": "moves.audits",
    "compare": "moves.comparisons",
    "score": "moves.scores",
    "export": "formats",
    "import_calibration": "formats",
    "import_observations": "formats",
    "Observations": "observations",
    "View": "observations",
    "Points": "observations",
    "Curves": "observations",
    "Prior": "observations",
    **dict.fromkeys(
        (
            *("Target", "Segment", "Arc", "april_grid", "checkerboard", "circle_grid", "custom", "painted_field"),
            *("Marker", "markers", "rings", "ssl_field", "tape_grid"),
        ),
        "scene.targets",
    ),
    "Options": "problem.parameters",
    "Pose": "base.transforms",
    "write_report": "report",
}
__all__ = list(_HOME)
__getattr__: Callable[[str], Any] = names_of(__name__, _HOME)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
