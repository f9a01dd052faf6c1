"""Derivatives against differences, the compiled form against the exact one, the covariance against
true errors."""

from dataclasses import replace

import numpy as np
import pytest
from splined_rig import BOARD, CELLS, aligned_error, observation, phase_map, poses, rig, surface

from slviewer.calibration.known_camera import KnownCamera
from slviewer.calibration.pinhole_fit import fit_splined
from slviewer.calibration.splined.adjust import adjust_bundle, gather_data
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.splined.normal import (
    BlockFactor,
    Prior,
    normal_equations,
    predict_observations,
)
from slviewer.calibration.splined.uncertainty import summarise_volume_sigma
from slviewer.calibration.splined.unknowns import (
    Device,
    State,
    displacement,
    distort_to_pixel,
    pinhole_lens,
    remove_displacement,
    roughness,
    undistort_pixel,
)
from slviewer.calibration.stereo import calibrate_stereo
from slviewer.geometry.lens import Lens


@pytest.fixture(scope="module")
def true():
    return rig(seed=4)


@pytest.fixture(scope="module")
def seen(true):
    return [observation(true, pose, f"pose_{i:02d}") for i, pose in enumerate(poses(true, 10))]


@pytest.fixture(scope="module")
def stereo(seen, true):
    return calibrate_stereo(seen, true.projector.size, str(BOARD))


@pytest.fixture(scope="module")
def model(seen, stereo):
    return SplinedModel(adjust_bundle(seen, stereo, cells_across=CELLS))


def flat_state(stereo, names: list[str], data) -> State:
    T = np.array([stereo.poses[name] for name in names])
    return State.from_rig(stereo.rig, T, len(data.points), CELLS)


def bent(state: State, rng: np.random.Generator) -> State:
    """A state away from where everything is flat."""
    at = state.layout
    step = np.zeros(at.size)
    step[at.height : at.offsets] = rng.normal(0, 0.05, at.offsets - at.height)
    step[at.offsets : at.rig] = rng.normal(0, 0.02, at.rig - at.offsets)
    step[at.camera_field :] = rng.normal(0, 0.3, at.size - at.camera_field)
    return state.step(step)


@pytest.mark.slow
@pytest.mark.computes
def test_every_derivative_agrees_with_differences(seen, stereo) -> None:
    rng = np.random.default_rng(0)
    few = [type(o)(**{**vars(o), "samples": _every(o.samples, 30)}) for o in seen[:3]]
    names, data, _ = gather_data(few, stereo)
    state = bent(flat_state(stereo, names, data), rng)
    at = state.layout
    residuals = tuple(rng.normal(size=p.shape) for p in predict_observations(state, data))
    weights = tuple(rng.random(r.shape) for r in residuals)
    A, b = normal_equations(state, data, residuals, weights)
    A = np.triu(A) + np.triu(A, 1).T
    W, r = (np.concatenate([v.ravel() for v in pair]) for pair in (weights, residuals))
    size = np.full(at.size, 1e-4)
    size[: at.height].reshape(-1, 6)[:, :3] = 1e-6
    size[at.rig + 4 : at.rig + 9] = size[at.rig + 13 : at.rig + 18] = 1e-5
    size[at.rig + 18 : at.rig + 21] = 1e-6
    fields = rng.choice(np.arange(at.camera_field, at.size), 60, replace=False)
    chosen = np.concatenate(
        [np.arange(at.offsets + 6), np.arange(at.rig, at.camera_field), np.sort(fields)]
    )

    def change(k: int) -> np.ndarray:
        step = np.zeros(at.size)
        step[k] = size[k]
        ahead, behind = (
            np.concatenate([p.ravel() for p in predict_observations(state.step(s), data)])
            for s in (step, -step)
        )
        return (ahead - behind) / (2 * size[k])

    J = np.array([change(k) for k in chosen])
    scale = np.sqrt(np.sum(W * J**2, axis=1)) + 1e-3
    assert np.abs(J @ (W * r) - b[chosen]).max() < 1e-5 * scale.max()
    assert (
        np.abs(((J * W) @ J.T - A[np.ix_(chosen, chosen)]) / (scale[:, None] * scale)).max() < 1e-5
    )


@pytest.mark.computes
@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_a_factor_by_blocks_solves_the_normal_equations(seen, stereo, damping: float) -> None:
    rng = np.random.default_rng(5)
    names, data, _ = gather_data(seen[:4], stereo)
    state = bent(flat_state(stereo, names, data), rng)
    residuals = tuple(rng.normal(size=p.shape) for p in predict_observations(state, data))
    A, b = normal_equations(state, data, residuals, tuple(rng.random(r.shape) for r in residuals))
    replace(Prior.build(state, data.points), strengths=(10.0, 20.0)).add(A, b, state)
    before, at = A.copy(), state.layout
    others = rng.normal(size=(at.size, 2))
    factor = BlockFactor(A, at, damping)
    assert np.array_equal(A, before)
    A = np.triu(A) + np.triu(A, 1).T
    rig = np.arange(at.rig, at.camera_field)
    A[rig, rig] *= 1 + damping
    solution = np.column_stack([factor.solve(b), factor.solve(others)])
    scale = np.sqrt(np.diag(A))[:, None]
    residual = A @ solution - np.column_stack([b, others])
    assert (
        np.abs(residual / scale).max(axis=0) < 1e-9 * np.abs(scale * solution).max(axis=0)
    ).all()


def _every(samples, n):
    return type(samples)(
        *(np.ascontiguousarray(a[::n]) for a in (samples.camera, samples.projector, samples.sigma))
    )


def test_a_displacement_and_its_inverse(true) -> None:
    rng = np.random.default_rng(3)
    device = Device(np.zeros(10), rng.normal(0, 0.5, (2, 23, 29)), np.array([400.0, 300.0]))
    basis = np.zeros((4, 4))
    for u, v in rng.uniform([-3, -3], [403, 303], (50, 2)):
        x, y = remove_displacement(device, u, v, basis)
        du, dv, *_ = displacement(device, x, y, basis)
        assert abs(x + du - u) + abs(y + dv - v) < 1e-9
    assert np.isclose(basis[0].sum(), 1) and np.isclose(basis[1].sum(), 0)
    form = roughness(device.coefficients)
    constant = np.ones(len(form))
    assert (
        np.isclose(constant @ form @ constant, 0.05 * len(form)) and np.linalg.eigvalsh(form)[0] > 0
    )


@pytest.mark.slow
@pytest.mark.computes
def test_the_compiled_form_is_the_exact_one(model, true) -> None:
    state = model.rig
    camera, projector = pinhole_lens(state.camera), pinhole_lens(state.projector)
    basis = np.zeros((4, 4))
    rng = np.random.default_rng(0)
    height, width = model.rays.shape[1:]
    z = rng.uniform(430, 810, (height, width))
    points = np.dstack([model.rays[0] * z, model.rays[1] * z, z])
    pixels = projector.project(points @ state.R.T + state.t)
    coordinate = np.array(
        [displacement(state.projector, u, v, basis)[0] for u, v in pixels.reshape(-1, 2)]
    )
    coordinate = coordinate.reshape(height, width) + pixels[..., 0]
    inside = ((pixels > 0) & (pixels < np.array(projector.size) - 1)).all(-1)
    phase = phase_map(true, z)
    exact = (2 * np.pi * np.where(inside, coordinate, np.nan) / phase.period_px).astype(np.float32)
    found = model.points(type(phase)(**{**vars(phase), "phase": exact}), supported=False)
    error = (found[..., 2] - z)[inside]
    assert np.isfinite(error).all() and np.sqrt(np.mean(error**2)) < 0.002
    central = camera.undistort(np.array([width / 2, height / 2]))
    assert np.abs(model.rays[:, height // 2, width // 2] - central).max() < 1e-3


@pytest.mark.slow
@pytest.mark.computes
def test_depth_noise_follows_from_the_phase_noise(model, true) -> None:
    z = np.full(true.camera.size[::-1], 600.0)
    phase = phase_map(true, z)
    more = type(phase)(**{**vars(phase), "phase": phase.phase + np.float32(0.01)})
    slope = (model.points(more) - model.points(phase))[..., 2] / 0.01
    sigma = model.sigma_z(phase, model.points(phase))
    ratio = sigma / phase.sigma_phase / np.abs(slope)
    assert np.nanmin(ratio) > 0.97 and np.nanmax(ratio) < 1.03


def column(state: State, pixel: np.ndarray, depth: float) -> float:
    """The projector column of what a camera pixel sees at a depth."""
    basis = np.zeros((4, 4))
    ray = np.array([*undistort_pixel(state.rig.camera, *pixel, basis), 1.0])
    X = state.rig.R @ (ray * depth) + state.rig.t
    return float(distort_to_pixel(state.rig.projector, X[0] / X[2], X[1] / X[2], basis)[0])


def exact_point(state: State, pixel: np.ndarray, coordinate: float, guess: float) -> np.ndarray:
    """(3,) mm: what a pixel sees that the projector lights with a column; by secants through the
    forward model."""
    depth = guess
    for _ in range(20):
        slope = (column(state, pixel, depth + 0.1) - column(state, pixel, depth - 0.1)) / 0.2
        depth -= (column(state, pixel, depth) - coordinate) / slope
    return np.array([*undistort_pixel(state.rig.camera, *pixel, np.zeros((4, 4))), 1.0]) * depth


@pytest.mark.slow
@pytest.mark.computes
def test_points_answer_to_the_unknowns_as_differences_say(model) -> None:
    bundle = model.bundle
    at = bundle.state.layout
    pixels, z = np.array([[120.0, 80.0], [250.3, 199.6]]), np.array([560.0, 660.0])
    J = bundle.point_jacobian("x", pixels, z).toarray()
    rng = np.random.default_rng(1)
    rig_step = rng.normal(size=at.size - at.rig) * np.concatenate(
        [
            np.tile([1e-3] * 4 + [1e-6] * 5, 2),
            [1e-7] * 3,
            [1e-5] * 3,
            np.full(at.size - at.camera_field, 1e-4),
        ]
    )
    step = np.concatenate([np.zeros(at.rig), rig_step])
    coordinate = [
        column(bundle.state, pixel, depth) for pixel, depth in zip(pixels, z, strict=True)
    ]
    ahead, behind = (
        np.array(
            [
                exact_point(bundle.state.step(s), *given)
                for given in zip(pixels, coordinate, z, strict=True)
            ]
        )
        for s in (step, -step)
    )
    assert np.allclose((ahead - behind).ravel() / 2, J @ rig_step, rtol=1e-4, atol=1e-9)


@pytest.mark.slow
@pytest.mark.computes
def test_the_covariance_predicts_true_errors_once_rigid_motion_is_removed(model, true) -> None:
    shape = true.camera.size[::-1]
    found, truth, pixels, depths = [], [], [], []
    for depth in (480.0, 600.0, 720.0):
        z = np.full(shape, depth)
        points = model.points(phase_map(true, z))
        v, u = np.nonzero(np.isfinite(points[..., 2]))
        chosen = np.random.default_rng(0).choice(len(v), 80, replace=False)
        pixels.append(np.stack([u, v], 1)[chosen].astype(float))
        depths.append(points[v, u, 2][chosen])
        found.append(points[v, u][chosen].astype(float))
        truth.append(surface(true, z)[v, u][chosen])
    P, T = np.concatenate(found), np.concatenate(truth)
    J = model.bundle.point_jacobian("x", np.concatenate(pixels), np.concatenate(depths)).toarray()
    centred = P - P.mean(0)
    motion = np.zeros((len(P), 3, 6))
    motion[:, :, :3] = np.eye(3)
    for k, axis in enumerate(np.eye(3)):
        motion[:, :, 3 + k] = np.cross(axis, centred)
    M = np.linalg.qr(motion.reshape(-1, 6))[0]
    spread = model.bundle.whiten(J - M @ (M.T @ J))
    predicted_rms = np.sqrt(np.mean(np.sum(spread**2, axis=0)))
    actual_rms = np.sqrt(np.mean(aligned_error(P, T) ** 2))
    assert 0.5 < predicted_rms / actual_rms < 2.0


@pytest.mark.slow
@pytest.mark.computes
def test_a_held_lens_stays_and_its_error_is_found(seen, stereo, model, true) -> None:
    # the best lens without local distortion
    lens = fit_splined(model)[0].lens
    fx, fy, *rest = lens.parameters[:9]
    changes = []
    for factor in (1.0, 1.005):
        held = Lens.from_parameters((factor * fx, factor * fy, *rest), lens.size)
        known = KnownCamera(held, "lens.yaml", True, 0.001 * fx)
        start = calibrate_stereo(seen, true.projector.size, str(BOARD), camera=known)
        bundle = adjust_bundle(seen, start, cells_across=CELLS)
        assert np.array_equal(bundle.state.rig.camera.numbers[:9], held.parameters[:9])
        fitted = fit_splined(SplinedModel(bundle))[0].lens  # its field does not change it either
        assert fitted.K[0, 0] == pytest.approx(factor * fx, rel=5e-4)
        again = SplinedModel.from_arrays(
            SplinedModel(bundle).to_dict(), SplinedModel(bundle).to_arrays()
        )
        assert again.bundle.camera == bundle.camera and bundle.camera is not None
        changes.append(bundle.camera)
        sigma = summarise_volume_sigma(bundle).median
        assert sigma > 1.5 * summarise_volume_sigma(model.bundle).median
    assert abs(changes[0].change) < 1e-3 and changes[0].sigma < 5e-4
    assert changes[1].change - changes[0].change == pytest.approx(-0.005, abs=1e-3)
    assert changes[1].is_significant and changes[1].uncertainty > 0.003
