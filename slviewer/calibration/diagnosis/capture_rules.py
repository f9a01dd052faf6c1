"""Causes that lie in how poses were captured, or in how their frames are described."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from slviewer.calibration.diagnosis.evidence import Evidence
from slviewer.calibration.diagnosis.frames import gamma_from_harmonic
from slviewer.calibration.diagnosis.poses import COMMON_SHARE, ORDERS, frame_order, list_poses, severity_of, was_refused
from slviewer.calibration.diagnosis.verdict import CAUSES, Cause, Finding, Severity

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
"""Times the RMS of a ripple: about its largest value, by which the phase there may be off."""

_ORDER_REMEDY: dict[Cause, str] = {
    "frame-lag": "let the camera wait longer after each pattern (the preflight measures the delay), and capture again",
    "missing-frame": "trigger the camera by the projector or wait longer for each frame, and capture again; of "
    "imported frames, look for the file that is missing",
    "frame-order": "run the preflight, and capture again",
}


def find_frame_faults(e: Evidence) -> Iterator[Finding]:
    """Frames that lag, are lost or out of order, by what most explains them."""
    orders = {pose.name: order for pose in e.poses if (order := frame_order(pose))}
    for cause in ORDERS:
        names = tuple(name for name, order in orders.items() if order == cause)
        if names:
            is_excluded = all(name in e.set_aside or was_refused(e, name) for name in names)
            yield Finding(
                cause,
                severity_of(e, names, is_excluded),
                f"{list_poses(e, names)} {ORDERS[cause]}",
                _ORDER_REMEDY[cause],
                names,
            )


def find_saturation(e: Evidence) -> Iterator[Finding]:
    """Boards that clip."""
    shares = {pose.name: max((a.saturated for a in pose.axes.values()), default=0.0) for pose in e.poses}
    names = tuple(name for name, share in shares.items() if share > MAX_SATURATED)
    if not names:
        return
    usual = float(np.median([shares[name] for name in names]))
    severity: Severity = "doubtful" if len(names) > 0.25 * len(e.poses) else "note"
    if len(names) >= COMMON_SHARE * len(e.poses) and (usual > REJECTED_SATURATED or e.solution is None):
        severity = "rejected"
    yield Finding(
        "saturation",
        severity,
        f"{list_poses(e, names)} {100 * usual:.0f} % of the board's illuminated pixels are saturated",
        "lower the exposure or the gain until white stays below the camera's full scale, and capture again",
        names,
    )


def find_mirroring(e: Evidence) -> Iterator[Finding]:
    """Axes exchanged or reversed: the projector coordinates are a mirror image of the camera's."""
    turns = [(pose.name, np.array(pose.turn)) for pose in e.poses if pose.turn is not None and not frame_order(pose)]
    turned = [(name, turn) for name, turn in turns if np.linalg.det(turn) < 0]
    if len(turned) <= COMMON_SHARE * len(turns):
        return
    mean = np.mean([turn / np.linalg.norm(turn, axis=1, keepdims=True) for _, turn in turned], axis=0)
    names = tuple(name for name, _ in turned)
    seen = (
        f"in {len(turned)} of {len(turns)} poses the projector's coordinates are a mirror image of what the camera sees"
    )
    if classify_mirroring(mean) == "axes-swapped":
        yield Finding(
            "axes-swapped",
            "rejected",
            f"{seen}, as if x and y were exchanged",
            "exchange the x and y (V and H) frames in the description of the sequence, or in the projector",
            names,
        )
    else:
        axis = "x" if mean[0, 0] < 0 else "y"
        across, mode = ("left and right", "rear or mirror") if axis == "x" else ("top and bottom", "flip")
        yield Finding(
            "axis-reversed",
            "rejected",
            f"{seen}, as if its {axis} axis were reversed ({across})",
            f"switch off the projector's {mode} mode, or number its {'columns' if axis == 'x' else 'rows'} from the "
            "other end",
            names,
        )


def classify_mirroring(turn: np.ndarray) -> Cause:
    """Of a mirrored (2, 2) turn from camera to projector: which exchange leaves devices that stand upright."""
    reversed_, swapped = abs(turn[0, 0]) + abs(turn[1, 1]), abs(turn[0, 1]) + abs(turn[1, 0])
    return "axes-swapped" if swapped > reversed_ else "axis-reversed"


def find_wrong_period(e: Evidence) -> Iterator[Finding]:
    """A fringe period that is not the one described."""
    if e.contradiction:
        sentence, _, remedy = e.contradiction.partition(": ")
        yield Finding("fringe-period", "rejected", sentence, remedy or "correct the sequence's description")
        return
    if any(find_mirroring(e)):  # the code is of another axis, or from its other end
        return
    if _aliased_gamma_poses(e):  # it moves the phase at which the code begins
        return
    sound = [pose for pose in e.poses if not frame_order(pose)]
    wrong = {}
    for axis in ("x", "y"):
        seen = np.array([p.axes[axis].period_seen_px for p in sound if axis in p.axes])
        seen = seen[np.isfinite(seen)]
        if len(seen) < 3:
            continue
        said = float(np.median([p.axes[axis].period_px for p in sound if axis in p.axes]))
        middle = float(np.median(seen))
        sigma = 1.4826 * 1.2533 * float(np.median(np.abs(seen - middle))) / np.sqrt(len(seen))
        if (
            abs(middle / said - 1) > MAX_PERIOD_ERROR
            and abs(middle - said) > PERIOD_SIGMAS * sigma
            and CODE_ORIGIN_PX * abs(said / middle - 1) > RIPPLE_PEAK * ripple_px(e)
        ):
            wrong[axis] = (said, middle)
    if wrong:
        both = " and ".join(
            f"{axis}: {seen:.1f} px measured, {said:g} px described" for axis, (said, seen) in wrong.items()
        )
        yield Finding(
            "fringe-period",
            "rejected",
            f"the fringes do not have the period that the sequence's description gives ({both}), by where the Gray "
            "code's edges fall in them",
            "correct period_px in the description, or project the patterns without scaling",
        )
    elif e.solution is not None and e.solution.aspect > 0 and not e.tilts_undetermined:
        ratio = min((e.solution.aspect / a for a in ASPECTS), key=lambda r: abs(np.log(r)))
        if abs(ratio - 1) > MAX_ASPECT_ERROR:
            yield Finding(
                "fringe-period",
                "doubtful",
                f"the projector's rows appear {e.solution.aspect:.2f} times as dense as its columns, as no pixels are",
                "compare the fringe period of each axis with its description, and turn off the projector's scaling",
            )


def find_wrong_description(e: Evidence) -> Iterator[Finding]:
    """Contradictions between frames and description that no other rule explains."""
    first = {pose.name: pose.contradictions[0] for pose in e.poses if pose.contradictions and not frame_order(pose)}
    for cause in dict.fromkeys(contradiction.cause for contradiction in first.values()):
        if cause not in CAUSES or cause in _CAUSES_IN_POSES:
            continue
        # Codes beyond the projector may be those of another axis or of another period.
        if cause in _SYMPTOMS and (
            any(find_mirroring(e)) or any(f.severity == "rejected" for f in find_wrong_period(e))
        ):
            continue
        names = tuple(name for name, contradiction in first.items() if contradiction.cause == cause)
        sentence, _, remedy = first[names[0]].message.rpartition(": ")
        yield Finding(
            cause, severity_of(e, names, is_excluded=True), f"{list_poses(e, names)} {sentence}", remedy, names
        )


def find_wrong_board_size(e: Evidence) -> Iterator[Finding]:
    """A board of other columns and rows than those given, in most of the poses."""
    kind, _, rest = e.board.partition(":")
    seen = Counter(pose.grid for pose in e.poses if pose.grid is not None and pose.refused)
    if kind != "circles" or not seen:
        return
    grid, count = seen.most_common(1)[0]
    given = rest.split(":")[0]
    if count < COMMON_SHARE * len(e.poses) or sorted(map(int, given.split("x"))) == sorted(grid):
        return
    yield Finding(
        "board-size",
        "rejected",
        f"{count} of {len(e.poses)} poses show a board of {grid[0]}x{grid[1]} circles, and {given} was given",
        f"give the board as circles:{grid[0]}x{grid[1]}:{rest.split(':', 1)[-1]}",
        tuple(pose.name for pose in e.poses if pose.grid == grid),
    )


def ripple_px(e: Evidence) -> float:
    """px, RMS: residuals that repeat with the fringe, on the axis where they are larger: where a camera pixel covers
    much of a fringe, its axis hides them; 0 where they are not known."""
    return max((found.rms_px for found in e.solution.ripple.values()), default=0.0) if e.solution else 0.0


def find_ripple(e: Evidence) -> Iterator[Finding]:
    """Residuals that repeat with the fringe and exceed the samples' noise: the light is no cosine of the pattern."""
    found = {axis: r for axis, r in (e.solution.ripple if e.solution else {}).items() if r.rms_px > r.noise_px}
    if not found:
        return
    axis, worst = max(found.items(), key=lambda item: item[1].rms_px / item[1].noise_px)
    steps = min((a.steps for p in e.poses for a in p.axes.values() if a.steps), default=0)
    seen = (
        f"the phase has an error that repeats {worst.waves} times a fringe period ({worst.rms_px:.2f} px RMS in "
        f"{axis}, beside {worst.noise_px:.2f} px of predicted noise)"
    )
    if steps and worst.waves % steps == 0:
        yield Finding(
            "gamma",
            "doubtful",
            f"{seen}, as where the light does not grow evenly with the grey level (gamma) and is read with {steps} "
            "phase steps",
            "set the gamma of projector and camera to 1, or let the preflight make light linear, and take eight phase "
            "steps or more",
        )
    else:
        yield Finding(
            "residuals",
            "doubtful",
            f"{seen}, as where exposure or light changes from frame to frame",
            "lock exposure, gain and white balance, switch off ambient light, and capture again",
        )


def _aliased_gamma_poses(e: Evidence) -> tuple[str, ...]:
    """Poses in which gamma shifts the phase of three or four steps; empty unless they are most of them."""
    names = tuple(pose.name for pose in e.poses if any(s.fault == "gamma" for s in pose.suspects))
    return names if len(names) > COMMON_SHARE * len(e.poses) else ()


def find_gamma(e: Evidence) -> Iterator[Finding]:
    """Light that does not grow evenly with the grey level."""
    if names := _aliased_gamma_poses(e):
        yield Finding(
            "gamma",
            "doubtful",
            f"{list_poses(e, names)} the light does not grow evenly with the grey level (gamma), which few phase steps "
            "do not average out: the phase was corrected as far as this could be measured",
            "set the projector's gamma to 1, or let the preflight make light linear, and take eight phase steps or "
            "more",
            names,
        )
        return
    ratios = [a.harmonic for p in e.poses if not frame_order(p) for a in p.axes.values() if np.isfinite(a.harmonic)]
    if not ratios:
        return
    exponent = gamma_from_harmonic(float(np.median(ratios)))
    if 1 / MAX_GAMMA < exponent < MAX_GAMMA:
        return
    steps = min(a.steps for p in e.poses for a in p.axes.values() if np.isfinite(a.harmonic))
    yield Finding(
        "gamma",
        "doubtful",
        f"the projector's light does not grow evenly with the grey level (gamma about {exponent:.1f}), which {steps} "
        f"phase steps {'average out' if steps >= 8 else 'do not average out'}",
        "set the projector's gamma to 1, or let the preflight make light linear"
        + (", and keep to eight phase steps or more" if steps >= 8 else ", and take eight phase steps or more"),
    )
