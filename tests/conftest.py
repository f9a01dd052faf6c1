"""What every room's tests may use."""

import os

# Workers share the cores: libraries that each take all of them wait for one another.
if "PYTEST_XDIST_WORKER" in os.environ:
    for library in ("OMP", "OPENBLAS", "NUMBA"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")

from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import launched
from playwright.sync_api import Browser, sync_playwright


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The long journeys first, so that both workers end at about the same time."""
    items.sort(key=lambda item: not {"gui", "workflow"} & set(item.path.parts))


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """One for all tests: Playwright runs once in a process."""
    with sync_playwright() as playwright:
        found = launched(playwright)
        yield found
        found.close()


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real captures: SLVIEWER_REAL_DATA, else ``../shared/data`` beside the repository."""
    given = os.environ.get("SLVIEWER_REAL_DATA")
    folder = Path(given) if given else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real captures: {folder} is missing; name their folder in SLVIEWER_REAL_DATA")
    return folder
