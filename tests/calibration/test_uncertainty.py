"""How sure the splined calibration is of its space: against the truth, over the working volume, and
pixel by pixel."""

import numpy as np
import pytest
from facts import missing_facts
from splined_rig import BOARD, CELLS, observation, phase_map, poses, rig

from slviewer.calibration.splined.model import SplinedModel, calibrate_splined
from slviewer.calibration.splined.uncertainty import (
    BestMotion,
    compute_sigma_map,
    extrapolation_factor,
    persistence_ratio,
    remove_rigid_motion,
    select_depth_axis,
    select_visible,
    sigma_3d,
    summarise_volume_sigma,
    working_volume,
)
from slviewer.calibration.splined.unknowns import Device
from slviewer.calibration.stereo import StereoModel, calibrate_stereo
from slviewer.errors import InputError
from slviewer.inspection.features import distance
from slviewer.inspection.uncertainty import Spread, splined_shared
from slviewer.reconstruction.reconstruct import reconstruct_cloud
from slviewer.records.record import render_text
from slviewer.session.ply import read_ply, write_ply
from slviewer.simulation.rig import SimulatedRig
from tests.proofs.accuracy import (
    PREDICTED_BAND,
    PredictedErrors,
    compare_with_truth,
    judge_uncertainty,
)


@pytest.fixture(scope="module")
def true() -> SimulatedRig:
    return rig(3)


@pytest.fixture(scope="module")
def stereo_and_model(true) -> tuple[StereoModel, SplinedModel]:
    seen = [
        observation(true, pose, f"pose_{i:02d}", samples=1000)
        for i, pose in enumerate(poses(true, 10))
    ]
    stereo = calibrate_stereo(seen, true.projector.size, str(BOARD))
    return stereo, calibrate_splined(seen, stereo, cells_across=CELLS)


@pytest.fixture(scope="module")
def model(stereo_and_model) -> SplinedModel:
    return stereo_and_model[1]


def illuminated(model: SplinedModel) -> tuple[np.ndarray, np.ndarray]:
    return model.bundle.camera_poses > 0, model.bundle.projector_poses > 0


@pytest.mark.slow
@pytest.mark.computes
def test_the_working_volume_is_what_both_see_in_front_of_inside_and_behind_the_calibrated_depths(
    model,
) -> None:
    near, far = model.bundle.depth_range_mm
    volume = working_volume(model.rig, (near, far), columns=5, rows=4, depths=3)
    width, height = model.rig.camera.size
    assert volume.z.min() < 0.9 * near and volume.z.max() > 1.1 * far
    assert {0.0, width - 1} <= set(volume.pixels[:, 0]) and {0.0, height - 1} <= set(
        volume.pixels[:, 1]
    )
    assert (volume.projector > -0.51).all() and (volume.projector < model.rig.projector.size).all()
    assert select_depth_axis(model.rig, volume) == "x"
    supported = volume.supported(model.rig, *illuminated(model))
    assert 0.5 < supported.mean() <= 1
    with pytest.raises(InputError):
        working_volume(model.rig, (700.0, 500.0))
    with pytest.raises(InputError):
        working_volume(model.rig, (3.0, 4.0))


def test_a_rigid_motion_is_taken_away_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-100, 100, (40, 3)) + np.array([0, 0, 600])
    turn, shift = rng.normal(size=3) * 1e-3, rng.normal(size=3)
    moved = np.cross(turn, points) + shift
    errors = rng.normal(size=(40, 3))
    both = np.stack([moved.ravel(), errors.ravel(), (moved + errors).ravel()])
    left = remove_rigid_motion(both, points)
    assert np.abs(left[0]).max() < 1e-9
    assert left[2] == pytest.approx(left[1])
    assert 0.9 < np.linalg.norm(left[1]) / np.linalg.norm(errors) < 1
    # fitted to some points that only move: the others keep all their errors
    some = np.arange(40) < 20
    errors[some] = 0
    assert remove_rigid_motion((moved + errors).reshape(1, -1), points, some)[0] == pytest.approx(
        errors.ravel(), abs=1e-9
    )
    with pytest.raises(InputError):
        remove_rigid_motion(both, points, np.arange(40) < 2)


@pytest.mark.slow
@pytest.mark.computes
def test_it_is_as_wrong_as_it_says(model, true) -> None:
    found = compare_with_truth(model, true)
    row = found.row("analytic")
    assert 0.6 < row["ratio"] < 1.7
    assert row["below_2_sigma"] > 0.8
    assert found.predicted[~found.supported].mean() > 3 * found.predicted[found.supported].mean()


@pytest.mark.computes
def test_the_frame_would_overstate_it(model) -> None:
    volume = working_volume(model.rig, model.bundle.depth_range_mm)
    whitened = model.bundle.whiten(model.bundle.point_jacobian("x", volume.pixels, volume.z))
    shape = sigma_3d(
        remove_rigid_motion(
            whitened, volume.points, volume.supported(model.rig, *illuminated(model))
        )
    )
    assert np.median(sigma_3d(whitened)) > 10 * np.median(shape)


@pytest.mark.computes
def test_the_volume_is_summed_up_before_anything_is_scanned(model) -> None:
    figures = model.describe().sigma_volume_mm
    assert figures == summarise_volume_sigma(model.bundle)
    assert 0.001 < figures.median < figures.p95 < figures.worst
    assert 0.5 < figures.supported < 1 and figures.axis == "x"
    shown = f"{figures.median:.4f}", f"{figures.p95:.4f} mm", f"{figures.worst:.3f} mm"
    assert missing_facts(render_text(model.describe().table()), *shown) == []


def test_a_smooth_field_goes_on_farther_than_independent_differences_do() -> None:
    rng = np.random.default_rng(0)
    illuminated = np.ones((20, 26), bool)
    illuminated[:, 22:] = False
    size = np.array([400.0, 300.0])
    rough = rng.normal(size=(2, 23, 29))
    waves = np.sin(2 * np.pi * np.arange(29) / 14)[None, None, :] * np.ones((2, 23, 1))
    assert persistence_ratio(Device(np.zeros(10), rough, size), illuminated) == 1
    assert 2 < persistence_ratio(Device(np.zeros(10), waves, size), illuminated) < 3
    assert persistence_ratio(Device(np.zeros(10), waves, size), np.zeros((20, 26), bool)) == 1


@pytest.mark.slow
@pytest.mark.computes
def test_the_map_says_at_each_pixel_what_the_covariance_says_there(model) -> None:
    bundle, (near, far) = model.bundle, model.depths_mm
    nodes = compute_sigma_map(bundle, "x", near, far)
    width, height = (int(n) for n in model.rig.camera.size)
    rng = np.random.default_rng(1)
    pixels = np.column_stack([rng.integers(0, width, 200), rng.integers(0, height, 200)]).astype(
        float
    )
    volume = select_visible(model.rig, pixels, rng.uniform(0.9, 1.1, 200) * 600)
    reference = working_volume(model.rig, bundle.depth_range_mm, columns=7, rows=5, depths=4)
    motion = BestMotion.fit(reference.points, reference.supported(model.rig, *illuminated(model)))
    fitted = (
        bundle.whiten(bundle.point_jacobian("x", reference.pixels, reference.z)) @ motion.weights
    )
    exact = bundle.whiten(bundle.point_jacobian("x", volume.pixels, volume.z)[2::3])
    exact = np.linalg.norm(
        exact - fitted @ motion.displace(volume.points)[2::3].T, axis=0
    ) * extrapolation_factor(bundle, volume)
    points = np.full((height, width, 3), np.nan, np.float32)
    u, v = volume.pixels.astype(int).T
    points[v, u] = volume.points
    found = nodes.interpolate(points)
    assert np.array_equal(np.isfinite(found), np.isfinite(points[..., 2]))
    ratio = found[v, u] / exact
    assert (
        0.9 < np.median(ratio) < 1.2
        and np.percentile(ratio, 5) > 0.7
        and np.percentile(ratio, 95) < 1.6
    )


@pytest.mark.slow
@pytest.mark.computes
def test_a_cloud_knows_its_noise_and_its_calibration_apart_and_its_file_holds_them(
    stereo_and_model, true, tmp_path
) -> None:
    stereo, model = stereo_and_model
    phases = {"x": phase_map(true, np.full(true.camera.size[::-1], 600.0))}
    cloud = reconstruct_cloud(model, phases)
    left, mask = cloud.sigma_calibration, cloud.mask
    assert left is not None and left.dtype == np.float32 and np.array_equal(np.isfinite(left), mask)
    noise = model.sigma_z(phases["x"], cloud.points)
    assert np.array_equal(cloud.sigma_z, noise, equal_nan=True)  # plane RMS is of noise alone
    assert cloud.sigma[mask] == pytest.approx(np.hypot(noise, left)[mask])
    assert 0.0005 < np.median(left[mask]) < 0.02
    write_ply(tmp_path / "cloud.ply", cloud.measured, scalars=cloud.sigmas(mask))
    scalars = read_ply(tmp_path / "cloud.ply").scalars
    assert set(scalars) == {"sigma_noise", "sigma_calibration", "sigma"}
    assert (
        np.array_equal(scalars["sigma_calibration"], left[mask])
        and (scalars["sigma"] >= noise[mask]).all()
    )
    plain = reconstruct_cloud(stereo, phases)
    assert plain.sigma_calibration is None and np.array_equal(
        plain.sigma, plain.sigma_z, equal_nan=True
    )
    assert set(plain.sigmas(plain.mask)) == {"sigma_noise"}


def test_a_proof_pools_its_rigs_and_says_whether_it_holds() -> None:
    supported = np.array([True, True, False])
    cautious = PredictedErrors(np.array([2.0, 2.0, 9.0]), np.array([1.0, 1.0, 3.0]), supported)
    bold = PredictedErrors(np.array([1.0, 1.0, 1.0]), np.array([2.0, 2.0, 3.0]), supported)
    too_bold = judge_uncertainty({"bold": bold}, 0.5)
    assert not judge_uncertainty({"cautious": cautious}, 0.5).holds and not too_bold.holds
    both = judge_uncertainty({"cautious": cautious, "bold": bold}, 0.5)
    record = both.to_json()
    assert both.holds and record["holds"] and record["ratio"] == pytest.approx(1)
    assert [row["rig"] for row in record["rigs"]] == ["cautious", "bold", "pooled"]
    assert missing_facts(both.text(), "1.00", *PREDICTED_BAND) == []
    assert (
        missing_facts(too_bold.text(), f"{too_bold.to_json()['ratio']:.2f}", *PREDICTED_BAND) == []
    )


@pytest.mark.computes
def test_what_is_fitted_is_as_sure_as_the_calibrations_covariance_says(model) -> None:
    bundle = model.bundle
    volume = working_volume(model.rig, bundle.depth_range_mm, columns=5, rows=4, depths=3)
    supported = volume.supported(model.rig, *illuminated(model))
    inside = np.argsort(np.linalg.norm(volume.points - volume.points.mean(axis=0), axis=1))
    # well inside: at the rim, rounding decides on which side a place lies
    two = inside[supported[inside]][:2]
    pixels, z, points = (each[two] for each in (volume.pixels, volume.z, volume.points))
    shared = splined_shared(bundle, "x")
    ends = [
        Spread(np.zeros((3, 3)), shared(point[None], np.eye(3)[:, None]), "one") for point in points
    ]
    found = distance(points[0], points[1], *ends)
    # a distance does not know of rigid motions: it is the same with them left in
    along = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
    whitened = bundle.whiten(bundle.point_jacobian("x", pixels, z)).astype(np.float64)
    assert found.sigma == pytest.approx(
        np.linalg.norm(whitened @ np.concatenate([-along, along])), rel=0.02
    )
    assert 0 < found.sigma < 0.2 and all(np.sqrt(np.trace(end.covariance)) < 0.2 for end in ends)
    larger = splined_shared(bundle, "x", 1.5)(1.5 * points[:1], np.eye(3)[:, None])
    assert np.allclose(larger, 1.5 * ends[0].shared, rtol=1e-3, atol=1e-6)
    # nor is any distance surer than the scale that it was corrected by
    scaled = splined_shared(bundle, "x", 1.0, 2e-3)
    ends = [
        Spread(np.zeros((3, 3)), scaled(point[None], np.eye(3)[:, None]), "one") for point in points
    ]
    of_scale = 2e-3 * np.linalg.norm(points[1] - points[0])
    assert distance(points[0], points[1], *ends).sigma == pytest.approx(
        np.hypot(found.sigma, of_scale), rel=1e-3
    )
