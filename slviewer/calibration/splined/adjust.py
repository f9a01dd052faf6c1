"""Robust bundle adjustment of devices, board and poses by Gauss-Newton, with weights and priors
estimated from data."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from slviewer.calibration.observe import Observation, combine_observed
from slviewer.calibration.splined.bundle import Bundle, PoseFit
from slviewer.calibration.splined.half_turns import (
    detect_half_turns,
    is_numbering_ambiguous,
    match_features,
    renumber_poses,
)
from slviewer.calibration.splined.held_camera import HeldCamera, HeldLens
from slviewer.calibration.splined.normal import (
    BlockFactor,
    ObservedValues,
    Prior,
    factorize,
    normal_equations,
    predict_observations,
)
from slviewer.calibration.splined.residual_noise import (
    Noise,
    estimate_noise,
    pose_sigmas,
    pose_trust,
    robust_weights,
)
from slviewer.calibration.splined.residuals import PoseData
from slviewer.calibration.splined.unknowns import CELLS_ACROSS, State, board_frame, long_side
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected, InputError
from slviewer.fringe.image_area import ImageArea
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import shared_rms

MIN_POSES = 3
MAX_STEPS = 30
LEAST_DAMPING, DAMPING_STEP, MOST_DAMPING = 1e-6, 10.0, 10.0
"""Damping relative to the information's diagonal: smallest value, factor between trials, and
limit."""
CONVERGENCE_SIGMAS = 0.02
"""Largest RMS change of the predicted observations that is left at convergence, in sigmas."""
NEAR_SIGMAS = 0.3
"""Largest step near the solution, where the priors' strengths are updated."""
STRENGTH_STEPS = 2
"""Number of updates of the priors' strengths; a third changes them by 6 %, and the state by 0.02 of
its sigma."""
MIN_SAMPLES = 3
"""Least number of samples with which a pose has illuminated a cell of a field."""
MOST_CELLS_FACTOR = 2.0
"""Of the camera's cells across the image where only a part of it changes."""
MIN_TRUST = 0.5
"""Least mean robust weight of a pose's features and samples; below, the pose contradicts the
others."""


def gather_data(
    observations: Sequence[Observation], stereo: StereoModel
) -> tuple[list[str], PoseData, Floats]:
    """Collect the observations of the poses that the stereo calibration used and that hold both
    axes.

    Returns their names, the observations, and the samples' predicted noise (m, 2) px. Raises
    InputError for fewer than MIN_POSES poses with both axes, and for observations without samples.
    """
    both = [o for o in observations if o.name in stereo.poses and len(o.surfaces) == 2]
    if len(both) < MIN_POSES:
        single = sorted({axis for o in observations if len(o.surfaces) < 2 for axis in o.surfaces})
        alone = f"; others hold axis {' or '.join(single)} alone" if single else ""
        raise InputError(
            f"{len(both)} target poses hold both projector coordinates{alone}",
            f"splined compares both, so capture at least {MIN_POSES} poses with the patterns of x"
            " and of y",
        )
    samples = [o.samples for o in both if o.samples is not None]
    if len(samples) < len(both):
        raise InputError(
            "these target poses were read without samples of their phase",
            "calibrate from the frames again",
        )
    boards, pixels = [o.points for o in both], [s.camera for s in samples]
    every = np.concatenate(boards)
    points, feature = np.unique(np.round(every, 6), axis=0, return_inverse=True)
    data = PoseData(
        np.cumsum([0, *map(len, boards)]),
        feature.ravel().astype(np.int64),
        np.ascontiguousarray(np.concatenate([o.camera for o in both])),
        np.cumsum([0, *map(len, pixels)]),
        np.concatenate(pixels),
        np.concatenate([s.projector for s in samples]),
        points,
        board_frame(points),
    )
    return [o.name for o in both], data, np.concatenate([s.sigma for s in samples])


def adjust_bundle(
    observations: Sequence[Observation],
    stereo: StereoModel,
    progress: Callable[[float], None] | None = None,
    *,
    cells_across: int | None = None,
    beside: Bundle | None = None,
) -> Bundle:
    """Adjust devices, board and poses jointly, from the observations that the stereo calibration
    used.

    ``cells_across``: cells of each displacement field across its image, the camera's across the
    part of it that changes; by default ``unknowns.CELLS_ACROSS``. ``beside``: an adjustment of the
    same camera, board and poses with another device, which are held: the projector alone is
    adjusted. Raises InputError as ``gather_data`` does, and CalibrationRejected where the
    adjustment does not converge, is undetermined, or where too few poses agree with each other.
    """
    names, data, sample_sigma = gather_data(observations, stereo)
    T = np.array([stereo.poses[name] for name in names])
    area = combine_observed(observations)
    camera_cells = _count_camera_cells(stereo.rig.camera, area, cells_across, beside)
    state = State.from_rig(stereo.rig, T, len(data.points), cells_across, camera_cells)
    layout = state.layout
    state, held, prior = _hold(state, data, stereo, beside, names)
    is_excluded = np.zeros(len(names), bool)
    marked = [o.name for o in observations if o.marked]
    certain = np.isin(names, marked) | (not is_numbering_ambiguous(stereo.board))
    half_turned = np.zeros(len(names), bool)
    updates, count, damping, moved = 0, 0, 0.0, 0.0
    # more threads gain a tenth, and take many times as long where other work uses the cores
    with threadpool_limits(1, user_api="blas"):
        residuals = _residuals(state, data)
        for step in range(1, MAX_STEPS + 1):
            if step == 3:  # before such poses seem to contradict the others
                half_turned = detect_half_turns(state, data, residuals[0], certain)
                state, data = renumber_poses(state, data, half_turned)
                residuals = _residuals(state, data)
            noise = estimate_noise(*residuals, sample_sigma)
            sigmas = _sigmas(residuals, noise, sample_sigma, data)
            weights = robust_weights(*residuals, sigmas)
            if step > 2:
                is_excluded |= (pose_trust(weights, sigmas, data) < MIN_TRUST).any(axis=1)
            for w, pose in zip(weights, data.poses, strict=True):
                w[is_excluded[pose]] = 0.0
            A, b = normal_equations(state, data, residuals, weights)
            prior.add(A, b, state)
            held.take(A, b)
            factor = BlockFactor(A, layout)
            count = int(sum(np.count_nonzero(w) for w in weights))
            system = A, b, factor.solve(b)
            taken = _take_step(state, residuals, data, weights, prior, system, damping)
            state, residuals, damping = taken.state, taken.residuals, taken.damping
            before, moved = moved, float(np.sqrt(max(float(taken.move @ b), 0.0) / count))
            if progress:
                progress(step / (step + 3))
            if moved < NEAR_SIGMAS and updates < STRENGTH_STEPS:
                prior = prior.update_strengths(state, factor.solve)
                updates += 1
            elif _remaining(before, moved) < CONVERGENCE_SIGMAS:
                break
        else:
            raise CalibrationRejected(
                f"the joint adjustment still moves by {moved:.2f} sigma after {MAX_STEPS} steps",
                "check the stereo calibration's residuals, exclude poses that stand out, and add"
                " some that reach into the corners",
            )
        if np.count_nonzero(~is_excluded) < MIN_POSES:
            raise CalibrationRejected(
                f"{np.count_nonzero(is_excluded)} of {len(names)} poses contradict the others",
                "capture the board again without moving it",
            )
        fits = _fit_statistics(
            names, residuals, _sigmas(residuals, noise, sample_sigma, data), data
        )
        camera_poses, projector_poses = _count_poses(state, weights[1], data, area)
        check = held.release(A, b, factor)  # A has what was held again
        rig_factor = factorize(A)[layout.rig :, layout.rig :]
        return Bundle(
            state=state,
            poses=tuple(names),
            points=data.points,
            noise=noise,
            strengths=prior.strengths,
            fits=fits,
            excluded={
                name: _explain_exclusion(fits[name])
                for name in np.array(names)[is_excluded].tolist()
            },
            depth_range_mm=_depth_range(state, data, is_excluded),
            camera_poses=camera_poses,
            projector_poses=projector_poses,
            packed_factor=rig_factor[np.tri(len(rig_factor), dtype=bool)].astype(np.float32),
            steps=step,
            half_turned_poses=tuple(np.array(names)[half_turned].tolist()),
            camera=check,
            area=area,
        )


def _explain_exclusion(fit: PoseFit) -> str:
    """Return why a pose was excluded."""
    return (
        f"contradicts the other poses (trust {fit.camera_trust:.2f} in the camera,"
        f" {fit.projector_trust:.2f} in the projector): was the board moved during the capture?"
    )


def _depth_range(state: State, data: PoseData, is_excluded: Mask) -> tuple[float, float]:
    """Return the least and the largest depth in mm of the features of the poses that are not
    excluded, (p,) bool."""
    pose, _ = data.poses
    z = np.einsum("ni,ni->n", state.R_board[pose, 2], data.points[data.feature])
    z = (z + state.t_board[pose, 2])[~is_excluded[pose]]
    return float(z.min()), float(z.max())


def _count_camera_cells(
    lens: Lens, area: ImageArea | None, cells_across: int | None, beside: Bundle | None
) -> int:
    """Return the number of cells along the longer side of the camera's image, as long as
    ``cells_across`` along its ``area`` are; those of the adjustment ``beside``, if there is one."""
    side = long_side(lens)
    if beside is not None:
        return beside.state.rig.camera.coefficients.shape[2 - side] - 3
    across = CELLS_ACROSS if cells_across is None else cells_across
    if area is None:
        return across
    first, last = area.bounds[side], area.bounds[2 + side]
    return round(across * min(area.size[side] / (last - first), MOST_CELLS_FACTOR))


def _hold(
    state: State,
    data: PoseData,
    stereo: StereoModel,
    beside: Bundle | None,
    names: Sequence[str],
) -> tuple[State, HeldLens | HeldCamera, Prior]:
    """Return the initial state, what is held of it, and the prior: with the camera, the board and
    the named poses of the adjustment ``beside``, if there is one."""
    if beside is None:
        held = HeldLens(stereo.known_camera, state.rig.camera, data.sample_px, state.layout.rig)
        return state, held, Prior.build(state, data.points, held.gauge)
    poses = [beside.poses.index(name) for name in names]
    feature, _ = match_features(data.points, beside.points)
    own = beside.state
    state = State(
        state.rig._replace(camera=own.rig.camera),
        own.R_board[poses],
        own.t_board[poses],
        own.heights,
        own.offsets[feature],
    )
    prior = Prior.build(state, data.points, None, beside.strengths[0])
    return state, HeldCamera(state.layout), prior


def _residuals(state: State, data: PoseData) -> ObservedValues:
    """Return the residuals of features (n, 2) and of samples (m, 2), px."""
    features, samples = predict_observations(state, data)
    return data.feature_px - features, data.projector_px - samples


@dataclass(frozen=True, eq=False)
class _Step:
    """The state after a step, its residuals, the step, and the damping with which it was taken."""

    state: State
    residuals: ObservedValues
    move: Floats
    damping: float


def _take_step(
    state: State,
    residuals: ObservedValues,
    data: PoseData,
    weights: ObservedValues,
    prior: Prior,
    system: tuple[Floats, Floats, Floats],
    damping: float,
) -> _Step:
    """Take a Gauss-Newton step; damp it where it does not lower the cost.

    ``system``: information matrix, right-hand side, and full step. Only lenses and relative pose
    are damped: together with the fields they have a curved valley of the cost at strong distortion.
    The state is unchanged where no damping helps.
    """
    A, b, full = system
    most = _cost(residuals, weights) + prior.cost(state)
    damping = damping / DAMPING_STEP if damping > LEAST_DAMPING else 0.0
    while damping < MOST_DAMPING:
        move = BlockFactor(A, state.layout, damping).solve(b) if damping else full
        after = state.step(move)
        new = _residuals(after, data)
        if _cost(new, weights) + prior.cost(after) <= most * (1 + 1e-9):  # False for NaN
            return _Step(after, new, move, damping)
        damping = max(DAMPING_STEP * damping, LEAST_DAMPING)
    return _Step(state, residuals, full, damping)


def _cost(residuals: ObservedValues, weights: ObservedValues) -> float:
    """Return half the weighted sum of squares; NaN where a step left the view."""
    total = 0.0
    for r, w in zip(residuals, weights, strict=True):
        used = w > 0
        total += float(np.sum(w[used] * r[used] ** 2))
    return 0.5 * total


def _remaining(before: float, moved: float) -> float:
    """Return the sum of the steps that follow one that ``moved``, each smaller by the ratio of that
    to the step ``before``; ``moved`` where they do not shrink by half or are still large."""
    return moved**2 / (before - moved) if moved < min(0.5 * before, NEAR_SIGMAS) else moved


def _sigmas(
    residuals: ObservedValues, noise: Noise, sample_sigma: Floats, data: PoseData
) -> ObservedValues:
    """Return the standard deviations of features (n, 2) and samples (m, 2), px."""
    return pose_sigmas(residuals[0], data.feature_from, noise), noise.sigmas(sample_sigma)


def _fit_statistics(
    names: Sequence[str], residuals: ObservedValues, sigmas: ObservedValues, data: PoseData
) -> dict[str, PoseFit]:
    """Compute the residuals' RMS and pattern and the trust of each pose, excluded ones included."""
    fresh = robust_weights(*residuals, sigmas)
    squares, used = (
        data.means(*(values.sum(axis=1) for values in pair))
        for pair in (
            [np.where(w > 0, r**2, 0.0) for r, w in zip(residuals, fresh, strict=True)],
            [0.5 * (w > 0) for w in fresh],
        )
    )
    rms = np.sqrt(np.where(squares > 0, squares, np.nan) / np.maximum(used, 1e-9))
    patterns = [
        [shared_rms(part) for part in np.split(np.where(w > 0, r, np.nan), start[1:-1])]
        for r, w, start in zip(residuals, fresh, (data.feature_from, data.sample_from), strict=True)
    ]
    figures = np.hstack([rms, pose_trust(fresh, sigmas, data), np.transpose(patterns)])
    return {name: PoseFit(*row) for name, row in zip(names, figures.tolist(), strict=True)}


def pose_residuals(
    bundle: Bundle, observation: Observation
) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]] | None:
    """Return the camera's pixels (n, 2) of a pose's features with their residuals (n, 2) px, and
    the projector's (m, 2) of its samples with theirs; NaN where they are outliers.

    None for a pose that the adjustment lacks.
    """
    samples = observation.samples
    if observation.name not in bundle.poses or samples is None:
        return None
    i = bundle.poses.index(observation.name)
    points = bundle.numbered_points(observation.name, observation.points)
    feature, known = match_features(points, bundle.points)
    data = PoseData(
        np.array([0, np.count_nonzero(known)]),
        feature[known],
        np.ascontiguousarray(observation.camera[known]),
        np.array([0, len(samples.camera)]),
        samples.camera,
        samples.projector,
        bundle.points,
        board_frame(bundle.points),
    )
    state = bundle.state
    pose = state._replace(R_board=state.R_board[i : i + 1], t_board=state.t_board[i : i + 1])
    residuals = _residuals(pose, data)
    weights = robust_weights(*residuals, _sigmas(residuals, bundle.noise, samples.sigma, data))
    camera, projector = (
        np.where(w > 0, r, np.nan) for r, w in zip(residuals, weights, strict=True)
    )
    return (data.feature_px, camera), (data.projector_px, projector)


def _count_poses(
    state: State, sample_weights: Floats, data: PoseData, area: ImageArea | None
) -> tuple[np.ndarray, np.ndarray]:
    """Count the poses that illuminated each cell (rows, columns) uint16 of the camera's and the
    projector's field. ``area``: the part of the camera's image that changes."""
    used, count = (sample_weights > 0).all(axis=1), state.layout.poses
    pose = data.poses[1][used]
    counts = []
    for device, pixels in zip(state.rig[:2], (data.sample_px, data.projector_px), strict=True):
        rows, columns = (n - 3 for n in device.coefficients.shape[1:])
        u, v = pixels[used].T
        extent = [(-0.5, n - 0.5) for n in (count, *device.size[::-1])]
        samples, _ = np.histogramdd((pose, v, u), bins=(count, rows, columns), range=extent)
        counts.append((samples >= MIN_SAMPLES).sum(axis=0, dtype=np.uint16))
    camera, projector = counts
    return area.fill_outside(camera) if area else camera, projector
