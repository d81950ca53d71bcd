"""Two cameras over one field and boards that both see: one solve, and how well they agree about a robot between them.

python examples/two_cameras.py
"""

import numpy as np

import ceres_cal as cc
from ceres_cal.simulate import built_in_scene, simulate

scene, disturbance = built_in_scene("two-cameras")
calibration = cc.calibrate(simulate(scene, disturbance, seed=0).observations)
for name in ("left", "right"):
    known = calibration.uncertainty.map_sd_mm(name, height_m=0.15)
    print(f"{name:5} {calibration.station(name).position[2]:.3f} m high, locates to {known.mean_mm:.2f} mm")

robot = np.array([[0.1, 0.4, 0.15]])
seen = {name: scene.camera_at(name).project(robot) for name in ("left", "right")}  # by the true cameras
places = [calibration.station(name).locate(pixels, height_m=0.15) for name, pixels in seen.items()]
apart_mm = 1e3 * float(np.linalg.norm(places[0] - places[1]))
seam = calibration.uncertainty.seam_sd_mm("left", "right", height_m=0.15)
print(f"a robot that both see: {apart_mm:.2f} mm apart, where {seam.mean_mm:.2f} mm are to be expected")
