"""Reference for the drift check: how precisely one view determines the projector's pose, from the
calibration's own poses.

Lens distortion beyond Brown's model is estimated from all poses together, as displacement fields.
Then each pose, with the fields of the others alone, gives an apparent motion of the projector. Its
true motion is zero: these apparent motions are the noise floor of every later check.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from slviewer.calibration.drift.view import (
    KINDS,
    DisplacementField,
    DriftView,
    LinearView,
    linearise_view,
)
from slviewer.errors import InputError
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats
from slviewer.geometry.robust import robust_sigma, tukey_weights
from slviewer.geometry.vectors import rms

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

    ``spreads``: covariance (6, 6) of the change by kind of observation, for errors of 1 px;
    ``by_growth`` (6,): change per relative growth of the board. ``scale``: apparent relative growth
    of the board; ``across_px``: mean offset across the epipolar lines, NaN with one axis;
    ``misfit_px``: RMS residual that no change explains.
    """

    name: str
    change: Floats
    spreads: Mapping[str, Floats]
    by_growth: Floats
    scale: float
    across_px: float
    misfit_px: float

    def covariance(self, sigmas: Mapping[str, float]) -> Floats:
        """Return the covariance (6, 6) of the change from the sigma in px of each kind of
        observation."""
        return sum(
            (sigmas[kind] ** 2 * spread for kind, spread in self.spreads.items()), np.zeros((6, 6))
        )


@dataclass(frozen=True, eq=False)
class DriftReference:
    """Reference of the drift check for one calibration.

    ``shared``: corrections of the relative pose and coefficients of the lens errors, with their
    ``covariance``; ``sigmas``: standard deviation in px of one observation by kind, remaining lens
    errors included; ``pose_changes``: apparent changes of the calibration's own poses, each from
    the other poses' lens errors.
    """

    rig: StereoRig
    shared: Floats
    covariance: Floats
    sigmas: Mapping[str, float]
    pose_changes: tuple[PoseChange, ...]

    def estimate_change(self, view: DriftView) -> PoseChange:
        """Estimate the projector's apparent change in a later view."""
        equations = linearise_view(self.rig, view)
        known = _shared_design(equations)
        variance = np.asarray(known.multiply(known @ self.covariance).sum(axis=1)).ravel()
        return solve_change(equations, self.shared, self.sigmas, variance < UNSUPPORTED_PX**2)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return named arrays for saving."""
        pose_changes = self.pose_changes
        return {
            "shared": self.shared,
            "covariance": self.covariance,
            "sigmas": np.array([self.sigmas[kind] for kind in KINDS]),
            "names": np.array([a.name for a in pose_changes]),
            "changes": np.array([a.change for a in pose_changes]),
            "spreads": np.array([[a.spreads[kind] for kind in KINDS] for a in pose_changes]),
            "by_growth": np.array([a.by_growth for a in pose_changes]),
            "figures": np.array([(a.scale, a.across_px, a.misfit_px) for a in pose_changes]),
        }

    @classmethod
    def from_arrays(cls, rig: StereoRig, arrays: Mapping[str, np.ndarray]) -> "DriftReference":
        """Return the reference that ``to_arrays`` saved, of a calibration with this rig."""
        each = zip(
            *(arrays[name] for name in ("names", "changes", "spreads", "by_growth", "figures")),
            strict=True,
        )
        pose_changes = tuple(
            PoseChange(
                str(name),
                change,
                dict(zip(KINDS, spreads, strict=True)),
                growth,
                *(float(f) for f in figures),
            )
            for name, change, spreads, growth, figures in each
        )
        sigmas = {kind: float(sigma) for kind, sigma in zip(KINDS, arrays["sigmas"], strict=True)}
        return cls(rig, arrays["shared"], arrays["covariance"], sigmas, pose_changes)


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
    prior = _prior_information(rig)
    sigmas = dict.fromkeys(KINDS, 0.05)
    weights = [
        _compute_weights(e, e.usable, np.zeros(len(e.residuals)), sigmas, robust=False)
        for e in equations
    ]
    for _ in range(3):
        parts = [_reduce_normal_equations(e, w) for e, w in zip(equations, weights, strict=True)]
        factor = cho_factor(sum((N for N, _ in parts), prior))
        shared = cho_solve(factor, sum(b for _, b in parts))
        residuals = [
            _remaining_residuals(e, w, shared) for e, w in zip(equations, weights, strict=True)
        ]
        sigmas = {
            k: _estimate_sigma(equations, residuals, i, sigmas[k]) for i, k in enumerate(KINDS)
        }
        weights = [
            _compute_weights(e, e.usable, r, sigmas)
            for e, r in zip(equations, residuals, strict=True)
        ]
    total, right = sum((N for N, _ in parts), prior), sum(b for _, b in parts)
    others = [cho_solve(cho_factor(total - N), right - b) for N, b in parts]
    for _ in range(2):  # the weights depend on the sigmas, and the sigmas on the changes
        pose_changes = tuple(
            solve_change(e, g, sigmas, e.usable) for e, g in zip(equations, others, strict=True)
        )
        sigmas = _fit_sigmas(pose_changes, sigmas)
    covariance = cho_solve(factor, np.eye(len(shared)))
    return DriftReference(rig, shared, covariance, sigmas, pose_changes)


def solve_change(
    e: LinearView, shared: Floats, sigmas: Mapping[str, float], supported: NDArray[np.bool_]
) -> PoseChange:
    """Estimate the projector's apparent change in one view by robust least squares, given the
    ``shared`` lens errors.

    ``sigmas``: px by kind; ``supported`` (k,) bool: rows with certain lens errors.
    """
    usable = e.usable & supported
    residuals = np.where(usable, e.residuals, 0.0) - _shared_design(e) @ shared
    both = np.hstack([e.pose, e.change])
    w = _compute_weights(e, usable, residuals, sigmas, robust=False)
    for _ in range(5):
        solution = _least_squares_gain(both, w) @ residuals
        w = _compute_weights(e, usable, residuals - both @ solution, sigmas)
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
        {kind: gain[6:, e.kinds == i] @ gain[6:, e.kinds == i].T for i, kind in enumerate(KINDS)},
        gain[6:] @ e.scale,
        float(growth),
        float(samples[has_both_axes].mean()) if has_both_axes.any() else float("nan"),
        rms(unexplained),
    )


def _shared_design(e: LinearView) -> sp.csr_array:
    """Return the design matrix of the unknowns that all views share: the rig's correction, then the
    lens errors."""
    return sp.csr_array(
        sp.hstack([sp.csr_array(np.where(np.isfinite(e.change), e.change, 0.0)), e.shared])
    )


def _prior_information(rig: StereoRig) -> np.ndarray:
    """Return the prior information matrix of the shared unknowns."""
    blocks = [sp.diags(RIG_SIGMAS**-2.0)]
    for field in (DisplacementField(rig.camera.size), DisplacementField(rig.projector.size)):
        one = field.roughness / ROUGHNESS_PX**2 + sp.eye(field.unknowns) / HEIGHT_PX**2
        blocks += [one, one]
    return sp.block_diag(blocks).toarray()


def _compute_weights(
    e: LinearView,
    usable: np.ndarray,
    residuals: np.ndarray,
    sigmas: Mapping[str, float],
    robust: bool = True,
) -> np.ndarray:
    """Return the weights (k,) 1/px^2 of ``residuals`` (k,), times Tukey's if ``robust``; 0 where
    not usable."""
    w = np.zeros(len(residuals))
    for i, kind in enumerate(KINDS):
        these = usable & (e.kinds == i)
        if these.any():
            spread = max(robust_sigma(residuals[these]), 1e-9)
            w[these] = (tukey_weights(residuals[these], spread) if robust else 1.0) / sigmas[
                kind
            ] ** 2
    return w


def _least_squares_gain(J: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the matrix (unknowns, k) of weighted least squares from residuals to unknowns; 0 for
    undetermined ones."""
    weighted = np.where(w > 0, w, 0.0)[:, None] * np.nan_to_num(J)
    N = weighted.T @ np.nan_to_num(J)
    s = 1 / np.sqrt(np.maximum(np.diag(N), 1e-300))[:, None]
    return s * (np.linalg.pinv(N * s * s.T, rcond=1e-13, hermitian=True) @ (s * weighted.T))


def _reduce_normal_equations(e: LinearView, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal equations of the shared unknowns with the view's own board pose
    eliminated."""
    D, P = _shared_design(e), np.nan_to_num(e.pose)
    r = np.where(w > 0, e.residuals, 0.0)
    weighted = sp.csr_array(sp.diags(w) @ D)
    cross = weighted.T @ P
    inverse = np.linalg.inv(P.T @ (P * w[:, None]))
    N = (weighted.T @ D).toarray() - cross @ inverse @ cross.T
    return N, weighted.T @ r - cross @ (inverse @ (P.T @ (w * r)))


def _remaining_residuals(e: LinearView, w: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return the residuals (k,) of a view after the shared unknowns and its best board pose."""
    residuals = np.where(e.usable, e.residuals, 0.0) - _shared_design(e) @ shared
    return residuals - np.nan_to_num(e.pose) @ (_least_squares_gain(e.pose, w) @ residuals)


def _estimate_sigma(
    equations: Sequence[LinearView], residuals: Sequence[np.ndarray], kind: int, otherwise: float
) -> float:
    """Return the robust sigma of all residuals of one kind, or ``otherwise`` where there are
    none."""
    values = np.concatenate(
        [r[e.usable & (e.kinds == kind)] for e, r in zip(equations, residuals, strict=True)]
    )
    return max(robust_sigma(values), 1e-3) if len(values) else otherwise


def _fit_sigmas(pose_changes: Sequence[PoseChange], start: Mapping[str, float]) -> dict[str, float]:
    """Fit the sigma in px of each kind by maximum likelihood of the apparent changes, whose true
    value is 0.

    It exceeds the scatter of the residuals, as errors of neighbouring samples are correlated.
    """
    # (views, kinds, 6, 6)
    spreads = np.array([[a.spreads[kind] for kind in KINDS] for a in pose_changes])
    changes = np.array([a.change for a in pose_changes])[..., None]

    def negative_log_likelihood(logs: np.ndarray) -> float:
        """Return twice the negative log likelihood at the logarithms of the sigmas."""
        L = np.linalg.cholesky(np.tensordot(spreads, np.exp(2 * logs), (1, 0)))
        whitened = np.linalg.solve(L, changes)
        return float(2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum() + (whitened**2).sum())

    first = np.log([4 * start[kind] for kind in KINDS])
    result = minimize(
        negative_log_likelihood, first, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.01}
    )
    return {kind: float(np.exp(log)) for kind, log in zip(KINDS, result.x, strict=True)}
