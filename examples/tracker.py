"""A tracker at 100 Hz: it needs NumPy and a look-up table, and nothing of this package.

python examples/tracker.py [TABLE.npz]     # ceres-cal export calibration.json --to table -o TABLE.npz
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

FRAMES, ROBOTS, PERIOD_S, TOP_M = 100, 22, 0.01, 0.15


class Table:
    """Where pixels look on the field, interpolated between the nodes of a grid over the image."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as table:
            self.origin = np.array([table["x_px"][0], table["y_px"][0]])
            self.step_px = float(table["step_px"])
            self.floor_m, self.per_height = table["floor_m"], table["per_height"]

    def locate(self, pixels: np.ndarray, height_m: float) -> np.ndarray:
        """(N, 2) px -> (N, 2) m on the plane z = height_m."""
        at = (pixels - self.origin) / self.step_px
        column, row = at.astype(int).T
        u, v = (at - np.column_stack([column, row])).T[:, :, None]
        corners = [(row, column), (row, column + 1), (row + 1, column), (row + 1, column + 1)]
        a, b, c, d = (self.floor_m[at] + height_m * self.per_height[at] for at in corners)
        place: np.ndarray = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
        return place


def export_a_table(path: Path) -> None:
    """What somebody does once, with ceres-cal."""
    import ceres_cal as cc

    cc.export(cc.calibrate(cc.Observations.load("data/ssl_field/observations.json")), "table", path)


with tempfile.TemporaryDirectory() as folder:
    given = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(folder) / "table.npz"
    if len(sys.argv) == 1:
        export_a_table(given)
    table = Table(given)

camera = np.random.default_rng(1)  # stands for one: pixels of robots' covers in every frame
busy_s = 0.0
for frame in range(FRAMES):
    pixels = camera.uniform((100.0, 100.0), (1180.0, 860.0), (ROBOTS, 2))
    begin = time.perf_counter()
    places = table.locate(pixels, TOP_M)
    busy_s += time.perf_counter() - begin
    assert np.all(np.isfinite(places)), frame
print(f"{FRAMES} frames of {ROBOTS} robots: {100 * busy_s / (FRAMES * PERIOD_S):.1f} % of the time that 100 Hz leave")
