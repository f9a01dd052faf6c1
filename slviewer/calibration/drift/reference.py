"""Reference for the drift check: how precisely one view determines the projector's pose, from the calibration's own
poses.

Lens distortion beyond Brown's model is estimated from all poses together, as displacement fields. Then each pose, with
the fields of the others alone, gives an apparent motion of the projector. Its true motion is zero: these apparent
motions are the noise floor of every later check.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from slviewer.calibration.drift.view import KINDS, DisplacementField, DriftView, LinearView, linearise_view
from slviewer.errors import InputError
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.robust import robust_sigma, tukey_weights

MIN_POSES = 8
"""With fewer, leave-one-out fields do not represent a later view's."""
ROUGHNESS_PX = 0.1
"""Typical second difference of a field's coefficients, a cell apart."""
HEIGHT_PX = 1.0
"""Typical height of a field: prior where no view supports it."""
UNSUPPORTED_PX = 0.1
"""Pixels whose lens error is less certain than this are not used."""
RIG_SIGMAS = np.array([3e-3] * 3 + [3.0] * 3)
"""rad and mm: how far the calibration's own arrangement may be off."""


@dataclass(frozen=True, eq=False)
class PoseChange:
    """How far the projector seems to have moved in one view: ``change`` (6,) rad and mm, as ``LinearView`` orders
    it.

    ``spreads``: by kind (6, 6), its covariance for errors of 1 px in every observation; ``by_growth`` (6,): what it
    would be if only the board grew, relative to that. ``scale`` is the board's apparent relative growth,
    ``across_px`` how far off its epipolar lines on average (NaN with one axis), ``misfit_px`` the RMS that no change
    explains.
    """

    name: str
    change: np.ndarray
    spreads: Mapping[str, np.ndarray]
    by_growth: np.ndarray
    scale: float
    across_px: float
    misfit_px: float

    def covariance(self, sigmas: Mapping[str, float]) -> np.ndarray:
        """(6, 6) of the change, from the sigma of one observation of each kind, px."""
        return sum((sigmas[kind] ** 2 * spread for kind, spread in self.spreads.items()), np.zeros((6, 6)))


@dataclass(frozen=True, eq=False)
class DriftReference:
    """What the drift check needs of a calibration.

    ``shared`` are the coefficients of the arrangement's correction and the lens errors, with their ``covariance``;
    ``sigmas`` px by kind what one observation is worth, lens errors left over included; ``answers`` those of its own
    poses, each excluded in turn.
    """

    rig: StereoRig
    shared: np.ndarray
    covariance: np.ndarray
    sigmas: Mapping[str, float]
    answers: tuple[PoseChange, ...]

    def estimate_change(self, view: DriftView) -> PoseChange:
        """The projector's apparent change in a later view."""
        equations = linearise_view(self.rig, view)
        known = _shared_design(equations)
        variance = np.asarray(known.multiply(known @ self.covariance).sum(axis=1)).ravel()
        return solve_change(equations, self.shared, self.sigmas, variance < UNSUPPORTED_PX**2)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Flat named arrays, for saving."""
        answers = self.answers
        return {
            "shared": self.shared,
            "covariance": self.covariance,
            "sigmas": np.array([self.sigmas[kind] for kind in KINDS]),
            "names": np.array([a.name for a in answers]),
            "changes": np.array([a.change for a in answers]),
            "spreads": np.array([[a.spreads[kind] for kind in KINDS] for a in answers]),
            "by_growth": np.array([a.by_growth for a in answers]),
            "figures": np.array([(a.scale, a.across_px, a.misfit_px) for a in answers]),
        }

    @classmethod
    def from_arrays(cls, rig: StereoRig, arrays: Mapping[str, np.ndarray]) -> "DriftReference":
        """The inverse of ``to_arrays``, of a calibration with this rig."""
        each = zip(*(arrays[name] for name in ("names", "changes", "spreads", "by_growth", "figures")), strict=True)
        answers = tuple(
            PoseChange(str(name), change, dict(zip(KINDS, spreads, strict=True)), growth, *(float(f) for f in figures))
            for name, change, spreads, growth, figures in each
        )
        sigmas = {kind: float(sigma) for kind, sigma in zip(KINDS, arrays["sigmas"], strict=True)}
        return cls(rig, arrays["shared"], arrays["covariance"], sigmas, answers)


def build_reference(rig: StereoRig, views: Sequence[DriftView]) -> DriftReference:
    """Lens errors and floor from a calibration's own views. Raises InputError for fewer than LEAST_POSES."""
    if len(views) < MIN_POSES:
        raise InputError(
            f"the calibration has {len(views)} poses, and {MIN_POSES} are needed for a drift reference: "
            "calibrate with more poses"
        )
    equations = [linearise_view(rig, view) for view in views]
    prior = _prior(rig)
    sigmas = dict.fromkeys(KINDS, 0.05)
    weights = [_weights(e, e.usable, np.zeros(len(e.residuals)), sigmas, robust=False) for e in equations]
    for _ in range(3):
        parts = [_reduce_normal_equations(e, w) for e, w in zip(equations, weights, strict=True)]
        factor = cho_factor(sum((N for N, _ in parts), prior))
        shared = cho_solve(factor, sum(b for _, b in parts))
        left = [_remaining_residuals(e, w, shared) for e, w in zip(equations, weights, strict=True)]
        sigmas = {k: _sigma_of(equations, left, i, sigmas[k]) for i, k in enumerate(KINDS)}
        weights = [_weights(e, e.usable, r, sigmas) for e, r in zip(equations, left, strict=True)]
    total, right = sum((N for N, _ in parts), prior), sum(b for _, b in parts)
    others = [cho_solve(cho_factor(total - N), right - b) for N, b in parts]
    for _ in range(2):  # the weights depend on the sigmas, and the sigmas on the changes
        answers = tuple(solve_change(e, g, sigmas, e.usable) for e, g in zip(equations, others, strict=True))
        sigmas = _fit_sigmas(answers, sigmas)
    covariance = cho_solve(factor, np.eye(len(shared)))
    return DriftReference(rig, shared, covariance, sigmas, answers)


def solve_change(e: LinearView, shared: np.ndarray, sigmas: Mapping[str, float], supported: np.ndarray) -> PoseChange:
    """The projector's apparent change in one view, given lens errors ``shared``."""
    usable = e.usable & supported
    left = np.where(usable, e.residuals, 0.0) - _shared_design(e) @ shared
    both = np.hstack([e.pose, e.change])
    w = _weights(e, usable, left, sigmas, robust=False)
    for _ in range(5):
        solution = _gain(both, w) @ left
        w = _weights(e, usable, left - both @ solution, sigmas)
    gain = _gain(both, w)
    growth = _gain(np.column_stack([e.pose, e.scale]), w)[6] @ left
    by_camera = _gain(e.pose, np.where(e.kinds == 0, w, 0.0)) @ left
    across = e.across * (left - e.pose @ by_camera)
    samples = across[e.kinds == 1] + across[e.kinds == 2]
    said = (w[e.kinds == 1] > 0) & (w[e.kinds == 2] > 0)
    unexplained = (left - both @ (gain @ left))[w > 0]
    return PoseChange(
        e.name,
        gain[6:] @ left,
        {kind: gain[6:, e.kinds == i] @ gain[6:, e.kinds == i].T for i, kind in enumerate(KINDS)},
        gain[6:] @ e.scale,
        float(growth),
        float(samples[said].mean()) if said.any() else float("nan"),
        float(np.sqrt(np.mean(unexplained**2))),
    )


def _shared_design(e: LinearView) -> sp.csr_array:
    """Columns of the unknowns that all views share: the rig's correction, then the lens errors."""
    return sp.csr_array(sp.hstack([sp.csr_array(np.where(np.isfinite(e.change), e.change, 0.0)), e.shared]))


def _prior(rig: StereoRig) -> np.ndarray:
    blocks = [sp.diags(RIG_SIGMAS**-2.0)]
    for field in (DisplacementField(rig.camera.size), DisplacementField(rig.projector.size)):
        one = field.roughness / ROUGHNESS_PX**2 + sp.eye(field.unknowns) / HEIGHT_PX**2
        blocks += [one, one]
    prior: np.ndarray = sp.block_diag(blocks).toarray()
    return prior


def _weights(
    e: LinearView, usable: np.ndarray, left: np.ndarray, sigmas: Mapping[str, float], robust: bool = True
) -> np.ndarray:
    w = np.zeros(len(left))
    for i, kind in enumerate(KINDS):
        these = usable & (e.kinds == i)
        if these.any():
            spread = max(robust_sigma(left[these]), 1e-9)
            w[these] = (tukey_weights(left[these], spread) if robust else 1.0) / sigmas[kind] ** 2
    return w


def _gain(J: np.ndarray, w: np.ndarray) -> np.ndarray:
    """(unknowns, k): from residuals to unknowns, by weighted least squares; what nothing determines stays 0."""
    weighted = np.where(w > 0, w, 0.0)[:, None] * np.nan_to_num(J)
    N = weighted.T @ np.nan_to_num(J)
    s = 1 / np.sqrt(np.maximum(np.diag(N), 1e-300))[:, None]
    gain: np.ndarray = s * (np.linalg.pinv(N * s * s.T, rcond=1e-13, hermitian=True) @ (s * weighted.T))
    return gain


def _reduce_normal_equations(e: LinearView, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of the shared unknowns, the view's own pose eliminated."""
    D, P = _shared_design(e), np.nan_to_num(e.pose)
    r = np.where(w > 0, e.residuals, 0.0)
    weighted = sp.csr_array(sp.diags(w) @ D)
    cross = weighted.T @ P
    inverse = np.linalg.inv(P.T @ (P * w[:, None]))
    N = (weighted.T @ D).toarray() - cross @ inverse @ cross.T
    return N, weighted.T @ r - cross @ (inverse @ (P.T @ (w * r)))


def _remaining_residuals(e: LinearView, w: np.ndarray, shared: np.ndarray) -> np.ndarray:
    left = np.where(e.usable, e.residuals, 0.0) - _shared_design(e) @ shared
    return left - np.nan_to_num(e.pose) @ (_gain(e.pose, w) @ left)


def _sigma_of(equations: Sequence[LinearView], left: Sequence[np.ndarray], kind: int, otherwise: float) -> float:
    values = np.concatenate([r[e.usable & (e.kinds == kind)] for e, r in zip(equations, left, strict=True)])
    return max(robust_sigma(values), 1e-3) if len(values) else otherwise


def _fit_sigmas(answers: Sequence[PoseChange], start: Mapping[str, float]) -> dict[str, float]:
    """The sigma of each kind that maximises the likelihood of the apparent changes if none is real.

    Neighbouring samples have correlated errors: the effective sigma exceeds their own scatter.
    """
    spreads = np.array([[a.spreads[kind] for kind in KINDS] for a in answers])  # (views, kinds, 6, 6)
    changes = np.array([a.change for a in answers])[..., None]

    def unlikeliness(logs: np.ndarray) -> float:
        L = np.linalg.cholesky(np.tensordot(spreads, np.exp(2 * logs), (1, 0)))
        whitened = np.linalg.solve(L, changes)
        return float(2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum() + (whitened**2).sum())

    first = np.log([4 * start[kind] for kind in KINDS])
    found = minimize(unlikeliness, first, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.01})
    return {kind: float(np.exp(log)) for kind, log in zip(KINDS, found.x, strict=True)}
