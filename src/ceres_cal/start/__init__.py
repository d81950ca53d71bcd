"""The initial estimate: closed forms, as the paper's, and a search. They only start the solve."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
