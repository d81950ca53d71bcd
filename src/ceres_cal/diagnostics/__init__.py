"""Reading what is left over: a table, what it says of the model."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
