"""Foundations that depend on nothing else in the package: errors, files, threads, transforms, tails, spreads."""

from ceres_cal.base.frozen import names_of

__version__ = "0.1.0"  # the package's version, read by the build; asking for the installed one takes long

__getattr__, __dir__, __all__ = names_of(__name__)
