"""A map of differences over the field as a small SVG: colour for the size, the field's lines on top."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ceres_cal.moves.comparison import StationComparison
from ceres_cal.scene.curves import Arc, curve_points
from ceres_cal.scene.targets import Target

_SCALE = 80.0  # px per metre
_MARGIN_M = 0.6
_STEPS = 8
_LOW, _HIGH = (247, 251, 255), (8, 48, 107)  # white to dark blue: readable in grey, too
_PAINT = "#d55e00"


def picture(found: StationComparison, targets: Mapping[str, Target]) -> str:
    """The map of one station as SVG text."""
    x, y = found.x_m, found.y_m
    left, top = x[0] - _MARGIN_M, y[-1] + _MARGIN_M
    width, height = (_SCALE * (np.ptp(v) + 2.0 * _MARGIN_M) for v in (x, y))
    worst = found.worst_mm if np.isfinite(found.worst_mm) and found.worst_mm > 0.0 else 1.0
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height + 40:.0f}"',
        f'  width="{width:.0f}" height="{height + 40:.0f}" font-family="sans-serif">',
        f'<rect width="{width:.0f}" height="{height + 40:.0f}" fill="#ffffff"/>',
        *_cells(found, left, top, worst),
        *_field(targets, left, top),
        *_legend(found, worst, height),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _cells(found: StationComparison, left: float, top: float, worst: float) -> Iterator[str]:
    dx, dy = (float(v[1] - v[0]) for v in (found.x_m, found.y_m))
    for row, y in enumerate(found.y_m):
        for column, x in enumerate(found.x_m):
            value = found.length_mm[row, column]
            if np.isfinite(value):
                at = f'x="{_SCALE * (x - 0.5 * dx - left):.1f}" y="{_SCALE * (top - y - 0.5 * dy):.1f}"'
                size = f'width="{_SCALE * dx + 0.5:.1f}" height="{_SCALE * dy + 0.5:.1f}"'
                yield f'<rect {at} {size} fill="{_colour(value / worst)}"/>'


def _colour(share: float) -> str:
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(_LOW, _HIGH, strict=True))
    return f"#{red:02x}{green:02x}{blue:02x}"


def _field(targets: Mapping[str, Target], left: float, top: float) -> Iterator[str]:
    for target in targets.values():
        if target.movable:
            continue
        for curve in target.curves.values():
            places = curve_points(curve, 0, 59 if isinstance(curve, Arc) else 1)
            path = " ".join(f"{_SCALE * (px - left):.1f},{_SCALE * (top - py):.1f}" for px, py, _ in places)
            yield f'<polyline points="{path}" fill="none" stroke="{_PAINT}" stroke-width="1.5"/>'


def _legend(found: StationComparison, worst: float, height: float) -> Iterator[str]:
    for step in range(_STEPS):
        share = (step + 0.5) / _STEPS
        yield f'<rect x="{20 + 30 * step}" y="{height:.0f}" width="30" height="14" fill="{_colour(share)}"/>'
    yield f'<text x="20" y="{height + 30:.0f}" font-size="13">0</text>'
    yield f'<text x="{20 + 30 * _STEPS}" y="{height + 30:.0f}" font-size="13" text-anchor="end">{worst:.2f} mm</text>'
    name = found.station.replace("&", "&amp;").replace("<", "&lt;")
    words = f"{name}, {1e3 * found.height_m:.0f} mm above the floor: {found.mean_mm:.2f} mm on average"
    yield f'<text x="{50 + 30 * _STEPS}" y="{height + 12:.0f}" font-size="14">{words}</text>'
