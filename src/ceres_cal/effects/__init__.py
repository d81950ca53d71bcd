"""Random effects: numbers that a model holds at zero, and what its residuals say of their size."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
