"""Aligning one scan with another: point-to-plane ICP, coarse to fine, and a judgement of the result.

ICP always ends somewhere. Whether it ended at the truth is judged afterwards: where the aligned surfaces face each
other they must agree, enough of the scan must have a counterpart, and the overlapping shape must hold all six degrees
of freedom (a plane slides on a plane, a sphere turns in a sphere). What fails is refused.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError, SlviewerError
from slviewer.registration.open3d_loader import open3d
from slviewer.registration.start import Start, ranked_starts

Progress = Callable[[float], None]

LEVELS_MM = ((2.0, 8.0), (1.0, 2.0), (0.5, 1.0))  # voxel and gate for objects of 75 to 300 mm, coarse to fine
LEAST_POINTS = 500
LEAST_OVERLAP = 0.15
LEAST_AGREEMENT = 0.8
MOST_ATTEMPTS = 3
MOST_SLACK = 1 / 30  # of the object's size
_STATISTICS_POINTS = 200_000


@dataclass(frozen=True)
class Registration:
    """How a scan lies on a reference.

    ``T_reference_scan`` (4, 4) maps scan points into the reference frame, in mm. ``rms_mm`` is the root mean square of
    the point-to-plane distances (along the reference's normal) of the overlapping points; it holds the noise of both
    scans. ``inlier_rmse_mm`` is the same of point-to-point distances, as Open3D counts it and the Letter reports it: it
    also holds the spacing of the points. Overlapping are the scan points that have a reference point within
    ``gate_mm``; ``overlap`` is their share. ``agreement`` is the share, among the scan points that face the reference
    within four gates, of those within one. ``slack_mm`` says how well the shape holds the pose: how far the scan would
    have to slide or turn (at the overlap's rim) in its loosest direction until the surfaces come apart by ``rms_mm``.
    It is large for planes and spheres, and always far larger than the pose's error.
    """

    T_reference_scan: np.ndarray
    rms_mm: float
    inlier_rmse_mm: float
    overlap: float
    agreement: float
    slack_mm: float
    gate_mm: float
    start: Start


def register(
    scan_points: np.ndarray,
    reference_points: np.ndarray,
    *,
    scan_normals: np.ndarray | None = None,
    reference_normals: np.ndarray | None = None,
    sigma_mm: float | None = None,
    initial: np.ndarray | None = None,
    progress: Progress | None = None,
) -> Registration:
    """Align a scan with a reference that shows part of the same object.

    Points are ``(n, 3)`` mm without NaN, each in the frame of the camera that took it; normals ``(n, 3)`` point to that
    camera, and are estimated where missing. ``sigma_mm`` is the expected error of one point, when it is known: gates
    are never narrower than noise. ``initial`` (4, 4) replaces the search for a start. ``progress`` receives the
    share of the work done, 0 to 1, and may raise to cancel.

    Raises ``SlviewerError`` where nothing aligns, where too little overlaps, or where the shape does not hold the pose.
    """
    for name, points, normals in (
        ("scan", scan_points, scan_normals),
        ("reference", reference_points, reference_normals),
    ):
        _check(name, points, normals)
    if initial is not None and np.shape(initial) != (4, 4):
        raise InputError(f"The initial pose has shape {np.shape(initial)}: give a (4, 4) matrix.")
    say = progress or (lambda share: None)

    say(0.0)
    size = min(_size(scan_points), _size(reference_points))
    scale = 1.0 if 75.0 <= size <= 300.0 else size / (75.0 if size < 75.0 else 300.0)
    tree = cKDTree(reference_points, balanced_tree=False, compact_nodes=False)
    spacing = _spacing(tree, reference_points)
    floor = max(2.0 * spacing, 0.0 if sigma_mm is None else 4.0 * sigma_mm)
    levels = [(voxel * scale, max(gate * scale, floor)) for voxel, gate in LEVELS_MM]
    finest = max(levels[-1][0], 0.5 * spacing)
    scan = _cloud(scan_points, scan_normals, finest)
    reference = _cloud(reference_points, reference_normals, finest)

    say(0.3)
    coarse = max(size / 40.0, 2.0 * spacing)
    starts = ranked_starts(scan.voxel_down_sample(coarse), reference.voxel_down_sample(coarse), coarse, initial)
    refusal: SlviewerError | None = None
    for attempt, start in enumerate(starts[:MOST_ATTEMPTS]):
        say(0.5 + 0.15 * attempt)
        T = start.T
        for voxel, gate in levels:
            thin = [scan, reference] if voxel <= finest else [c.voxel_down_sample(voxel) for c in (scan, reference)]
            T = _icp(thin[0], thin[1], T, gate)
        result = _judge(scan_points, reference_points, tree, reference, T, levels[-1][1], spacing, size, start.start)
        try:
            _refuse_if_doubtful(result, size)
        except SlviewerError as error:
            refusal = refusal or error  # the best start's refusal says most
            continue
        say(1.0)
        return result
    assert refusal is not None
    raise refusal


def _check(name: str, points: np.ndarray, normals: np.ndarray | None) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"The {name} has shape {points.shape}: give its valid points as (n, 3).")
    if len(points) < LEAST_POINTS:
        raise InputError(f"The {name} has {len(points)} points: at least {LEAST_POINTS} are needed to align it.")
    if not np.isfinite(points).all():
        raise InputError(f"The {name} holds points that are not finite: leave out its invalid pixels first.")
    if normals is not None and normals.shape != points.shape:
        raise InputError(f"The {name} has {len(points)} points and normals of shape {normals.shape}: give one each.")


def _size(points: np.ndarray) -> float:
    """The longest side in mm of the box around the points, stray ones (1 % at each end) left out."""
    low, high = np.percentile(points[:: max(1, len(points) // 100_000)], (1.0, 99.0), axis=0)
    return float((high - low).max())


def _spacing(tree: cKDTree, points: np.ndarray) -> float:
    """Median distance in mm of a point to its nearest neighbour."""
    distance, _ = tree.query(points[:: max(1, len(points) // 2000)], k=2)
    return float(np.median(distance[:, 1]))


def _cloud(points: np.ndarray, normals: np.ndarray | None, voxel: float) -> Any:
    """An Open3D cloud thinned to ``voxel`` mm, with unit normals towards the camera at the origin."""
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, dtype=np.float64)))
    if normals is not None:
        finite = np.nan_to_num(np.asarray(normals, dtype=np.float64))  # a NaN normal weighs nothing in a voxel's mean
        cloud.normals = o3d.utility.Vector3dVector(finite)
        cloud = cloud.voxel_down_sample(voxel)
        known = np.linalg.norm(np.asarray(cloud.normals), axis=1) > 0.1
        cloud = cloud.select_by_index(np.flatnonzero(known))
        cloud.normalize_normals()
        return cloud
    cloud = cloud.voxel_down_sample(voxel)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    return cloud


def _icp(scan: Any, reference: Any, T: np.ndarray, gate: float) -> np.ndarray:
    pipeline = open3d().pipelines.registration
    method = pipeline.TransformationEstimationPointToPlane(pipeline.TukeyLoss(0.5 * gate))
    criteria = pipeline.ICPConvergenceCriteria(1e-7, 1e-7, 60)
    return np.array(pipeline.registration_icp(scan, reference, gate, T, method, criteria).transformation)


def _judge(
    scan_points: np.ndarray,
    reference_points: np.ndarray,
    tree: cKDTree,
    reference: Any,
    T: np.ndarray,
    gate: float,
    spacing: float,
    size: float,
    start: Start,
) -> Registration:
    """The figures of a pose, from up to 200,000 scan points against every reference point."""
    points = scan_points[:: -(-len(scan_points) // _STATISTICS_POINTS)] @ T[:3, :3].T + T[:3, 3]
    distance, nearest = tree.query(points, distance_upper_bound=4.0 * gate, workers=-1)
    near = np.isfinite(distance)
    points, distance, counterpart = points[near], distance[near], reference_points[nearest[near]]
    _, plane = cKDTree(np.asarray(reference.points)).query(counterpart, workers=-1)
    normals = np.asarray(reference.normals)[plane]
    height = np.abs(np.sum(normals * (points - counterpart), axis=1))

    overlapping = distance < gate
    aside = np.sqrt(np.maximum(distance**2 - height**2, 0.0))
    facing = aside < spacing + 0.25 * height  # a point beyond the reference's rim faces nothing
    rms = _rms(height[overlapping])
    return Registration(
        T_reference_scan=T,
        rms_mm=rms,
        inlier_rmse_mm=_rms(distance[overlapping]),
        overlap=float(overlapping.sum() / near.size),
        agreement=float((facing & (height < gate)).sum() / max(1, facing.sum())),
        slack_mm=_slack(reference.voxel_down_sample(size / 80.0), counterpart[overlapping], rms),
        gate_mm=gate,
        start=start,
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")


def _slack(surface: Any, points: np.ndarray, rms: float) -> float:
    """``rms`` over the root of the smallest eigenvalue of the point-to-plane information at ``points``, in mm.

    The information is the mean over points, with lengths divided by the overlap's radius. Normals come from the
    thinned ``surface``, over some ten of its voxels: the noise of finer ones would pass for relief.
    """
    if len(points) < 6:
        return float("inf")
    surface.estimate_normals(open3d().geometry.KDTreeSearchParamKNN(30))
    points = points[:: -(-len(points) // 20_000)]
    _, nearest = cKDTree(np.asarray(surface.points)).query(points)
    normals = np.asarray(surface.normals)[nearest]
    arm = points - points.mean(axis=0)
    arm /= _rms(np.linalg.norm(arm, axis=1))
    J = np.hstack([np.cross(arm, normals), normals])
    return rms / float(np.sqrt(max(np.linalg.eigvalsh(J.T @ J / len(J))[0], 1e-12)))


def _refuse_if_doubtful(result: Registration, size: float) -> None:
    if not result.overlap >= LEAST_OVERLAP:
        raise SlviewerError(
            f"Only {100 * result.overlap:.0f} % of the scan lies on the reference within {result.gate_mm:.2g} mm: "
            f"take scans that share at least {100 * LEAST_OVERLAP:.0f} % of the surface, or choose another reference."
        )
    if not result.agreement >= LEAST_AGREEMENT:
        raise SlviewerError(
            f"No pose found in which the two scans agree: where they face each other only "
            f"{100 * result.agreement:.0f} % of the points come within {result.gate_mm:.2g} mm; check that both show "
            "the same object, and that it did not change between the scans."
        )
    if not result.slack_mm <= MOST_SLACK * size:
        raise SlviewerError(
            "The surface that the two scans share is so flat or so evenly round that they can slide on each other: "
            "let them share edges, corners or bumps too, or put something with relief beside the object."
        )
