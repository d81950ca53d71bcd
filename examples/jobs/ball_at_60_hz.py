"""Where the ball is on the field, 60 times a second."""

import numpy as np

import ceres_cal as cc

camera = cc.Calibration.load("calibration.json").station()
for frame in range(60):
    pixels = np.array([[640.0 + frame, 480.0]])  # of the ball, by your detector
    (place,) = camera.locate(pixels, height_m=0.0215)
    print(f"{place[0]:.4f} {place[1]:.4f} m")
