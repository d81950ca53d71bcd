"""The posterior of every number: information, valleys along phi, other explanations, maps over the field."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
