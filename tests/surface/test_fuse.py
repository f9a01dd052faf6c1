"""Fusing: averaged by sigma, one layer, strays out, no seam; all against a ball that is known."""

from dataclasses import replace

import numpy as np
import pytest
from ball_scans import ball, looking_from, off, rms
from facts import raises

from slviewer.errors import Cancelled, InputError
from slviewer.geometry.rigid import Uncertainty
from slviewer.surface.fuse import Fused, fuse
from slviewer.surface.view import detect_far_clusters

pytestmark = pytest.mark.computes

SIDE = (0.1, -0.05, -1.0)
DEPTHS = {"near": (240.0, 0.02), "middle": (320.0, 0.04), "far": (400.0, 0.06)}


def depths(**changed: float) -> tuple[dict, dict]:
    scans = {
        name: ball(away, changed.get(name, sigma), i)
        for i, (name, (away, sigma)) in enumerate(DEPTHS.items())
    }
    return scans, {name: looking_from(SIDE, away) for name, (away, _) in DEPTHS.items()}


@pytest.fixture(scope="module")
def fused() -> Fused:
    return fuse(*depths())


def test_the_fused_surface_is_better_than_the_best_scan(fused: Fused) -> None:
    scans, _ = depths()
    best = min(rms(off(scans[name].measured - [0, 0, away])) for name, (away, _) in DEPTHS.items())
    found = rms(off(fused.surface.points))
    assert 0.5 * best < found < 0.95 * best


def test_sigma_tells_the_error_that_is_left(fused: Fused) -> None:
    seen = fused.seen_by == 3
    assert seen.mean() > 0.8
    surface = fused.surface
    assert surface.sigma_mm is not None
    assert 0.8 < rms(off(surface.points)[seen] / surface.sigma_mm[seen]) < 1.2


def test_a_place_is_kept_once_with_its_normal_outwards(fused: Fused) -> None:
    scans, _ = depths()
    points, normals = fused.surface.points, fused.surface.normals
    assert 0.9 < len(points) / scans["near"].mask.sum() < 1.1
    assert normals is not None
    outwards = (normals * points).sum(axis=1) / np.linalg.norm(points, axis=1)
    assert np.percentile(outwards, 1) > 0.97
    assert fused.shared > 0.9 and all(0.02 < pair.rms_mm < 0.1 for pair in fused.pairs.values())


def test_the_error_of_a_pose_is_part_of_sigma_where_it_moves_the_surface(fused: Fused) -> None:
    covariance = np.diag([0, 0, 0, 0, 0, 0.1**2])  # 0.1 mm along z
    uncertain = fuse(*depths(), poses={"near": Uncertainty(covariance, np.zeros(3))})
    before, after = fused.surface.sigma_mm, uncertain.surface.sigma_mm
    assert before is not None and after is not None and uncertain.surface.normals is not None
    near = uncertain.source == uncertain.names.index("near")
    added = np.sqrt(after.astype(np.float64) ** 2 - before.astype(np.float64) ** 2)
    np.testing.assert_allclose(
        added[near], 0.1 * np.abs(uncertain.surface.normals[near, 2]), atol=1e-3
    )
    assert near.mean() > 0.5 and np.array_equal(after[~near], before[~near])
    # about the ball's middle
    turning = Uncertainty(np.diag([1e-6, 0, 0, 0, 0, 0]), np.zeros(3))
    turned = fuse(*depths(), poses={"near": turning})
    assert turned.surface.sigma_mm is not None
    assert np.abs(turned.surface.sigma_mm - before).max() < 0.05 * np.median(before)


def test_a_bad_scan_weighs_little() -> None:
    scans, poses = depths()
    shifted = poses["far"].copy()
    shifted[:3, 3] += 0.2 * shifted[:3, 2]
    sigma = np.full(scans["far"].sigma_z.shape, 0.4)
    biased = fuse({**scans, "far": replace(scans["far"], sigma_z=sigma)}, {**poses, "far": shifted})
    seen = biased.seen_by == 3
    assert abs(off(biased.surface.points)[seen].mean()) < 0.01
    equal = fuse(
        {**scans, "far": replace(scans["far"], sigma_z=sigma / 20)}, {**poses, "far": shifted}
    )
    assert abs(off(equal.surface.points)[equal.seen_by == 3].mean()) > 0.03


def test_a_calibrations_own_error_is_not_averaged_away() -> None:
    scans, poses = depths()
    lasting = {
        name: replace(scan, sigma_calibration=np.full(scan.sigma_z.shape, 0.05))
        for name, scan in scans.items()
    }
    sigma = fuse(lasting, poses).surface.sigma_mm
    assert sigma is not None and 0.035 < np.median(sigma) < 0.055


def test_noise_that_is_not_known_is_taken_from_the_scan() -> None:
    scans, poses = depths()
    unknown = {
        name: replace(scan, sigma_z=np.full(scan.sigma_z.shape, np.nan))
        for name, scan in scans.items()
    }
    found = fuse(unknown, poses)
    sigma, seen = found.surface.sigma_mm, found.seen_by == 3
    assert sigma is not None
    assert 0.6 < rms(off(found.surface.points)[seen] / sigma[seen]) < 1.6


def test_strays_flying_pixels_and_what_others_see_through_go() -> None:
    scans, poses = depths()
    points = scans["middle"].points.copy()
    v, u = np.mgrid[:5, :5]
    points[1:6, 1:6] = np.stack([u / 2, v / 2, np.full(u.shape, 200.0)], axis=2)
    points[28, 38] *= 1.05  # behind the surface, by 14 mm
    points[24:35, 18:29] *= 0.97  # a patch that stands 9 mm before it
    found = fuse({**scans, "middle": replace(scans["middle"], points=points)}, poses)
    excluded = found.excluded["middle"]
    assert excluded["groups"] == 9 and excluded["edges"] > 60 and excluded["unconfirmed"] > 40
    assert found.excluded["near"]["unconfirmed"] == 0
    assert np.abs(off(found.surface.points)).max() < 0.5


def test_small_clusters_far_from_everything_else_are_removed_and_counted() -> None:
    large = np.full((200, 200, 3), np.nan, np.float32)
    v, u = np.mgrid[:200, :200]
    large[...] = np.stack([u * 0.2, v * 0.2, np.full(u.shape, 500.0)], axis=2)
    large[5:10, 5:10, 2] = 900.0
    assert detect_far_clusters(large, np.ones((200, 200), bool)).sum() == 25
    large[5:10, 5:10, 2] = 502.0
    assert detect_far_clusters(large, np.ones((200, 200), bool)).sum() == 0


def test_colours_show_no_seam() -> None:
    poses = {"a": looking_from((0.4, 0, -1), 300.0), "b": looking_from((-0.4, 0, -1), 300.0)}
    found = fuse(
        {"a": ball(300.0, 0.03, 1, grey=120.0), "b": ball(300.0, 0.03, 2, grey=180.0)}, poses
    )
    grey = found.surface.colours
    assert grey is not None and np.ptp(np.percentile(grey, [1, 99])) < 4
    assert abs(grey.mean() - np.sqrt(120 * 180)) < 3


def test_a_single_scan_is_cleaned_and_stays_where_it_is() -> None:
    scan = ball(300.0, 0.03, 5)
    found = fuse({"one": scan}, {"one": np.eye(4)})
    kept = {tuple(p) for p in scan.measured.tolist()}
    assert all(tuple(p) in kept for p in found.surface.points.tolist())
    assert not found.pairs and found.shared == 0


def test_refusals() -> None:
    scans, poses = depths()
    with raises(InputError, "far"):
        fuse(scans, {name: T for name, T in poses.items() if name != "far"})
    with pytest.raises(InputError):
        moved = replace(
            scans["far"],
            points=scans["far"].points + [0, 0, -200] + 3 * np.sin(scans["far"].points),
        )
        fuse({"far": moved}, poses)
    with raises(InputError, "far", 0):
        fuse(
            {"far": replace(scans["far"], points=np.full_like(scans["far"].points, np.nan))}, poses
        )
    with raises(InputError, 1, 255):
        fuse({}, {})


def test_it_can_be_cancelled() -> None:
    def stop(share: float) -> None:
        if share > 0.4:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        fuse(*depths(), stop)
