"""By how much numbers are off if another lens is the right one: of several that predict as well, one was taken.

Where they agree, the data tell them apart; at the rim and between lines they do not, and what the chosen one says there
is its own. What another lens shows over the picture is followed by the numbers of the chosen one as closely as they
can, by least squares over places on the floor and above it, or over rays of a camera that sees no floor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose
from ceres_cal.model.keys import Key
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.quantities import natural_sizes
from ceres_cal.scene.heights import HEIGHTS_M
from ceres_cal.uncertainty.image import Picture, picture_slopes
from ceres_cal.uncertainty.maps import locate_slopes

_PLACES = 12  # along each side of the picture
_PARTS = (1.0, 0.1)
_FOLLOWED = 1e-4  # of the largest singular value: directions that show less are not moved along


def shifts_to_lenses(
    near: Estimate, others: Sequence[Estimate], keys: Sequence[Key], reach_px: Mapping[str, float]
) -> list[Array]:
    """(K,) from an estimate to what comes nearest to each of the others, whose cameras have other lenses.

    Args:
        reach_px: how far from its principal point each camera was observed: farther out nothing is compared.
    """
    slopes, offs = [], []
    for name in near.cameras:
        for own, off in _compared(near, others, keys, name, reach_px[name]):
            slopes.append(own.reshape(-1, len(keys)))
            offs.append(off.reshape(len(others), -1))
    slope, off = np.concatenate(slopes), np.concatenate(offs, axis=1).T
    known = np.isfinite(slope).all(axis=1) & np.isfinite(off).all(axis=1)
    sizes = natural_sizes(near, keys)
    steps = np.linalg.lstsq(slope[known] * sizes, off[known], rcond=_FOLLOWED)[0]
    return list(np.asarray(steps.T * sizes))


def _compared(
    near: Estimate, others: Sequence[Estimate], keys: Sequence[Key], name: str, reach_px: float
) -> list[tuple[Array, Array]]:
    """(N, 2, K) slopes of what a camera shows, px, and (L, N, 2) by how much the others show something else."""
    camera = near.cameras[name]
    pixels = _places(camera.image_size, camera.principal_point, reach_px)
    stations = [key.owner for key in keys if key.kind == "station" and key.quantity == "height"]
    stations = [station for station in stations if near.stations[station].camera == name]
    if not stations:
        picture = Picture(camera.at(Pose.identity()), pixels)
        shifts = [picture.shift(one.cameras[name].at(Pose.identity())) for one in others]
        return [(picture_slopes(picture, near, keys, name), np.array(shifts))]
    compared = []
    for station in stations:
        there = near.camera_at(station)
        px_per_m = camera.phi / max(abs(float(there.position[2])), 1e-3)
        for height_m, part in zip(HEIGHTS_M, _PARTS, strict=True):
            located = there.locate(pixels, height_m)
            off = [one.camera_at(station).locate(pixels, height_m) - located for one in others]
            slopes = locate_slopes(near, keys, station, pixels, height_m)
            compared.append((part * px_per_m * slopes, part * px_per_m * np.array(off)))
    return compared


def _places(image_size: tuple[int, int], middle: Sequence[float], reach_px: float) -> Array:
    """(N, 2) pixels of a grid over an image, as far as it was observed."""
    x, y = (np.linspace(0.0, side - 1.0, _PLACES) for side in image_size)
    pixels = np.column_stack([part.ravel() for part in np.meshgrid(x, y)])
    return np.asarray(pixels[np.linalg.norm(pixels - middle, axis=1) <= reach_px])
