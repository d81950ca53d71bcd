"""A field of your own, its lines and its circle: from the pixels of one photograph to the camera above it.

python examples/own_field.py
"""

import numpy as np

import ceres_cal as cc

# A court of 6 x 4 m between line centres with a circle in its middle; paint is 50 mm wide. Any name will do.
PAINT_M = 0.05
CORNERS = {"a": (-3.0, -2.0, 0.0), "b": (3.0, -2.0, 0.0), "c": (3.0, 2.0, 0.0), "d": (-3.0, 2.0, 0.0)}
LINES = {f"{p}{q}": cc.Segment(CORNERS[p], CORNERS[q], PAINT_M) for p, q in ("ab", "bc", "cd", "da")}
CIRCLE = cc.Arc((0.0, 0.0, 0.0), 1.0, 0.0, 2.0 * np.pi, PAINT_M)
court = cc.custom(CORNERS, {**LINES, "circle": CIRCLE})

# The true camera, tilted by 9 degrees. It is used only to make the pixels of this example.
matrix = np.array([[700.0, 0.0, 640.0], [0.0, 700.0, 480.0], [0.0, 0.0, 1.0]])
lens = cc.Camera.from_opencv((1280, 960), matrix, np.array([-0.25, 0.06, 0.0, 0.0, 0.0]))
true = lens.at(cc.Pose.looking((0.3, -0.5, 4.5), cc.Pose.exp((np.pi - 0.15, 0.02, 0.0, 0.0, 0.0, 0.0)).rotation))
noise = np.random.default_rng(1)


def clicked(places: np.ndarray) -> np.ndarray:
    """Pixels of places on the court with an error of 0.3 px, as of careful clicks."""
    pixels = true.project(places)
    return np.asarray(pixels + noise.normal(0.0, 0.3, pixels.shape))


share = np.linspace(0.02, 0.98, 40)[:, None]
turn = np.linspace(0.0, 6.2, 60)
places = {name: np.asarray(one.start) + share * np.subtract(one.end, one.start) for name, one in LINES.items()}
places["circle"] = np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn])

corners = cc.Observations.from_points(clicked(court.point_array), court, (1280, 960), sigma_px=0.3)
lines = {name: clicked(along) for name, along in places.items()}
seen = corners + cc.Observations.from_curves(lines, court, (1280, 960), sigma_px=0.3)
tape = cc.Prior("station", "camera", "height_m", (4.49,), (0.02,))
options = cc.Options(lens="brown", fixed={"p1": 0.0, "p2": 0.0, "k3": 0.0}, priors=(tape,))
calibration = cc.calibrate(seen, options)

camera, robot = calibration.station(), np.array([[1.0, 1.0, 0.15]])
off_mm = 1e3 * np.linalg.norm(camera.locate(true.project(robot), height_m=0.15) - robot[:, :2])
known = calibration.uncertainty.map_sd_mm(height_m=0.15)
print(f"phi {camera.phi:.1f} px, height {camera.position[2]:.3f} m, rms {calibration.rms_px:.2f} px")
print(f"a robot's top at (1, 1): off by {off_mm:.1f} mm, stated {known.mean_mm:.1f} mm")
