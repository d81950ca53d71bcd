"""Prediction of held-out views with the default lens: python scripts/run.py held_out [--help]

Every real set of boards is split into two halves, views in turns. Each half is calibrated with the default options and
with each lens that a user may name, and the poses of the other half's boards are fitted with it. The root mean square
of the residuals, over the corners that every lens keeps, is compared with that of the best named lens. Exits with 1
where the default is more than 3 % worse. The folder of real sets is $CERES_CAL_REAL, or shared/real beside the
repository.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from runner import Row, script

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import CalibrationError
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import detect_boards
from ceres_cal.moves.scores import score, sights_as_built
from ceres_cal.observations import Observations
from ceres_cal.observations.columns import taken
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.residuals import residuals
from ceres_cal.scene.targets import checkerboard
from photos.real_data import ov_plane, real_folder

MOST = 1.03  # times the best named lens
DEFAULT = "default"
LENSES: Mapping[str, Options] = {
    DEFAULT: Options(),
    "as drawn": Options(as_built="as drawn"),
    "radial 2,3": Options(lens="radial"),
    "radial 2,3,4,5": Options(lens="radial", powers=(2, 3, 4, 5)),
    "brown": Options(lens="brown"),
    "kannala-brandt": Options(lens="kannala-brandt"),
}
"""The named ones have the default's priors on usual cameras."""


def _photographed(pattern: str, columns: int, rows: int, square_m: float) -> Observations:
    return detect_boards(sorted(real_folder().glob(pattern)), checkerboard(columns, rows, square_m)).observations


def _case(name: str) -> Observations:
    return Observations.load(real_folder() / "cases" / f"{name}.json")


SETS: Mapping[str, Callable[[], Observations]] = {
    "opencv left": partial(_photographed, "opencv_left_right/left*.jpg", 9, 6, 0.025),
    "opencv right": partial(_photographed, "opencv_left_right/right*.jpg", 9, 6, 0.025),
    "sony": partial(_photographed, "boofcv_sony_chess/*.jpg", 4, 6, 0.03),
    "gopro": partial(_photographed, "udacity_gopro_wide/GOPR*.jpg", 8, 6, 1.0),
    "stereo left": partial(_case, "stereo_left"),
    "squeezed": partial(_case, "squeezed"),
    "fisheye": partial(_case, "stray_corner"),
    "ov plane": partial(ov_plane, "train"),
}


def _of_views(observations: Observations, chosen: Mask) -> Observations:
    return replace(observations, points=taken(observations.points, chosen[observations.points.view]))


def left_px(options: Options, known: Observations, new: Observations) -> tuple[Array, Mask]:
    """(N,) residuals, px, of new observations with a calibration from known ones, and (N,) which of them it keeps."""
    calibration = calibrate(known, options)
    (answer,) = score(calibration, new).values()
    assert answer.solution is not None
    there = residuals(sights_as_built(new, calibration), answer.solution.estimate)
    return there.lengths[0], answer.solution.inlier_masks(new)[0]


def rows(name: str, observed: Callable[[], Observations], runs: int) -> Iterator[Row]:
    """Prediction error of each lens, and the ratio of the default's error to that of the best named lens."""
    observations = observed()
    number = np.arange(len(observations.views))
    halves = [_of_views(observations, number % 2 == half) for half in range(2)]
    found: dict[str, tuple[Array, Mask]] = {}
    for lens, options in LENSES.items():
        try:
            parts = [left_px(options, *pair) for pair in (halves, halves[::-1])]
        except CalibrationError as error:
            print(f"{name}: {lens}: {error}")
            continue
        found[lens] = np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
    kept = np.all([own for _, own in found.values()], axis=0)
    rms_px = {lens: float(np.sqrt(np.mean(lengths[kept] ** 2))) for lens, (lengths, _) in found.items()}
    best = min((lens for lens in rms_px if lens != DEFAULT), key=rms_px.__getitem__)
    for lens, one in rms_px.items():
        yield Row(name, f"{lens}: held-out rms, px", one)
    yield Row(name, f"default over {best}", rms_px[DEFAULT] / rms_px[best], most=MOST)


main = script({name: partial(rows, name, one) for name, one in SETS.items()}, __doc__, (1, "always one"))
