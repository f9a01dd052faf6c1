"""Stereo corrected pixel by pixel, against a rig whose lenses bend as no pinhole with Brown's distortion does."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from analytic_rig import BOARD, PERIOD, PROJECTOR, SIZE, board_poses, cv_project, observation, rig

from slviewer.calibration.anchored import AnchoredModel, calibrate_anchored
from slviewer.calibration.correction import QuadraticSums
from slviewer.calibration.observe import Observation
from slviewer.calibration.pixelwise import calibrate_pixelwise
from slviewer.calibration.stereo import StereoModel, calibrate_stereo
from slviewer.errors import CalibrationRejected
from slviewer.fringe.phase import PhaseMap
from slviewer.geometry.polynomial import fit_polynomial
from slviewer.geometry.shapes import fit_plane

TRUE = rig()
BENT_PX = 0.12
"""Height of the wave that the projector adds to its columns, of half its width in length."""


def bend(column: np.ndarray, row: np.ndarray) -> np.ndarray:
    return BENT_PX * np.sin(2 * np.pi * (column / 230 + row / 500))


def bent(o: Observation) -> Observation:
    """The same pose through a projector whose columns wave."""
    u0, v0, u1, v1 = o.box
    u, v = (a.ravel() for a in np.meshgrid(np.arange(u0, u1, 3), np.arange(v0, v1, 3)))
    column, row = (o.surfaces[axis].evaluate(u, v) * PERIOD / (2 * np.pi) for axis in ("x", "y"))
    waved = 2 * np.pi * (column + bend(column, row)) / PERIOD
    surface = fit_polynomial(u, v, waved, None, (u0 - 0.5, v0 - 0.5, u1 - 0.5, v1 - 0.5), 10)
    projector = o.projector.copy()
    projector[:, 0] += bend(*o.projector.T)
    return replace(o, projector=projector, surfaces=dict(o.surfaces) | {"x": surface})


@cache  # at its first use, not wherever tests are collected
def observations() -> list[Observation]:
    return [bent(observation(TRUE, T, f"pose_{k:02d}", 0.005)) for k, T in enumerate(board_poses(20))]


def phase_of_plane(z: float) -> PhaseMap:
    """What the bent projector makes of the plane at depth z."""
    rays = TRUE.camera.rays()
    points = np.dstack([rays * z, np.full(rays.shape[:2], z)])
    seen = cv_project(TRUE.projector, points.reshape(-1, 3) @ TRUE.R.T + TRUE.t)
    column = (seen[:, 0] + bend(*seen.T)).reshape(rays.shape[:2])
    one = np.ones(column.shape, np.float32)
    phase = (2 * np.pi * column / PERIOD).astype(np.float32)
    reason = np.zeros(column.shape, np.uint8)
    return PhaseMap("x", PERIOD, phase, 0 * one, 80 * one, 120 * one, reason, (1.0, 0.01), 18)


def flatness(points: np.ndarray, seen: np.ndarray) -> float:
    cloud = points[seen & np.isfinite(points[..., 2])].astype(float)
    return float(np.sqrt(np.mean(fit_plane(cloud).distance(cloud) ** 2)))


@pytest.fixture(scope="module")
def stereo() -> StereoModel:
    return calibrate_stereo(observations(), PROJECTOR, str(BOARD))


@pytest.fixture(scope="module")
def model(stereo: StereoModel) -> AnchoredModel:
    return calibrate_anchored(observations(), stereo)


def test_planes_are_flatter_than_stereo_and_pixelwise_make_them(stereo: StereoModel, model: AnchoredModel) -> None:
    pixelwise = calibrate_pixelwise(observations(), stereo)
    seen = model.corrections["x"].poses >= 8
    for z, share in ((560.0, 0.2), (640.0, 0.2), (470.0, 0.75), (740.0, 0.75)):
        phase = phase_of_plane(z)
        by_stereo, by_pixelwise, by_anchored = (flatness(m.points(phase), seen) for m in (stereo, pixelwise, model))
        assert by_stereo > 0.05
        assert 1e-3 < by_anchored < share * by_stereo
        assert by_anchored < by_pixelwise


def test_boards_misplaced_by_the_calibration_are_laid_again(stereo: StereoModel) -> None:
    """What all poses share cannot be told from a rig; what one pose has for itself can."""
    rng = np.random.default_rng(0)
    poses = {name: T.copy() for name, T in stereo.poses.items()}
    for T in poses.values():
        T[2, 3] += rng.normal(0, 0.1)
    model = calibrate_anchored(observations(), stereo, poses)
    assert model.corrections["x"].noise_px < 0.01  # 0.1 mm are 0.05 px
    assert flatness(model.points(phase_of_plane(600.0)), model.corrections["x"].poses >= 8) < 0.03


def test_a_pixel_without_a_pose_and_a_phase_far_off_are_nan(model: AnchoredModel) -> None:
    none = model.corrections["x"].poses == 0
    points = model.points(phase_of_plane(600.0))
    assert none.any() and np.isnan(points[none]).all()
    assert np.isfinite(points[model.corrections["x"].poses >= 8]).all()
    assert np.isnan(model.points(phase_of_plane(200.0))).all()


def test_a_capture_of_another_fringe_period_measures_the_same(model: AnchoredModel) -> None:
    phase = phase_of_plane(600.0)
    finer = replace(phase, period_px=12.0, phase=(phase.phase * 1.5).astype(np.float32))
    assert np.nanmax(np.abs(model.points(finer) - model.points(phase))) < 2e-3


def test_predicted_noise_is_the_measured_one(model: AnchoredModel) -> None:
    phase = phase_of_plane(600.0)
    clean = model.points(phase)
    noise = np.random.default_rng(1).normal(size=clean.shape[:2]) * phase.sigma_phase
    shaken = model.points(replace(phase, phase=(phase.phase + noise).astype(np.float32)))
    assert np.nanstd((shaken - clean)[..., 2] / model.sigma_z(phase, clean)) == pytest.approx(1.0, abs=0.02)


def test_it_survives_saving(model: AnchoredModel) -> None:
    again = AnchoredModel.restored(model.to_dict(), model.to_arrays())
    phase = phase_of_plane(600.0)
    assert again.axes == model.axes
    assert np.array_equal(again.points(phase), model.points(phase), equal_nan=True)


def test_the_prior_is_what_the_pixels_were_drawn_from() -> None:
    """And a pixel of few poses is nearer to the truth with it than by its own least squares."""
    rng = np.random.default_rng(3)
    truth = np.array([0.2, 0.1, 0.05])[:, None, None] * rng.normal(size=(3, 60, 80))
    sums = QuadraticSums(np.full((60, 80), 200.0, np.float32), np.full((60, 80), -80.0, np.float32))
    for k in range(12):
        s = rng.uniform(-1, 1, (60, 80))
        e = truth[0] + truth[1] * s + truth[2] * s**2 + rng.normal(0, 0.03, s.shape)
        if k >= 3:
            e[:, 40:] = np.nan  # half of the pixels saw three poses
        sums.add(200 - 80 * s, 200 - 80 * s + e, (0, 0))
    found = sums.solve()
    np.testing.assert_allclose(np.sqrt(np.diag(found.prior)), [0.2, 0.1, 0.05], rtol=0.1)
    assert found.noise_px == pytest.approx(0.03, rel=0.05)
    for part, limit in ((np.s_[:, :, :40], 0.03), (np.s_[:, :, 40:], 0.06)):
        off = (found.coefficients - truth)[part]
        assert np.sqrt((off**2).mean()) < limit
    assert np.array_equal(np.unique(sums.poses), [3, 12])


def test_too_few_poses_are_rejected(stereo: StereoModel) -> None:
    with pytest.raises(CalibrationRejected, match="at least 4"):
        calibrate_anchored(observations()[:3], stereo)
    with pytest.raises(CalibrationRejected, match="made elsewhere"):
        calibrate_anchored(observations(), StereoModel.made_elsewhere(TRUE), stereo.poses)
    assert stereo.rig.camera.size == SIZE
