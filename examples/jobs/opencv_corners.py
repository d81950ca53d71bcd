"""Detected corners from OpenCV to a camera matrix."""

import cv2
import numpy as np

import ceres_cal as cc

FOLDER = "data/ssl_field/photographs"
images = {f"{n:02}": np.asarray(cv2.imread(f"{FOLDER}/board_{n:02}.jpg", 0)) for n in range(1, 9)}
corners = {name: cv2.findChessboardCornersSB(image, (9, 6))[1] for name, image in images.items()}
observations = cc.Observations.from_points(corners, cc.checkerboard(9, 6, 0.1), (1280, 960))
matrix, distortion, *_ = cc.calibrate(observations).station().to_opencv()
print(matrix, distortion)
