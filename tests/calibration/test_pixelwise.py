"""The pixel-wise rational model against an exactly known rig."""

import numpy as np
import pytest
from analytic_rig import BOARD, PERIOD, PROJECTOR, board_poses, cv_project, observation, rig
from facts import raises

from slviewer.calibration.observe import Observation
from slviewer.calibration.pixelwise import (
    PixelwiseModel,
    calibrate_pixelwise,
    fit_rational,
    pixel_samples,
)
from slviewer.calibration.stereo import calibrate_stereo
from slviewer.errors import CalibrationRejected
from slviewer.fringe.phase import PhaseMap

pytestmark = pytest.mark.computes

TRUE = rig()
OBSERVATIONS = [observation(TRUE, T, f"pose_{k:02d}", 0.01) for k, T in enumerate(board_poses(16))]


@pytest.fixture(scope="module")
def model() -> PixelwiseModel:
    return calibrate_pixelwise(OBSERVATIONS, calibrate_stereo(OBSERVATIONS, PROJECTOR, str(BOARD)))


def phase_of_plane(z: float) -> tuple[PhaseMap, np.ndarray]:
    """Exact phase of the plane at depth z, and its points."""
    rays = TRUE.camera.rays()
    points = np.dstack([rays * z, np.full(rays.shape[:2], z)])
    coordinate = cv_project(TRUE.projector, points.reshape(-1, 3) @ TRUE.R.T + TRUE.t)[
        :, 0
    ].reshape(rays.shape[:2])
    shape = coordinate.shape
    phase = PhaseMap(
        axis="x",
        period_px=PERIOD,
        phase=(2 * np.pi * coordinate / PERIOD).astype(np.float32),
        wrapped=np.zeros(shape, np.float32),
        modulation=np.full(shape, 80, np.float32),
        background=np.full(shape, 120, np.float32),
        reason=np.zeros(shape, np.uint8),
        noise=(1.0, 0.01),
        steps=18,
    )
    return phase, points


@pytest.mark.parametrize(
    ("z", "limit"), [(560.0, 0.06), (640.0, 0.06), (460.0, 0.25), (760.0, 0.25)]
)
def test_depth_inside_and_outside_the_calibrated_range(
    model: PixelwiseModel, z: float, limit: float
) -> None:
    phase, truth = phase_of_plane(z)
    measured = model.points(phase)
    seen = model.fits["x"].poses >= 10
    error = (measured - truth)[seen]
    rms = np.sqrt(np.nanmean(error[:, 2] ** 2))
    assert 1e-4 < rms < limit
    # the gauge: a principal point some tenths of a pixel off
    assert np.sqrt(np.nanmean(error[:, :2] ** 2)) < 0.15


def test_fit_rms_is_kept_in_z_x_and_y(model: PixelwiseModel) -> None:
    rms = model.median_rms_mm("x")
    assert 1e-5 < rms["z"] < 0.08 and 0 < rms["x"] < 0.02 and 0 < rms["y"] < 0.02


def test_a_pixel_of_fewer_than_four_poses_is_nan(model: PixelwiseModel) -> None:
    fit = model.fits["x"]
    few = fit.poses < 4
    assert (
        few.any()
        and np.isnan(fit.coefficients[:, few]).all()
        and np.isnan(fit.rms_mm[:, few]).all()
    )
    assert np.isfinite(fit.coefficients[:, fit.poses >= 8]).all()
    assert fit.poses.max() == 16


def test_a_phase_far_from_the_fitted_ones_is_masked(model: PixelwiseModel) -> None:
    phase, _ = phase_of_plane(200.0)
    assert np.isnan(model.points(phase)).all()


def test_predicted_noise_is_the_measured_one(model: PixelwiseModel) -> None:
    phase, _ = phase_of_plane(600.0)
    clean = model.points(phase)
    rng = np.random.default_rng(1)
    noisy = phase.phase + rng.normal(size=clean.shape[:2]).astype(np.float32) * phase.sigma_phase
    shaken = model.points(PhaseMap(**{**vars(phase), "phase": noisy.astype(np.float32)}))
    ratio = (shaken - clean)[..., 2] / model.sigma_z(phase, clean)
    assert np.nanstd(ratio) == pytest.approx(1.0, abs=0.02)


def test_a_capture_of_another_fringe_period_measures_the_same(model: PixelwiseModel) -> None:
    phase, _ = phase_of_plane(600.0)
    finer = PhaseMap(
        **{**vars(phase), "period_px": 12.0, "phase": (phase.phase * 1.5).astype(np.float32)}
    )
    clean = model.points(phase)
    assert np.nanmax(np.abs(model.points(finer) - clean)) < 1e-3
    # the same error in phase is two thirds of the error in projector px
    assert np.nanmedian(model.sigma_z(finer, clean) / model.sigma_z(phase, clean)) == pytest.approx(
        2 / 3, rel=1e-3
    )


def test_it_survives_saving(model: PixelwiseModel) -> None:
    again = PixelwiseModel.from_arrays(model.to_dict(), model.to_arrays())
    phase, _ = phase_of_plane(600.0)
    assert np.array_equal(again.points(phase), model.points(phase), equal_nan=True)


def test_the_samples_of_a_pixel_lie_on_its_curve(model: PixelwiseModel) -> None:
    stereo = calibrate_stereo(OBSERVATIONS, PROJECTOR, str(BOARD))
    saved = [Observation.from_arrays(o.name, o.to_arrays()) for o in OBSERVATIONS]
    phase, points = pixel_samples(saved, stereo, model, "x", (200, 150))
    c = model.fits["x"].coefficients[:, 150, 200]
    assert len(phase) == model.fits["x"].poses[150, 200]
    residual = points[:, 2] - (c[0] + c[1] * phase) / (1 + c[2] * phase)
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(
        float(model.fits["x"].rms_mm[0, 150, 200]), rel=0.05
    )


def test_too_few_poses_are_rejected() -> None:
    stereo = calibrate_stereo(OBSERVATIONS[::5], PROJECTOR)
    with raises(CalibrationRejected, 1, 4):
        calibrate_pixelwise(OBSERVATIONS[:3], stereo)


def test_places_captured_twice_count_once() -> None:
    poses = board_poses(5)
    once = [observation(TRUE, T, f"pose_{k}", 0.01) for k, T in enumerate(poses)]
    again = [observation(TRUE, T, f"again_{k}", 0.01) for k, T in enumerate(poses)]
    models = [
        calibrate_pixelwise(each, calibrate_stereo(each, PROJECTOR, str(BOARD)))
        for each in (once, once + again)
    ]
    first, twice = (each.fits["x"].poses.astype(int) for each in models)
    assert first.max() == twice.max() == 5
    assert np.count_nonzero(first != twice) < 0.01 * first.size


def test_moments_find_an_exact_rational_function() -> None:
    """Noise-free data of the form itself come back to rounding, whatever the reference point."""
    phi = np.linspace(100, 130, 9)
    c0, c1, c2 = 900.0, -1.5, 3e-3
    z = (c0 + c1 * phi) / (1 + c2 * phi)
    a, rms, condition = np.empty((3, 1, 1)), np.empty((1, 1)), np.empty((1, 1), np.float32)
    poses, low, high = (
        np.empty((1, 1), np.uint16),
        np.empty((1, 1), np.float32),
        np.empty((1, 1), np.float32),
    )
    reference = np.full((1, 1), 118.0)
    fit_rational(
        0,
        1,
        phi.reshape(9, 1, 1),
        z.reshape(9, 1, 1),
        np.full(9, -1),
        reference,
        600.0,
        4,
        a,
        rms,
        poses,
        low,
        high,
        condition,
    )
    assert rms[0, 0] < 1e-6 and poses[0, 0] == 9 and (low[0, 0], high[0, 0]) == (100, 130)
    a0, a1, a2 = a[:, 0, 0]
    s = phi - 118.0
    assert np.allclose(600 + (a0 + a1 * s) / (1 + a2 * s), z, atol=1e-7)
