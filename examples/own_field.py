"""A field of your own: its lines and its circle, and what the pixels of one photograph tell of the camera above it.

python examples/own_field.py
"""

import json
import tempfile
from pathlib import Path

import numpy as np

import ceres_cal as cc

# A court of 6 x 4 m between line centres with a circle in its middle; paint is 50 mm wide. Any name will do.
PAINT_M = 0.05
CORNERS = {"a": (-3.0, -2.0, 0.0), "b": (3.0, -2.0, 0.0), "c": (3.0, 2.0, 0.0), "d": (-3.0, 2.0, 0.0)}
LINES = {f"{p}{q}": cc.Segment(CORNERS[p], CORNERS[q], PAINT_M) for p, q in ("ab", "bc", "cd", "da")}
CIRCLE = cc.Arc((0.0, 0.0, 0.0), 1.0, 0.0, 2.0 * np.pi, PAINT_M)
court = cc.custom(CORNERS, {**LINES, "circle": CIRCLE})

# The camera that took the photograph, tilted by 9 degrees: nobody knows it, it only makes the pixels for this example.
matrix = np.array([[700.0, 0.0, 640.0], [0.0, 700.0, 480.0], [0.0, 0.0, 1.0]])
lens = cc.Camera.from_opencv((1280, 960), matrix, np.array([-0.25, 0.06, 0.0, 0.0, 0.0]))
secret = lens.at(cc.Pose.looking((0.3, -0.5, 4.5), cc.Pose.exp((np.pi - 0.15, 0.02, 0.0, 0.0, 0.0, 0.0)).rotation))
noise = np.random.default_rng(1)


def clicked(places: np.ndarray) -> list[list[float]]:
    """Pixels of places on the court, as somebody clicks them: 0.3 px off."""
    pixels = secret.project(places)
    return (pixels + noise.normal(0.0, 0.3, pixels.shape)).tolist()  # type: ignore[no-any-return]


share = np.linspace(0.02, 0.98, 40)[:, None]
turn = np.linspace(0.0, 6.2, 60)
on_curves = {name: np.asarray(one.start) + share * np.subtract(one.end, one.start) for name, one in LINES.items()}
on_curves["circle"] = np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn])

# A file of observations (docs/files.md): corners by name, and pixels that lie somewhere on a named line or circle.
observed = {
    "format": "ceres-cal/observations",
    "version": 1,
    "units": "metres, radians, pixels",
    "pixel_origin": "centre of the top-left pixel",
    "targets": {"court": court.spec},
    "cameras": {"ceiling": {"image_size": [1280, 960]}},
    "priors": [{"station": "ceiling", "height_m": 4.49, "sigma_m": 0.02}],  # a tape measure
    "views": [
        {
            "frame": "1",
            "camera": "ceiling",
            "target": "court",
            "points": {"features": list(CORNERS), "pixels": clicked(court.point_array), "sigma_px": 0.3},
            "curves": {
                "features": list(on_curves),
                "counts": [len(places) for places in on_curves.values()],
                "pixels": [pixel for places in on_curves.values() for pixel in clicked(places)],
                "sigma_px": 0.3,
            },
        }
    ],
}
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "court.json"
    path.write_text(json.dumps(observed))
    calibration = cc.calibrate(cc.Observations.load(path), cc.Options(lens="brown", fixed={"p1": 0, "p2": 0, "k3": 0}))

camera, truth = calibration.station(), np.array([[1.0, 1.0, 0.15]])
off_mm = 1e3 * np.linalg.norm(camera.locate(secret.project(truth), height_m=0.15) - truth[:, :2])
known = calibration.uncertainty.map_sd_mm(height_m=0.15)
print(f"phi {camera.phi:.1f} px, height {camera.position[2]:.3f} m, rms {calibration.rms_px:.2f} px")
print(f"a robot's top at (1, 1): off by {off_mm:.1f} mm, stated {known.mean_mm:.1f} mm")
