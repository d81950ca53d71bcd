"""The commands: `ceres-cal COMMAND ...` (design, section 11).

Only argparse is imported at the top of the commands' modules, so that help and wrong usage answer at once; and of these
only the one whose command is typed.
"""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
