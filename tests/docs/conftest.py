"""What the tests of the documentation share."""

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from small_fields import fit_few_cells

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="session")
def figures() -> ModuleType:
    """The script docs/figures.py as a module."""
    spec = importlib.util.spec_from_file_location("figures", DOCS / "figures.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def few_cells() -> Iterator[None]:
    with fit_few_cells():
        yield
