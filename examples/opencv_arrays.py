"""Corners as cv2.findChessboardCorners gives them, to a calibration and back to OpenCV.

python examples/opencv_arrays.py
"""

from pathlib import Path

import cv2
import numpy as np

import ceres_cal as cc

PHOTOGRAPHS = sorted(Path("data/ssl_field/photographs").glob("board_*.jpg"))
COLUMNS, ROWS, SQUARE_M = 9, 6, 0.1

corners, size, last = {}, (0, 0), np.empty((0, 0))
for path in PHOTOGRAPHS:
    last = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    size = (last.shape[1], last.shape[0])
    found, pixels = cv2.findChessboardCornersSB(last, (COLUMNS, ROWS))
    if found:
        corners[path.stem] = pixels  # (54, 1, 2): one row of the board after the other

observations = cc.Observations.from_points(corners, cc.checkerboard(COLUMNS, ROWS, SQUARE_M), size)
calibration = cc.calibrate(observations, cc.Options(lens="brown", fixed={"k3": 0.0}))
for row in calibration.uncertainty.table():
    print(f"{row['quantity']:3} {row['value']:9.3f} ± {row['sd']:.2g}, {row['verdict']}")

matrix, distortion, _, _ = calibration.station().to_opencv()
straight = cv2.undistort(last, matrix, distortion)  # OpenCV goes on from here
print(f"rms {calibration.rms_px:.3f} px over {len(corners)} boards; straightened a picture of {straight.shape} px")
