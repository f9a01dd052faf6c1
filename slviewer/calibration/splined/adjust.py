"""The joint adjustment: Gauss-Newton from a stereo calibration, robust, with weights and priors that the data set."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from scipy.linalg import cho_solve, lapack

from slviewer.calibration.observe import Observation
from slviewer.calibration.splined.board_shape import board_frame
from slviewer.calibration.splined.bundle import Bundle, PoseFit
from slviewer.calibration.splined.half_turns import detect_half_turns, is_numbering_ambiguous, renumber_poses
from slviewer.calibration.splined.normal import PoseData, normal_equations, predict_observations
from slviewer.calibration.splined.prior import Prior
from slviewer.calibration.splined.residual_noise import Noise, estimate_noise, pose_sigmas, pose_trust, robust_weights
from slviewer.calibration.splined.unknowns import State
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected, InputError

MIN_POSES = 3
MAX_STEPS = 30
LEAST_DAMPING, DAMPING_STEP, MOST_DAMPING = 1e-6, 10.0, 10.0
"""Of the information's diagonal: what is added to it where full steps fail."""
CONVERGENCE_SIGMAS = 0.02
"""Sigmas that the predictions of all observations still move by, RMS: a fiftieth of their noise."""
FIRST_STRENGTH = 10.0
"""1/px^2: displacements of some tenths of a pixel."""
STRENGTH_STEPS = 3
"""Updates of the priors: near their fixed point after two, and inside the support the result hardly depends on them."""
MIN_SAMPLES = 3
"""Of one pose in a cell of a field, and the pose has illuminated it."""
MIN_TRUST = 0.5
"""Of a pose's features or samples: below, the pose contradicts the others."""


def gather_data(observations: Sequence[Observation], stereo: StereoModel) -> tuple[list[str], PoseData, np.ndarray]:
    """Names of the poses, what they observed, and the samples' predicted noise (m, 2) px.

    Raises InputError where poses lack an axis or were read before samples were kept.
    """
    used = [o for o in observations if o.name in stereo.poses]
    both = [o for o in used if len(o.surfaces) == 2]
    if len(both) < MIN_POSES:
        single = sorted({axis for o in observations for axis in o.surfaces}) if len(both) < len(observations) else []
        alone = f"; others hold axis {' or '.join(single)} alone" if single else ""
        raise InputError(
            f"{len(both)} target poses hold both projector coordinates{alone}: splined compares both, so capture at "
            f"least {MIN_POSES} poses with the patterns of x and of y"
        )
    if any(o.samples is None for o in both):
        raise InputError("these target poses were read without samples of their phase: calibrate from the frames again")
    every = np.concatenate([o.points for o in both])
    points, feature = np.unique(np.round(every, 6), axis=0, return_inverse=True)
    samples = [o.samples for o in both if o.samples is not None]

    def starts(lengths: list[int]) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)

    data = PoseData(
        starts([len(o.points) for o in both]),
        feature.ravel().astype(np.int64),
        np.ascontiguousarray(np.concatenate([o.camera for o in both])),
        starts([len(s.camera) for s in samples]),
        np.concatenate([s.camera for s in samples]),
        np.concatenate([s.projector for s in samples]),
        points,
        board_frame(points),
    )
    return [o.name for o in both], data, np.concatenate([s.sigma for s in samples])


def adjust_bundle(
    observations: Sequence[Observation], stereo: StereoModel, progress: Callable[[float], None] | None = None
) -> Bundle:
    """The joint adjustment of all poses that the stereo calibration used.

    Raises InputError as ``gather_data`` does, and CalibrationRejected where it does not converge or poses contradict
    each other.
    """
    names, data, sample_sigma = gather_data(observations, stereo)
    state = State.from_stereo(stereo, names, len(data.points))
    layout = state.layout
    prior = Prior.build(state, data)
    strengths = [FIRST_STRENGTH, FIRST_STRENGTH]
    aside = np.zeros(len(names), bool)
    marked = {o.name for o in observations if o.marked}
    certain = np.array([name in marked or not is_numbering_ambiguous(stereo.board) for name in names])
    turned = np.zeros(len(names), bool)
    updates, count, damping = 0, 0, 0.0
    residuals = _residuals(state, data)
    for step in range(1, MAX_STEPS + 1):
        if step == 3:  # before such poses seem to contradict the others
            turned = detect_half_turns(state, data, residuals[0], certain)
            state, data = renumber_poses(state, data, turned)
            residuals = _residuals(state, data)
        noise = estimate_noise(*residuals, sample_sigma)
        sigmas = _sigmas(residuals, noise, sample_sigma, data)
        weights = robust_weights(*residuals, sigmas)
        if step > 2:
            aside |= (pose_trust(weights, sigmas, data) < MIN_TRUST).any(axis=1)
        _zero_weights(weights, aside, data)
        A, b = normal_equations(state, data, residuals, weights)
        prior.add(A, b, state, strengths)
        undamped = A.copy()
        factor = _cholesky(A)
        count = int(sum(np.count_nonzero(w) for w in weights))
        cost = partial(_cost, weights=weights, prior=prior, strengths=strengths)
        system = undamped, b, _inverse(factor)(b)
        state, residuals, move, damping = _take_step(state, residuals, data, cost, system, damping)
        moved = float(np.sqrt(max(move @ b, 0.0) / count))
        if progress:
            progress(step / (step + 3))
        if moved < 0.3 and updates < STRENGTH_STEPS:
            strengths = prior.update_strengths(strengths, state, _inverse(factor))
            updates += 1
        elif moved < CONVERGENCE_SIGMAS:
            break
    else:
        raise CalibrationRejected(
            f"the joint adjustment still moves by {moved:.2f} sigma after {MAX_STEPS} steps: check the stereo "
            "calibration's residuals, exclude poses that stand out, and add some that reach into the corners"
        )
    if np.count_nonzero(~aside) < MIN_POSES:
        raise CalibrationRejected(
            f"{np.count_nonzero(aside)} of {len(names)} poses contradict the others: capture the board anew, at rest"
        )
    fits = _fit_statistics(names, residuals, _sigmas(residuals, noise, sample_sigma, data), data)
    excluded = {
        name: f"contradicts the other poses (trust {fits[name].camera_trust:.2f} in the camera, "
        f"{fits[name].projector_trust:.2f} in the projector): was the board moved during the capture?"
        for name, out in zip(names, aside, strict=True)
        if out
    }
    camera_poses, projector_poses = _count_poses(state, weights, data)
    return Bundle(
        state=state,
        poses=tuple(names),
        points=data.points,
        noise=noise,
        strengths=(strengths[0], strengths[1]),
        fits=fits,
        excluded=excluded,
        depth_range_mm=_depth_range(state, data, aside),
        camera_poses=camera_poses,
        projector_poses=projector_poses,
        packed_factor=_pack_factor(factor[layout.rig :, layout.rig :]),
        steps=step,
        turned=tuple(name for name, over in zip(names, turned, strict=True) if over),
    )


def _residuals(state: State, data: PoseData) -> tuple[np.ndarray, np.ndarray]:
    features, samples = predict_observations(state, data)
    return data.feature_px - features, data.projector_px - samples


def _cost(
    state: State,
    residuals: tuple[np.ndarray, np.ndarray],
    weights: tuple[np.ndarray, np.ndarray],
    prior: Prior,
    strengths: Sequence[float],
) -> float:
    total = 0.0
    for r, w in zip(residuals, weights, strict=True):
        used = w > 0
        total += float(np.sum(w[used] * r[used] ** 2))  # NaN where a step left the view
    return 0.5 * total + prior.cost(state, strengths)


def _take_step(
    state: State,
    residuals: tuple[np.ndarray, np.ndarray],
    data: PoseData,
    cost: Callable[[State, tuple[np.ndarray, np.ndarray]], float],
    system: tuple[np.ndarray, np.ndarray, np.ndarray],
    damping: float,
) -> tuple[State, tuple[np.ndarray, np.ndarray], np.ndarray, float]:
    """The state after the step, its residuals, the step, and how damped it was. ``system``: information, right side,
    the full step.

    Where a full step makes matters worse, devices and arrangement are held back: together with the fields they have a
    valley that bends where lenses bend a lot, and full steps leave it.
    """
    information, b, full = system
    layout, before = state.layout, cost(state, residuals)
    rig = np.arange(layout.rig, layout.camera_field)
    damping = damping / DAMPING_STEP if damping > LEAST_DAMPING else 0.0
    while damping < MOST_DAMPING:
        move = full
        if damping:
            A = information.copy()
            A[rig, rig] *= 1 + damping
            move = _inverse(_cholesky(A))(b)
        after = state.step(move)
        new = _residuals(after, data)
        if cost(after, new) <= before * (1 + 1e-9):  # False for NaN
            return after, new, move, damping
        damping = max(DAMPING_STEP * damping, LEAST_DAMPING)
    return state, residuals, full, damping


def _cholesky(A: np.ndarray) -> np.ndarray:
    """The lower factor of the matrix whose upper triangle A (C order) holds; A is overwritten."""
    factor, failed = lapack.dpotrf(A.T, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise CalibrationRejected(
            "the poses leave the joint adjustment undetermined: capture the board in more positions and tilts"
        )
    return np.asarray(factor)


def _pack_factor(factor: np.ndarray) -> np.ndarray:
    return np.asarray(factor[np.tri(len(factor), dtype=bool)], np.float32)


def _inverse(factor: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """What the inverse of the matrix does to a vector or columns."""
    return lambda right: np.asarray(cho_solve((factor, True), right, check_finite=False))


def _sigmas(
    residuals: tuple[np.ndarray, np.ndarray], noise: Noise, sample_sigma: np.ndarray, data: PoseData
) -> tuple[np.ndarray, np.ndarray]:
    return pose_sigmas(residuals[0], data.feature_from, noise), noise.sigmas(sample_sigma)


def _zero_weights(weights: tuple[np.ndarray, np.ndarray], aside: np.ndarray, data: PoseData) -> None:
    for w, start in zip(weights, (data.feature_from, data.sample_from), strict=True):
        for i in np.nonzero(aside)[0]:
            w[start[i] : start[i + 1]] = 0.0


def _fit_statistics(
    names: Sequence[str],
    residuals: tuple[np.ndarray, np.ndarray],
    sigmas: tuple[np.ndarray, np.ndarray],
    data: PoseData,
) -> dict[str, PoseFit]:
    fresh = robust_weights(*residuals, sigmas)
    trust = pose_trust(fresh, sigmas, data)
    fits = {}
    for i, name in enumerate(names):
        rms = []
        for r, w, start in zip(residuals, fresh, (data.feature_from, data.sample_from), strict=True):
            part = slice(start[i], start[i + 1])
            good = np.where(w[part] > 0, r[part], np.nan)
            rms.append(float(np.sqrt(np.nanmean(np.nansum(good**2, axis=1)))) if (w[part] > 0).any() else np.nan)
        fits[name] = PoseFit(rms[0], rms[1], float(trust[i, 0]), float(trust[i, 1]))
    return fits


def _depth_range(state: State, data: PoseData, aside: np.ndarray) -> tuple[float, float]:
    """Nearest and farthest depth of a feature, mm."""
    pose = np.repeat(np.arange(len(aside)), np.diff(data.feature_from))
    z = np.einsum("ni,ni->n", state.R_board[pose, 2], data.points[data.feature]) + state.t_board[pose, 2]
    z = z[~aside[pose]]
    return float(z.min()), float(z.max())


def _count_poses(state: State, weights: tuple[np.ndarray, np.ndarray], data: PoseData) -> tuple[np.ndarray, np.ndarray]:
    """How many poses illuminated each cell of the camera's field and of the projector's, (rows, columns) uint16
    each."""
    counts = []
    for device, pixels in ((state.rig.camera, data.sample_px), (state.rig.projector, data.projector_px)):
        rows, columns = (n - 3 for n in device.coefficients.shape[1:])
        width, height = device.size
        total = np.zeros((rows, columns), np.uint16)
        for first, last in zip(data.sample_from[:-1], data.sample_from[1:], strict=True):
            seen = (weights[1][first:last] > 0).all(axis=1)
            u, v = pixels[first:last][seen].T
            extent = [[-0.5, height - 0.5], [-0.5, width - 0.5]]
            found, _, _ = np.histogram2d(v, u, bins=(rows, columns), range=extent)
            total += (found >= MIN_SAMPLES).astype(np.uint16)
        counts.append(total)
    return counts[0], counts[1]
