"""Segmentation of a static background from a moving object in several scans, by free-space
violations.

A point of another scan that is in front of a scan's surface violates its free space. Where an
object was turned before a background, the background's points violate free space under the object's
motion, and agree without motion.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, Mask, move_points
from slviewer.geometry.vectors import lengths
from slviewer.reconstruction.cloud import Cloud, Points, choose_pixels, keep_pixels
from slviewer.registration.multiway import MultiwayAlignment, Pair, Starts, register_all
from slviewer.registration.open3d_loader import fit_normals, point_cloud
from slviewer.registration.pairwise import Progress
from slviewer.registration.refusal import Refused
from slviewer.registration.scan import LEAST_POINTS, measure_size

SIGMAS = 5.0
"""A point violates free space where its height exceeds this many standard deviations of the pair's
own scatter."""
LEAST_SHARE = 0.01
"""Least share of static samples in a scan with a static background; fewer are scatter."""
LEAST_PART = 0.05
"""Least share of every scan that must agree without motion for an initial segmentation."""
NOISY = 3.0
"""Times the median standard deviation of a scan beyond which a point is not compared."""
QUARTILE = 0.3186
"""Lower quartile of the absolute value of a normal variable, in standard deviations."""
ROUNDS = 3
"""Largest number of alternations between segmentation and registration."""
SETTLED = 0.002
"""The alternation ends where fewer than this share of the pixels changed."""
LEAST_SAMPLES = 50
_SAMPLES_PER_SIDE = 250.0
"""Samples along the longest side of a scan."""
_NORMAL_POINTS = 20
_MIN_COSINE = 0.25
"""Least cosine between a sample's normal and its viewing direction."""
_NEIGHBOURS = 15
"""Decided samples that vote on an undecided one."""


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """A downsampled scan in its camera's frame, with search trees.

    ``points`` (n, 3) mm, unit ``normals`` (n, 3) towards the camera, ``ray_tree`` of the rays (x/z,
    y/z), ``ray_distance`` (n,) from each ray to the fourth nearest other one, ``point_tree`` of the
    points, and the indices ``neighbours`` (n, 8) of each point's nearest ones. ``heights``: cached
    results of ``heights_above``.
    """

    points: Points
    normals: Points
    ray_tree: cKDTree
    ray_distance: np.ndarray
    point_tree: cKDTree
    neighbours: np.ndarray
    heights: dict[tuple["SurfaceSamples", bytes], Floats] = field(default_factory=dict)


@dataclass(frozen=True)
class SceneContradiction:
    """Free-space violations between two scans.

    ``compared``: number of samples in the other scan's view; ``share`` of them that are more than
    ``gate_mm`` in front of the other scan's surface.
    """

    compared: int
    share: float
    gate_mm: float


@dataclass(frozen=True, eq=False)
class ObjectAlignment:
    """The alignment of the scans of a moved object, without the static background.

    ``clouds``: the scans without static points; ``static``: (h, w) bool by scan, the static points;
    ``contradictions``: the free-space violations that remain, of each registered pair.
    """

    alignment: MultiwayAlignment
    clouds: Mapping[str, Cloud]
    static: Mapping[str, Mask]
    contradictions: Mapping[Pair, SceneContradiction]


def register_object(
    clouds: Mapping[str, Cloud],
    reference: str,
    starts: Starts | None = None,
    progress: Progress = lambda share: None,
) -> ObjectAlignment:
    """Register the organised clouds of an object by ``register_all``, after removal of a static
    background.

    A background that fills more of the image than the object would keep the scans where they are.
    So where parts of the scans agree without motion, the other parts are registered first; each
    point is then assigned to the motion that it agrees with, and the object's points alone are
    registered again. Beside imported clouds nothing is removed. Raises as ``register_all`` does.

    ``progress`` receives the completed share of the work, 0 to 1, and may raise to cancel.
    """
    starts = starts or Starts()
    if any(cloud.normals is not None for cloud in clouds.values()):  # no camera, no free space
        alignment = register_all(clouds, reference, starts, progress)
        none = {name: np.zeros_like(cloud.mask) for name, cloud in clouds.items()}
        return ObjectAlignment(alignment, clouds, none, {})
    all_samples = _sample_clouds(clouds)
    alignment, static = _register_once(clouds, all_samples, reference, starts, progress)
    first = alignment
    moving, samples = clouds, all_samples
    for _ in range(ROUNDS):
        if not static:
            break
        candidate = remove_points(clouds, static)
        again = Starts(poses=alignment.T_reference_scan, is_decided=True, markers=starts.markers)
        refined = _try_register(candidate, reference, again, lambda share: progress(0.9))
        # too few points remain of a scan: its background may be needed to determine its pose
        if refined is None:
            moving, samples, static = clouds, all_samples, {}
            break
        alignment = _keep_starts(refined, first)
        moving, samples = candidate, _sample_clouds(candidate)
        now = detect_static_points(clouds, all_samples, alignment)
        if all(
            np.count_nonzero(now[n] ^ mask if now else mask) < SETTLED * mask.size
            for n, mask in static.items()
        ):
            break
        static = now
    T = alignment.T_reference_scan
    contradictions = {
        (a, b): measure_contradiction(
            samples[a], samples[b], np.linalg.inv(T[b]) @ T[a], registration.gate_mm
        )
        for (a, b), registration in alignment.pairs.items()
    }
    progress(1.0)
    static = static or {name: np.zeros_like(cloud.mask) for name, cloud in clouds.items()}
    return ObjectAlignment(alignment, moving, static, contradictions)


def _keep_starts(alignment: MultiwayAlignment, first: MultiwayAlignment) -> MultiwayAlignment:
    """Return the alignment with the starts of the ``first`` one, which it was refined from, and
    their rivals."""
    known = {pair[::turn]: r for pair, r in first.pairs.items() for turn in (-1, 1)}
    pairs = {
        pair: replace(r, start=known[pair].start, rival_mm=known[pair].rival_mm)
        if pair in known
        else r
        for pair, r in alignment.pairs.items()
    }
    return replace(alignment, pairs=pairs)


def _register_once(
    clouds: Mapping[str, Cloud],
    samples: Mapping[str, SurfaceSamples],
    reference: str,
    starts: Starts,
    report: Progress,
) -> tuple[MultiwayAlignment, dict[str, Mask]]:
    """Register the scans without what agrees without motion, or as they are where that does not
    separate two motions.

    Returns the alignment and the static points, (h, w) bool by scan; {} without any.
    """
    # markers tell how the object moved, also where a plane in its own plane seems to stand still
    unmoved = {} if starts.markers else _detect_unmoved_points(clouds, samples)
    if unmoved:
        first = _try_register(
            remove_points(clouds, unmoved), reference, starts, lambda share: report(0.5 * share)
        )
        if first is not None:
            static = detect_static_points(clouds, samples, first)
            if static:
                return first, static
    alignment = register_all(clouds, reference, starts, lambda share: report(0.5 + 0.2 * share))
    return alignment, detect_static_points(clouds, samples, alignment)


def _sample_clouds(clouds: Mapping[str, Cloud]) -> dict[str, SurfaceSamples]:
    """Return the samples of the precise points of each scan."""
    return {name: sample_surface(_select_precise(cloud)) for name, cloud in clouds.items()}


def _select_precise(cloud: Cloud) -> Points:
    """Return the points (n, 3) mm of a cloud but the noisiest, which on dark print lie further off
    than the others."""
    mask = cloud.mask
    sigma = cloud.sigma_z[mask]
    usual = np.nanmedian(sigma) if np.isfinite(sigma).any() else np.inf
    return choose_pixels(cloud.points, mask)[~(sigma > NOISY * usual)]


def remove_points(clouds: Mapping[str, Cloud], static: Mapping[str, Mask]) -> dict[str, Cloud]:
    """Return the clouds with the points at ``static`` (h, w) bool replaced by NaN."""
    return {
        name: replace(cloud, points=keep_pixels(cloud.points, ~static[name]))
        for name, cloud in clouds.items()
    }


def _try_register(
    clouds: Mapping[str, Cloud], reference: str, starts: Starts, progress: Progress
) -> MultiwayAlignment | None:
    """Return ``register_all`` of the clouds, or None where it refuses."""
    try:
        return register_all(clouds, reference, starts, progress)
    except (Refused, InputError):
        return None


def _detect_unmoved_points(
    clouds: Mapping[str, Cloud], samples: Mapping[str, SurfaceSamples]
) -> dict[str, Mask]:
    """Detect the points, (h, w) bool by scan, that agree with the next scan's or the previous one's
    without any motion.

    {} where they are less than LEAST_PART of a scan, or leave too few points to register.
    """
    votes = {name: np.zeros(len(s.points)) for name, s in samples.items()}
    sigma = {
        name: float(np.nan_to_num(np.nanmedian(cloud.sigma_z[cloud.mask])))
        for name, cloud in clouds.items()
    }
    for first, second in pairwise(clouds):
        gate = SIGMAS * float(np.hypot(sigma[first], sigma[second]))
        for scan, onto in ((first, second), (second, first)):
            height = np.abs(heights_above(samples[scan], samples[onto], np.eye(4)))
            votes[scan] += (height <= gate).astype(float) - (height > gate)
    static = _classify_pixels(clouds, samples, votes)
    for name, mask in static.items():
        measured, unmoved = int(clouds[name].mask.sum()), int(mask.sum())
        if unmoved < LEAST_PART * measured or measured - unmoved < 2 * LEAST_POINTS:
            return {}
    return static


def sample_surface(points: Points) -> SurfaceSamples:
    """Downsample the measured points (n, 3) mm of a scan in its camera's frame; grazing samples are
    removed."""
    points = np.asarray(points, np.float64)
    cloud = point_cloud(points).voxel_down_sample(measure_size(points) / _SAMPLES_PER_SIDE)
    # neighbours beside each other in memory halve the time of searches
    cloud = cloud.select_by_index(cKDTree(np.asarray(cloud.points)).indices)
    fit_normals(cloud, _NORMAL_POINTS)
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    samples, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    facing = -np.sum(samples * normals, axis=1) > _MIN_COSINE * lengths(samples)
    facing &= samples[:, 2] > 0
    samples, normals = samples[facing], normals[facing]
    ray_tree, point_tree = cKDTree(samples[:, :2] / samples[:, 2:]), cKDTree(samples)
    ray_distance = ray_tree.query(ray_tree.data, k=min(5, len(samples)), workers=-1)[0][:, -1]
    neighbours = point_tree.query(samples, k=min(8, len(samples)), workers=-1)[1]
    return SurfaceSamples(samples, normals, ray_tree, ray_distance, point_tree, neighbours)


def heights_above(scan: SurfaceSamples, onto: SurfaceSamples, T: np.ndarray) -> Floats:
    """Return the heights (n,) mm of a scan's samples, moved by ``T`` (4, 4), above another scan's
    surface.

    Heights are along that surface's normal, positive in front of it as seen from its camera, and
    medians over each sample's neighbourhood; NaN outside the other scan's view. Cached.
    """
    key = onto, T.tobytes()
    if key in scan.heights:
        return scan.heights[key]
    points = move_points(T, scan.points)
    in_front = points[:, 2] > 0
    rays = points[:, :2] / np.where(in_front, points[:, 2], 1.0)[:, None]
    reach = np.append(onto.ray_distance, -1.0)  # the last for rays without a sample nearby
    distance, nearest = onto.ray_tree.query(
        rays, distance_upper_bound=1.001 * reach.max(), workers=-1
    )
    in_view = np.flatnonzero(in_front & (distance < reach[nearest]))
    nearest = nearest[in_view]
    height = np.full(len(points), np.nan)
    height[in_view] = np.sum(
        onto.normals[nearest] * (points[in_view] - onto.points[nearest]), axis=1
    )
    neighbourhood = np.sort(height[scan.neighbours[in_view]], axis=1)  # NaN last
    count = np.count_nonzero(np.isfinite(neighbourhood), axis=1)
    row = np.arange(len(count))
    height[in_view] = 0.5 * (neighbourhood[row, (count - 1) // 2] + neighbourhood[row, count // 2])
    scan.heights[key] = height
    return height


def measure_contradiction(
    scan: SurfaceSamples, onto: SurfaceSamples, T: Floats, widest_mm: float
) -> SceneContradiction:
    """Measure the free-space violations between two scans with ``T_onto_scan`` (4, 4), in both
    directions.

    ``widest_mm``: upper bound of the gate.
    """
    height = np.concatenate(
        [heights_above(scan, onto, T), heights_above(onto, scan, np.linalg.inv(T))]
    )
    gate = estimate_gate(height, widest_mm)
    known = height[np.isfinite(height)]
    return SceneContradiction(len(known), float(np.mean(known > gate)) if len(known) else 0.0, gate)


def estimate_gate(height: Floats, widest_mm: float) -> float:
    """Estimate the gate in mm, SIGMAS times the scatter of heights (n,) of overlapping surfaces, up
    to ``widest_mm``.

    The scatter is estimated by the lower quartile of the heights within ``widest_mm``, as up to
    half of these may belong to points with another motion. NaN heights do not count.
    """
    near = np.abs(height[np.abs(height) < widest_mm])
    scatter = float(np.quantile(near, 0.25)) / QUARTILE if len(near) >= LEAST_SAMPLES else widest_mm
    return min(SIGMAS * scatter, widest_mm)


def detect_static_points(
    clouds: Mapping[str, Cloud], samples: Mapping[str, SurfaceSamples], alignment: MultiwayAlignment
) -> dict[str, Mask]:
    """Detect the points, (h, w) bool by scan, that are static in the camera's frame while the
    object moves.

    A sample votes for static where it disagrees with another scan under the ``alignment`` and
    agrees without motion, and against it in the opposite case; otherwise the nearest votes decide.
    {} without a static part, and where the scans did not move, so that the two cases cannot be
    distinguished.
    """
    votes = {name: np.zeros(len(s.points)) for name, s in samples.items()}
    poses = alignment.T_reference_scan
    for (first, second), registration in alignment.pairs.items():
        T_second_first = np.linalg.inv(poses[second]) @ poses[first]
        for scan, onto, T in (
            (first, second, T_second_first),
            (second, first, np.linalg.inv(T_second_first)),
        ):
            moved = heights_above(samples[scan], samples[onto], T)
            unmoved = heights_above(samples[scan], samples[onto], np.eye(4))
            gate = estimate_gate(moved, registration.gate_mm)
            is_static = (np.abs(unmoved) <= gate) & (np.abs(moved) > gate)
            is_moving = (np.abs(moved) <= gate) & (np.abs(unmoved) > gate)
            votes[scan] += is_static.astype(float) - is_moving
    return _classify_pixels(clouds, samples, votes)


def _classify_pixels(
    clouds: Mapping[str, Cloud],
    samples: Mapping[str, SurfaceSamples],
    votes: Mapping[str, Floats],
) -> dict[str, Mask]:
    """Return the static pixels (h, w) bool by scan; {} without any."""
    static = {name: _classify_scan(clouds[name], samples[name], votes[name]) for name in clouds}
    return static if any(mask.any() for mask in static.values()) else {}


def _classify_scan(cloud: Cloud, samples: SurfaceSamples, votes: Floats) -> Mask:
    """Return the static pixels (h, w) bool of a cloud, by the majority of the votes (n,) nearest to
    each sample.

    A positive vote is for static, 0 none. All False for too few positive votes.
    """
    static = np.zeros(cloud.mask.shape, bool)
    voting = np.flatnonzero(votes)
    if np.count_nonzero(votes > 0) < max(LEAST_SAMPLES, LEAST_SHARE * len(votes)):
        return static
    k = min(_NEIGHBOURS, len(voting))
    _, nearest = cKDTree(samples.points[voting]).query(samples.points, k=k, workers=-1)
    is_static = np.sign(votes[voting])[np.reshape(nearest, (len(votes), k))].mean(axis=1) > 0
    _, sample = samples.point_tree.query(cloud.measured, workers=-1)
    static[cloud.mask] = is_static[sample]
    return static
