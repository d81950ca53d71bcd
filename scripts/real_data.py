"""Where real photographs are, which are not part of the repository."""

from __future__ import annotations

import os
from pathlib import Path


def real_place() -> Path:
    """$CERES_CAL_REAL, or shared/real beside the repository, whether it is there or not."""
    return Path(os.environ.get("CERES_CAL_REAL") or Path(__file__).resolve().parents[2] / "shared" / "real")


def real_folder() -> Path:
    """The same; where it is missing the program says so and ends with 1."""
    folder = real_place()
    if not folder.is_dir():
        raise SystemExit(f"real photographs are needed, and {folder} is not there: set CERES_CAL_REAL to their folder")
    return folder
