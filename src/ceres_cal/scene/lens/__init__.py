"""The lens models."""

from ceres_cal.scene.lens.base import LENSES, Lens, lens_class, make_lens, register
from ceres_cal.scene.lens.opencv import Brown, KannalaBrandt
from ceres_cal.scene.lens.radial import Radial
from ceres_cal.scene.lens.spline import Spline

__all__ = ["LENSES", "Brown", "KannalaBrandt", "Lens", "Radial", "Spline", "lens_class", "make_lens", "register"]

register(Radial)
register(Brown)
register(KannalaBrandt)
register(Spline)
