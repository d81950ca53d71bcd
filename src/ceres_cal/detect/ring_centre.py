"""The common centre of concentric rings, from the light's gradients: they point to or from it everywhere."""

from __future__ import annotations

import cv2
import numpy as np

from ceres_cal.base.arrays import Array, Array32
from ceres_cal.base.errors import InputError


def ring_centre(grey: Array32) -> Array:
    """Where the gradients' lines meet, (2,) px: by votes on a grid, then by least squares."""
    clear = 12.0  # from black to white over the noise: rings have been found from 8 on
    soft = cv2.GaussianBlur(grey, (0, 0), 1.5)
    gradient = np.dstack([cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)]).astype(float)
    strength = np.hypot(gradient[..., 0], gradient[..., 1])
    strong = np.argwhere(strength > 0.3 * np.quantile(strength, 0.99))
    if not len(strong) or strength.max() < 1e-3:
        raise InputError("no rings found: the picture has no edges: take it in better light")
    chosen = strong[np.random.default_rng(0).permutation(len(strong))[:20_000]]
    places = chosen[:, ::-1].astype(float)
    direction = gradient[chosen[:, 0], chosen[:, 1]] / strength[chosen[:, 0], chosen[:, 1], None]
    normal = np.column_stack([-direction[:, 1], direction[:, 0]])
    centre = _voted(places[:2000], normal[:2000], grey.shape)
    for scale in (20.0, 10.0, 5.0, 3.0, 3.0, 3.0, 3.0):
        away = np.sum((places - centre) * normal, axis=1)
        weight = 1.0 / (1.0 + (away / scale) ** 2) ** 2
        weighted = normal * weight[:, None]
        centre = centre + np.linalg.solve(weighted.T @ normal + 1e-9 * np.eye(2), weighted.T @ away)
    share = float(np.mean(np.abs(np.sum((places - centre) * normal, axis=1)) < 6.0))
    if share < 0.3:
        contrast, noise = float(np.ptp(np.quantile(soft, (0.01, 0.99)))), 1.48 * float(np.median(np.abs(grey - soft)))
        if contrast < clear * noise:
            raise InputError(
                f"no rings found: too dark, from black to white {contrast:.0f} grey levels in a noise of {noise:.1f}: "
                "give more light, expose longer, or take the mean of several pictures"
            )
        raise InputError(
            "no concentric rings found: edges point to no common centre: let the rings fill most of the picture"
        )
    return np.asarray(centre)


def _voted(places: Array, normal: Array, shape: tuple[int, ...]) -> Array:
    step = max(shape) / 60.0
    y, x = np.mgrid[0.0 : shape[0] : step, 0.0 : shape[1] : step]
    grid = np.column_stack([x.ravel(), y.ravel()])
    away = np.abs(grid @ normal.T - np.sum(places * normal, axis=1))
    return np.asarray(grid[np.argmax(np.sum(away < step, axis=1))])
