"""What everything else stands on and that knows nobody: errors, digits, files, threads, transforms, tails, spreads."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
