"""What everything else stands on and that knows nobody: errors, digits, files, threads, transforms, tails, spreads."""

from ceres_cal.base.frozen import names_of

__version__ = "0.1.0"  # the package's, where the build takes it from: to ask what is installed takes long

__getattr__, __dir__, __all__ = names_of(__name__)
