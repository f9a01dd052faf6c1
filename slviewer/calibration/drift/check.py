"""Drift check: whether a saved calibration is still valid, from one capture of its board.

The check estimates the change of the projector's pose relative to the camera: a rotation about its own centre, and a
translation of that centre. Flatness would not show it: a rotation of 0.1 mrad leaves flat boards flat, and distorts
space by 700 ppm. Changes along the epipolar lines change the board's apparent scale; changes across them move the
pattern off its epipolar lines.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import fdtrc, fdtri

from slviewer.calibration.drift.reference import DriftReference, PoseChange
from slviewer.calibration.drift.view import DriftView
from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis
from slviewer.geometry.vectors import rms, unit_vectors

FALSE_ALARMS = 1e-4
"""False-alarm probability of one check; a check precedes every day's work."""
BOARD_PPM = 5.0
"""Thermal expansion of the board since the calibration: half a kelvin of steel."""
MAX_MISFIT_RATIO = 3.0
"""Largest RMS that no movement explains, over that of the calibration's worst pose."""
TURN_MRAD, SHIFT_MM = 0.05, 0.010
"""Changes that must be detectable."""
Verdict = Literal["still good", "recalibrate"]
_MOVES = (
    ("turn about its x axis (nod)", "rows", "y"),
    ("turn about its y axis (pan)", "columns", "x"),
    ("turn about its optical axis (roll)", "rows", "y"),
    ("shift along its x axis", "columns", "x"),
    ("shift along its y axis", "rows", "y"),
    ("shift along its optical axis", "rows and columns", "y"),
)


@dataclass(frozen=True)
class Drift:
    """Result of the drift check; sigmas are standard deviations.

    ``turn_mrad``, ``shift_mm`` (3,): estimated rotation about and translation along the projector's own axes.
    ``scale_ppm``: apparent growth of the board; ``across_px``: mean offset across the epipolar lines, None with one
    axis; ``misfit_px``: RMS that no movement explains. ``chance``: p-value of the change if nothing moved.
    ``seen_alone`` (6,): size in mrad and mm at which each rotation and translation would be detected with 95 %
    probability if it were the only change. ``unseen``: descriptions of changes that would not be detected.
    """

    capture: str
    axes: tuple[Axis, ...]
    verdict: Verdict
    reasons: tuple[str, ...]
    turn_mrad: tuple[float, ...]
    turn_sigma_mrad: tuple[float, ...]
    shift_mm: tuple[float, ...]
    shift_sigma_mm: tuple[float, ...]
    baseline_mm: float
    baseline_sigma_mm: float
    scale_ppm: float
    scale_sigma_ppm: float
    across_px: float | None
    across_sigma_px: float | None
    misfit_px: float
    chance: float
    seen_alone: tuple[float, ...]
    unseen: tuple[str, ...]

    def text(self) -> str:
        """Return a report of several lines for the terminal: the verdict, then the figures behind it."""
        answer = self.verdict if not self.reasons else f"{self.verdict}, because {'; '.join(self.reasons)}"
        across = (
            "off its epipolar lines: not known from one axis"
            if self.across_px is None
            else f"off its epipolar lines by {self.across_px:+.4f} +- {self.across_sigma_px:.4f} px"
        )
        shifts, shift_sigmas = ([1e3 * s for s in three] for three in (self.shift_mm, self.shift_sigma_mm))
        lines = [
            f"{self.capture}: {answer}",
            f"  the board seems {self.scale_ppm:+.0f} +- {self.scale_sigma_ppm:.0f} ppm larger than it is; {across}",
            f"  projector turned by {_format_xyz(self.turn_mrad, self.turn_sigma_mrad, '.3f')} mrad about its x, y, z",
            f"  and shifted by {_format_xyz(shifts, shift_sigmas, '.0f')} um;"
            f" baseline {1e3 * self.baseline_mm:+.0f} +- {1e3 * self.baseline_sigma_mm:.0f} um",
            "  a pan and a shift along x look nearly alike, as do a nod and a shift along y: their sum is known far "
            "better than each",
            "  detectable if it is the only change: turns from "
            + ", ".join(f"{s:.4f}" for s in self.seen_alone[:3])
            + " mrad, shifts from "
            + ", ".join(f"{1e3 * s:.1f}" for s in self.seen_alone[3:])
            + " um",
        ]
        return "\n".join(lines + [f"  not detectable: {what}" for what in self.unseen])


def check_drift(reference: DriftReference, view: DriftView) -> Drift:
    """Check a calibration with one later view of its board.

    Raises InputError where no axis of the pattern could be read.
    """
    if not view.axes:
        raise InputError(f"{view.name}: no axis of the pattern could be read on the board: illuminate the whole board")
    estimate = reference.estimate_change(view)
    own = reference.pose_changes
    growth = BOARD_PPM * 1e-6
    C = estimate.covariance(reference.sigmas) + growth**2 * np.outer(estimate.by_growth, estimate.by_growth)
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
            f"residuals of {estimate.misfit_px:.3f} px RMS remain with any movement of the projector "
            f"(at most {worst:.3f} px in the poses of the calibration): "
            "was a lens refocused, the board moved, or is it another one?"
        )
    elif squared_distance > limit:
        reasons.append(_list_movements(estimate, information, squared_distance, along))
        if abs(estimate.scale) > 3 * scale_sigma:
            reasons.append(
                f"the board seems {1e6 * estimate.scale:+.0f} ppm larger than it is (+- {1e6 * scale_sigma:.0f})"
            )
        if across_sigma is not None and abs(estimate.across_px) > 4 * across_sigma:
            reasons.append(
                f"the pattern is {estimate.across_px:+.4f} px off its epipolar lines (+- {across_sigma:.4f})"
            )
    sigmas = np.sqrt(np.diag(C))
    seen_alone = (np.sqrt(limit) + 1.645) / np.sqrt(np.diag(information)) * np.array([1e3] * 3 + [1.0] * 3)
    return Drift(
        capture=view.name,
        axes=view.axes,
        verdict="recalibrate" if reasons else "still good",
        reasons=tuple(reasons),
        turn_mrad=_to_floats(1e3 * estimate.change[:3]),
        turn_sigma_mrad=_to_floats(1e3 * sigmas[:3]),
        shift_mm=_to_floats(estimate.change[3:]),
        shift_sigma_mm=_to_floats(sigmas[3:]),
        baseline_mm=float(along @ estimate.change),
        baseline_sigma_mm=float(np.sqrt(along @ C @ along)),
        scale_ppm=1e6 * estimate.scale,
        scale_sigma_ppm=1e6 * scale_sigma,
        across_px=float(estimate.across_px) if two else None,
        across_sigma_px=across_sigma,
        misfit_px=estimate.misfit_px,
        chance=chance,
        seen_alone=_to_floats(seen_alone),
        unseen=(*_list_undetermined(seen_alone, view.axes), "common motion of both devices (harmless)"),
    )


def _list_movements(estimate: PoseChange, information: np.ndarray, squared_distance: float, along: np.ndarray) -> str:
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
            words.append(f"a {names[i]} by {1e3 * sizes[i]:+{form}} +- {1e3 * sigmas[i]:{form}} {unit}")
    return f"the projector has moved, as by {' or '.join(words)} ({100 * share.max():.0f} % of the change)"


def _list_undetermined(seen_alone: np.ndarray, axes: Sequence[Axis]) -> list[str]:
    """Describe the movements whose detection limits (6,) mrad and mm are too large, with the reason and remedy."""
    limits = [TURN_MRAD] * 3 + [SHIFT_MM] * 3
    undetermined = []
    for i, ((move, lines, axis), limit) in enumerate(zip(_MOVES, limits, strict=True)):
        if seen_alone[i] > limit:
            size = f"{seen_alone[i]:.2f} mrad" if i < 3 else f"{1e3 * seen_alone[i]:.0f} um"
            why = (
                f"it moves the pattern's {lines}, and the capture holds axis {axes[0]} alone"
                if len(axes) == 1 and axis not in axes
                else f"at this pose it moves the pattern by too little; {'capture both axes, or ' * (len(axes) < 2)}"
                "bring the board nearer and tilt it"
            )
            undetermined.append(f"a {move} of less than {size}: {why}")
    return undetermined


def _format_xyz(values: Sequence[float], sigmas: Sequence[float], form: str) -> str:
    """Format values with their sigmas: "+1.0 +- 0.1, ..."."""
    return ", ".join(f"{value:+{form}} +- {sigma:{form}}" for value, sigma in zip(values, sigmas, strict=True))


def _to_floats(values: np.ndarray) -> tuple[float, ...]:
    """Convert an array (n,) to a tuple of floats."""
    return tuple(float(value) for value in values)
