"""Rules that turn the evidence of a calibration into findings, and the order in which they are
applied.

A rule yields the findings of one cause. Faults of the frames come first, as nothing that follows
can be trusted; then wrong descriptions; then single poses; then the set of poses as a whole. The
stages after a rejecting finding are not run, as their findings could be its consequences.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from msgspec import structs

from slviewer.calibration.diagnosis.evidence import Evidence, PoseEvidence, SolutionEvidence
from slviewer.calibration.known_camera import MAX_FOCAL_UNCERTAINTY, CameraCheck, judge_camera
from slviewer.calibration.observe import AXES
from slviewer.calibration.pixelwise import POSES_FOR_PIXELWISE
from slviewer.calibration.splined.residual_noise import Noise
from slviewer.calibration.squareness import judge_squareness, nearest_aspect
from slviewer.calibration.stereo import (
    MAX_FOCAL_SIGMA,
    MIN_POSES,
    MIN_TILT_SPREAD_DEG,
    describe_telecentric,
)
from slviewer.examination.findings import mirroring_remedy, reversed_axis
from slviewer.fringe.response import gamma_from_harmonic
from slviewer.fringe.sequence import Axis
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.vectors import unit_vectors
from slviewer.records.verdict import Cause, Finding, Severity, Verdict

COMMON_SHARE = 0.5
"""Least share of the poses with which a fault counts as common to all."""
FEW_POSES = 6
"""A calibration from fewer poses is doubtful."""
FEW_POSES_OF_PROJECTOR = 4
"""The same beside a fixed camera: one pose more than the least shows which one is wrong."""
MOTION_LIMITS_PX = (0.12, 0.3)
"""Least and largest value of the limit beyond which a board has moved."""
_MOTION_RATIO = 5.0  # of that limit over the poses' median motion
_RESIDUAL_RATIO = 4.0  # of the largest plausible residual over the poses' median
MAX_SATURATED = 0.12
REJECTED_SATURATED = 0.3
MAX_GAMMA = 1.5
MAX_PERIOD_ERROR = 0.04
PERIOD_SIGMAS = 4.0
MAX_ASPECT_ERROR = 0.05
_CAUSES_IN_POSES = ("axes-swapped", "axis-reversed", "saturation")
_SYMPTOMS = ("projector-size", "fringe-period", "unreadable")
CODE_ORIGIN_PX = 0.5
"""px from column 0: the origin of most Gray codes, whose phase gives the fringe's true period."""
RIPPLE_PEAK = 2.0
"""Peak of a ripple over its RMS."""
MIN_TILT_DEG = 15.0
HIGH_REPROJECTION_PX = 1.0
DOUBTFUL_RATIO = 4.0
"""Ratio of residuals to predicted noise. It is 0.5 to 1.1 on clean simulated rigs with local
distortion, and 0.8 on real Gray code. Noise that is correlated between pixels, as after demosaicing
or compression, raises it to less than 4: it would be 5 if the 5 by 5 camera pixels of a block had
identical noise."""
EXPLAINING_CAUSES = ("gamma", "saturation", "moved", "frame-lag", "frame-order", "missing-frame")
REJECTED_RATIO = 25.0
REJECTED_PX = 1.0
"""Beyond both limits the phases contradict the geometry, whatever the noise."""

ORDERS: dict[Cause, tuple[str, str]] = {
    "frame-lag": (
        "the camera is one image behind the projector",
        "let the camera wait longer after each pattern, or switch its buffering off (the preflight"
        " shows which), and capture again",
    ),
    "missing-frame": (
        "a frame is missing, and those that follow came too early",
        "trigger the camera by the projector or wait longer for each frame, and capture again; of "
        "imported frames, look for the file that is missing",
    ),
    "frame-order": (
        "frames show patterns that are not theirs",
        "run the preflight, and capture again",
    ),
}
"""Descriptions and remedies of the causes by which frames are out of order."""
_POSE_REMEDIES: dict[Cause, str] = {
    "board-numbering": "uncover the whole board, and capture the pose again",
    "moved": "hold the board still until all frames are captured, and capture the pose again",
    "outlier": "look at its picture, and capture the pose again",
}


def reason_to_exclude(pose: PoseEvidence, limit_px: float) -> str:
    """Return the reason to exclude a pose whose board was read; "" where it is fit.

    ``limit_px``: the largest motion of a board at rest.
    """
    match classify_unfit_pose(pose, limit_px):
        case None:
            return ""
        case "board-numbering", shown:
            return f"its {shown}: uncover the whole board, and capture the pose again"
        case "moved", shown:
            return f"{shown} during capture: hold it still, and capture the pose again"
        case _, shown:
            return f"its frames are out of order ({shown}): capture the pose again"


def classify_unfit_pose(pose: PoseEvidence, limit_px: float) -> tuple[Cause, str] | None:
    """Return the cause by which a pose is unfit, and what shows it; None where it is fit."""
    if order := classify_frame_order(pose):
        return order
    if pose.numbering:
        return "board-numbering", f"features are {pose.numbering}"
    if pose.moved_px > limit_px:
        return "moved", f"the board moved by {pose.moved_px:.2f} px"
    return None


def motion_limit_px(poses: Sequence[PoseEvidence]) -> float:
    """Estimate the largest apparent motion, in px, of a board at rest, from the median motion over
    the poses."""
    motions = [pose.moved_px for pose in poses if np.isfinite(pose.moved_px)]
    median = np.median(motions) if motions else np.inf
    return float(np.clip(_MOTION_RATIO * median, *MOTION_LIMITS_PX))


def classify_frame_order(pose: PoseEvidence) -> tuple[Cause, str] | None:
    """Return the cause by which the frames of a pose are out of order, and what they show; None
    where they are in order."""
    for finding in pose.findings:
        cause: Cause = "frame-order" if finding.cause == "duplicate-frame" else finding.cause
        if cause in ORDERS:
            return cause, finding.observation
    # the white frame, which decoding does not need
    if pose.displaced:
        cause = "frame-lag" if pose.displaced > 0 else "missing-frame"
        return cause, ORDERS[cause][0]
    return None


def list_ordered_poses(e: Evidence) -> list[PoseEvidence]:
    """List the poses whose frames are in order."""
    return [pose for pose in e.poses if not classify_frame_order(pose)]


def rate_severity(e: Evidence, names: tuple[str, ...], is_excluded: bool) -> Severity:
    """Rate a fault of the poses ``names`` by their share of all poses; ``is_excluded``: the fit
    excluded them."""
    if len(names) >= COMMON_SHARE * len(e.poses):
        return "rejected"
    is_few = e.solution is None or len(e.solution.used) < FEW_POSES
    return "doubtful" if is_few or not is_excluded or len(names) > 0.25 * len(e.poses) else "note"


def format_poses(e: Evidence, names: tuple[str, ...]) -> str:
    """Format the poses of a finding for its message: "in every pose", "in pose_03", "in 4 of 12
    poses"."""
    if len(names) == len(e.poses):
        return "in every pose"
    return f"in {names[0]}" if len(names) == 1 else f"in {len(names)} of {len(e.poses)} poses"


def diagnose_frame_order(e: Evidence) -> Iterator[Finding]:
    """Yield a finding for each way in which frames are out of order: lagging, missing, or
    exchanged."""
    orders = [(pose, order[0]) for pose in e.poses if (order := classify_frame_order(pose))]
    for cause, (sentence, remedy) in ORDERS.items():
        poses = [pose for pose, each in orders if each == cause]
        if poses:
            names = tuple(pose.name for pose in poses)
            is_excluded = all(pose.refused or pose.name in e.excluded for pose in poses)
            severity = rate_severity(e, names, is_excluded)
            yield Finding(cause, severity, f"{format_poses(e, names)} {sentence}", remedy, names)


def diagnose_saturation(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where too many of the boards' pixels are saturated."""
    saturated = {
        pose.name: share
        for pose in e.poses
        if (share := max((a.saturated for a in pose.axes.values()), default=0.0)) > MAX_SATURATED
    }
    if not saturated:
        return
    names, median_share = tuple(saturated), np.median([*saturated.values()])
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
    """Yield a finding where the axes are exchanged or one is reversed: one device's image is a
    mirror image, the projector's where the board shows that the camera's is not."""
    # of projector by camera pixels
    jacobians = {pose.name: np.array(pose.turn) for pose in list_ordered_poses(e) if pose.turn}
    mirrored = {name: J for name, J in jacobians.items() if np.linalg.det(J) < 0}
    if len(mirrored) <= COMMON_SHARE * len(jacobians):
        return
    upright = [pose.upright for pose in e.poses if pose.name in mirrored]
    is_upright = sum(upright) > COMMON_SHARE * len(upright)
    shown = "the camera sees, and the board shows unmirrored" if is_upright else "the camera sees"
    mean = unit_vectors(np.array([*mirrored.values()])).mean(axis=0)
    cause: Cause = "axis-reversed"
    if (axis := reversed_axis(mean)) is None:
        cause, as_if = "axes-swapped", "x and y were exchanged"
        remedy = (
            "exchange the x and y (V and H) frames in the description of the sequence, or in the"
            " projector"
        )
    else:
        across, mode, lines = {
            "x": ("left and right", "rear or mirror", "columns"),
            "y": ("top and bottom", "flip", "rows"),
        }[axis]
        as_if = f"its {axis} axis were reversed ({across})"
        remedy = f"switch off the projector's {mode} mode"
        if is_upright:
            remedy += f", or number its {lines} from the other end"
    if not is_upright:
        remedy = mirroring_remedy(remedy)
    yield Finding(
        cause,
        "rejected",
        f"in {len(mirrored)} of {len(jacobians)} poses the projector's coordinates are a mirror"
        f" image of what {shown}, as if {as_if}",
        remedy,
        tuple(mirrored),
    )


def diagnose_period(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where the fringe period differs from its description, or the projector
    distorts its image.

    Evidence is the phase at the Gray code's edges, or the projector's aspect ratio and the angle of
    its rows and columns by the calibration.
    """
    if error := e.contradiction:
        remedy = error.remedy or "correct the sequence's description"
        yield Finding("fringe-period", "rejected", error.located_observation, remedy)
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
    elif e.solution is not None:
        yield from _judge_projected_image(e, e.solution)


def _judge_projected_image(e: Evidence, solution: SolutionEvidence) -> Iterator[Finding]:
    """Yield a finding where the projector's rows and columns, by the calibration, are not at right
    angles, or not as dense as any pixels are."""
    if e.tilts_undetermined:  # as of a telecentric lens
        return
    is_unknown = _is_focal_unknown(e)
    if (skew := solution.squareness) and skew.is_skewed:
        is_wrong = solution.reprojection_px > HIGH_REPROJECTION_PX or is_unknown
        yield Finding(
            "fringe-period",
            "rejected" if is_wrong else "doubtful",
            f"the projector's rows and columns are at {90 - skew.skew_deg:.1f}"
            f" (+- {skew.skew_limit_deg:.1f}) degrees, as a projector's are that moves the corners"
            " of its image",
            "turn off the projector's keystone and corner correction, and capture the poses again",
        )
        return
    camera, aspect = solution.aspects
    # or of a stretched board, which both devices see
    errors = [each / nearest_aspect(each) - 1 for each in (aspect, aspect / camera)]
    if min(map(abs, errors)) > MAX_ASPECT_ERROR:
        # tilts that leave no focal length unknown, unless the projector moves its image
        is_wrong = solution.tilt_spread_deg >= MIN_TILT_DEG and is_unknown
        yield Finding(
            "fringe-period",
            "rejected" if is_wrong else "doubtful",
            f"the projector's rows appear {aspect:.2f} times as dense as its columns, as no"
            " pixels are",
            "compare the fringe period of each axis with its description, and turn off the"
            " projector's scaling and its keystone correction",
        )


def _describe_wrong_period(e: Evidence, axis: Axis) -> str:
    """Describe how the period of an axis differs from its description; "" where it does not, or is
    not measured."""
    axes = [pose.axes[axis] for pose in list_ordered_poses(e) if axis in pose.axes]
    periods = np.array([a.period_seen_px for a in axes if np.isfinite(a.period_seen_px)])
    if len(periods) < 3:
        return ""
    described, measured = float(np.median([a.period_px for a in axes])), float(np.median(periods))
    sigma = 1.2533 * robust_sigma(periods) / np.sqrt(len(periods))  # of a median
    # the larger of both axes, as one hides it where a camera pixel covers much of a fringe
    ripple_px = max((ripple.rms_px for ripple in e.ripple.values()), default=0.0)
    is_wrong = (
        abs(measured / described - 1) > MAX_PERIOD_ERROR
        and abs(measured - described) > PERIOD_SIGMAS * sigma
        and CODE_ORIGIN_PX * abs(described / measured - 1) > RIPPLE_PEAK * ripple_px
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
        yield structs.replace(
            shown,
            severity=rate_severity(e, names, is_excluded=True),
            observation=f"{format_poses(e, names)} {shown.observation}",
            poses=names,
        )


def diagnose_refused_boards(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where most poses show a board that contradicts its description, or its mirror
    image."""
    misfits = [(pose.name, pose.misfit) for pose in e.poses if pose.misfit]
    for cause, count in Counter(misfit.cause for _, misfit in misfits).items():
        if count <= COMMON_SHARE * len(e.poses):
            continue
        names = tuple(name for name, misfit in misfits if misfit.cause == cause)
        first = next(misfit for _, misfit in misfits if misfit.cause == cause)
        sentence = f"{format_poses(e, names)} {first.observation}"
        yield structs.replace(first, observation=sentence, poses=names)


def diagnose_board_size(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where the board's cells are not square, and where most poses show a board of
    other columns and rows than those given."""
    if e.solution and e.solution.squareness and not e.tilts_undetermined:
        yield from judge_squareness(e.board, e.solution.squareness, e.solution.aspects[1])
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


def diagnose_ripple(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where residuals repeat with the fringe and matter: the fringe is not
    sinusoidal."""
    ripples = {axis: ripple for axis, ripple in e.ripple.items() if ripple.matters}
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
    measured = [
        (a.harmonic, a.steps)
        for p in list_ordered_poses(e)
        for a in p.axes.values()
        if np.isfinite(a.harmonic)
    ]
    if not measured:
        return
    ratios, all_steps = zip(*measured, strict=True)
    exponent, steps = gamma_from_harmonic(float(np.median(ratios))), min(all_steps)
    if 1 / MAX_GAMMA < exponent < MAX_GAMMA:
        return
    averaging, advice = ("average out", "keep to") if steps >= 8 else ("do not average out", "take")
    yield Finding(
        "gamma",
        "doubtful",
        "the projector's light does not grow evenly with the grey level (gamma about"
        f" {exponent:.1f}), which {steps} phase steps {averaging}",
        "set the projector's gamma to 1, or let the preflight make light linear, and"
        f" {advice} eight phase steps or more",
    )


def diagnose_single_poses(e: Evidence) -> Iterator[Finding]:
    """Yield a finding each for the poses that are misnumbered, that moved, and that disagree with
    the others."""
    sentences: dict[Cause, dict[str, str]] = {cause: {} for cause in _POSE_REMEDIES}
    limit_px = motion_limit_px(e.poses)
    for pose in e.poses:
        match classify_unfit_pose(pose, limit_px):
            case "board-numbering", shown:
                sentences["board-numbering"][pose.name] = f"in {pose.name} the board's {shown}"
            case "moved", shown:
                sentences["moved"][pose.name] = f"{pose.name}: {shown} while it was captured"
    if e.solution is not None:
        explained = {*e.excluded, *sentences["board-numbering"], *sentences["moved"]}
        camera_limit, projector_limit = (
            _RESIDUAL_RATIO * max(px, 0.02) for px in e.solution.median_pose_rms_px
        )
        for name, residuals in e.solution.excluded.items():
            camera, projector = min(residuals.camera_px, 999), min(residuals.projector_px, 999)
            if name in explained:
                continue
            if camera < camera_limit and projector > projector_limit:
                sentences["moved"][name] = (
                    f"{name}: the projector's coordinates are {projector:.1f} px off the board that"
                    " the camera sees: it moved while it was captured"
                )
            else:
                sentences["outlier"][name] = (
                    f"{name} disagrees with the other poses by {camera:.1f} px in the camera and"
                    f" {projector:.1f} px in the projector"
                )
    for cause, poses in sentences.items():
        if poses:
            names = tuple(poses)
            more = [f"and {len(poses) - 3} more"] * (len(poses) > 3)
            sentence = "; ".join([*poses.values()][:3] + more + ["excluded"])
            severity = rate_severity(e, names, is_excluded=e.solution is not None)
            yield Finding(cause, severity, sentence, _POSE_REMEDIES[cause], names)


def diagnose_pose_count(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where fewer poses are usable than a calibration needs; those at one place
    count once."""
    usable = [pose.name for pose in e.usable if pose.name not in e.excluded]
    count = len(e.solution.used if e.solution else usable)
    places = count
    if e.solution and e.solution.places is not None:
        places = e.solution.places
    needed = FEW_POSES_OF_PROJECTOR if e.is_camera_fixed else FEW_POSES
    if places >= needed:
        return
    refused = {pose.name: pose.refused for pose in e.poses if pose.refused}
    because = "; ".join(f"{name}: {why}" for name, why in [*refused.items()][:3])
    wanted = needed if e.is_camera_fixed else POSES_FOR_PIXELWISE
    yield Finding(
        "too-few-poses",
        "rejected" if places < MIN_POSES else "doubtful",
        f"{count} usable pose{'s' * (count != 1)} of {len(e.poses)}{because and f' ({because})'}"
        + (f", at {places} place{'s' * (places != 1)}" if places < count else ""),
        f"capture the board in more positions and tilts: {wanted} poses at least",
        tuple(refused)[:3],
    )


def diagnose_parallel_poses(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where the boards of all poses are nearly parallel; rejected also where that
    leaves a focal length unknown."""
    solved = None if e.tilts_undetermined else e.solution
    spread = solved.tilt_spread_deg if solved else e.tilt_spread_deg
    if e.is_camera_fixed or not spread < MIN_TILT_DEG or len(e.usable) < MIN_POSES:
        return
    rejected = spread < MIN_TILT_SPREAD_DEG or solved is None or e.refusal or _is_focal_unknown(e)
    if not solved and e.foreshortened_deg >= MIN_TILT_DEG:
        yield Finding("parallel-poses", "rejected", *describe_telecentric(e.foreshortened_deg))
        return
    text = (
        f"all {len(e.solution.used if e.solution else e.usable)} poses are nearly parallel "
        f"(tilts differ by {spread:.1f} degrees, and should by {MIN_TILT_DEG:.0f} at least)"
    )
    remedy = "tilt the board by 15 to 30 degrees, in different directions"
    yield Finding("parallel-poses", "rejected" if rejected else "doubtful", text, remedy)


def _is_focal_unknown(e: Evidence) -> bool:
    """Return whether the poses leave a focal length so uncertain that nothing can be measured, and
    a large reprojection error, whose consequence it may be, does not explain it."""
    if e.solution is None or e.solution.reprojection_px > HIGH_REPROJECTION_PX:
        return False
    return not all(sigma < MAX_FOCAL_SIGMA for sigma in e.solution.focal_sigma.values())


def describe_constant_pixels(constant: str) -> Finding:
    """Return the note on pixels that never change, as `ImageArea.describe` names them."""
    return Finding(
        "constant-pixels",
        "note",
        f"the light of no frame changes {constant} of the camera's image: this does not count as"
        " image",
        "see that neither a mask, a lens hood nor a video's format hides what the camera could"
        " show, and that its sensor is sound; nothing else needs to be done",
    )


def diagnose_solution(e: Evidence) -> Iterator[Finding]:
    """Yield findings on pixels that never change, on corners of the image that no pose covers, on a
    large reprojection error, and on focal lengths that the poses leave uncertain."""
    if e.solution is None:
        return
    if e.solution.constant:
        yield describe_constant_pixels(e.solution.constant)
    if e.solution.empty_corners:
        where = " and ".join(", ".join(e.solution.empty_corners).rsplit(", ", 1))
        text = f"no pose reaches the {where} of the image, where lenses bend the most"
        remedy = f"capture poses that reach into the {where}"
        yield Finding("empty-corner", "doubtful", text, remedy)
    if e.solution.reprojection_px > HIGH_REPROJECTION_PX:
        yield Finding(
            "residuals",
            "rejected" if e.refusal else "doubtful",
            f"the reprojection error is {e.solution.reprojection_px:.1f} px",
            "check that the board is flat, in focus and held still, and look at the poses with the"
            " largest residuals",
        )
    sigmas = e.solution.focal_sigma
    uncertain = {device: s for device, s in sigmas.items() if not s < MAX_FOCAL_UNCERTAINTY}
    if uncertain:
        lengths = [f"the {device}'s by {100 * sigma:.1f} %" for device, sigma in uncertain.items()]
        yield Finding(
            "uncertain",
            "rejected" if _is_focal_unknown(e) else "doubtful",
            f"the poses, whose tilts differ by {e.solution.tilt_spread_deg:.0f} degrees, leave"
            f" focal lengths uncertain: {' and '.join(lengths)}",
            "tilt the board by 15 to 30 degrees in different directions, and vary its distance",
        )


STAGES: tuple[tuple[Callable[[Evidence], Iterator[Finding]], ...], ...] = (
    (diagnose_frame_order, diagnose_saturation),
    (
        diagnose_refused_boards,
        diagnose_mirroring,
        diagnose_period,
        diagnose_description,
        diagnose_board_size,
    ),
    (
        lambda e: judge_camera(e.camera),
        diagnose_single_poses,
        diagnose_gamma,
        diagnose_ripple,
        diagnose_pose_count,
        diagnose_parallel_poses,
        diagnose_solution,
    ),
)


def judge_evidence(evidence: Evidence) -> Verdict:
    """Judge the evidence of a calibration; the verdict's findings start with the root cause."""
    findings: list[Finding] = []
    for stage in STAGES:
        findings += [finding for rule in stage for finding in rule(evidence)]
        if any(finding.severity == "rejected" for finding in findings):
            return Verdict.of(findings)
    if error := evidence.refusal:
        remedy = error.remedy or "capture the poses again, and check each before the next"
        findings.append(Finding("residuals", "rejected", error.observation, remedy))
    return Verdict.of(findings)


def judge_splined(verdict: Verdict, noise: Noise, camera: CameraCheck | None = None) -> Verdict:
    """Return the verdict with findings added where the joint adjustment's residuals exceed their
    predicted noise, and where it contradicts a fixed camera.

    The former names the first of ``EXPLAINING_CAUSES`` among the others as its probable cause.
    """
    if camera is not None:
        others = [finding for finding in verdict.findings if finding.cause != "camera-file"]
        verdict = Verdict.of([*others, *judge_camera(camera)])
    ratio, px, axis = max(zip(noise.ratio, noise.sample_px, "xy", strict=True))
    if ratio < DOUBTFUL_RATIO:
        return verdict
    known = [finding.cause for finding in verdict.findings if finding.cause in EXPLAINING_CAUSES]
    because = f" (probable cause: {known[0]}, named above)" if known else ""
    finding = Finding(
        "residuals",
        "rejected" if ratio > REJECTED_RATIO and px > REJECTED_PX else "doubtful",
        f"the residuals of the joint adjustment in {axis}, {px:.2f} px, are {ratio:.1f} times the"
        f" predicted noise{because}",
        "see that light, exposure and rig did not change while a pose was captured, that the"
        " projector scales nothing, and that its response is linear; sigmas of clouds are raised by"
        " that factor",
    )
    return Verdict.of([*verdict.findings, finding])
