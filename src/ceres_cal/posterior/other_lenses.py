"""Other lenses that predict as well as the chosen one, and how its numbers follow them.

Where they agree, the data tell them apart; at the rim and between lines they do not, and what the chosen one says there
is its own. So they are components of the posterior, and maps show what they show, also where nothing was observed. The
numbers of the chosen one follow each as closely as they can, by least squares over places on the floor and above it, or
over rays of a camera that sees no floor.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.cached import cached_property
from ceres_cal.base.transforms import Pose
from ceres_cal.posterior.maps import Picture, locate_slopes, picture_slopes
from ceres_cal.problem.information import Key
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.quantities import natural_sizes
from ceres_cal.scene.heights import HEIGHTS_M

_PLACES = 12  # along each side of the picture
# How closely the heights of HEIGHTS_M are followed. Above the floor phi tells, and the quadratic picture bends:
# followed as closely, what lenses with another phi show there ruins the floor; not at all, one map in ten was 2.5
# standard deviations off there.
_PARTS = (1.0, 0.1)
# Of the weights. Of maps by one photograph fewest are off by other than 1 / 1.6 to 1.6 times what is stated, a quarter;
# a little more at the whole of them, most of them wide, and nearly a third without, most of them too narrow.
_COUNTED = 0.5


@dataclass(frozen=True, eq=False)
class OtherLenses:
    """Other lenses than the chosen one, solved for from the same observations.

    Attributes:
        near: with the chosen lens. others: with others. weights: of each, its probability or less.
        reach_px: camera -> how far from its principal point it was observed: farther out nothing is compared.
        failed: why nothing could be compared; "" where it could.
    """

    near: Estimate
    others: tuple[Estimate, ...]
    weights: tuple[float, ...]
    reach_px: Mapping[str, float]
    failed: str = ""

    @cached_property
    def pixels(self) -> dict[str, Array]:
        """Camera -> (N, 2) of a grid over its image, as far as it was observed."""
        pixels = {}
        for name, reach_px in self.reach_px.items():
            camera = self.near.cameras[name]
            x, y = (np.linspace(0.0, side - 1.0, _PLACES) for side in camera.image_size)
            places = np.column_stack([part.ravel() for part in np.meshgrid(x, y)])
            pixels[name] = places[np.linalg.norm(places - camera.principal_point, axis=1) <= reach_px]
        return pixels

    def shifts(self, camera: str) -> Array:
        """(L, N, 2) px by how much the others show rays elsewhere, turned as well as can be."""
        picture = Picture(self.near.cameras[camera].at(Pose.identity()), self.pixels[camera])
        return np.array([picture.shift(one.cameras[camera].at(Pose.identity())) for one in self.others])

    def offsets(self, station: str, height_m: float) -> Array:
        """(L, N, 2) m by how much the others locate pixels elsewhere; every node of a valley asks for the same."""
        if (station, height_m) not in self._offsets:
            pixels = self.pixels[self.near.stations[station].camera]
            located = self.near.camera_at(station).locate(pixels, height_m)
            every = [one.camera_at(station).locate(pixels, height_m) - located for one in self.others]
            self._offsets[station, height_m] = np.array(every)
        return self._offsets[station, height_m]

    @cached_property
    def _offsets(self) -> dict[tuple[str, float], Array]:
        return {}


def counted(weights: Sequence[float]) -> Array:
    """(L,) probabilities of other lenses as far as they count, together less than all."""
    most = 0.8  # of all of them together
    each = _COUNTED * np.asarray(weights, dtype=float)
    return np.asarray(each / max(1.0, float(each.sum()) / most))


def shifts_to_lenses(lenses: OtherLenses, keys: Sequence[Key], there: Estimate) -> list[Array]:
    """(K,) of numbers of an estimate, which follow each of the others.

    Args:
        there: with the chosen lens, at its best or elsewhere in a valley along phi.
    """
    followed = 1e-4  # of the largest singular value: directions that show less are not moved along
    every = list(_compared(lenses, keys, there))
    if not every:
        return []
    slopes, offsets = zip(*every, strict=True)
    slope = np.concatenate([one.reshape(-1, len(keys)) for one in slopes])
    sizes, shifts = natural_sizes(there, keys), []
    for number in range(len(lenses.others)):
        offset = np.concatenate([one[number].ravel() for one in offsets])
        known = np.isfinite(slope).all(axis=1) & np.isfinite(offset)
        step = np.linalg.lstsq(slope[known] * sizes, offset[known], rcond=followed)[0]
        shifts.append(step * sizes)
    return shifts


def _compared(lenses: OtherLenses, keys: Sequence[Key], there: Estimate) -> Iterator[tuple[Array, Array]]:
    """Of each camera that the keys say anything of: (N, 2, K) slopes of what it shows, px, and (L, N, 2) by how much
    others show it elsewhere.
    """
    known = dict.fromkeys(key.owner for key in keys if key.kind == "station")
    spoken_of = {key.owner for key in keys if key.kind == "camera"} | {there.stations[name].camera for name in known}
    for name, pixels in lenses.pixels.items():
        if name not in spoken_of:
            continue
        camera = there.cameras[name]
        stations = [station for station in known if there.stations[station].camera == name]
        tells_phi = any(key[:3] == ("camera", name, "phi") for key in keys)
        for station in stations:
            px_per_m = camera.phi / max(abs(float(there.camera_at(station).position[2])), 1e-3)
            for height_m, part in zip(HEIGHTS_M[: 2 if tells_phi else 1], _PARTS, strict=False):
                slopes = locate_slopes(there, keys, station, pixels, height_m)
                yield part * px_per_m * slopes, part * px_per_m * lenses.offsets(station, height_m)
        if not stations:
            picture = Picture(camera.at(Pose.identity()), pixels)
            yield picture_slopes(picture, keys, name), lenses.shifts(name)
