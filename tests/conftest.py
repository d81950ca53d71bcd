"""What several test modules share."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real images and calibrations: $CERES_CAL_REAL, or shared/real beside the repository."""
    folder = Path(os.environ.get("CERES_CAL_REAL") or Path(__file__).parents[2] / "shared" / "real")
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} is not there (set CERES_CAL_REAL to its place)")
    return folder
