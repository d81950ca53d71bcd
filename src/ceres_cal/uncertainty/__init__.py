"""How well a calibration is known: covariance, weak directions, bounds beyond the quadratic picture, maps in mm."""

from ceres_cal.uncertainty.assess import assess
from ceres_cal.uncertainty.dependence import Dependence, Scatter, measure_scatter
from ceres_cal.uncertainty.files import PosteriorFile, information_from, lower_triangle, require_keys
from ceres_cal.uncertainty.image import ImageMap, image_grid
from ceres_cal.uncertainty.maps import FieldMap, PointSpread
from ceres_cal.uncertainty.posterior import Posterior, make_posterior
from ceres_cal.uncertainty.profile import PhiProfile
from ceres_cal.uncertainty.seam import Disagreement, disagreement
from ceres_cal.uncertainty.uncertainty import Uncertainty
from ceres_cal.uncertainty.weak import Verdict, WeakDirection

__all__ = [
    "Dependence",
    "Disagreement",
    "FieldMap",
    "ImageMap",
    "PhiProfile",
    "PointSpread",
    "Posterior",
    "PosteriorFile",
    "Scatter",
    "Uncertainty",
    "Verdict",
    "WeakDirection",
    "assess",
    "disagreement",
    "image_grid",
    "information_from",
    "lower_triangle",
    "make_posterior",
    "measure_scatter",
    "require_keys",
]
