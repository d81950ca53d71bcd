"""Formats of other programs: one module for each format that can be exported or imported, and a table of them."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
