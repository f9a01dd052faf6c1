"""Drift check: whether a saved calibration is still valid, from one capture of its board.

The check estimates the change of the projector's pose relative to the camera: a rotation about its
own centre, and a translation of that centre. Flatness would not show it: a rotation of 0.1 mrad
leaves flat boards flat, and distorts space by 700 ppm. Changes along the epipolar lines change the
board's apparent scale; changes across them move the pattern off its epipolar lines.

How precisely one view determines the projector's pose is known from the calibration's own poses.
Lens distortion beyond Brown's model is estimated from all of them together, as displacement fields.
Then each pose, with the fields of the others alone, gives an apparent motion of the projector. Its
true motion is zero: these apparent motions are the noise floor of every later check.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.special import fdtrc, fdtri

from slviewer.calibration.drift.view import (
    KINDS,
    DisplacementField,
    DriftView,
    LinearView,
    linearise_view,
)
from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.robust import robust_sigma, tukey_weights
from slviewer.geometry.vectors import rms, unit_vectors
from slviewer.records.drift import Drift
from slviewer.records.record import to_vector

FALSE_ALARMS = 1e-4
"""False-alarm probability of one check; a check precedes every day's work."""
BOARD_PPM = 5.0
"""Thermal expansion of the board since the calibration: half a kelvin of steel."""
MAX_MISFIT_RATIO = 3.0
"""Largest RMS that no movement explains, over that of the calibration's worst pose."""
TURN_MRAD, SHIFT_MM = 0.05, 0.010
"""Changes that must be detectable."""
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
RIG_SIGMAS = np.array([3e-3] * 3 + [3.0] * 3)
"""Prior sigma of the error of the calibration's own relative pose, rad and mm."""


@dataclass(frozen=True, eq=False)
class PoseChange:
    """Apparent change of the projector's pose in one view: ``change`` (6,) rad and mm, in the order
    of ``LinearView``.

    ``spreads`` (3, 6, 6): covariance of the change by kind of observation, for errors of 1 px;
    ``by_growth`` (6,): change per relative growth of the board. ``scale``: apparent relative growth
    of the board; ``across_px``: mean offset across the epipolar lines, NaN with one axis;
    ``misfit_px``: RMS residual that no change explains.
    """

    name: str
    change: Floats
    spreads: Floats
    by_growth: Floats
    scale: float
    across_px: float
    misfit_px: float


@dataclass(frozen=True, eq=False)
class DriftReference:
    """Reference of the drift check for one calibration.

    ``shared``: corrections of the relative pose and coefficients of the lens errors, with their
    ``covariance``; ``sigmas`` (3,) px: standard deviation of one observation by kind, remaining
    lens errors included; ``pose_changes``: apparent changes of the calibration's own poses, each
    from the other poses' lens errors.
    """

    rig: StereoRig
    shared: Floats
    covariance: Floats
    sigmas: Floats
    pose_changes: tuple[PoseChange, ...]

    def estimate_change(self, view: DriftView) -> PoseChange:
        """Estimate the projector's apparent change in a later view."""
        equations = linearise_view(self.rig, view)
        known = equations.shared
        variance = np.asarray(known.multiply(known @ self.covariance).sum(axis=1)).ravel()
        return solve_change(equations, self.shared, self.sigmas, variance < UNSUPPORTED_PX**2)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return named arrays for saving."""
        changes = self.pose_changes
        return {
            "shared": self.shared,
            "covariance": self.covariance,
            "sigmas": self.sigmas,
            "names": np.array([a.name for a in changes]),
            "changes": np.array([a.change for a in changes]),
            "spreads": np.array([a.spreads for a in changes]),
            "by_growth": np.array([a.by_growth for a in changes]),
            "figures": np.array([(a.scale, a.across_px, a.misfit_px) for a in changes]),
        }

    @classmethod
    def from_arrays(cls, rig: StereoRig, arrays: Mapping[str, np.ndarray]) -> "DriftReference":
        """Return the reference that ``to_arrays`` saved, of a calibration with this rig."""
        each = (arrays[name] for name in ("names", "changes", "spreads", "by_growth", "figures"))
        pose_changes = tuple(
            PoseChange(str(name), change, spreads, growth, *figures.tolist())
            for name, change, spreads, growth, figures in zip(*each, strict=True)
        )
        shared, covariance, sigmas = (arrays[name] for name in ("shared", "covariance", "sigmas"))
        return cls(rig, shared, covariance, sigmas, pose_changes)


def build_reference(rig: StereoRig, views: Sequence[DriftView]) -> DriftReference:
    """Estimate lens errors and noise floor from a calibration's own views.

    Raises InputError for fewer than MIN_POSES views.
    """
    if len(views) < MIN_POSES:
        raise InputError(
            f"the calibration has {len(views)} poses, and {MIN_POSES} are needed for a drift"
            " reference: calibrate with more poses"
        )
    equations = [linearise_view(rig, view) for view in views]
    blocks = [sp.diags(RIG_SIGMAS**-2.0)]
    for field in (DisplacementField(rig.camera.size), DisplacementField(rig.projector.size)):
        one = field.roughness / ROUGHNESS_PX**2 + sp.eye(field.unknowns) / HEIGHT_PX**2
        blocks += [one, one]
    prior = sp.block_diag(blocks).toarray()
    sigmas = np.full(len(KINDS), 0.05)
    weights = [_compute_weights(e, e.usable, sigmas) for e in equations]
    for _ in range(3):
        parts = [_reduce_normal_equations(e, w) for e, w in zip(equations, weights, strict=True)]
        total, right = sum((N for N, _ in parts), prior), sum(b for _, b in parts)
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
            _compute_weights(e, e.usable, sigmas, r)
            for e, r in zip(equations, residuals, strict=True)
        ]
    others = [cho_solve(cho_factor(total - N), right - b) for N, b in parts]
    for _ in range(2):  # the weights depend on the sigmas, and the sigmas on the changes
        pose_changes = tuple(
            solve_change(e, g, sigmas, e.usable) for e, g in zip(equations, others, strict=True)
        )
        sigmas = _fit_sigmas(pose_changes, sigmas)
    covariance = cho_solve(factor, np.eye(len(shared)))
    return DriftReference(rig, shared, covariance, sigmas, pose_changes)


def solve_change(e: LinearView, shared: Floats, sigmas: Floats, supported: Mask) -> PoseChange:
    """Estimate the projector's apparent change in one view by robust least squares, given the
    ``shared`` lens errors.

    ``sigmas`` (3,) px by kind; ``supported`` (k,) bool: rows with certain lens errors.
    """
    usable = e.usable & supported
    residuals = np.where(usable, e.residuals, 0.0) - e.shared @ shared
    both = np.hstack([e.pose, e.change])
    w = _compute_weights(e, usable, sigmas)
    for _ in range(5):
        solution = _least_squares_gain(both, w) @ residuals
        w = _compute_weights(e, usable, sigmas, residuals - both @ solution)
    gain = _least_squares_gain(both, w)
    growth = _least_squares_gain(np.column_stack([e.pose, e.scale]), w)[6] @ residuals
    by_camera = _least_squares_gain(e.pose, np.where(e.kinds == 0, w, 0.0)) @ residuals
    across = e.across * (residuals - e.pose @ by_camera)
    samples = across[e.kinds == 1] + across[e.kinds == 2]
    has_both_axes = (w[e.kinds == 1] > 0) & (w[e.kinds == 2] > 0)
    unexplained = (residuals - both @ (gain @ residuals))[w > 0]
    return PoseChange(
        e.name,
        gain[6:] @ residuals,
        np.array([part @ part.T for k in range(3) for part in [gain[6:, e.kinds == k]]]),
        gain[6:] @ e.scale,
        float(growth),
        float(samples[has_both_axes].mean()) if has_both_axes.any() else float("nan"),
        rms(unexplained),
    )


def _compute_weights(
    e: LinearView, usable: Mask, sigmas: Floats, residuals: Floats | None = None
) -> Floats:
    """Return the weights (k,) 1/px^2, times Tukey's where ``residuals`` (k,) are given; 0 where not
    usable."""
    w = usable / sigmas[e.kinds] ** 2
    if residuals is not None:
        for kind in range(len(KINDS)):
            these = usable & (e.kinds == kind)
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


def _fit_sigmas(pose_changes: Sequence[PoseChange], start: Floats) -> Floats:
    """Fit the sigmas (3,) px by kind by maximum likelihood of the apparent changes, whose true
    value is 0.

    It exceeds the scatter of the residuals, as errors of neighbouring samples are correlated.
    """
    # (views, kinds, 6, 6)
    spreads = np.array([a.spreads for a in pose_changes])
    changes = np.array([a.change for a in pose_changes])[..., None]

    def negative_log_likelihood(logs: Floats) -> float:
        """Return twice the negative log likelihood at the logarithms of the sigmas."""
        L = np.linalg.cholesky(np.tensordot(spreads, np.exp(2 * logs), (1, 0)))
        whitened = np.linalg.solve(L, changes)
        return float(2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum() + (whitened**2).sum())

    options = {"xatol": 0.02, "fatol": 0.01}
    first = np.log(4 * start)
    result = minimize(negative_log_likelihood, first, method="Nelder-Mead", options=options)
    return np.exp(result.x)


def check_drift(reference: DriftReference, view: DriftView) -> Drift:
    """Check a calibration with one later view of its board.

    Raises InputError where no axis of the pattern could be read.
    """
    if not view.axes:
        raise InputError(
            f"{view.name}: no axis of the pattern could be read on the board: illuminate the whole"
            " board"
        )
    estimate = reference.estimate_change(view)
    own = reference.pose_changes
    growth = BOARD_PPM * 1e-6
    C = np.tensordot(reference.sigmas**2, estimate.spreads, 1)
    C += growth**2 * np.outer(estimate.by_growth, estimate.by_growth)
    information = np.linalg.inv(C)
    squared_distance = float(estimate.change @ information @ estimate.change)
    degrees = 6 * len(own) - 3  # the floor is itself an estimate, from so many numbers
    chance = float(fdtrc(6, degrees, squared_distance / 6))
    limit = 6 * float(fdtri(6, degrees, 1 - FALSE_ALARMS))
    scale_sigma = float(np.hypot(rms([a.scale for a in own]), growth))
    across_px = across_sigma = None
    if np.isfinite(estimate.across_px):
        across_px = estimate.across_px
        across_sigma = float(np.sqrt(np.nanmean([a.across_px**2 for a in own])))
    along = np.concatenate([np.zeros(3), unit_vectors(reference.rig.t)])
    reasons = []
    worst = max(a.misfit_px for a in own)
    if estimate.misfit_px > MAX_MISFIT_RATIO * worst:
        reasons.append(
            f"residuals of {estimate.misfit_px:.3f} px RMS remain with any movement of the"
            f" projector (at most {worst:.3f} px in the poses of the calibration): was a lens"
            " refocused, the board moved, or is it another one?"
        )
    elif squared_distance > limit:
        reasons.append(_list_movements(estimate, information, squared_distance, along))
        if abs(estimate.scale) > 3 * scale_sigma:
            reasons.append(
                f"the board seems {1e6 * estimate.scale:+.0f} ppm larger than it is (+-"
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
        scale_ppm=1e6 * estimate.scale,
        scale_sigma_ppm=1e6 * scale_sigma,
        across_px=across_px,
        across_sigma_px=across_sigma,
        misfit_px=estimate.misfit_px,
        chance=chance,
        seen_alone=(*to_vector(seen_alone[:3]), *to_vector(seen_alone[3:])),
        unseen=(
            *_list_undetermined(seen_alone, view.axes),
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


def _list_undetermined(seen_alone: Floats, axes: Sequence[Axis]) -> list[str]:
    """Describe the movements whose detection limits (6,) mrad and mm are too large, with the reason
    and remedy."""
    undetermined = []
    for i, (move, lines, axis) in enumerate(_MOVES):
        if seen_alone[i] > (TURN_MRAD if i < 3 else SHIFT_MM):
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
