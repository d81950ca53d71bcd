"""How well a calibration is known: covariance, weak directions, bounds beyond the quadratic picture, maps in mm."""

from ceres_cal.uncertainty.files import PosteriorFile, posterior_from_file, posterior_to_json
from ceres_cal.uncertainty.posterior import Posterior, make_posterior

__all__ = ["Posterior", "PosteriorFile", "make_posterior", "posterior_from_file", "posterior_to_json"]
