"""What a lens does along the radius, as a start finds it, and the lens of a kind that comes nearest to it."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Lens

RADII = np.linspace(0.02, 1.0, 50)  # of the observed ones, at which lenses are compared


def edge_over(camera: Camera, reach_px: float) -> float:
    """How many times as far out as its observations reach a camera's lens is asked about."""
    margin = 1.15  # of what a start takes for the edge of the picture: its profile is least sure there
    return margin * max(1.0, camera.corner_radius / reach_px)


@dataclass(frozen=True, eq=False)
class LensProfile:
    """What a lens does: the angles (n,), rad, to the axis of what it shows at radii (n,), px, as far as was seen."""

    radii_px: Array
    angles: Array

    @classmethod
    def of(cls, camera: Camera, reach_px: float) -> LensProfile:
        """A camera's up to some radius."""
        r, lens = RADII * reach_px, camera.lens
        across = {*lens.decentring, *lens.more_terms.get("tangential", ())}
        lens = lens.with_values([0.0 if name in across else lens.coefficients[name] for name in lens.names])
        rays = lens.undistort(np.column_stack([r, np.zeros_like(r)]), camera.phi)
        angles = np.arctan2(rays[:, 0], rays[:, 2])
        known = np.isfinite(angles)
        return cls(r[known], angles[known])

    @property
    def reach_px(self) -> float:
        return float(np.max(self.radii_px, initial=0.0))

    def nearest(self, blank: Lens, phi: float, held: Container[str]) -> Lens:
        """The lens that comes nearest to it: every model is linear in its coefficients at given radii. Fewer of them
        where it would fold.

        Args:
            blank: with the values of the coefficients that are held.
        """
        grazing = 0.02  # cosine of the angle at which a ray has no ideal radius any more
        r = self.radii_px
        with np.errstate(divide="ignore", invalid="ignore"):
            ideal = np.where(np.cos(self.angles) > grazing, phi * np.tan(self.angles), np.nan)
        columns, right = blank.start_equations(r, ideal, self.angles, phi)
        free = [i for i, name in enumerate(blank.names) if name in columns and name not in held]
        ahead = np.isfinite(right)
        right = right - sum(
            np.nan_to_num(columns[n]) * blank.coefficients[n] for n in blank.names if n in columns and n in held
        )
        for count in range(len(free), 0, -1):
            basis = np.column_stack([columns[blank.names[i]] for i in free[:count]])[ahead]
            values = np.array(blank.values)
            values[free[:count]] = np.linalg.lstsq(basis, right[ahead], rcond=1e-8)[0]
            lens = blank.with_values(values)
            if lens.monotone_radius(phi) > 1.05 * self.reach_px:
                return lens
        return blank
