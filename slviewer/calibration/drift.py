"""Drift check: whether a saved calibration is still valid, from one capture of its board.

The check estimates the change of the projector's pose relative to the camera: a rotation about its
own centre, and a translation of that centre. Flatness would not show it: a rotation of 0.1 mrad
leaves flat boards flat, and distorts space by 700 ppm. Changes along the epipolar lines change the
board's apparent scale; changes across them move the pattern off its epipolar lines.

How precisely one view determines the projector's pose is known from the calibration's own poses.
Lens distortion beyond Brown's model is estimated from all of them together, as displacement fields.
Then each pose, with the fields of the others alone, gives an apparent motion of the projector. Its
true motion is zero: these apparent motions are the noise floor of every later check.

A view is a calibration pose or a later capture of the same board: its features in the camera, and
the projector's coordinates at a grid of the board's pixels. It is linearised in the board's pose,
the projector's pose and the lens errors: all unknowns are small (tenths of a pixel), so that one
linearisation at the calibration and at the board's pose by the camera is sufficient.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import cv2
import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.special import fdtrc, fdtri

from slviewer.calibration.board_pose import intersect_board, solve_pose
from slviewer.calibration.observe import AXES, Observation
from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis, Size
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats, Mask, move_points, rigid_transform
from slviewer.geometry.robust import robust_sigma, tukey_weights
from slviewer.geometry.splines import image_basis, second_differences
from slviewer.geometry.vectors import finite_rows, rms, unit_vectors
from slviewer.records.acceptance import Drift
from slviewer.records.record import to_vector

FALSE_ALARMS = 1e-4
"""False-alarm probability of one check; a check precedes every day's work."""
BOARD_PPM = 5.0
"""Thermal expansion of the board since the calibration: half a kelvin of steel."""
MAX_MISFIT_RATIO = 3.0
"""Largest RMS that no movement explains, over that of the calibration's worst pose."""
TURN_MRAD, SHIFT_SHARE = 0.05, 5.5e-5
"""Changes that must be detectable, a shift over the baseline: 10 um at 180 mm."""
_MOVES = (
    ("turn about its x axis (nod)", "rows", "y"),
    ("turn about its y axis (pan)", "columns", "x"),
    ("turn about its optical axis (roll)", "rows", "y"),
    ("shift along its x axis", "columns", "x"),
    ("shift along its y axis", "rows", "y"),
    ("shift along its optical axis", "rows and columns", "y"),
)
MIN_POSES = 8
"""With fewer poses, the fields estimated without one pose do not represent those of a later
view."""
ROUGHNESS_PX = 0.1
"""Prior sigma of the second differences of a field's coefficients."""
HEIGHT_PX = 1.0
"""Prior sigma of a field's coefficients."""
UNSUPPORTED_PX = 0.1
"""Largest sigma of the lens error at pixels that are used."""
RIG_SIGMAS = np.array([3e-3] * 3 + [0.017] * 3)
"""Prior sigma of the error of the calibration's own relative pose, rad and over the baseline."""
FACTOR_SPREAD = 0.5
"""Prior sigma of the logarithm of the factor by which a kind's errors are correlated."""
SAMPLES = 1000
"""Number of pixels of the board at which the projector's coordinates are compared."""
CELLS_PER_WIDTH = 16
"""Spline cells across an image of the lens errors beyond Brown's model."""
KINDS = ("camera", "x", "y")
"""Kinds of observations: features in the camera, projector columns, projector rows."""
STEPS = np.repeat([1e-4, 3e-4], 3)
"""Half steps of the numerical derivatives, rad and over the baseline: pixels move by about a
tenth."""


@dataclass(frozen=True, eq=False)
class DriftView:
    """``camera`` (n, 2) px of board ``points`` (n, 3) mm; ``pixels`` (m, 2) px of the board in the
    camera, and the ``projector`` coordinates (m, 2) px there, a column of NaN for an axis that was
    not captured."""

    name: str
    points: Floats
    camera: Floats
    pixels: Floats
    projector: Floats

    @classmethod
    def from_observation(cls, observation: Observation) -> "DriftView":
        """Sample an observation of the board. Raises InputError where its region is empty."""
        u0, v0, _, _ = observation.box
        v, u = np.nonzero(observation.region)
        if not len(v):
            raise InputError(
                f"{observation.name}: no pixel of the board carries a readable pattern",
                "illuminate the board",
            )
        step = max(1, int(np.sqrt(len(v) / SAMPLES)))
        on_grid = (u % step == 0) & (v % step == 0)
        pixels = np.stack([u[on_grid] + u0, v[on_grid] + v0], 1).astype(float)
        projector = np.full((len(pixels), 2), np.nan)
        for axis in observation.surfaces:
            projector[:, AXES.index(axis)] = observation.coordinate(axis, *pixels.T)
        return cls(observation.name, observation.points, observation.camera, pixels, projector)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes with known projector coordinates."""
        return tuple(axis for i, axis in enumerate(AXES) if np.isfinite(self.projector[:, i]).any())


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """A cubic B-spline displacement field over an image of ``size`` px: ``cells`` (across,
    down)."""

    size: Size

    @property
    def cells(self) -> tuple[int, int]:
        """Cells (across, down): square ones."""
        return CELLS_PER_WIDTH, max(1, round(CELLS_PER_WIDTH * self.size[1] / self.size[0]))

    @property
    def unknowns(self) -> int:
        """Number of coefficients of one of the two components."""
        return (self.cells[0] + 3) * (self.cells[1] + 3)

    def basis(self, pixels: Floats) -> sp.csr_array:
        """Return the spline basis (n, unknowns) at pixels (n, 2): displacement by coefficients."""
        size = np.array(self.size)
        inside = np.clip(pixels, -0.5, size - 0.5)
        return sp.csr_array(image_basis(inside, size, self.cells))

    @cached_property
    def roughness(self) -> sp.csr_array:
        """Quadratic form (unknowns, unknowns) of the squared second differences of one component's
        coefficients."""
        across, down = (n + 3 for n in self.cells)
        u = sp.kron(sp.eye(down), second_differences(across))
        v = sp.kron(second_differences(down), sp.eye(across))
        return sp.csr_array(u.T @ u + v.T @ v)


@dataclass(frozen=True, eq=False)
class LinearView:
    """A view's linear equations ``residuals = pose a + change b + shared c``, one row per observed
    coordinate (px).

    ``kinds`` (k,): index into KINDS of each row; ``usable`` (k,) bool: the rows that were measured.
    Derivatives: ``pose`` (k, 6) by the board's pose; ``change`` (k, 6) by the projector's rotation
    about its own centre and axes (rad) and its translation (mm); ``scale`` (k,) by the board's
    relative growth; ``shared`` (k, unknowns) by what all views share: the change again, as the
    calibration's own error, then the lens errors, u and v components of the camera's field, then of
    the projector's. ``across`` (k,): weight of each projector coordinate in the offset across the
    epipolar lines.
    """

    kinds: np.ndarray
    residuals: Floats
    usable: Mask
    pose: Floats
    change: Floats
    scale: Floats
    shared: sp.csr_array
    across: Floats


def linearise_view(rig: StereoRig, view: DriftView) -> LinearView:
    """Linearise a view at the board's pose by the camera alone.

    Raises InputError where that pose cannot be solved.
    """
    T = solve_pose(view.points, rig.camera.undistort(view.camera), np.eye(3), np.zeros(5))
    if T is None:
        raise InputError(
            f"{view.name}: no pose of the board fits its features", "is it the calibration's board?"
        )
    steps = np.r_[np.tile(STEPS * _units(rig), 2), 1e-4]  # of board pose, projector, scale
    derivatives = np.column_stack(
        [
            (_predict(rig, view, T, step) - _predict(rig, view, T, -step)) / (2 * step.sum())
            for step in np.diag(steps)
        ]
    )
    unchanged = np.zeros(len(steps))
    predicted = _predict(rig, view, T, unchanged)
    residuals = _flatten(view.camera, view.projector) - predicted
    usable = finite_rows(residuals[:, None], derivatives[:, 6:12])
    derivatives = np.nan_to_num(derivatives)
    pose, change, scale = derivatives[:, :6], derivatives[:, 6:12], derivatives[:, 12]
    n, m = len(view.camera), len(view.pixels)
    # how the sample in the projector (u, then v: rows) moves with the pixel in the camera (columns)
    moved = [
        (_predict(rig, view, T, unchanged, shift) - _predict(rig, view, T, unchanged, -shift)) / 0.2
        for shift in 0.1 * np.eye(2)
    ]
    J = np.nan_to_num(np.reshape([each[2 * n :] for each in moved], (2, 2, m)))
    camera, projector = DisplacementField(rig.camera.size), DisplacementField(rig.projector.size)
    on_features, at_pixels = camera.basis(view.camera), camera.basis(view.pixels)
    on_samples = projector.basis(np.nan_to_num(predicted[2 * n :].reshape(2, m).T))
    lens_errors = sp.block_array(
        [
            [*(sp.kron(on_features, unit[:, None]) for unit in np.eye(2)), None, None],
            [*(-sp.diags(each) @ at_pixels for each in J[:, 0]), on_samples, None],
            [*(-sp.diags(each) @ at_pixels for each in J[:, 1]), None, on_samples],
        ]
    )
    by_shift = (derivatives[2 * n :, 3:6] @ T[:3, 2]).reshape(2, m)  # along the board's normal
    towards = unit_vectors(by_shift.T)
    return LinearView(
        kinds=np.repeat([0, 1, 2], [2 * n, m, m]),
        residuals=np.where(usable, residuals, 0.0),
        usable=usable,
        pose=pose,
        change=change,
        scale=scale,
        shared=sp.csr_array(sp.hstack([sp.csr_array(change), lens_errors])),
        across=np.concatenate([np.zeros(2 * n), -towards[:, 1], towards[:, 0]]),
    )


def _predict(
    rig: StereoRig, view: DriftView, T: Floats, change: Floats, moved: Floats | float = 0.0
) -> Floats:
    """Predict what `_flatten` returns of a view, px, with the board at T_camera_board.

    ``change`` (13,): turn (rad) and shift (mm) of the board, the same of the projector about its
    own centre, and relative growth of the board. ``moved`` (2,) px: shift of the camera's pixels.
    """
    board = rigid_transform(cv2.Rodrigues(change[:3])[0] @ T[:3, :3], T[:3, 3] + change[3:6])
    on_board = intersect_board(board, rig.camera.undistort(view.pixels + moved))
    turn = cv2.Rodrigues(change[6:9])[0]
    in_projector = rig.to_projector(on_board) @ turn.T + change[9:12]
    middle = view.points.mean(0)
    points = middle + (view.points - middle) * (1 + change[12])
    features = rig.camera.project(move_points(board, points))
    return _flatten(features, rig.projector.project(in_projector))


def _flatten(camera: Floats, projector: Floats) -> Floats:
    """Flatten values of features (n, 2) and of samples (m, 2) in the order of KINDS, (2 n + 2
    m,)."""
    return np.concatenate([camera.ravel(), *projector.T])


@dataclass(frozen=True, eq=False)
class PoseChange:
    """Apparent change of the projector's pose in one view: ``change`` (6,) rad and mm, in the order
    of ``LinearView``.

    ``spreads`` (3, 6, 6): covariance of the change by kind of observation, for errors of 1 px;
    ``by_growth`` (6,): change per relative growth of the board. ``figures`` (3,): apparent relative
    growth of the board, mean offset in px across the epipolar lines, NaN with one axis, and RMS
    residual in px that no change explains.
    """

    change: Floats
    spreads: Floats
    by_growth: Floats
    figures: Floats


@dataclass(frozen=True, eq=False)
class DriftReference:
    """Reference of the drift check for one calibration.

    ``shared``: corrections of the relative pose and coefficients of the lens errors, with their
    ``covariance``; ``sigmas`` (3,) px: standard deviation of one observation by kind, remaining
    lens errors included. Of the calibration's own poses, one row each: ``names``, and apparent
    ``changes`` from the other poses' lens errors with ``spreads``, ``by_growth`` and ``figures`` as
    in `PoseChange`.
    """

    rig: StereoRig
    shared: Floats
    covariance: Floats
    sigmas: Floats
    names: np.ndarray
    changes: Floats
    spreads: Floats
    by_growth: Floats
    figures: Floats

    def estimate_change(self, view: DriftView) -> PoseChange:
        """Estimate the projector's apparent change in a later view."""
        equations = linearise_view(self.rig, view)
        known = equations.shared
        variance = np.asarray(known.multiply(known @ self.covariance).sum(axis=1)).ravel()
        supported = equations.usable & (variance < UNSUPPORTED_PX**2)
        return solve_change(replace(equations, usable=supported), self.shared, self.sigmas)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return named arrays for saving."""
        return {name: values for name, values in vars(self).items() if name != "rig"}

    @classmethod
    def from_arrays(cls, rig: StereoRig, arrays: Mapping[str, np.ndarray]) -> "DriftReference":
        """Return the reference that ``to_arrays`` saved, of a calibration with this rig."""
        return cls(rig, *(arrays[field.name] for field in fields(cls)[1:]))


def build_reference(rig: StereoRig, views: Sequence[DriftView]) -> DriftReference:
    """Estimate lens errors and noise floor from a calibration's own views.

    Raises InputError for fewer than MIN_POSES views.
    """
    if len(views) < MIN_POSES:
        raise InputError(
            f"the calibration has {len(views)} poses, and {MIN_POSES} are needed for a drift"
            " reference",
            "calibrate with more poses",
        )
    equations = [linearise_view(rig, view) for view in views]
    blocks = [sp.diags((RIG_SIGMAS * _units(rig)) ** -2)]
    for field in (DisplacementField(rig.camera.size), DisplacementField(rig.projector.size)):
        one = field.roughness / ROUGHNESS_PX**2 + sp.eye(field.unknowns) / HEIGHT_PX**2
        blocks += [one, one]
    prior = sp.block_diag(blocks).toarray()
    sigmas = np.full(len(KINDS), 0.05)
    weights = [_compute_weights(e, sigmas) for e in equations]
    for _ in range(3):
        parts = list(map(_reduce_normal_equations, equations, weights))
        normals, rights = zip(*parts, strict=True)
        total, right = sum(normals, prior), sum(rights)
        factor = cho_factor(total)
        shared = cho_solve(factor, right)
        # after the shared unknowns and the best board poses
        residuals = [e.residuals - e.shared @ shared for e in equations]
        residuals = [
            r - e.pose @ (_least_squares_gain(e.pose, w) @ r)
            for e, w, r in zip(equations, weights, residuals, strict=True)
        ]
        sigmas = _estimate_sigmas(equations, residuals, sigmas)
        weights = [
            _compute_weights(e, sigmas, r) for e, r in zip(equations, residuals, strict=True)
        ]
    others = [cho_solve(cho_factor(total - N), right - b) for N, b in parts]
    scatter = sigmas
    for _ in range(2):  # the weights depend on the sigmas, and the sigmas on the changes
        own = [solve_change(e, g, sigmas) for e, g in zip(equations, others, strict=True)]
        rows = _stack_changes(own)
        sigmas = _fit_sigmas(rows["change"], rows["spreads"], scatter)
    covariance = cho_solve(factor, np.eye(len(shared)))
    names = np.array([view.name for view in views])
    changes = rows.pop("change")
    return DriftReference(rig, shared, covariance, sigmas, names, changes, **rows)


def _stack_changes(changes: Sequence[PoseChange]) -> dict[str, Floats]:
    """Return each figure of several views' changes by its name, one row a view."""
    names = [each.name for each in fields(PoseChange)]
    return {name: np.array([getattr(each, name) for each in changes]) for name in names}


def solve_change(e: LinearView, shared: Floats, sigmas: Floats) -> PoseChange:
    """Estimate the projector's apparent change in one view by robust least squares, given the
    ``shared`` lens errors.

    ``sigmas`` (3,) px by kind.
    """
    residuals = np.where(e.usable, e.residuals, 0.0) - e.shared @ shared
    both = np.hstack([e.pose, e.change])
    w = _compute_weights(e, sigmas)
    for _ in range(5):
        solution = _least_squares_gain(both, w) @ residuals
        w = _compute_weights(e, sigmas, residuals - both @ solution)
    gain = _least_squares_gain(both, w)
    growth = _least_squares_gain(np.column_stack([e.pose, e.scale]), w)[6] @ residuals
    by_camera = _least_squares_gain(e.pose, np.where(e.kinds == 0, w, 0.0)) @ residuals
    across = e.across * (residuals - e.pose @ by_camera)
    samples = across[e.kinds == 1] + across[e.kinds == 2]
    has_both_axes = (w[e.kinds == 1] > 0) & (w[e.kinds == 2] > 0)
    unexplained = (residuals - both @ (gain @ residuals))[w > 0]
    offset = samples[has_both_axes].mean() if has_both_axes.any() else np.nan
    by_kind = [gain[6:, e.kinds == k] for k in range(len(KINDS))]
    return PoseChange(
        gain[6:] @ residuals,
        np.array([part @ part.T for part in by_kind]),
        gain[6:] @ e.scale,
        np.array([growth, offset, rms(unexplained)]),
    )


def _compute_weights(e: LinearView, sigmas: Floats, residuals: Floats | None = None) -> Floats:
    """Return the weights (k,) 1/px^2, times Tukey's where ``residuals`` (k,) are given; 0 where not
    usable."""
    w = e.usable / sigmas[e.kinds] ** 2
    if residuals is not None:
        for kind in range(len(KINDS)):
            these = e.usable & (e.kinds == kind)
            if these.any():
                spread = max(robust_sigma(residuals[these]), 1e-9)
                w[these] *= tukey_weights(residuals[these], spread)
    return w


def _least_squares_gain(J: Floats, w: Floats) -> Floats:
    """Return the matrix (unknowns, k) of weighted least squares from residuals to unknowns; 0 for
    undetermined ones."""
    weighted = w[:, None] * J
    N = weighted.T @ J
    s = 1 / np.sqrt(np.maximum(np.diag(N), 1e-300))[:, None]
    return s * (np.linalg.pinv(N * s * s.T, rcond=1e-13, hermitian=True) @ (s * weighted.T))


def _reduce_normal_equations(e: LinearView, w: Floats) -> tuple[Floats, Floats]:
    """Return the normal equations of the shared unknowns with the view's own board pose
    eliminated."""
    r = np.where(w > 0, e.residuals, 0.0)
    weighted = sp.csr_array(sp.diags(w) @ e.shared)
    cross = weighted.T @ e.pose
    inverse = np.linalg.inv(e.pose.T @ (e.pose * w[:, None]))
    N = (weighted.T @ e.shared).toarray() - cross @ inverse @ cross.T
    return N, weighted.T @ r - cross @ (inverse @ (e.pose.T @ (w * r)))


def _estimate_sigmas(
    equations: Sequence[LinearView], residuals: Sequence[Floats], before: Floats
) -> Floats:
    """Return the robust sigmas (3,) px of all residuals by kind; those ``before`` where a kind has
    none."""
    sigmas = before.copy()
    kinds = np.concatenate([e.kinds for e in equations])
    usable = np.concatenate([e.usable for e in equations])
    values = np.concatenate(residuals)
    for kind in np.unique(kinds[usable]):
        sigmas[kind] = max(robust_sigma(values[usable & (kinds == kind)]), 1e-3)
    return sigmas


def _fit_sigmas(changes: Floats, spreads: Floats, scatter: Floats) -> Floats:
    """Fit the sigmas (3,) px by kind to the apparent ``changes`` (views, 6) with ``spreads``
    (views, 3, 6, 6), whose true value is 0: the most probable ones.

    They exceed the ``scatter`` (3,) px of the residuals, as errors of neighbouring samples are
    correlated, by about the same factor in each kind: without this few views are explained best by
    one kind without any error.
    """
    least = np.log(scatter)

    def improbability(logs: Floats) -> float:
        """Return twice the negative log probability of the logarithms of the sigmas."""
        L = np.linalg.cholesky(np.tensordot(spreads, np.exp(2 * logs), (1, 0)))
        whitened = np.linalg.solve(L, changes[..., None])
        likelihood = 2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum() + (whitened**2).sum()
        return float(likelihood + 3 * np.var(logs - least) / FACTOR_SPREAD**2)

    options = {"xatol": 0.02, "fatol": 0.01}
    bounds = [(each, None) for each in least]
    result = minimize(
        improbability, least + np.log(4), method="Nelder-Mead", bounds=bounds, options=options
    )
    return np.exp(result.x)


def check_drift(reference: DriftReference, view: DriftView) -> Drift:
    """Check a calibration with one later view of its board.

    Raises InputError where no axis of the pattern could be read.
    """
    if not view.axes:
        raise InputError(
            f"{view.name}: no axis of the pattern could be read on the board",
            "illuminate the whole board",
        )
    estimate = reference.estimate_change(view)
    growth = BOARD_PPM * 1e-6
    C = np.tensordot(reference.sigmas**2, estimate.spreads, 1)
    C += growth**2 * np.outer(estimate.by_growth, estimate.by_growth)
    information = np.linalg.inv(C)
    squared_distance = float(estimate.change @ information @ estimate.change)
    # the floor is itself an estimate: three numbers a view, as the six share its lens errors, less
    # the sigmas and the calibration's own relative pose
    degrees = 3 * len(reference.changes) - 9
    chance = float(fdtrc(6, degrees, squared_distance / 6))
    limit = 6 * float(fdtri(6, degrees, 1 - FALSE_ALARMS))
    scale, offset, misfit = estimate.figures.tolist()
    scales, offsets, misfits = reference.figures.T
    scale_sigma = float(np.hypot(rms(scales), growth))
    across_px = across_sigma = None
    if np.isfinite(offset):
        across_px, across_sigma = offset, float(np.sqrt(np.nanmean(offsets**2)))
    along = np.concatenate([np.zeros(3), unit_vectors(reference.rig.t)])
    reasons = []
    if misfit > MAX_MISFIT_RATIO * misfits.max():
        reasons.append(
            f"residuals of {misfit:.3f} px RMS remain with any movement of the"
            f" projector (at most {misfits.max():.3f} px in the poses of the calibration): was a"
            " lens refocused, the board moved, or is it another one?"
        )
    elif squared_distance > limit:
        reasons.append(_list_movements(estimate, information, squared_distance, along))
        if abs(scale) > 3 * scale_sigma:
            reasons.append(
                f"the board seems {1e6 * scale:+.0f} ppm larger than it is (+-"
                f" {1e6 * scale_sigma:.0f})"
            )
        if across_px and across_sigma and abs(across_px) > 4 * across_sigma:
            reasons.append(
                f"the pattern is {across_px:+.4f} px off its epipolar lines (+- {across_sigma:.4f})"
            )
    sigmas = np.sqrt(np.diag(C))
    seen_alone = (np.sqrt(limit) + 1.645) / np.sqrt(np.diag(information))
    seen_alone[:3] *= 1e3
    return Drift(
        capture=view.name,
        axes=view.axes,
        verdict="recalibrate" if reasons else "still good",
        reasons=tuple(reasons),
        turn_mrad=to_vector(1e3 * estimate.change[:3]),
        turn_sigma_mrad=to_vector(1e3 * sigmas[:3]),
        shift_mm=to_vector(estimate.change[3:]),
        shift_sigma_mm=to_vector(sigmas[3:]),
        baseline_mm=float(along @ estimate.change),
        baseline_sigma_mm=float(np.sqrt(along @ C @ along)),
        scale_ppm=1e6 * scale,
        scale_sigma_ppm=1e6 * scale_sigma,
        across_px=across_px,
        across_sigma_px=across_sigma,
        misfit_px=misfit,
        chance=chance,
        seen_alone=tuple(seen_alone.tolist()),
        unseen=(
            *_list_undetermined(seen_alone, reference.rig.baseline_mm, view.axes),
            "common motion of both devices (harmless)",
        ),
    )


def _list_movements(
    estimate: PoseChange, information: np.ndarray, squared_distance: float, along: Floats
) -> str:
    """Describe the single movements that explain the change best, with their sizes.

    ``information`` (6, 6): inverse covariance of the change; ``squared_distance``: its Mahalanobis
    distance from 0, squared; ``along`` (6,): direction of a longer baseline.
    """
    moves = np.vstack([np.eye(6), along])  # (7, 6); a longer baseline is the last
    names = [*(name for name, _, _ in _MOVES), "change of the baseline"]
    curvature = np.einsum("ij,jk,ik->i", moves, information, moves)
    sizes, sigmas = moves @ information @ estimate.change / curvature, curvature**-0.5
    share = sizes**2 * curvature / squared_distance
    words = []
    for i in np.argsort(-share):
        if share[i] > 0.9 * share.max():
            form, unit = (".4f", "mrad") if i < 3 else (".1f", "um")
            words.append(
                f"a {names[i]} by {1e3 * sizes[i]:+{form}} +- {1e3 * sigmas[i]:{form}} {unit}"
            )
    return (
        f"the projector has moved, as by {' or '.join(words)} ({100 * share.max():.0f} % of the"
        " change)"
    )


def _units(rig: StereoRig) -> Floats:
    """Return the units (6,) of a pose's turns and shifts: 1 rad, and the baseline in mm."""
    return np.repeat([1.0, rig.baseline_mm], 3)


def _list_undetermined(seen_alone: Floats, baseline_mm: float, axes: Sequence[Axis]) -> list[str]:
    """Describe the movements whose detection limits (6,) mrad and mm are too large, with the reason
    and remedy."""
    undetermined = []
    for i, (move, lines, axis) in enumerate(_MOVES):
        if seen_alone[i] > (TURN_MRAD if i < 3 else SHIFT_SHARE * baseline_mm):
            size = f"{seen_alone[i]:.2f} mrad" if i < 3 else f"{1e3 * seen_alone[i]:.0f} um"
            why = (
                f"it moves the pattern's {lines}, and the capture holds axis {axes[0]} alone"
                if len(axes) == 1 and axis not in axes
                else (
                    "at this pose it moves the pattern by too little;"
                    f" {'capture both axes, or ' * (len(axes) < 2)}bring the board nearer and"
                    " tilt it"
                )
            )
            undetermined.append(f"a {move} of less than {size}: {why}")
    return undetermined
