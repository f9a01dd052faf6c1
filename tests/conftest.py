"""What every room's tests may use."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real captures: SLVIEWER_REAL_DATA, else ``../shared/data`` beside the repository."""
    given = os.environ.get("SLVIEWER_REAL_DATA")
    folder = Path(given) if given else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real captures: {folder} is missing; name their folder in SLVIEWER_REAL_DATA")
    return folder
