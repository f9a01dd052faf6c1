"""Guidance from information: it foretells what a pose brings, asks for what can be seen, and knows
when to stop."""

import numpy as np
import pytest
from splined_rig import BOARD, poses, rig

from slviewer.calibration.guidance import (
    ExpectedNoise,
    GuidanceModel,
    RigInformation,
    estimate_rig,
    information_rows,
    suggest_poses,
    volume_jacobian,
)
from slviewer.calibration.next_pose import depth_range
from slviewer.fringe.image_area import ImageArea
from slviewer.geometry.rig import StereoRig
from slviewer.wizard.pose_plan import (
    MIN_POSES,
    PlanInput,
    PoseFeatures,
    plan_next_pose,
    quick_plan,
)


@pytest.fixture(scope="module")
def true():
    return rig(seed=1)


@pytest.fixture(scope="module")
def seen(true) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Points, camera and projector of 12 poses, with noise."""
    rng = np.random.default_rng(0)
    found = []
    for pose in poses(true, 12):
        points = pose.to_camera(BOARD.points)
        devices = [
            d + rng.normal(0, 0.01, d.shape)
            for d in (true.camera.project(points), true.project(points))
        ]
        found.append((BOARD.points, *devices))
    return found


@pytest.fixture(scope="module")
def known(true, seen) -> tuple[StereoRig, list[np.ndarray]]:
    found = estimate_rig(*zip(*seen[:6], strict=True), (true.camera.size, true.projector.size))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def bench(known) -> GuidanceModel:
    return GuidanceModel(known[0], BOARD)


def test_few_poses_tell_where_things_will_be_seen(true, seen, known) -> None:
    stereo, found = known
    for T, (points, camera, projector) in zip(found, seen, strict=False):
        X = points @ T[:3, :3].T + T[:3, 3]
        assert np.abs(stereo.camera.project(X) - camera).max() < 0.5
        assert np.abs(stereo.project(X) - projector).max() < 5
    sizes = true.camera.size, true.projector.size
    assert estimate_rig(*zip(*seen[:2], strict=True), sizes) is None
    points, camera, projector = (list(a) for a in zip(*seen[:4], strict=True))
    # of other poses
    assert estimate_rig(points, camera, projector[1:] + projector[:1], sizes) is None


@pytest.mark.computes
@pytest.mark.slow
def test_the_gain_of_a_pose_is_what_it_will_bring(bench, known) -> None:
    sensitivity = volume_jacobian(bench, depth_range(BOARD, bench.stereo.camera))
    rows = information_rows(bench, np.array(known[1]))
    before, after = (RigInformation.from_rows(bench, rows[:n], sensitivity) for n in (5, 6))
    gain = before.gain(rows[5])
    assert (
        gain == pytest.approx(before.variances.mean() - after.variances.mean(), rel=1e-3)
        and gain > 0
    )
    assert (after.variances <= before.variances * (1 + 1e-6)).all()


@pytest.mark.slow
@pytest.mark.computes
def test_guided_poses_are_seen_and_know_more_than_others(true, bench, known) -> None:
    had = known[1][:3]
    sigmas = []
    for _ in range(3):
        found = suggest_poses(bench, had, trials=16)
        assert found is not None and found.sigma_next_mm < found.sigma_mm
        sigmas.append(found.sigma_mm)
        had = [*had, found.poses[0]]
        X = BOARD.points @ had[-1][:3, :3].T + had[-1][:3, 3]
        for pixels, device in (
            (true.camera.project(X), true.camera),
            (true.project(X), true.projector),
        ):
            assert ((pixels > -1) & (pixels < np.array(device.size))).all()
    sensitivity = volume_jacobian(bench, depth_range(BOARD, bench.stereo.camera))
    reached, by_design = (
        RigInformation.from_rows(
            bench, information_rows(bench, np.array(poses)), sensitivity
        ).sigma_mm
        for poses in (had, known[1])
    )
    assert sigmas[0] > sigmas[1] > sigmas[2] > reached
    assert reached < 0.8 * by_design  # as many that reach the corners by design
    assert found.sigma_next_mm == pytest.approx(reached, rel=1e-3)


def test_noise_that_was_seen_is_expected() -> None:
    usual = ExpectedNoise()
    assert usual.with_noise(np.array([np.nan, np.nan])) == usual
    noisy = usual.with_noise(3 * usual.sample * np.array([1.0, np.nan, 1.0]))
    assert noisy.sample == pytest.approx(3 * usual.sample) and noisy.feature == pytest.approx(
        3 * usual.feature
    )


def test_a_plan_is_of_the_part_of_the_image_that_changes(true, seen) -> None:
    sizes = true.camera.size, true.projector.size
    (width, height), left, right = sizes[0], 60, 40
    size = left + width + right, height
    u = np.tile(np.arange(size[0]), (height, 1))
    area = ImageArea.of((u < left) | (u >= left + width))
    plain, barred = (
        {f"pose_{i}": PoseFeatures(p, c + dx, q, area=part) for i, (p, c, q) in enumerate(seen[:4])}
        for dx, part in ((np.zeros(2), None), (np.array([left, 0.0]), area))
    )
    whole = quick_plan(PlanInput(BOARD, *sizes, plain), None)
    plan = quick_plan(PlanInput(BOARD, size, sizes[1], barred), None)
    assert np.array_equal(plan.coverage.cells, whole.coverage.cells)
    assert plan.coverage.share == whole.coverage.share
    assert plan.lens.size == size
    assert plan.lens.K[:2, 2] == pytest.approx(whole.lens.K[:2, 2] + np.array([left, 0]))
    assert plan.suggestion is not None and whole.suggestion is not None
    assert plan.suggestion.sentence == whole.suggestion.sentence
    assert plan.suggestion.outline_px == pytest.approx(
        whole.suggestion.outline_px + np.array([left, 0])
    )
    again = quick_plan(PlanInput(BOARD, size, sizes[1], barred), plan)
    assert again.suggestion is not None
    assert again.suggestion.outline_px == pytest.approx(plan.suggestion.outline_px)


@pytest.mark.slow
@pytest.mark.computes
def test_a_plan_asks_until_the_wanted_sigma_is_reached(true, seen) -> None:
    sizes = true.camera.size, true.projector.size
    features = {f"pose_{i:02d}": PoseFeatures(*each) for i, each in enumerate(seen)}
    nothing, few, many = (
        plan_next_pose(PlanInput(BOARD, *sizes, dict(list(features.items())[:n])), trials=16)
        for n in (0, 4, MIN_POSES)
    )
    assert nothing.sigma_mm is None and nothing.suggestion is not None and not nothing.reaches(1.0)
    assert (
        few.sigma_mm is not None
        and many.sigma_mm is not None
        and few.sigma_mm > many.sigma_mm > 0.001
    )
    assert few.sigma_next_mm is not None and few.sigma_next_mm < few.sigma_mm
    assert not few.reaches(2 * few.sigma_mm)  # too few to tell whether all is as it should be
    assert many.reaches(1.01 * many.sigma_mm) and not many.reaches(0.99 * many.sigma_mm)
    assert 0.01 < many.usual_mm < 0.04
    refused = plan_next_pose(
        PlanInput(BOARD, *sizes, dict(list(features.items())[:4]), refused=1), trials=16
    )
    assert refused.suggestion is not None and few.suggestion is not None
    assert not np.allclose(refused.suggestion.T_camera_board, few.suggestion.T_camera_board)
