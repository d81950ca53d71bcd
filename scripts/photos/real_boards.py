"""Real photographs of boards, compared with OpenCV's calibration: python scripts/run.py real_boards [--help]

Plain least squares, with two radial coefficients for BoofCV's Sony and three for the wide GoPro. OpenCV itself has
residuals of 0.1624 and 0.5235 px for its own corners, with focal lengths of 700.93 and 560.07 px; the corners that
`detect board` measures by saddles have smaller residuals. BabelCalib's very wide OV camera is calibrated by plain least
squares, and only the poses of its test views are fitted; scipy has residuals of 0.482 px in training and 0.475 px in
the test. "Stated": the noise that a calibration estimates over the stated standard deviation of corners, with the board
as drawn and, by default, as built. It is less than 1 where the scatter of single pictures includes an unevenly printed
board, as for the GoPro. Exits with 1 when a figure is missed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from runner import Row, script

from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import detect_boards
from ceres_cal.moves.scores import score
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.targets import checkerboard
from photos.real_data import ov_plane, real_folder

_NO_TANGENT = {"p1": 0.0, "p2": 0.0}
_GOPRO = Options(
    lens="brown",
    free_aspect=True,
    fixed=_NO_TANGENT,
    usual_camera=False,
    loss="trivial",
    noise_scale="stated",
    reject_sigma=1e9,
    as_built="as drawn",
)
_SONY = replace(_GOPRO, fixed={**_NO_TANGENT, "k3": 0.0})


def sony(runs: int) -> Iterator[Row]:
    yield from _rows("sony", "boofcv_sony_chess/*.jpg", (4, 6, 0.03), _SONY, (13, 0.1625, 700.93, 0.02))


def gopro(runs: int) -> Iterator[Row]:
    yield from _rows("gopro", "udacity_gopro_wide/GOPR*.jpg", (8, 6, 1.0), _GOPRO, (35, 0.5245, 560.07, 0.02))


def very_wide(runs: int) -> Iterator[Row]:
    train, test = ov_plane("train"), ov_plane("test")
    for lens, most_px in (("kannala-brandt", 0.4825), ("spline", 0.435)):
        options = Options(lens=lens, free_aspect=True, loss="trivial", reject_sigma=1e9, as_built="as drawn")
        calibration = calibrate(train, options)
        yield Row("ov plane", f"{lens}, training views: rms, px", calibration.fit.points_rms_px, most=most_px)
        (answer,) = score(calibration, test).values()
        test_px = answer.misfit.points_rms_px
        yield Row("ov plane", f"{lens}, test views: rms, px", test_px, most=most_px - 0.007)


def stated(runs: int) -> Iterator[Row]:
    """Noise over the corners' stated standard deviations, with the board as drawn and, by default, as built."""
    sets = {"left": ("opencv_left_right/left*.jpg", 9, 6), "right": ("opencv_left_right/right*.jpg", 9, 6)}
    sets |= {"sony": ("boofcv_sony_chess/*.jpg", 4, 6), "gopro": ("udacity_gopro_wide/GOPR*.jpg", 8, 6)}
    for name, (pattern, columns, rows) in sets.items():
        found = detect_boards(sorted(real_folder().glob(pattern)), checkerboard(columns, rows, 0.03)).observations
        drawn = calibrate(found, Options(as_built="as drawn")).fit.point_scale
        yield Row(f"stated, {name}", "noise over stated, board as drawn", drawn)
        built = calibrate(found).fit.point_scale
        yield Row(f"stated, {name}", "noise over stated, board as built", built, most=1.5)


def _rows(
    name: str, pattern: str, board: tuple[int, int, float], options: Options, kept: tuple[int, float, float, float]
) -> Iterator[Row]:
    images = sorted(real_folder().glob(pattern))
    if not images:
        raise SystemExit(f"{real_folder() / pattern}: there are no such photographs")
    least, most_px, phi, off = kept
    for corners in ("opencv", "saddle"):
        detections = detect_boards(images, checkerboard(*board), corner_fit=corners)
        calibration = calibrate(detections.observations, options)
        found = len(detections.found)
        yield Row(name, f"{corners}: boards found in {len(images)} photographs", found, least=least)
        yield Row(name, f"{corners}: rms, px", calibration.fit.points_rms_px, most=most_px)
        if corners == "opencv":
            yield Row(name, f"{corners}: phi, px", calibration.station().phi, least=phi - off, most=phi + off)


main = script({"sony": sony, "gopro": gopro, "ov plane": very_wide, "stated": stated}, __doc__, (1, "always one"))
