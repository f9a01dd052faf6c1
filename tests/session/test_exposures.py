"""Captures in several exposures: all frames are kept, and what is read is their merge."""

import numpy as np
import pytest
import zarr
from facts import raises

from slviewer.errors import InputError, SessionError
from slviewer.fringe.hdr import merge_exposures
from slviewer.session.store import Session

EXPOSURES = (2.0, 8.0, 32.0)


@pytest.fixture(params=[np.uint8, np.uint16])
def stacks(request):
    """(3, 4, 30, 40): from dark on the left to clipped on the right, later on in the shorter
    exposures."""
    rng = np.random.default_rng(5)
    top = np.iinfo(request.param).max
    light = np.geomspace(0.01, 1.5, 40) * rng.uniform(0.5, 1, (4, 30, 40)) * top
    return np.stack([np.clip(light * e / 8, 0, top).astype(request.param) for e in EXPOSURES])


def save(session, sequence, stacks, name="a", exposures=EXPOSURES, **more):
    frames = stacks.reshape(-1, *stacks.shape[2:])
    return session.save_capture(
        name, "scan", sequence, frames, source="", exposures_ms=exposures, **more
    )


def test_every_frame_is_kept_and_the_merge_is_read(session, sequence, stacks):
    saved = save(session, sequence, stacks)
    kept = zarr.open_array(saved.folder / "frames.zarr", mode="r")[...]
    np.testing.assert_array_equal(kept.reshape(stacks.shape), stacks)
    loaded = Session.open(session.folder).load_capture("a")
    frames, choice = merge_exposures(stacks, EXPOSURES)
    assert loaded.exposures_ms == EXPOSURES and loaded.size == (40, 30)
    np.testing.assert_array_equal(loaded.exposure_choice, choice)
    assert set(np.unique(choice)) == {0, 1, 2}
    np.testing.assert_array_equal(loaded.frames, frames)
    np.testing.assert_array_equal(loaded.stack([3, 0, 3]), frames[[3, 0, 3]])
    assert loaded.frames.dtype == stacks.dtype
    with raises(InputError, "[4]", "4 frames"):
        loaded.stack([4])


def test_exposures_are_part_of_the_content(session, sequence, stacks):
    hashes = {
        save(session, sequence, stacks, name, e).hash
        for name, e in (("a", EXPOSURES), ("b", (2.0, 8.0, 33.0)))
    }
    assert len(hashes) == 2


def test_one_exposure_is_as_it_always_was(session, sequence, frames):
    one = session.save_capture("one", "scan", sequence, frames, source="")
    assert one.exposures_ms == () and one.exposure_choice is None and "exposures_ms" not in one.meta


@pytest.mark.parametrize(
    ("exposures", "facts"),
    [
        ((2.0,), ("[2.0] ms",)),
        ((2.0, 2.0, 8.0), ("[2.0, 2.0, 8.0] ms",)),
        ((0.0, 1.0, 2.0), ("[0.0, 1.0, 2.0] ms",)),
        ((1.0, 2.0), ("12 frames", 4, "2 exposures")),
    ],
)
def test_what_does_not_fit_is_refused(session, sequence, stacks, exposures, facts):
    with raises(InputError, *facts):
        save(session, sequence, stacks, exposures=exposures)


def test_a_replaced_or_damaged_capture_is_never_mixed(session, sequence, stacks):
    first = save(session, sequence, stacks)
    first.stack()
    second = save(session, sequence, stacks[:, ::-1], force=True)
    with pytest.raises(SessionError):
        first.stack()
    assert second.frames.shape == stacks.shape[1:]
    third = save(session, sequence, np.ascontiguousarray(stacks[..., ::-1]), force=True)
    (third.folder / "frames.zarr" / "c.5.0.0").unlink()
    with raises(SessionError, "frame 6 of 12", "c.5.0.0", "missing"):
        third.stack()
