"""Correlated errors for simulated observations, used by `intervals.py`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.observations import Observations
from ceres_cal.simulate import Scene

Errors = Callable[[Observations, Scene, int], Observations]
SIGMA_PX = 0.3
_FEWEST = 8  # observations of a line that is displaced


def along_lines(observations: Observations, scene: Scene, seed: int, length_m: float) -> Observations:
    """Errors of curve observations, in x and y, correlated along each curve of each view with the given length."""
    rng, pixels = np.random.default_rng([seed, 77]), np.array(observations.curves.pixels)
    for rows in _curves(observations):
        places = _places(observations, scene, rows)
        together = np.exp(-np.linalg.norm(places[:, None] - places[None], axis=2) / length_m)
        root = np.linalg.cholesky(together + 1e-9 * np.eye(len(rows)))
        pixels[rows] += SIGMA_PX * root @ rng.standard_normal((len(rows), 2))
    return replace(observations, curves=replace(observations.curves, pixels=pixels, sigma_px=np.ones(len(pixels))))


def line_aside(observations: Observations, scene: Scene, seed: int, aside_px: float) -> Observations:
    """One whole curve of the first frame that is seen displaced, and independent errors."""
    rng, pixels = np.random.default_rng([seed, 9]), np.array(observations.curves.pixels)
    rows = rng.choice(np.array([r for r in _curves(observations) if len(r) >= _FEWEST], dtype=object))
    rows = np.asarray(rows, dtype=np.int64)
    across = pixels[rows[-1]] - pixels[rows[0]]
    pixels += SIGMA_PX * rng.standard_normal(pixels.shape)
    normal = np.array([-across[1], across[0]]) / np.linalg.norm(across)
    inwards = np.mean(pixels, axis=0) - np.mean(pixels[rows], axis=0)  # no pixel leaves the image
    pixels[rows] += np.copysign(aside_px, inwards @ normal) * normal
    return replace(observations, curves=replace(observations.curves, pixels=pixels, sigma_px=np.ones(len(pixels))))


def warped(observations: Observations, scene: Scene, seed: int, sigma_px: float, views: int | None) -> Observations:
    """A smooth error over each of the first boards with this root mean square: a random cubic in x and y."""
    del scene
    rng, pixels, points = np.random.default_rng([seed, 3]), np.array(observations.points.pixels), observations.points
    for number, view in enumerate(observations.views[:views]):
        rows = np.flatnonzero(points.view == number)
        x, y = _unit(observations.targets[view.target].point_array[points.feature[rows], :2]).T
        terms = np.column_stack([x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
        error = terms @ rng.standard_normal((terms.shape[1], 2))
        pixels[rows] += sigma_px * error / np.sqrt(np.mean(error**2))
    return replace(observations, points=replace(points, pixels=pixels))


def in_rows(observations: Observations, scene: Scene, seed: int) -> Observations:
    """Errors that all corners in one row of a board have in common."""
    del scene
    rng, pixels, points = np.random.default_rng([seed, 4]), np.array(observations.points.pixels), observations.points
    for number, view in enumerate(observations.views):
        rows = np.flatnonzero(points.view == number)
        heights = observations.targets[view.target].point_array[points.feature[rows], 1]
        names, row = np.unique(heights, return_inverse=True)
        pixels[rows] += SIGMA_PX * rng.standard_normal((len(names), 2))[row]
    return replace(observations, points=replace(points, pixels=pixels))


def _unit(places: Array) -> Array:
    """Places (N, 2) in -1 to 1 both ways."""
    low, high = places.min(axis=0), places.max(axis=0)
    return np.asarray((2.0 * places - low - high) / np.maximum(high - low, 1e-12))


def _curves(observations: Observations) -> list[Indices]:
    """Rows of each curve of each view."""
    curves = observations.curves
    names = np.column_stack([curves.view, curves.feature])
    return [np.flatnonzero(np.all(names == name, axis=1)) for name in np.unique(names, axis=0)]


def _places(observations: Observations, scene: Scene, rows: Indices) -> Array:
    """(N, 2) m on the floor where curve observations of one view lie."""
    view = observations.views[int(observations.curves.view[rows[0]])]
    return scene.camera_at(view.station).locate(observations.curves.pixels[rows])
