"""Draws the README's picture: the sample field seen by its calibrated camera, enlarged residuals, marked outliers.

Run: python scripts/run.py make_picture [OUT.svg]
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ceres_cal import Calibration, Camera, Observations, calibrate
from ceres_cal.base.arrays import Array
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.residuals import residuals
from ceres_cal.scene.curves import curve_points

ROOT = Path(__file__).parents[2]
ENLARGED = 25.0
PAINT, POINT, RESIDUAL, OUTLIER = "#9fb8a4", "#0072b2", "#0072b2", "#d55e00"  # also for colour-blind readers


def main(arguments: Sequence[str]) -> int:
    out = Path(arguments[0]) if arguments else ROOT / "docs" / "ssl_field.svg"
    observations = Observations.load(ROOT / "data" / "ssl_field" / "observations.json")
    calibration = calibrate(observations)
    camera = calibration.station()
    width, height = camera.image_size
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}">',
        f'<rect width="{width}" height="{height}" fill="#f4f6f4"/>',
        *field_lines(observations, camera),
        *marks(observations, calibration),
        "</svg>",
    ]
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text("\n".join(parts) + "\n", encoding="utf-8")
    print(f"{out}: {out.stat().st_size / 1024:.0f} KiB, {len(calibration.rejected)} outliers marked")
    return 0


def field_lines(observations: Observations, camera: Camera) -> Iterator[str]:
    field = observations.targets["field"]
    for curve in field.curves.values():
        pixels = camera.project(curve_points(curve, 0, 119))
        pixels = pixels[np.all(np.isfinite(pixels), axis=1)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
        yield f'<polyline points="{path}" fill="none" stroke="{PAINT}" stroke-width="5"/>'


def marks(observations: Observations, calibration: Calibration) -> Iterator[str]:
    found = residuals(gather_sights(observations), calibration.estimate)
    rejected = {(entry.kind, entry.row) for entry in calibration.rejected}
    for row, (x, y) in enumerate(observations.points.pixels):
        if ("point", row) in rejected:
            yield cross(x, y)
        else:
            dx, dy = ENLARGED * found.points[row]
            yield f'<path d="M{x:.1f} {y:.1f}l{dx:.1f} {dy:.1f}" stroke="{RESIDUAL}" stroke-width="1"/>'
            yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.6" fill="{POINT}"/>'
    normals = image_normals(observations, calibration.station())
    for row, (x, y) in enumerate(observations.curves.pixels):
        if ("curve", row) in rejected:
            yield cross(x, y)
        else:
            dx, dy = ENLARGED * found.curves[row] * normals[row]
            yield f'<path d="M{x:.1f} {y:.1f}l{dx:.1f} {dy:.1f}" stroke="{RESIDUAL}" stroke-width="1.4"/>'


def image_normals(observations: Observations, camera: Camera) -> Array:
    """(M, 2) unit normals in the image of the curve at each observation."""
    field = observations.targets["field"]
    ground = np.column_stack([camera.locate(observations.curves.pixels), np.zeros(len(observations.curves))])
    is_arc = field.is_arc[observations.curves.feature]
    tracks = field.tracks[0][observations.curves.feature]
    away = ground - tracks[:, 0]
    tangent = np.where(is_arc[:, None], np.column_stack([-away[:, 1], away[:, 0], 0.0 * away[:, 0]]), tracks[:, 1])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    along = camera.project(ground + 0.01 * tangent) - camera.project(ground - 0.01 * tangent)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.column_stack([-along[:, 1], along[:, 0]])


def cross(x: float, y: float) -> str:
    return f'<path d="M{x - 4:.1f} {y - 4:.1f}l8 8m0-8l-8 8" stroke="{OUTLIER}" stroke-width="2"/>'
