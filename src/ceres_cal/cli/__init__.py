"""The commands: `ceres-cal COMMAND ...` (design, section 11).

The commands' modules import only argparse at the top, and only the module of the typed command is imported, so that
help and errors of usage appear at once.
"""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
