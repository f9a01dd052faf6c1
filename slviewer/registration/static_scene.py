"""What of several scans stands still while the object moves, and what of them contradicts.

A scan sees along its rays: a point of another scan, carried over by a pose, that lies in front of its surface lies
where it saw through (a free-space violation). Where an object was turned before a background, the background's points
contradict under the object's motion, and agree where the scans are laid on each other unmoved.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.reconstruction.cloud import Cloud
from slviewer.registration.multiway import Alignment, Pair, Starts, register_all
from slviewer.registration.open3d_loader import open3d
from slviewer.registration.pairwise import Progress
from slviewer.registration.prepared import LEAST_POINTS
from slviewer.registration.refusal import Refused

SIGMAS = 5.0
"""A point contradicts another scan's surface where it lies so many standard deviations of the pair's own scatter off:
of a normal distribution, one in two million does."""
LEAST_SHARE = 0.01
"""Share of a scan's samples from which on a background that stands still is separated; less is scatter."""
LEAST_PART = 0.05
"""Share of every scan that must agree unmoved for a search of what moved apart from it."""
QUARTILE = 0.3186
"""Of a normal distribution: the absolute value that a quarter stays below, in standard deviations."""
ROUNDS = 3
"""Times that points are assigned to a motion and the object is registered anew, ..."""
SETTLED = 0.002
"""... unless fewer than this share of the pixels changed sides."""
LEAST_SAMPLES = 50
_FINENESS = 250.0
"""Samples along the longest side of a scan."""
_NORMAL_POINTS = 20
_SLOPE = 0.25
"""Cosine between a surface's normal and the line of sight below which heights are not compared."""
_NEIGHBOURS = 15
"""Nearest samples by which one that shows nothing itself is decided."""


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """A scan thinned: ``points`` (n, 3) mm, unit ``normals`` (n, 3) towards the camera, a ``tree`` of its
    rays (x/z, y/z), the distance ``apart`` (n,) to the fourth nearest of them, the ``own`` tree of the points, and the
    ``neighbours`` (n, 8) of each."""

    points: np.ndarray
    normals: np.ndarray
    tree: cKDTree
    apart: np.ndarray
    own: cKDTree
    neighbours: np.ndarray


@dataclass(frozen=True)
class SceneContradiction:
    """Of the samples of two scans that the other's view covers (``compared``), the ``share`` that lies in front of the
    other's surface by more than ``gate_mm``: it would have had to see them."""

    compared: int
    share: float
    gate_mm: float


@dataclass(frozen=True, eq=False)
class ObjectAlignment:
    """Where the scans of an object lie (``alignment``), by the points that moved with it.

    ``clouds``: the scans without the points that stand still; ``static``: (h, w) bool by scan, those points;
    ``contradictions``: of each registered pair, how much of what is left contradicts.
    """

    alignment: Alignment
    clouds: Mapping[str, Cloud]
    static: Mapping[str, np.ndarray]
    contradictions: Mapping[Pair, SceneContradiction]


def register_object(
    clouds: Mapping[str, Cloud], reference: str, starts: Starts | None = None, progress: Progress | None = None
) -> ObjectAlignment:
    """``register_all`` of organised clouds, of which what stands still while the object moves is taken away first.

    A background that fills more of the image than the object would hold the scans where they are. So where a part of
    them agrees unmoved, the rest is registered; each point then belongs to the motion that it agrees with, and the
    object alone is registered again. Raises as ``register_all`` does.

    ``progress`` receives the share of the work done, 0 to 1, and may raise to cancel.
    """
    say = progress or (lambda share: None)
    views = {name: sample_surface(cloud.measured) for name, cloud in clouds.items()}
    alignment, static = None, _unmoved(clouds, views)
    if any(mask.any() for mask in static.values()):
        alignment, static = _moving(clouds, views, static, reference, starts, lambda done: say(0.5 * done))
    if alignment is None:
        alignment = register_all(clouds, reference, starts, lambda done: say(0.5 + 0.2 * done))
        static = detect_static_points(clouds, views, alignment)
    begun = {pair: found.start for pair, found in alignment.pairs.items()}
    whole, every = clouds, views
    for _ in range(ROUNDS):
        if not any(mask.any() for mask in static.values()):
            break
        moving = remove_points(whole, static)
        again = _registered(moving, reference, Starts(poses=alignment.T_reference_scan), lambda done: say(0.9))
        if again is None:  # too little is left of a scan: what moved with it may be needed to hold it
            static = {name: np.zeros_like(mask) for name, mask in static.items()}
            clouds, views = whole, every
            break
        pairs = {pair: replace(found, start=begun.get(pair, found.start)) for pair, found in again.pairs.items()}
        alignment, clouds = replace(again, pairs=pairs), moving
        views = {name: sample_surface(cloud.measured) for name, cloud in clouds.items()}
        before, static = static, detect_static_points(whole, every, alignment)
        if all(np.count_nonzero(static[n] ^ before[n]) < SETTLED * before[n].size for n in static):
            static = before
            break
    poses = alignment.T_reference_scan
    contradictions = {
        (one, other): contradiction(views[one], views[other], np.linalg.inv(poses[other]) @ poses[one], found.gate_mm)
        for (one, other), found in alignment.pairs.items()
    }
    say(1.0)
    return ObjectAlignment(alignment, clouds, static, contradictions)


def remove_points(clouds: Mapping[str, Cloud], static: Mapping[str, np.ndarray]) -> dict[str, Cloud]:
    """The clouds less the points at ``static`` (h, w) bool."""
    return {
        name: replace(cloud, points=np.where(static[name][..., None], np.float32(np.nan), cloud.points))
        for name, cloud in clouds.items()
    }


def _registered(
    clouds: Mapping[str, Cloud], reference: str, starts: Starts | None, progress: Progress
) -> Alignment | None:
    try:
        return register_all(clouds, reference, starts, progress)
    except (Refused, InputError):
        return None


def _moving(
    clouds: Mapping[str, Cloud],
    views: Mapping[str, SurfaceSamples],
    unmoved: Mapping[str, np.ndarray],
    reference: str,
    starts: Starts | None,
    progress: Progress,
) -> tuple[Alignment | None, dict[str, np.ndarray]]:
    """The motion of what does not agree ``unmoved``, and what stands still beside it; None where there is none."""
    alignment = _registered(remove_points(clouds, unmoved), reference, starts, progress)
    if alignment is None:
        return None, {}
    static = detect_static_points(clouds, views, alignment)
    return (alignment, static) if any(mask.any() for mask in static.values()) else (None, {})


def _unmoved(clouds: Mapping[str, Cloud], views: Mapping[str, SurfaceSamples]) -> dict[str, np.ndarray]:
    """By scan, (h, w) bool: the points that agree with the next scan's where neither is moved; all False where these
    are nearly none of a scan, or too little is left."""
    votes = {name: np.zeros(len(view.points)) for name, view in views.items()}
    sigma = {name: float(np.nanmedian(cloud.sigma_z[cloud.mask])) for name, cloud in clouds.items()}
    for one, other in pairwise(clouds):
        gate = SIGMAS * float(np.hypot(np.nan_to_num(sigma[one]), np.nan_to_num(sigma[other])))
        for scan, onto in ((one, other), (other, one)):
            height = np.abs(heights_above(views[scan], views[onto], np.eye(4)))
            with np.errstate(invalid="ignore"):
                votes[scan] += (height <= gate).astype(float) - (height > gate)
    static = {name: _static_pixels(clouds[name], views[name], votes[name]) for name in clouds}
    measured = {name: int(cloud.mask.sum()) for name, cloud in clouds.items()}
    still = {name: int(mask.sum()) for name, mask in static.items()}
    if any(still[name] < LEAST_PART * n or n - still[name] < 2 * LEAST_POINTS for name, n in measured.items()):
        return {name: np.zeros_like(mask) for name, mask in static.items()}
    return static


def sample_surface(points: np.ndarray) -> SurfaceSamples:
    """The measured points (n, 3) mm of a scan, in its camera's frame, as the comparisons below take them."""
    o3d = open3d()
    points = np.asarray(points, np.float64)
    low, high = np.percentile(points[:: max(1, len(points) // 100_000)], (1.0, 99.0), axis=0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud = cloud.voxel_down_sample(float((high - low).max()) / _FINENESS)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_POINTS))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    thin, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    facing = -np.sum(thin * normals, axis=1) > _SLOPE * np.linalg.norm(thin, axis=1)
    thin, normals = thin[facing & (thin[:, 2] > 0)], normals[facing & (thin[:, 2] > 0)]
    tree, own = cKDTree(thin[:, :2] / thin[:, 2:]), cKDTree(thin)
    apart = tree.query(tree.data, k=min(5, len(thin)))[0][:, -1]
    neighbours = own.query(thin, k=min(8, len(thin)))[1]
    return SurfaceSamples(thin, normals, tree, apart, own, neighbours)


def heights_above(scan: SurfaceSamples, onto: SurfaceSamples, T: np.ndarray) -> np.ndarray:
    """(n,) mm: how far a scan's samples, carried over by ``T`` (4, 4), lie in front of another scan's surface
    (negative: behind, hidden by it), along that surface's normal; NaN where the other saw nothing.

    The median of each sample's neighbourhood, which averages noise.
    """
    points = scan.points @ T[:3, :3].T + T[:3, 3]
    before = points[:, 2] > 0
    distance, nearest = onto.tree.query(points[:, :2] / np.where(before, points[:, 2], 1.0)[:, None], workers=-1)
    seen = before & (distance < onto.apart[nearest])
    height = np.sum(onto.normals[nearest] * (points - onto.points[nearest]), axis=1)
    around = np.where(seen[scan.neighbours], height[scan.neighbours], np.nan)
    out = np.full(len(points), np.nan)
    out[seen] = np.nanmedian(around[seen], axis=1)
    return out


def contradiction(scan: SurfaceSamples, onto: SurfaceSamples, T: np.ndarray, widest_mm: float) -> SceneContradiction:
    """How much of two scans contradicts where ``T`` (4, 4) puts the first on the second, seen from either; points of
    one surface lie within ``widest_mm``."""
    height = np.concatenate([heights_above(scan, onto, T), heights_above(onto, scan, np.linalg.inv(T))])
    gate = estimate_gate(height, widest_mm)
    known = height[np.isfinite(height)]
    return SceneContradiction(len(known), float(np.mean(known > gate)) if len(known) else 0.0, gate)


def estimate_gate(height: np.ndarray, widest_mm: float) -> float:
    """mm: ``SIGMAS`` times the scatter of heights that lie on each other, by the least quarter of those within
    ``widest_mm``: up to half of these may belong to another motion."""
    near = np.abs(height[np.abs(height) < widest_mm])
    scatter = float(np.quantile(near, 0.25)) / QUARTILE if len(near) >= LEAST_SAMPLES else widest_mm
    return min(SIGMAS * scatter, widest_mm)


def detect_static_points(
    clouds: Mapping[str, Cloud], views: Mapping[str, SurfaceSamples], alignment: Alignment
) -> dict[str, np.ndarray]:
    """By scan, (h, w) bool: the points that stand still in the camera's frame while the rest moves as ``alignment``
    says.

    A sample counts that contradicts another scan under the estimated motion and agrees with it unmoved; where it agrees
    with both or with neither, the nearest that count decide. All False where nothing stands still, or where scans did
    not move: then nothing distinguishes the two.
    """
    votes = {name: np.zeros(len(view.points)) for name, view in views.items()}
    poses = alignment.T_reference_scan
    for (one, other), found in alignment.pairs.items():
        for scan, onto in ((one, other), (other, one)):
            T = np.linalg.inv(poses[onto]) @ poses[scan]
            moved, unmoved = (
                heights_above(views[scan], views[onto], T),
                heights_above(views[scan], views[onto], np.eye(4)),
            )
            gate = estimate_gate(moved, found.gate_mm)
            with np.errstate(invalid="ignore"):
                static = (np.abs(unmoved) <= gate) & (np.abs(moved) > gate)
                moving = (np.abs(moved) <= gate) & (np.abs(unmoved) > gate)
            votes[scan] += static.astype(float) - moving
    return {name: _static_pixels(clouds[name], views[name], votes[name]) for name in clouds}


def _static_pixels(cloud: Cloud, view: SurfaceSamples, votes: np.ndarray) -> np.ndarray:
    """(h, w) bool at the cloud's own resolution: what stands still, by the votes (n,) of the samples."""
    mask = cloud.mask
    out = np.zeros(mask.shape, bool)
    decided = np.flatnonzero(votes)
    if np.count_nonzero(votes > 0) < max(LEAST_SAMPLES, LEAST_SHARE * len(votes)):
        return out
    near = min(_NEIGHBOURS, len(decided))
    _, nearest = cKDTree(view.points[decided]).query(view.points, k=near, workers=-1)
    still = np.sign(votes[decided])[np.reshape(nearest, (len(votes), near))].mean(axis=1) > 0
    _, sample = view.own.query(cloud.measured, workers=-1)
    out[mask] = still[sample]
    return out
