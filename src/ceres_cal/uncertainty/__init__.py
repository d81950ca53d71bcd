"""How well a calibration is known: covariance, weak directions, bounds beyond the quadratic picture, maps in mm."""

from ceres_cal.uncertainty.assess import assess
from ceres_cal.uncertainty.files import PosteriorFile, posterior_from_file, posterior_to_json
from ceres_cal.uncertainty.posterior import Posterior, make_posterior
from ceres_cal.uncertainty.profile import Profile, Setting

__all__ = [
    "Posterior",
    "PosteriorFile",
    "Profile",
    "Setting",
    "assess",
    "make_posterior",
    "posterior_from_file",
    "posterior_to_json",
]
