"""The joint adjustment on a simulated rig seen without images: right in space, honest about what it
does not know."""

from dataclasses import replace

import numpy as np
import pytest
from facts import raises
from splined_rig import (
    BOARD,
    CELLS,
    PERIOD,
    aligned_error,
    observation,
    phase_map,
    poses,
    rig,
    surface,
)

from slviewer.calibration.observe import Observation
from slviewer.calibration.splined.adjust import adjust_bundle, pose_residuals
from slviewer.calibration.splined.model import SplinedModel, calibrate_splined
from slviewer.calibration.splined.unknowns import board_frame, board_heights
from slviewer.calibration.stereo import StereoModel, calibrate_stereo
from slviewer.errors import InputError
from slviewer.geometry.vectors import rms_length, shared_rms
from slviewer.records.verdict import Verdict
from slviewer.simulation.boards import BoardShape, printed_board

pytestmark = pytest.mark.computes

SHAPE = BoardShape(bow_x_mm=0.1, bow_y_mm=-0.04, twist_mm=0.05, misplaced_mm=0.02)
DEPTHS = (440.0, 520.0, 600.0, 690.0, 780.0)


@pytest.fixture(scope="module")
def true():
    return rig(seed=2)


@pytest.fixture(scope="module")
def seen(true) -> list[Observation]:
    return [
        observation(true, pose, f"pose_{i:02d}", SHAPE) for i, pose in enumerate(poses(true, 12))
    ]


@pytest.fixture(scope="module")
def stereo(seen, true) -> StereoModel:
    return calibrate_stereo(seen, true.projector.size, str(BOARD))


@pytest.fixture(scope="module")
def model(seen, stereo) -> SplinedModel:
    return calibrate_splined(seen, stereo, cells_across=CELLS)


def measured(model, true, depths=DEPTHS) -> tuple[np.ndarray, np.ndarray]:
    """Found and true points (n, 3) of fronto-parallel surfaces, through pixels that the model
    measures."""
    found, truth = [], []
    for depth in depths:
        z = np.full(true.camera.size[::-1], depth)
        points = model.points(phase_map(true, z)).astype(float)
        known = np.isfinite(points[..., 2])
        found.append(points[known][::7])
        truth.append(surface(true, z)[known][::7])
    return np.concatenate(found), np.concatenate(truth)


@pytest.mark.slow
def test_space_is_right_in_front_of_inside_and_behind_the_calibrated_depths(
    model, stereo, true
) -> None:
    found, truth = measured(model, true)
    assert len(truth) > 30_000
    error = aligned_error(found, truth)
    rms = np.sqrt(np.mean(error**2))
    assert 0.0005 < rms < 0.012
    theirs = aligned_error(*measured(stereo, true))
    assert np.sqrt(np.mean(theirs**2)) > 10 * rms


@pytest.mark.slow
def test_the_board_is_found_as_it_is(model, true) -> None:
    bundle = model.bundle
    scene = printed_board(BOARD, poses(true, 1)[0], SHAPE, true.seed)
    order = [int(np.argmin(np.linalg.norm(BOARD.points - p, axis=1))) for p in bundle.points]
    height = board_heights(bundle.points, board_frame(bundle.points), bundle.state.heights)
    shape = np.column_stack([bundle.points[:, :2] + bundle.state.offsets, height])
    error = aligned_error(shape, scene.features[order])
    assert np.sqrt(np.mean(error[:, 2] ** 2)) < 0.003
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 0.006 < np.std(scene.misplacement) / 3


def test_weights_come_from_the_residuals(model) -> None:
    noise = model.bundle.noise
    assert 0.006 < noise.camera_px < 0.012
    assert max(noise.excess_px) < 0.003 and all(0.004 < s < 0.008 for s in noise.sample_px)
    assert all(
        fit.camera_trust > 0.7 and fit.projector_trust > 0.7 for fit in model.bundle.fits.values()
    )
    assert not model.bundle.excluded


@pytest.mark.slow
def test_a_pose_that_moved_during_its_capture_is_named_and_changes_nothing(
    model, seen, stereo, true
) -> None:
    moved = observation(true, poses(true, 12)[5], "pose_05", SHAPE, moved_mm=0.5)
    bundle = adjust_bundle(
        [moved if o.name == "pose_05" else o for o in seen], stereo, cells_across=CELLS
    )
    assert list(bundle.excluded) == ["pose_05"] and "moved" in bundle.excluded["pose_05"]
    z = np.full(true.camera.size[::-1], 600.0)
    phase = phase_map(true, z)
    good, other = (m.points(phase)[..., 2] for m in (model, SplinedModel(bundle)))
    assert np.nanstd(good - other) < 0.01


@pytest.mark.slow
def test_poses_read_with_more_noise_count_less_and_do_not_pass_for_moved(seen, stereo) -> None:
    rng = np.random.default_rng(1)
    noisy = ("pose_02", "pose_07")
    read = [
        replace(o, camera=o.camera + rng.normal(0, 0.02, o.camera.shape)) if o.name in noisy else o
        for o in seen
    ]
    bundle = adjust_bundle(read, stereo, cells_across=CELLS)
    assert not bundle.excluded
    assert all(bundle.fits[name].camera_trust > 0.65 for name in noisy)
    assert bundle.noise.camera_px < 0.013  # that of the others


@pytest.mark.slow
def test_where_no_pose_looked_points_are_masked_unless_asked_for(seen, stereo, true) -> None:
    left = [replace(o, samples=_left_of(o, 0.6 * true.camera.size[0])) for o in seen]
    model = SplinedModel(adjust_bundle(left, stereo, cells_across=CELLS))
    phase = phase_map(true, np.full(true.camera.size[::-1], 600.0))
    width = true.camera.size[0]
    masked, all_of_it = model.points(phase)[..., 2], model.points(phase, supported=False)[..., 2]
    assert np.isfinite(masked[:, int(0.2 * width) : int(0.55 * width)]).mean() > 0.95
    assert np.isnan(masked[:, int(0.66 * width) :]).all()
    assert np.isfinite(all_of_it[:, int(0.66 * width) : int(0.8 * width)]).mean() > 0.95
    assert np.array_equal(model.support(phase), np.isfinite(masked))


def _left_of(o: Observation, limit: float):
    assert o.samples is not None
    kept = o.samples.camera[:, 0] < limit
    return type(o.samples)(
        *(a[kept] for a in (o.samples.camera, o.samples.projector, o.samples.sigma))
    )


@pytest.mark.slow
def test_what_is_saved_comes_back_the_same(model, true) -> None:
    import json

    again = SplinedModel.from_arrays(json.loads(json.dumps(model.to_dict())), model.to_arrays())
    phase = phase_map(true, np.full(true.camera.size[::-1], 600.0))
    assert np.array_equal(model.points(phase), again.points(phase), equal_nan=True)
    assert np.array_equal(model.bundle.factor, again.bundle.factor)
    assert again.describe() == model.describe()


def test_poses_of_one_axis_are_refused_with_what_is_missing(seen, stereo, true) -> None:
    single = [
        observation(true, p, f"pose_{i:02d}", axes=("x",)) for i, p in enumerate(poses(true, 4))
    ]
    with raises(InputError, 0, "axis x"):
        adjust_bundle(single, stereo)
    with pytest.raises(InputError):
        adjust_bundle([replace(o, samples=None) for o in seen], stereo)


def test_a_scan_of_another_period_or_of_the_wrong_size(model, true) -> None:
    z = np.full(true.camera.size[::-1], 600.0)
    one, other = (model.points(phase_map(true, z, period=p)) for p in (PERIOD, 36.0))
    assert np.nanmax(np.abs(one - other)) < 2e-3
    small = phase_map(true, z)
    small = replace(
        small,
        **{
            k: getattr(small, k)[:-2]
            for k in ("phase", "wrapped", "modulation", "background", "reason")
        },
    )
    with pytest.raises(InputError):
        model.points(small)


def test_residuals_are_noise_where_those_of_stereo_are_a_pattern(model, seen, stereo) -> None:
    of_stereo, of_splined = stereo.describe(), model.describe().reprojection
    assert of_splined is not None and of_splined.patterns == {}
    assert set(stereo.reprojection.patterns) == {"camera", "projector"}
    assert of_stereo.pattern_px == stereo.reprojection.pattern_px
    for device, px in of_splined.rms_px.items():
        assert px < 0.5 * stereo.reprojection.rms_px[device]
    good, used = Verdict(), stereo.reprojection
    assert of_splined.judge(good, "splined").level == "good"
    assert used.judge(good, "pixelwise").level == "good"  # it corrects the pattern
    (finding,) = used.judge(good, "stereo").findings
    assert finding.cause == "residuals" and finding.severity == "doubtful"
    for each in seen:
        parts = pose_residuals(model.bundle, each)
        assert parts is not None
        errors = [rms_length(residuals) for _, residuals in parts]
        assert errors == pytest.approx(of_splined.pose_rms_px[each.name], rel=1e-6)
    assert pose_residuals(model.bundle, replace(seen[0], name="another")) is None


def test_shared_rms_is_that_of_the_pattern_alone() -> None:
    rng, n = np.random.default_rng(1), 20_000
    swirl = 0.2 * np.column_stack([np.cos(np.arange(n) / 50), np.sin(np.arange(n) / 50)])
    noise = rng.normal(0, 0.1, (n, 2))
    noise[7] = np.nan
    assert shared_rms(swirl + noise) == pytest.approx(0.2, rel=0.03)
    assert shared_rms(noise) < 0.02
    assert shared_rms(noise[:1]) == 0.0
