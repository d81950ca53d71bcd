"""Photographs by another model than the estimator's, calibrated and compared: python scripts/run.py make_honest_picture

The camera has OpenCV's lens with decentring. The field is painted 12 mm longer and 9 mm narrower than drawn, its paint
is worn, and the sun makes stripes on it. The calibration knows none of this. It is run once with the field as drawn and
the `radial` lens, and once with unknown length and width and a chosen lens. The camera's height is stated to 20 mm.

Writes docs/pictures/honest.jpg, the first photograph with the calibrated model on it. Prints the errors of places.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from rendering.album import take_album
from rendering.photography import Photography, taken_as
from scenery import field_scene, overhead_pose

import ceres_cal as cc
from ceres_cal.calibration import Calibration
from ceres_cal.cli import main as ceres_cal
from ceres_cal.problem.parameters import Station
from ceres_cal.scene.lens import Brown
from ceres_cal.simulate import simulate

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "honest.jpg"
RADIAL, LENGTHS = "radial", ["--estimate", "length,width"]
SMALLER, QUALITY = 0.75, 82
PAINTED = cc.ssl_field("B", field_length_m=9.012, field_width_m=5.991)
TRUE = cc.Camera((1280, 960), 872.0, (651.0, 469.0), Brown((-0.21, 0.055, 0.0012, -0.0009, -0.004)))
POSE = overhead_pose(-2.2, -0.15, 4.1, tilt_x_deg=4.0, tilt_y_deg=-3.0, yaw_deg=90.6)
HOW = Photography(robots=8, balls=1, shadows=1, wear=0.06, sun=0.4, strips=0.1, mosaic=True, jpeg_quality=85)


def rendered(folder: Path) -> None:
    scene = field_scene(PAINTED, {"camera": TRUE}, {"camera": Station("camera", POSE)}, frames=4)
    take_album(simulate(taken_as(scene, HOW), seed=3), "jpg").write(folder)


def calibrated(folder: Path, *how: str) -> Calibration:
    """The calibration by the commands that a user would type; `how`: options of `detect field` and `calibrate`."""
    field, camera, photographs = folder / "field.json", folder / "camera.json", folder / "photographs"
    found = ["--target", "ssl-b", "--auto", "--facing", "LeftGoalLine=top", *[word for word in how if word != RADIAL]]
    steps = (
        ["detect", "field", photographs, *found, "-o", field],
        ["calibrate", field, "--prior", "height_m=4.10:20mm", *(how if RADIAL not in how else ("--lens", RADIAL))],
        ["undistort", camera, photographs / "0001.jpg", "-o", folder, "--overlay"],
    )
    for step in steps:
        to = ["-o", camera] if step[0] == "calibrate" else []
        if ceres_cal([str(word) for word in (*step, *to, "--quiet")]):
            raise SystemExit(1)
    return Calibration.load(camera)


def errors_mm(calibration: Calibration, height_m: float) -> tuple[float, float, float]:
    """Root mean square and largest error over the visible field, and the largest stated 95 % radius."""
    known = calibration.uncertainty.map_sd_mm("camera", height_m)
    places = np.column_stack([known.places, np.full(len(known.places), height_m)])
    pixels = TRUE.at(POSE).project(places)
    seen = np.isfinite(known.radius_95_mm.ravel()) & np.all((pixels > 0.0) & (pixels < (1279.0, 959.0)), axis=1)
    located = calibration.station().locate(pixels[seen], height_m)
    off = 1e3 * np.linalg.norm(located - places[seen, :2], axis=1)
    stated = float(np.max(known.radius_95_mm.ravel()[seen]))
    return float(np.sqrt(np.mean(off**2))), float(off.max()), stated


def main(arguments: Sequence[str]) -> int:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        rendered(folder)
        for title, how in (("as drawn, radial lens", [RADIAL]), ("lengths solved for, lens chosen", LENGTHS)):
            calibration = calibrated(folder, *how)
            print(f"{title}: residuals {calibration.rms_px:.2f} px rms")
            for height_m in (0.0, 0.15):
                rms, most, stated = errors_mm(calibration, height_m)
                off = f"{rms:.1f} mm rms, {most:.1f} mm at most; stated: 95 % within {stated:.1f} mm"
                print(f"  places at {1e3 * height_m:.0f} mm: {off}")
        drawn = cv2.imread(str(folder / "0001-overlay.png"))
        assert drawn is not None
        drawn = cv2.resize(drawn, None, fx=SMALLER, fy=SMALLER, interpolation=cv2.INTER_AREA)
        to = Path(arguments[0]) if arguments else PICTURE
        cv2.imwrite(str(to), drawn, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return 0
