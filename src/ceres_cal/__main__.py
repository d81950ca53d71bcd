"""The command line as `python -m ceres_cal`."""

import sys

from ceres_cal.cli import main

sys.exit(main())
