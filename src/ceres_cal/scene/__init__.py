"""The scene: lenses, cameras, and targets of known geometry."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
