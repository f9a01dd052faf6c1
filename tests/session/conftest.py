import numpy as np
import pytest

from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.store import Session


@pytest.fixture
def session(tmp_path):
    with Session.create(tmp_path / "session") as opened:
        yield opened


@pytest.fixture
def sequence():
    return PatternSequence((96, 64), tuple(phase_steps("x", 4, 16.0)))


@pytest.fixture
def noise():
    def make(seed, n=4, dtype=np.uint8):
        return np.random.default_rng(seed).integers(
            0, np.iinfo(dtype).max, (n, 30, 40), dtype, endpoint=True
        )

    return make


@pytest.fixture
def frames(noise):
    return noise(1)
