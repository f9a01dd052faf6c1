"""Fusion of registered scans to one set of points, with overlapping surfaces averaged.

Every point of a scan is moved along its normal to the weighted mean of all scans' surfaces; of
overlapping scans, only the points of the one with the highest quality are kept. Weights are 1 /
sigma2 and decrease to 0 at each scan's border, so that no step shows where a scan ends. Another
scan's surface is interpolated between pixels, with a lower weight where it is curved, so that
nothing is smoothed beyond one scan's resolution.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.jit import run_rows
from slviewer.geometry.rigid import Mask, Uncertainty, distance_jacobian, move_points
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.vectors import lengths, rms, unit_vectors
from slviewer.reconstruction.cloud import Cloud, Points, choose_pixels, keep_pixels
from slviewer.surface.overlap_kernels import FIELDS, add_surface, add_votes, measure_heights
from slviewer.surface.shapes import PointSet
from slviewer.surface.unorganised import fuse_points, point_set
from slviewer.surface.view import View, prepare_view, viewing_cosines

Progress = Callable[[float], None]

MIN_WITNESS_WEIGHT = 0.3
"""Least border weight of a pixel whose free space can contradict another scan's points."""
_SAMPLES = 20_000
_LEAST_PLACES = 30
_WINDOW_SPACINGS = 6.0  # largest distance of points that may be of one surface, in point spacings
_WINDOW_SIGMAS = 12.0  # and in standard deviations, whichever is larger
_GATE_SIGMAS = 6.0


@dataclass(frozen=True)
class SurfaceAgreement:
    """Comparison of two scans where they overlap.

    ``places``: number of compared points; ``rms_mm``: height of the second scan's surface
    above the first's along the normal; ``gate_mm``: height within which both are one
    surface; ``log_gain``: median logarithm of the second's brightness over the first's, None
    without colours.
    """

    places: int
    rms_mm: float
    gate_mm: float
    log_gain: float | None


Views = Mapping[str, View]
Agreements = Mapping[tuple[str, str], SurfaceAgreement]
"""Of overlapping scans, by their names."""


@dataclass(frozen=True, eq=False)
class Fused:
    """The fused surface of several scans, in the frame of their poses.

    ``surface``: points with normals towards the cameras, sigmas along the normals, and colours if
    every scan has them. ``source`` (n,) uint8: index in ``names`` of the scan that a point is from;
    ``seen_by`` (n,) uint8: number of scans averaged in it. ``excluded``: numbers of excluded pixels
    of each scan by reason; ``pairs``: agreement of overlapping scans, by their names.
    """

    surface: PointSet
    source: np.ndarray
    seen_by: np.ndarray
    names: tuple[str, ...]
    excluded: dict[str, dict[str, int]]
    pairs: dict[tuple[str, str], SurfaceAgreement]

    @property
    def shared(self) -> float:
        """Share of the points that are averages of more than one scan."""
        return float((self.seen_by > 1).mean())


def fuse(
    scans: Mapping[str, Cloud],
    T_reference_scan: Mapping[str, np.ndarray],
    progress: Progress | None = None,
    poses: Mapping[str, Uncertainty] | None = None,
) -> Fused:
    """Fuse clouds, organised ones each in its camera's frame, with the pose (4, 4) of each by the
    same name.

    ``poses``: how uncertain these poses are, in the reference's frame; it becomes part of the
    points' sigmas, as if a point were from its best scan alone.

    ``progress`` receives the completed share of the work, 0 to 1, and may raise to cancel. A single
    scan is only cleaned. Raises InputError for a scan without a pose, without a surface, or whose
    points are not those of one camera.
    """
    if not 1 <= len(scans) <= 255:
        raise InputError(f"{len(scans)} scans were given", "fusing takes 1 to 255.")
    for name in scans:
        if name not in T_reference_scan:
            raise InputError(f"{name} has no pose", "register it first, or exclude it.")
    report, views = progress or (lambda share: None), {}
    if any(cloud.normals is not None for cloud in scans.values()):
        return _fuse_unorganised(scans, T_reference_scan, poses)
    for i, (name, cloud) in enumerate(scans.items()):
        report(0.3 * i / len(scans))
        views[name] = prepare_view(name, cloud, T_reference_scan[name])
    names = tuple(views)
    pairs = compare_views(views, lambda share: report(0.3 + 0.1 * share))
    excluded = {name: dict(view.cleaned) for name, view in views.items()}
    for name, violations in _detect_violations(
        views, pairs, lambda share: report(0.4 + 0.1 * share)
    ).items():
        excluded[name]["unconfirmed"] = int(violations.sum())
        kept = keep_pixels(views[name].points, ~violations)
        views[name] = replace(views[name], points=kept)
    gains = colour_gains(views, pairs)
    parts = []
    for i, name in enumerate(names):
        report(0.5 + 0.5 * i / len(names))
        points, seen_by = _fuse_scan(name, views, pairs, gains)
        parts.append((points, seen_by))
    report(1.0)
    return _join_parts(names, parts, poses, excluded, pairs)


def _fuse_unorganised(
    scans: Mapping[str, Cloud],
    T_reference_scan: Mapping[str, np.ndarray],
    poses: Mapping[str, Uncertainty] | None,
) -> Fused:
    """Fuse clouds of which some were imported, as `fuse_points` does; the others are cleaned."""
    sets = {
        name: fuse({name: cloud}, T_reference_scan).surface
        if cloud.normals is None
        else point_set(cloud, T_reference_scan[name])
        for name, cloud in scans.items()
    }
    if any(each.colours is None for each in sets.values()):
        sets = {name: replace(each, colours=None) for name, each in sets.items()}
    return _join_parts(tuple(sets), fuse_points(sets), poses, {name: {} for name in sets}, {})


def _join_parts(
    names: tuple[str, ...],
    parts: Sequence[tuple[PointSet, np.ndarray]],
    poses: Mapping[str, Uncertainty] | None,
    excluded: dict[str, dict[str, int]],
    pairs: dict[tuple[str, str], SurfaceAgreement],
) -> Fused:
    """Return the points of each scan that remain, and the numbers of scans in them, as one
    surface."""
    if poses is not None:
        parts = [
            (_add_pose_error(points, poses[name]) if name in poses else points, seen_by)
            for name, (points, seen_by) in zip(names, parts, strict=True)
        ]
    # either all scans have colours, or none
    surface: dict[str, Any] = {
        name: None if value is None else np.concatenate([vars(part)[name] for part, _ in parts])
        for name, value in vars(parts[0][0]).items()
    }
    return Fused(
        surface=PointSet(**surface),
        source=np.repeat(np.arange(len(names), dtype=np.uint8), [len(p) for p, _ in parts]),
        seen_by=np.concatenate([seen_by for _, seen_by in parts]),
        names=names,
        excluded=excluded,
        pairs=pairs,
    )


def _detect_violations(views: Views, pairs: Agreements, progress: Progress) -> dict[str, Mask]:
    """Detect the points, (h, w) bool by scan, in the free space of more scans than the number that
    confirm them."""
    witnesses = {name: _select_witnesses(view) for name, view in views.items()}
    violations = {}
    for i, (name, view) in enumerate(views.items()):
        progress(i / len(views))
        mask = view.mask
        points = choose_pixels(view.points, mask)
        votes = np.zeros(len(points), np.int16)
        for other, there in views.items():
            if other != name:
                T = np.linalg.inv(there.T) @ view.T
                # along the viewing direction two surfaces may be farther apart than along their
                # normal
                gate = 2.0 * max(_gate_mm(pairs, views, name, other), view.spacing, there.spacing)
                moved = move_points(T, points)
                run_rows(
                    add_votes,
                    len(moved),
                    moved,
                    gate,
                    there.points,
                    witnesses[other],
                    there.to_pixel,
                    votes,
                )
        violations[name] = np.zeros(mask.shape, bool)
        violations[name][mask] = votes < 0
    return violations


def _select_witnesses(view: View) -> Mask:
    """Select the pixels (h, w) bool whose free space is certain: inside the surface, and not at
    grazing angles."""
    inside = cv2.erode(view.mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    facing = viewing_cosines(view.points, view.normals) > 0.25
    return inside & (view.inner > MIN_WITNESS_WEIGHT) & facing


def _gate_mm(pairs: Agreements, views: Views, a: str, b: str) -> float:
    """Return the gate of two scans by their agreement, or the larger of their point spacings
    without one."""
    pair = pairs.get((a, b)) or pairs.get((b, a))
    return pair.gate_mm if pair else max(views[a].spacing, views[b].spacing)


def _fuse_scan(
    name: str,
    views: Views,
    pairs: Agreements,
    gains: Mapping[str, float] | None,
) -> tuple[PointSet, np.ndarray]:
    """Average a scan's points with the other scans' surfaces.

    Returns the points at which the scan has the highest quality, in the reference's frame, and the
    number of scans (n,) uint8 averaged in each.
    """
    view, order = views[name], list(views)
    mask = view.mask
    points, normals = (choose_pixels(values, mask) for values in (view.points, view.normals))
    noise, systematic, inner = view.noise[mask], view.systematic[mask], view.inner[mask]
    R = view.T[:3, :3]
    weight = inner / (noise.astype(np.float64) ** 2 + systematic.astype(np.float64) ** 2)
    sums = np.zeros((len(points), FIELDS))
    sums[:, 0], sums[:, 2], sums[:, 3] = weight, (weight * noise) ** 2, weight * systematic
    sums[:, 4:7] = weight[:, None] * (normals @ R.T)
    own_colours = None
    if gains is not None and view.colours is not None:
        own_colours = view.colours[mask]
        share = inner * -np.einsum("ij,ij->i", points, normals) / lengths(points)
        sums[:, 8] = share
        sums[:, 9:] = share[:, None] * gains[name] * own_colours
    inferior = np.zeros(len(points), bool)
    for other, there in views.items():
        if (name, other) not in pairs and (other, name) not in pairs:
            continue
        run_rows(
            add_surface,
            len(points),
            *view.move_into(there, points, normals),
            view.quality[mask],
            np.ascontiguousarray(there.T[:3, :3]),
            max(view.spacing, there.spacing),
            _gate_mm(pairs, views, name, other),
            there.grid,
            there.colours if own_colours is not None else np.zeros((0, 0, 3), np.uint8),
            1.0 if gains is None else gains[other],
            order.index(other) < order.index(name),
            sums,
            inferior,
        )
    best = ~inferior
    averages = _average(view, points[best], normals[best], sums[best], own_colours is not None)
    return averages, (1 + sums[best, 7]).astype(np.uint8)


def _average(
    view: View, points: Points, normals: Points, sums: np.ndarray, coloured: bool
) -> PointSet:
    """Return the averages of a scan's points (n, 3) in the reference's frame from their ``sums``
    (n, FIELDS)."""
    total = sums[:, 0]
    height = sums[:, 1] / total
    moved = move_points(view.T, points + height[:, None] * normals)
    sigma = np.hypot(np.sqrt(sums[:, 2]) / total, sums[:, 3] / total)
    colours = None
    if coloured:
        colours = np.clip(sums[:, 9:] / np.maximum(sums[:, 8:9], 1e-12) + 0.5, 0, 255)
    return PointSet(moved, unit_vectors(sums[:, 4:7]), colours, sigma)


def _add_pose_error(points: PointSet, pose: Uncertainty) -> PointSet:
    """Return the points with the error that their scan's pose has along the normals added to their
    sigmas."""
    assert points.normals is not None and points.sigma_mm is not None
    lever = distance_jacobian(points.points - pose.centre, points.normals)
    variance = np.einsum("ij,jk,ik->i", lever, pose.covariance, lever)
    return replace(points, sigma_mm=np.sqrt(points.sigma_mm**2 + np.maximum(variance, 0.0)))


def compare_views(views: Views, progress: Progress) -> dict[tuple[str, str], SurfaceAgreement]:
    """Compare every ordered pair of scans; pairs that overlap in too few points are missing from
    the result."""
    agreements = {}
    pairs = list(permutations(views, 2))
    for i, (a, b) in enumerate(pairs):
        progress(i / len(pairs))
        if agreement := _compare_pair(views[a], views[b]):
            agreements[a, b] = agreement
    return agreements


def _compare_pair(first: View, second: View) -> SurfaceAgreement | None:
    """Compare a subset of the first scan's points with the second scan's surface; None for too
    small an overlap."""
    mask = first.mask
    subset = slice(None, None, max(1, int(mask.sum()) // _SAMPLES))
    points, normals = first.move_into(
        second, choose_pixels(first.points, mask)[subset], first.normals[mask][subset]
    )
    spacing = max(first.spacing, second.spacing)
    noise = sum(
        float(np.median(each)) for each in (first.noise[mask][subset], second.noise[second.mask])
    )
    window = max(_WINDOW_SPACINGS * spacing, _WINDOW_SIGMAS * noise)
    heights = np.empty((len(points), 2))
    run_rows(measure_heights, len(points), points, normals, spacing, window, second.grid, heights)
    height, overlaps = heights[:, 0], heights[:, 1] >= 0
    if overlaps.sum() < _LEAST_PLACES:
        return None
    height = height[overlaps]
    log_gain = None
    if first.colours is not None and second.colours is not None:
        there = second.colours.reshape(-1, 3)[heights[overlaps, 1].astype(int)]
        log_gain = _estimate_log_gain(first.colours[mask][subset][overlaps], there)
    gate = max(_GATE_SIGMAS * robust_sigma(height, about=0.0), 3.0 * noise, 0.25 * spacing)
    gate = min(gate, window)
    return SurfaceAgreement(
        places=int(overlaps.sum()),
        rms_mm=rms(height[np.abs(height) <= gate]),
        gate_mm=gate,
        log_gain=log_gain,
    )


def _estimate_log_gain(first: np.ndarray, second: np.ndarray) -> float | None:
    """Return the median logarithm of the second colours' brightness over the first's, (n, 3) uint8
    each.

    None where too few are neither dark nor saturated.
    """
    first, second = first.mean(axis=1, dtype=float), second.mean(axis=1, dtype=float)
    exposed = (first > 8) & (first < 250) & (second > 8) & (second < 250)
    if exposed.sum() < _LEAST_PLACES:
        return None
    return float(np.median(np.log(second[exposed] / first[exposed])))


def colour_gains(views: Views, pairs: Agreements) -> dict[str, float] | None:
    """Estimate the factor of each scan's colours that makes overlapping scans agree, least squares
    of the logarithms.

    The mean logarithm is 0. None where a scan has no colours.
    """
    if any(view.colours is None for view in views.values()):
        return None
    names = list(views)
    # weak equations for a mean of 0, and for 0 of a scan without overlap
    rows = [np.full(len(names), 1e-3), *(1e-6 * np.eye(len(names)))]
    values = [0.0] * len(rows)
    for (a, b), pair in pairs.items():
        if pair.log_gain is not None:
            weight, of = np.sqrt(pair.places), np.eye(len(names))
            rows.append(weight * (of[names.index(b)] - of[names.index(a)]))
            values.append(-weight * pair.log_gain)
    solution, *_ = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)
    return dict(zip(names, np.exp(solution).tolist(), strict=True))
