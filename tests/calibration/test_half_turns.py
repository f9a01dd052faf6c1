"""A board of circles that was turned by 180 degrees between poses is numbered as in the others,
where it shows."""

from dataclasses import replace

import numpy as np
import pytest
from facts import missing_facts
from splined_rig import BOARD, CELLS, aligned_error, observation, phase_map, poses, rig

from slviewer.calibration.observe import Observation
from slviewer.calibration.splined.adjust import adjust_bundle
from slviewer.calibration.splined.half_turns import is_numbering_ambiguous, opposite_features
from slviewer.calibration.splined.model import SplinedModel, calibrate_splined
from slviewer.calibration.stereo import calibrate_stereo
from slviewer.simulation.boards import BoardShape
from slviewer.target.board import Board

pytestmark = pytest.mark.computes

TURNED = (1, 4, 7)


@pytest.fixture(scope="module")
def true():
    return rig(seed=2)


@pytest.fixture(scope="module")
def seen(true) -> list[Observation]:
    shape = BoardShape(bow_x_mm=0.1, twist_mm=0.05, misplaced_mm=0.03)
    return [
        observation(true, pose, f"pose_{i:02d}", shape) for i, pose in enumerate(poses(true, 10))
    ]


@pytest.fixture(scope="module")
def mixed(seen) -> list[Observation]:
    """The same with three boards numbered from their other end."""
    return [turned(each) if i in TURNED else each for i, each in enumerate(seen)]


def turned(seen: Observation) -> Observation:
    return replace(seen, camera=seen.camera[::-1].copy(), projector=seen.projector[::-1].copy())


def calibrated(seen: list[Observation], true) -> SplinedModel:
    return calibrate_splined(
        seen, calibrate_stereo(seen, true.projector.size, str(BOARD)), cells_across=CELLS
    )


@pytest.mark.slow
def test_turned_poses_are_found_and_change_nothing(seen, mixed, true) -> None:
    as_held, found = calibrated(seen, true), calibrated(mixed, true)
    assert as_held.bundle.half_turned_poses == () and found.bundle.half_turned_poses == tuple(
        f"pose_{i:02d}" for i in TURNED
    )
    assert not found.bundle.excluded
    notes = " ".join(found.describe().table().notes)
    assert missing_facts(notes, *found.bundle.half_turned_poses) == []
    assert found.bundle.noise.camera_px == pytest.approx(as_held.bundle.noise.camera_px, rel=0.05)
    assert np.abs(found.bundle.state.offsets - as_held.bundle.state.offsets).max() < 0.003
    assert np.sqrt(np.mean(found.bundle.state.offsets**2)) > 0.025
    for depth in (480.0, 700.0):
        phase = phase_map(true, np.full(true.camera.size[::-1], depth))
        clouds = [model.points(phase).astype(float) for model in (found, as_held)]
        known = np.isfinite(clouds[0][..., 2]) & np.isfinite(clouds[1][..., 2])
        assert known.sum() > 20_000
        assert (
            np.sqrt(np.mean(aligned_error(*(cloud[known][::11] for cloud in clouds)) ** 2)) < 0.002
        )
    again = SplinedModel.from_arrays(found.to_dict(), found.to_arrays())
    assert again.bundle.half_turned_poses == found.bundle.half_turned_poses


@pytest.mark.slow
def test_marked_poses_are_never_turned(mixed, true) -> None:
    marked = [replace(each, marked=i in TURNED) for i, each in enumerate(mixed)]
    found = adjust_bundle(
        marked, calibrate_stereo(marked, true.projector.size, str(BOARD)), cells_across=CELLS
    )
    assert set(found.half_turned_poses) == {
        each.name for i, each in enumerate(mixed) if i not in TURNED
    }


def test_boards_that_may_be_turned() -> None:
    assert is_numbering_ambiguous("circles:21x16:9") and is_numbering_ambiguous("acircles:4x11:20")
    assert (
        not is_numbering_ambiguous("charuco:8x6:30")
        and not is_numbering_ambiguous("chessboard:9x7:20")
        and not is_numbering_ambiguous("")
    )
    partner = opposite_features(BOARD.points)
    assert partner is not None and np.array_equal(partner, np.arange(len(BOARD.points))[::-1])
    assert opposite_features(Board.parse("acircles:4x11:20").points) is None, (
        "its last row would start elsewhere"
    )
    assert opposite_features(Board.parse("acircles:4x10:20").points) is not None
