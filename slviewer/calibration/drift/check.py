"""Drift check: whether a saved calibration is still valid, from one capture of its board.

The check estimates the change of the projector's pose relative to the camera: a rotation about its
own centre, and a translation of that centre. Flatness would not show it: a rotation of 0.1 mrad
leaves flat boards flat, and distorts space by 700 ppm. Changes along the epipolar lines change the
board's apparent scale; changes across them move the pattern off its epipolar lines.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import fdtrc, fdtri

from slviewer.calibration.drift.reference import DriftReference, PoseChange
from slviewer.calibration.drift.view import DriftView
from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis
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
    C = estimate.covariance(reference.sigmas) + growth**2 * np.outer(
        estimate.by_growth, estimate.by_growth
    )
    information = np.linalg.inv(C)
    squared_distance = float(estimate.change @ information @ estimate.change)
    degrees = 6 * len(own) - 3  # the floor is itself an estimate, from so many numbers
    chance = float(fdtrc(6, degrees, squared_distance / 6))
    limit = 6 * float(fdtri(6, degrees, 1 - FALSE_ALARMS))
    scale_sigma = float(np.hypot(rms([a.scale for a in own]), growth))
    two = np.isfinite(estimate.across_px)
    across_sigma = float(np.sqrt(np.nanmean([a.across_px**2 for a in own]))) if two else None
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
        if across_sigma is not None and abs(estimate.across_px) > 4 * across_sigma:
            reasons.append(
                f"the pattern is {estimate.across_px:+.4f} px off its epipolar lines (+-"
                f" {across_sigma:.4f})"
            )
    sigmas = np.sqrt(np.diag(C))
    seen_alone = (
        (np.sqrt(limit) + 1.645) / np.sqrt(np.diag(information)) * np.array([1e3] * 3 + [1.0] * 3)
    )
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
        across_px=float(estimate.across_px) if two else None,
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
    estimate: PoseChange, information: np.ndarray, squared_distance: float, along: np.ndarray
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


def _list_undetermined(seen_alone: np.ndarray, axes: Sequence[Axis]) -> list[str]:
    """Describe the movements whose detection limits (6,) mrad and mm are too large, with the reason
    and remedy."""
    limits = [TURN_MRAD] * 3 + [SHIFT_MM] * 3
    undetermined = []
    for i, ((move, lines, axis), limit) in enumerate(zip(_MOVES, limits, strict=True)):
        if seen_alone[i] > limit:
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
