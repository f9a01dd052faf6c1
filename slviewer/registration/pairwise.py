"""Pairwise registration: point-to-plane ICP, coarse to fine, with checks of the result.

A registration is refused, with the reason, unless the surfaces agree where they face each other,
enough of the scan overlaps, the shape of the overlap or a small feature on it determines all six
degrees of freedom (a plane slides on a plane, a sphere turns in a sphere), and no other pose fits
as well.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slviewer.geometry.rigid import Floats, Uncertainty, move_points
from slviewer.geometry.vectors import rms, subsample
from slviewer.registration.markers import MOVED_SHARE, MarkerPose
from slviewer.registration.open3d_loader import align_icp, open3d
from slviewer.registration.refine import (
    WORDS,
    Freedom,
    LooseMotions,
    RefinedPose,
    estimate_freedom,
    refine_pose,
)
from slviewer.registration.refusal import Refused
from slviewer.registration.scan import PreparedScan
from slviewer.registration.small_feature import hold_by_feature
from slviewer.registration.start import SEARCHED, Candidate, Start, pose_distance, search_starts

Progress = Callable[[float], None]

LEVELS = ((1 / 50, 4 / 50), (1 / 100, 1 / 50))
"""Voxel and gate over the object's size, coarse to fine; the last stage, ``refine``, goes on from
there."""
LAST_GATE = 1 / 100
LEAST_OVERLAP = 0.15
LEAST_AGREEMENT = 0.8
MOST_ATTEMPTS = 3
MOST_SLACK = 1 / 30  # of the object's size
_SLIGHT = 0.2
"""Share of that slack from which a small feature holds the pose better than all points do."""
LEAST_MARKERS = 2
"""In common, without overlap: of one alone nobody could tell that it was moved."""
MOST_MARKER_ERROR = 1 / 300
"""Of the object's size: what markers alone may leave open at its rim (1 sigma)."""
RIVAL_SCORE, RIVAL_OVERLAP, RIVAL_RMS, RIVAL_GATES = 0.7, 0.6, 1.25, 2.0
"""A rival comes to so much of the best pose's score and overlap, to at most so many times its RMS,
and lies more than so many gates away."""
DECISIVE = 10.0
"""A given start decides between poses that fit alike where the others are so many times as far from
it."""
_STATISTICS_POINTS = 50_000


@dataclass(frozen=True)
class Registration:
    """The pose of a scan on a reference, and its figures.

    ``T_reference_scan`` (4, 4) maps scan points into the reference frame, in mm. ``rms_mm`` is the
    root mean square of the point-to-plane distances (along the reference's normal) of the
    overlapping points; it holds the noise of both scans. ``inlier_rmse_mm`` is the same of
    point-to-point distances, as Open3D counts it and the Letter reports it: it also holds the
    spacing of the points. Overlapping are the scan points that have a reference point within
    ``gate_mm``; ``overlap`` is their share. ``agreement`` is the share, among the scan points that
    face the reference within four gates, of those within one. ``slack_mm`` says how well the shape
    holds the pose: how far the scan would have to slide or turn (at the overlap's rim) in its
    loosest direction until the surfaces come apart by ``rms_mm``. It is large for planes and
    spheres, and always far larger than the pose's error, which ``uncertainty`` estimates.
    ``rival_mm``: distance of another pose that fits as well, so that the start alone decides.
    """

    T_reference_scan: Floats
    rms_mm: float
    inlier_rmse_mm: float
    overlap: float
    agreement: float
    slack_mm: float
    gate_mm: float
    start: Start
    uncertainty: Uncertainty
    rival_mm: float | None = None


def register_prepared(
    scan: PreparedScan,
    reference: PreparedScan,
    size: float,
    start: Candidate | list[Candidate] | None,
    markers: MarkerPose | None = None,
    progress: Progress = lambda share: None,
) -> Registration:
    """Align a scan with a reference that shows part of the same object, of ``size`` mm.

    ``start``: the initial pose, or the result of an earlier ``search_starts``, which is run
    otherwise. ``markers``: those that both scans show, from whose pose it starts, and which hold
    what the shape leaves open; alone, where the surfaces do not overlap. ``progress`` receives the
    share of the work done, 0 to 1, and may raise to cancel.

    Raises ``Refused`` where nothing aligns, where too little overlaps, where neither the shape nor
    a small feature holds the pose, or where a second pose fits alike, between which a given start
    does not decide.
    """
    if markers is not None:
        progress(0.4)
        return _register_by_markers(scan, reference, markers, size)
    starts = start if isinstance(start, list) else search_starts(scan, reference, size, start)
    refusals: list[Refused] = []
    given = start if isinstance(start, Candidate) else None
    for attempt, candidate in enumerate(starts[:MOST_ATTEMPTS]):
        progress(0.4 + 0.15 * attempt)
        result, freedom = _align_start(scan, reference, candidate, size)
        refusal = None
        try:
            _refuse_if_doubtful(result, freedom, size)
        except Refused as error:
            refusals.append(error)
            refusal = error
            if error.reason not in WORDS:
                continue
        limit = MOST_SLACK * size
        if freedom.loosest_mm > _SLIGHT * limit:
            loose = freedom.loose_motions(min(limit, freedom.loosest_mm))
            held = _hold_by_feature(scan, reference, result, loose, size, given)
            if held is not None:
                progress(1.0)
                return held
        # the surfaces agree, and every other start would slide or turn as well
        if refusal is not None:
            break
        if not candidate.is_decided:
            others = starts[attempt + 1 : MOST_ATTEMPTS + 1]
            if candidate.start not in SEARCHED:
                others = search_starts(scan, reference, size)[: MOST_ATTEMPTS + 1]
            rival = _find_rival(scan, reference, result, candidate.score, others, size)
            if rival is not None:
                result = replace(result, rival_mm=_check_rival(scan, result, rival, given))
        progress(1.0)
        return result
    raise refusals[0]  # the best start's refusal says most


def _register_by_markers(
    scan: PreparedScan, reference: PreparedScan, markers: MarkerPose, size: float
) -> Registration:
    """Register scans from the pose of their common markers: by surfaces and markers where the
    surfaces overlap, else by the markers alone. Raises ``Refused`` where the surfaces contradict
    them, and where they do not determine the pose.
    """
    try:
        return _refine_start(scan, reference, Candidate(markers.T, "markers"), size, markers)
    except Refused as refusal:
        if refusal.reason != "overlap":
            raise
    uncertainty = markers.uncertainty
    error = float(np.hypot(uncertainty.shift_mm, np.radians(uncertainty.turn_deg) * size / 2))
    if len(markers.ids) < LEAST_MARKERS or not error <= MOST_MARKER_ERROR * size:
        raise Refused(
            "overlap",
            f"The scans hardly overlap, and the markers that both show ({len(markers.ids)}) leave"
            f" {error:.2g} mm open: let both see three markers or more, well apart.",
        )
    gate = max(MOVED_SHARE * size, 2.0 * reference.spacing)
    pose = RefinedPose(markers.T, gate, uncertainty)
    figures, _ = _compute_figures(scan, reference, pose, "markers")
    return replace(
        figures, rms_mm=markers.rms_mm, inlier_rmse_mm=markers.rms_mm, agreement=1.0, slack_mm=error
    )


def _refine_start(
    scan: PreparedScan,
    reference: PreparedScan,
    start: Candidate,
    size: float,
    markers: MarkerPose | None = None,
) -> Registration:
    """Run ICP from an initial pose, and compute its figures; raises ``Refused`` where the result is
    not reliable."""
    result, held = _align_start(scan, reference, start, size, markers)
    _refuse_if_doubtful(result, None if markers is not None else held, size)
    return result


def _align_start(
    scan: PreparedScan,
    reference: PreparedScan,
    start: Candidate,
    size: float,
    markers: MarkerPose | None = None,
) -> tuple[Registration, Freedom]:
    """Run ICP from an initial pose, and compute its figures and the freedom of the overlap."""
    T = start.T
    # of the distance of two corresponding points
    noise = float(np.hypot(scan.sigma_mm or 0.0, reference.sigma_mm or 0.0))
    for voxel, gate in LEVELS:
        widest = max(gate * size, 2.0 * max(scan.spacing, reference.spacing), 3.0 * noise)
        # else it starts within a fraction of a millimetre, and a plane would slide
        if markers is None:
            loss = open3d().pipelines.registration.TukeyLoss(0.5 * widest)
            thinned = scan.thinned(voxel * size), reference.thinned(voxel * size)
            T = align_icp(*thinned, T, widest, loss, 1e-6, 40)
    narrowest = max(LAST_GATE * size, 3.0 * noise)
    pose = refine_pose(scan, reference, T, widest, narrowest, markers)
    return _compute_figures(scan, reference, pose, start.start)


def _hold_by_feature(
    scan: PreparedScan,
    reference: PreparedScan,
    result: Registration,
    loose: LooseMotions,
    size: float,
    start: Candidate | None,
) -> Registration | None:
    """Return the registration of scans whose shape does not hold the pose, by a small feature; None
    where there is none. A given ``start`` chooses between poses that fit alike; raises ``Refused``
    where it does not."""
    pose = RefinedPose(result.T_reference_scan, result.gate_mm, result.uncertainty)
    held = []
    for each in hold_by_feature(scan, reference, pose, loose, size):
        figures, _ = _compute_figures(scan, reference, each, result.start)
        if figures.overlap >= LEAST_OVERLAP and figures.agreement >= LEAST_AGREEMENT:
            held.append(figures)
    if not held:
        return None
    points = scan.fine_points
    if start is not None:
        held.sort(key=lambda each: pose_distance(points, start.T, each.T_reference_scan))
    best = held[0]
    for rival in held[1:]:
        gap = pose_distance(points, best.T_reference_scan, rival.T_reference_scan)
        if gap > RIVAL_GATES * best.gate_mm and _is_alike(rival, best):
            if start is not None and start.is_decided:
                break
            return replace(best, rival_mm=_check_rival(scan, best, rival, start))
    return best


def _is_alike(rival: Registration, result: Registration) -> bool:
    """Whether a rival overlaps and fits about as well as a result."""
    return (
        rival.overlap >= RIVAL_OVERLAP * result.overlap
        and rival.rms_mm <= RIVAL_RMS * result.rms_mm
    )


def _compute_figures(
    scan: PreparedScan, reference: PreparedScan, pose: RefinedPose, start: Start
) -> tuple[Registration, Freedom]:
    """Compute the figures of a pose from up to 50,000 scan points, and the freedom of the
    overlap."""
    T, spacing = pose.T, reference.spacing
    gate = max(pose.gate_mm, 2.0 * spacing)
    points = move_points(T, subsample(scan.points, _STATISTICS_POINTS))
    distance, nearest = reference.tree.query(points, distance_upper_bound=4.0 * gate, workers=-1)
    near = np.isfinite(distance)
    points, distance, counterpart = points[near], distance[near], reference.points[nearest[near]]
    _, plane = reference.fine_tree.query(counterpart, workers=-1)
    height = np.abs(np.sum(reference.fine_normals[plane] * (points - counterpart), axis=1))

    overlapping = distance < gate
    lateral = np.sqrt(np.maximum(distance**2 - height**2, 0.0))
    facing = lateral < spacing + 0.25 * height  # a point beyond the reference's rim faces nothing
    error = rms(height[overlapping])
    held = estimate_freedom(scan, reference, T, counterpart[overlapping], error)
    figures = Registration(
        T_reference_scan=T,
        rms_mm=error,
        inlier_rmse_mm=rms(distance[overlapping]),
        overlap=float(overlapping.sum() / near.size),
        agreement=float((facing & (height < gate)).sum() / max(1, facing.sum())),
        slack_mm=held.loosest_mm,
        gate_mm=gate,
        start=start,
        uncertainty=pose.uncertainty,
    )
    return figures, held


def _refuse_if_doubtful(result: Registration, held: Freedom | None, size: float) -> None:
    """Raise ``Refused`` for too small an overlap or agreement, or a shape that leaves the pose
    undetermined.

    ``held``: None where markers determine the pose.
    """
    if not result.overlap >= LEAST_OVERLAP:
        raise Refused(
            "overlap",
            f"Only {100 * result.overlap:.0f} % of the scan lies on the reference within"
            f" {result.gate_mm:.2g} mm: take scans that share at least {100 * LEAST_OVERLAP:.0f} %"
            " of the surface, or choose another reference.",
        )
    if not result.agreement >= LEAST_AGREEMENT:
        raise Refused(
            "disagree",
            "No pose found in which the two scans agree: where they face each other only"
            f" {100 * result.agreement:.0f} % of the points come within {result.gate_mm:.2g} mm;"
            " check that both show the same object, and that it did not change between the scans.",
        )
    shape = None if held is None else held.shape(MOST_SLACK * size)
    if shape is not None or not np.isfinite(result.uncertainty.shift_mm):
        shape = shape or "plane"
        raise Refused(
            shape,
            f"The surface that the two scans share {WORDS[shape]}, so that nothing holds the pose:"
            " let them share edges, corners or bumps too, or put coded markers on it or beside it,"
            " and start from markers.",
        )


def _find_rival(
    scan: PreparedScan,
    reference: PreparedScan,
    result: Registration,
    score: float,
    others: list[Candidate],
    size: float,
) -> Registration | None:
    """Return the result of ICP from the first of the ``others`` that ends at a different pose, and
    fits as well; ``score``: of the result's own start."""
    nearest, T = RIVAL_GATES * result.gate_mm, result.T_reference_scan
    for other in others:
        is_same = pose_distance(scan.fine_points, T, other.T) <= nearest
        if is_same or not other.score >= RIVAL_SCORE * score:
            continue
        try:
            rival = _refine_start(scan, reference, other, size)
        except Refused:
            continue
        gap = pose_distance(scan.fine_points, T, rival.T_reference_scan)
        distinct = gap > max(nearest, 10.0 * result.uncertainty.shift_mm)
        if distinct and _is_alike(rival, result):
            return rival
    return None


def _check_rival(
    scan: PreparedScan, result: Registration, rival: Registration, start: Candidate | None
) -> float:
    """Return how far, mm, a rival lies from a result; raises ``Refused`` unless the given ``start``
    decides between the two."""
    poses = result.T_reference_scan, rival.T_reference_scan
    gap = pose_distance(scan.fine_points, *poses)
    undecided = ""
    if start is not None:
        near, far = (pose_distance(scan.fine_points, start.T, T) for T in poses)
        if far > DECISIVE * near:
            return gap
        undecided = (
            f"; the given start, {near:.1f} and {far:.1f} mm from them, does not decide between"
            " the two"
        )
    raise Refused(
        "ambiguous",
        f"Two poses fit alike, with an RMS of {result.rms_mm:.3f} and {rival.rms_mm:.3f} mm"
        f" over {100 * result.overlap:.0f} and {100 * rival.overlap:.0f} % of the scan, and"
        f" they lie {gap:.0f} mm apart{undecided}: put coded markers on the object or beside it"
        " and start from markers, pick three point pairs, or give the turntable's angle.",
    )
