"""Displacement fields that small simulated rigs are fitted with."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from slviewer.calibration.splined import unknowns


@contextmanager
def fit_few_cells() -> Iterator[None]:
    """Fit displacement fields of fewer cells: a hundredth of the time to solve, and as good for the
    simulated rigs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unknowns, "CELLS_ACROSS", 12)
        yield
