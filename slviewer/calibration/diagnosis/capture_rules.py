"""Rules on the capture of the poses and on the description of their frames; each yields the
findings of one cause."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from slviewer.calibration.diagnosis.evidence import Evidence
from slviewer.calibration.diagnosis.frames import gamma_from_harmonic
from slviewer.calibration.diagnosis.poses import (
    COMMON_SHARE,
    ORDERS,
    classify_frame_order,
    format_poses,
    list_ordered_poses,
    rate_severity,
    was_refused,
)
from slviewer.calibration.observe import AXES
from slviewer.fringe.sequence import Axis
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.vectors import unit_vectors
from slviewer.records.verdict import Cause, Finding, Severity

MAX_SATURATED = 0.12
REJECTED_SATURATED = 0.3
MAX_GAMMA = 1.5
MAX_PERIOD_ERROR = 0.04
PERIOD_SIGMAS = 4.0
ASPECTS = (0.5, 1.0, 2.0)
"""Of square pixels, and of the diamond pixels of some DMDs."""
MAX_ASPECT_ERROR = 0.05
_CAUSES_IN_POSES = ("axes-swapped", "axis-reversed", "saturation")
_SYMPTOMS = ("projector-size", "fringe-period", "unreadable")

CODE_ORIGIN_PX = 0.5
"""px from column 0: the origin of most Gray codes, whose phase gives the fringe's true period."""
RIPPLE_PEAK = 2.0
"""Peak of a ripple over its RMS."""

_ORDER_REMEDY: dict[Cause, str] = {
    "frame-lag": (
        "let the camera wait longer after each pattern, or switch its buffering off (the preflight"
        " shows which), and capture again"
    ),
    "missing-frame": (
        "trigger the camera by the projector or wait longer for each frame, and capture again; of "
        "imported frames, look for the file that is missing"
    ),
    "frame-order": "run the preflight, and capture again",
}


def diagnose_frame_order(e: Evidence) -> Iterator[Finding]:
    """Yield a finding for each way in which frames are out of order: lagging, missing, or
    exchanged."""
    orders = {pose.name: order for pose in e.poses if (order := classify_frame_order(pose))}
    for cause in ORDERS:
        names = tuple(name for name, order in orders.items() if order == cause)
        if names:
            is_excluded = all(name in e.excluded or was_refused(e, name) for name in names)
            yield Finding(
                cause,
                rate_severity(e, names, is_excluded),
                f"{format_poses(e, names)} {ORDERS[cause]}",
                _ORDER_REMEDY[cause],
                names,
            )


def diagnose_saturation(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where too many of the boards' pixels are saturated."""
    shares = {
        pose.name: max((a.saturated for a in pose.axes.values()), default=0.0) for pose in e.poses
    }
    names = tuple(name for name, share in shares.items() if share > MAX_SATURATED)
    if not names:
        return
    median_share = float(np.median([shares[name] for name in names]))
    severity: Severity = "doubtful" if len(names) > 0.25 * len(e.poses) else "note"
    if len(names) >= COMMON_SHARE * len(e.poses) and (
        median_share > REJECTED_SATURATED or e.solution is None
    ):
        severity = "rejected"
    yield Finding(
        "saturation",
        severity,
        f"{format_poses(e, names)} {100 * median_share:.0f} % of the board's illuminated pixels are"
        " saturated",
        "lower the exposure or the gain until white stays below the camera's full scale, and"
        " capture again",
        names,
    )


def diagnose_mirroring(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where the axes are exchanged or one is reversed: the projector's image is a
    mirror image."""
    jacobians = {
        pose.name: np.array(pose.turn) for pose in list_ordered_poses(e) if pose.turn is not None
    }
    mirrored = {name: J for name, J in jacobians.items() if np.linalg.det(J) < 0}
    if len(mirrored) <= COMMON_SHARE * len(jacobians):
        return
    mean = np.mean([unit_vectors(J) for J in mirrored.values()], axis=0)
    names = tuple(mirrored)
    observation = (
        f"in {len(mirrored)} of {len(jacobians)} poses the projector's coordinates are a mirror"
        " image of what the camera sees"
    )
    if classify_mirroring(mean) == "axes-swapped":
        yield Finding(
            "axes-swapped",
            "rejected",
            f"{observation}, as if x and y were exchanged",
            "exchange the x and y (V and H) frames in the description of the sequence, or in the"
            " projector",
            names,
        )
    else:
        axis = "x" if mean[0, 0] < 0 else "y"
        across, mode = (
            ("left and right", "rear or mirror") if axis == "x" else ("top and bottom", "flip")
        )
        yield Finding(
            "axis-reversed",
            "rejected",
            f"{observation}, as if its {axis} axis were reversed ({across})",
            f"switch off the projector's {mode} mode, or number its"
            f" {'columns' if axis == 'x' else 'rows'} from the other end",
            names,
        )


def classify_mirroring(jacobian: np.ndarray) -> Cause:
    """Return the cause of a mirrored Jacobian (2, 2) of projector by camera pixels, assuming both
    devices upright."""
    diagonal, off_diagonal = abs(np.diag(jacobian)).sum(), abs(np.diag(jacobian[::-1])).sum()
    return "axes-swapped" if off_diagonal > diagonal else "axis-reversed"


def diagnose_period(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where the fringe period differs from its description.

    Evidence is the phase at the Gray code's edges, or the projector's aspect ratio by the
    calibration.
    """
    if e.contradiction:
        sentence, _, remedy = e.contradiction.partition(": ")
        yield Finding(
            "fringe-period", "rejected", sentence, remedy or "correct the sequence's description"
        )
        return
    # the code is of another axis or from its other end, or gamma moves the phase at which it starts
    if any(diagnose_mirroring(e)) or _list_aliased_gamma_poses(e):
        return
    wrong = [text for axis in AXES if (text := _describe_wrong_period(e, axis))]
    if wrong:
        yield Finding(
            "fringe-period",
            "rejected",
            f"the fringe period differs from the sequence's description ({' and '.join(wrong)}), by"
            " the phase at the Gray code's edges",
            "correct period_px in the description, or project the patterns without scaling",
        )
    elif e.solution is not None and not (e.tilts_undetermined or any(_diagnose_cells(e))):
        aspect = e.solution.aspects[1]
        if abs(aspect / _nearest_aspect(aspect) - 1) > MAX_ASPECT_ERROR:
            yield Finding(
                "fringe-period",
                "doubtful",
                f"the projector's rows appear {aspect:.2f} times as dense as its columns, as no"
                " pixels are",
                "compare the fringe period of each axis with its description, and turn off the"
                " projector's scaling",
            )


def _nearest_aspect(aspect: float) -> float:
    """Return the aspect of a projector's pixels that is nearest to the measured one."""
    return min(ASPECTS, key=lambda each: abs(np.log(aspect / each)))


def _describe_wrong_period(e: Evidence, axis: Axis) -> str:
    """Describe how the period of an axis differs from its description; "" where it does not, or is
    not measured."""
    axes = [pose.axes[axis] for pose in list_ordered_poses(e) if axis in pose.axes]
    periods = np.array([a.period_seen_px for a in axes if np.isfinite(a.period_seen_px)])
    if len(periods) < 3:
        return ""
    described, measured = float(np.median([a.period_px for a in axes])), float(np.median(periods))
    sigma = 1.2533 * robust_sigma(periods) / np.sqrt(len(periods))  # of a median
    is_wrong = (
        abs(measured / described - 1) > MAX_PERIOD_ERROR
        and abs(measured - described) > PERIOD_SIGMAS * sigma
        and CODE_ORIGIN_PX * abs(described / measured - 1) > RIPPLE_PEAK * max_ripple_px(e)
    )
    return f"{axis}: {measured:.1f} px measured, {described:g} px described" if is_wrong else ""


def diagnose_description(e: Evidence) -> Iterator[Finding]:
    """Yield the contradictions between frames and description that no other rule explains."""
    first = {
        pose.name: pose.findings[0]
        for pose in list_ordered_poses(e)
        if pose.refused and pose.findings and pose.findings[0].severity == "rejected"
    }
    for cause in dict.fromkeys(finding.cause for finding in first.values()):
        if cause in _CAUSES_IN_POSES:
            continue
        # Codes beyond the projector may be those of another axis or of another period.
        if cause in _SYMPTOMS and (
            any(diagnose_mirroring(e)) or any(f.severity == "rejected" for f in diagnose_period(e))
        ):
            continue
        names = tuple(name for name, finding in first.items() if finding.cause == cause)
        shown = first[names[0]]
        yield replace(
            shown,
            severity=rate_severity(e, names, is_excluded=True),
            sentence=f"{format_poses(e, names)} {shown.sentence}",
            poses=names,
        )


def _diagnose_cells(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where camera and projector share an aspect that is not of their pixels."""
    if e.solution is None or e.tilts_undetermined:
        return
    camera, projector = e.solution.aspects
    projector /= _nearest_aspect(projector / camera)
    if min(abs(camera - 1), abs(projector - 1)) > MAX_ASPECT_ERROR > abs(projector / camera - 1):
        yield Finding(
            "board-size",
            "doubtful",
            "camera and projector alike appear to have pixels of another aspect: seen upright, the"
            f" board's cells are {np.sqrt(camera * projector):.2f} times as high as wide",
            "measure the board's pitch along both directions, and use a board whose cells are"
            " square",
        )


def diagnose_board_size(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where the board's cells are not square, and where most poses show a board of
    other columns and rows than those given."""
    yield from _diagnose_cells(e)
    kind, _, rest = e.board.partition(":")
    grids = Counter(pose.grid for pose in e.poses if pose.grid is not None and pose.refused)
    if kind != "circles" or not grids:
        return
    grid, count = grids.most_common(1)[0]
    given = rest.split(":")[0]
    if count < COMMON_SHARE * len(e.poses) or sorted(map(int, given.split("x"))) == sorted(grid):
        return
    yield Finding(
        "board-size",
        "rejected",
        f"{count} of {len(e.poses)} poses show a board of {grid[0]}x{grid[1]} circles, and {given}"
        " was given",
        f"give the board as circles:{grid[0]}x{grid[1]}:{rest.split(':', 1)[-1]}",
        tuple(pose.name for pose in e.poses if pose.grid == grid),
    )


def max_ripple_px(e: Evidence) -> float:
    """Return the larger RMS, in px, of both axes' residuals that repeat with the fringe; 0 where
    not measured.

    The larger one, as an axis hides them where a camera pixel covers much of a fringe.
    """
    return (
        max((ripple.rms_px for ripple in e.solution.ripple.values()), default=0.0)
        if e.solution
        else 0.0
    )


def diagnose_ripple(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where residuals repeat with the fringe and matter: the fringe is not
    sinusoidal."""
    ripples = {
        axis: r for axis, r in (e.solution.ripple if e.solution else {}).items() if r.matters
    }
    if not ripples:
        return
    axis, worst = max(ripples.items(), key=lambda item: item[1].rms_px)
    steps = min((a.steps for p in e.poses for a in p.axes.values() if a.steps), default=0)
    observation = (
        f"the phase has an error that repeats {worst.waves} times a fringe period"
        f" ({worst.rms_px:.2f} px RMS in {axis}, {worst.rms_px * worst.mm_per_px:.3f} mm in depth;"
        f" the noise of a point is {worst.noise_px:.2f} px,"
        f" {worst.noise_px * worst.mm_per_px:.3f} mm)"
    )
    if steps and worst.waves % steps == 0:
        yield Finding(
            "gamma",
            "doubtful",
            f"{observation}, as where the light does not grow evenly with the grey level (gamma)"
            f" and is read with {steps} phase steps",
            "set the gamma of projector and camera to 1, or let the preflight make light linear,"
            " and take eight phase steps or more",
        )
    else:
        yield Finding(
            "residuals",
            "doubtful",
            f"{observation}, as where exposure or light changes from frame to frame",
            "lock exposure, gain and white balance, switch off ambient light, and capture again",
        )


def _list_aliased_gamma_poses(e: Evidence) -> tuple[str, ...]:
    """List the poses in which gamma shifts the phase of three or four steps; empty unless they are
    the majority."""
    names = tuple(pose.name for pose in e.poses if any(f.cause == "gamma" for f in pose.findings))
    return names if len(names) > COMMON_SHARE * len(e.poses) else ()


def diagnose_gamma(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where the light is not linear in the grey level (gamma)."""
    if names := _list_aliased_gamma_poses(e):
        yield Finding(
            "gamma",
            "doubtful",
            f"{format_poses(e, names)} the light does not grow evenly with the grey level (gamma),"
            " which few phase steps do not average out: the phase was corrected as far as this"
            " could be measured",
            "set the projector's gamma to 1, or let the preflight make light linear, and take eight"
            " phase steps or more",
            names,
        )
        return
    ratios = [
        a.harmonic
        for p in list_ordered_poses(e)
        for a in p.axes.values()
        if np.isfinite(a.harmonic)
    ]
    if not ratios:
        return
    exponent = gamma_from_harmonic(float(np.median(ratios)))
    if 1 / MAX_GAMMA < exponent < MAX_GAMMA:
        return
    steps = min(a.steps for p in e.poses for a in p.axes.values() if np.isfinite(a.harmonic))
    yield Finding(
        "gamma",
        "doubtful",
        "the projector's light does not grow evenly with the grey level (gamma about"
        f" {exponent:.1f}), which {steps} phase steps"
        f" {'average out' if steps >= 8 else 'do not average out'}",
        "set the projector's gamma to 1, or let the preflight make light linear"
        + (
            ", and keep to eight phase steps or more"
            if steps >= 8
            else ", and take eight phase steps or more"
        ),
    )
