"""Scans from several depths come together in one frame."""

import numpy as np
import pytest
from bumpy_scans import NOISE, bumpy, error, motion, organised, view

from slviewer.errors import InputError, SlviewerError
from slviewer.reconstruction.cloud import Cloud
from slviewer.registration.merge import Scan, merge

DEPTHS = {"object_r1": -120.0, "object_r2": 0.0, "object_r3": 120.0}


def pose(name: str) -> np.ndarray:
    """Where the object stands in the reference's frame: its scan is nearer or further, and a little turned."""
    T = motion(6.0 if name == "object_r1" else 3.0, 4.0, seed=len(name) + int(DEPTHS[name]) % 7)
    T[:3, 3] -= T[:3, :3] @ [0.0, 0.0, DEPTHS[name]]
    return T if name != "object_r2" else np.eye(4)


@pytest.fixture(scope="module")
def clouds() -> dict[str, Cloud]:
    made = {}
    for k, name in enumerate(DEPTHS):
        points = organised(bumpy(2), pose(name), seed=k)
        texture = np.full(points.shape[:2], 50 * (k + 1), np.uint8)
        made[name] = Cloud(points, "x", "stereo", np.full(points.shape[:2], NOISE, np.float32), texture)
    return made


def test_three_depths_merge_into_one_cloud(clouds: dict[str, Cloud]) -> None:
    told: list[float] = []
    merged = merge(clouds, "object_r2", told.append)
    assert list(merged.pairs) == ["object_r1", "object_r3"]
    for name, pair in merged.pairs.items():
        shift, turn = error(pair, pose(name))
        assert shift < 0.03
        assert turn < 0.02
        assert 0.8 * NOISE < pair.rms_mm < 2.0 * NOISE
        assert pair.overlap > 0.6
        assert pair.start == "features"
    counts = [np.count_nonzero(cloud.mask) for cloud in clouds.values()]
    assert len(merged.points) == sum(counts)
    assert merged.points.dtype == np.float32
    assert merged.names == tuple(clouds)
    assert np.bincount(merged.source).tolist() == counts
    assert merged.colours is not None and merged.normals is not None
    assert merged.colours.shape == merged.points.shape
    assert (merged.colours[merged.source == 2] == 150).all()
    facing = np.sum(merged.normals * merged.points, axis=1)
    assert (facing[np.isfinite(facing)] < 0).mean() > 0.99
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
    np.testing.assert_array_equal(merged.points[merged.source == 1], clouds["object_r2"].measured)


def test_scans_without_colours_merge_without_colours() -> None:
    T = motion(10, 30)
    scans = {"a": Scan(view(bumpy(2), (-75, 45), 2)), "b": Scan(view(bumpy(2), (-45, 75), 1, T))}
    merged = merge(scans, "a")
    assert merged.colours is None
    assert merged.normals is None
    assert error(merged.pairs["b"], T)[0] < 0.03


def test_a_scan_that_does_not_belong_is_named() -> None:
    scans = {"a": Scan(view(bumpy(2), (-75, 45), 2)), "stranger": Scan(view(bumpy(58), (-45, 75), 1))}
    with pytest.raises(SlviewerError, match="stranger could not be merged"):
        merge(scans, "a")


def test_an_unknown_reference_and_a_single_scan_are_refused() -> None:
    scan = Scan(view(bumpy(2), (-75, 45), 2, points=1000))
    with pytest.raises(InputError, match="no scan called 'c'"):
        merge({"a": scan, "b": scan}, "c")
    with pytest.raises(InputError, match="2 to 255"):
        merge({"a": scan}, "a")
