"""Fusion of registered scans to one set of points, with overlapping surfaces averaged.

Every point of a scan is moved along its normal to the weighted mean of all scans' surfaces; of
overlapping scans, only the points of the one with the highest quality are kept. Weights are 1 /
sigma2 and decrease to 0 at each scan's border, so that no step shows where a scan ends. Another
scan's surface is interpolated between pixels, with a lower weight where it is curved, so that
nothing is smoothed beyond one scan's resolution.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rigid import move_points
from slviewer.reconstruction.cloud import Cloud, choose_pixels
from slviewer.surface.agreement import (
    Agreements,
    SurfaceAgreement,
    Views,
    colour_gains,
    compare_views,
)
from slviewer.surface.clean import viewing_cosines
from slviewer.surface.overlap_kernels import FIELDS, add_surface, add_votes
from slviewer.surface.shapes import PointSet
from slviewer.surface.view import View, prepare_view

Progress = Callable[[float], None]

MIN_WITNESS_WEIGHT = 0.3
"""Least border weight of a pixel whose free space can contradict another scan's points."""


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


PoseCovariance = tuple[np.ndarray, np.ndarray]
"""Covariance (6, 6) of a scan's pose in the reference's frame: of a small rotation (rad) about a
centre (3,) mm, and of a translation (mm); and that centre."""


def fuse(
    scans: Mapping[str, Cloud],
    T_reference_scan: Mapping[str, np.ndarray],
    progress: Progress | None = None,
    poses: Mapping[str, PoseCovariance] | None = None,
) -> Fused:
    """Fuse organised clouds, each in its camera's frame, with the pose (4, 4) of each by the same
    name.

    ``poses``: how uncertain these poses are; it becomes part of the points' sigmas, as if a point
    were from its best scan alone.

    ``progress`` receives the completed share of the work, 0 to 1, and may raise to cancel. A single
    scan is only cleaned. Raises InputError for a scan without a pose, without a surface, or whose
    points are not those of one camera.
    """
    if not 1 <= len(scans) <= 255:
        raise InputError(f"{len(scans)} scans were given: fusing takes 1 to 255.")
    for name in scans:
        if name not in T_reference_scan:
            raise InputError(f"{name} has no pose: register it first, or exclude it.")
    report = progress or (lambda share: None)
    views = {}
    for i, (name, cloud) in enumerate(scans.items()):
        report(0.3 * i / len(scans))
        views[name] = prepare_view(name, cloud, T_reference_scan[name])
    names = tuple(views)
    pairs = compare_views(views, lambda share: report(0.3 + 0.1 * share))
    excluded = {name: asdict(view.cleaned) for name, view in views.items()}
    for name, violations in _detect_violations(
        views, pairs, lambda share: report(0.4 + 0.1 * share)
    ).items():
        excluded[name]["unconfirmed"] = int(violations.sum())
        views[name] = views[name].without(violations)
    gains = colour_gains(views, pairs)
    parts = []
    for i, name in enumerate(names):
        report(0.5 + 0.5 * i / len(names))
        points, seen_by = _fuse_scan(name, views, pairs, gains)
        if poses is not None and name in poses:
            points = _add_pose_error(points, *poses[name])
        parts.append((points, seen_by))
    report(1.0)
    return Fused(
        surface=_concatenate([part[0] for part in parts]),
        source=np.repeat(np.arange(len(names), dtype=np.uint8), [len(part[0]) for part in parts]),
        seen_by=np.concatenate([part[1] for part in parts]),
        names=names,
        excluded=excluded,
        pairs=pairs,
    )


def _detect_violations(
    views: Views, pairs: Agreements, progress: Progress
) -> dict[str, np.ndarray]:
    """Detect the points, (h, w) bool by scan, in the free space of more scans than the number that
    confirm them."""
    witnesses = {name: _select_witnesses(view) for name, view in views.items()}
    violations = {}
    for i, (name, view) in enumerate(views.items()):
        progress(i / len(views))
        mask = view.mask
        points = choose_pixels(view.points, mask)
        confirming, contradicting = np.zeros(len(points), np.int16), np.zeros(len(points), np.int16)
        for other, there in views.items():
            if other != name:
                T = np.linalg.inv(there.T) @ view.T
                # along the viewing direction two surfaces may be farther apart than along their
                # normal
                gate = 2.0 * max(
                    _gate_mm(pairs, name, other, view, there), view.spacing, there.spacing
                )
                add_votes(
                    move_points(T, points), gate, there.points, witnesses[other], there.to_pixel,
                    confirming,
                    contradicting,
                )  # fmt: skip
        violations[name] = np.zeros(mask.shape, bool)
        violations[name][mask] = contradicting > confirming
    return violations


def _select_witnesses(view: View) -> np.ndarray:
    """Select the pixels (h, w) bool whose free space is certain: inside the surface, and not at
    grazing angles."""
    inside = cv2.erode(view.mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    facing = viewing_cosines(view.points, view.normals) > 0.25
    return np.asarray(inside & (view.inner > MIN_WITNESS_WEIGHT) & facing)


def _gate_mm(pairs: Agreements, a: str, b: str, first: View, second: View) -> float:
    """Return the gate of two scans by their agreement, or the larger of their point spacings
    without one."""
    pair = pairs.get((a, b)) or pairs.get((b, a))
    return pair.gate_mm if pair else max(first.spacing, second.spacing)


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
        share = inner * -np.einsum("ij,ij->i", points, normals) / np.linalg.norm(points, axis=1)
        sums[:, 8] = share
        sums[:, 9:] = share[:, None] * gains[name] * own_colours
    scans = np.ones(len(points), np.uint8)
    inferior = np.zeros(len(points), bool)
    for other, there in views.items():
        if (name, other) not in pairs and (other, name) not in pairs:
            continue
        overlap = np.zeros((len(points), FIELDS))
        add_surface(
            *view.move_into(there, points, normals),
            view.quality[mask],
            np.ascontiguousarray(there.T[:3, :3]),
            max(view.spacing, there.spacing),
            _gate_mm(pairs, name, other, view, there),
            there.grid,
            there.colours if own_colours is not None else np.zeros((0, 0, 3), np.uint8),
            1.0 if gains is None else gains[other],
            order.index(other) < order.index(name),
            overlap,
            inferior,
        )
        scans += (overlap[:, 7] > 0).astype(np.uint8)
        sums += overlap
    best = ~inferior
    return (
        _average(view, points[best], normals[best], sums[best], own_colours is not None),
        scans[best],
    )


def _average(
    view: View, points: np.ndarray, normals: np.ndarray, sums: np.ndarray, coloured: bool
) -> PointSet:
    """Return the averages of a scan's points (n, 3) in the reference's frame from their ``sums``
    (n, FIELDS)."""
    total = sums[:, 0]
    height = sums[:, 1] / total
    moved = move_points(view.T, points + height[:, None] * normals)
    mean_normals = sums[:, 4:7] / np.linalg.norm(sums[:, 4:7], axis=1, keepdims=True)
    sigma = np.hypot(np.sqrt(sums[:, 2]) / total, sums[:, 3] / total)
    colours = None
    if coloured:
        colours = np.clip(sums[:, 9:] / np.maximum(sums[:, 8:9], 1e-12) + 0.5, 0, 255).astype(
            np.uint8
        )
    return PointSet(moved, mean_normals, colours, sigma)


def _add_pose_error(points: PointSet, covariance: np.ndarray, centre: np.ndarray) -> PointSet:
    """Return the points with the error that their scan's pose has along the normals added to their
    sigmas."""
    assert points.normals is not None and points.sigma_mm is not None
    lever = np.hstack([np.cross(points.points - centre, points.normals), points.normals])
    pose = np.einsum("ij,jk,ik->i", lever, covariance, lever)
    return replace(points, sigma_mm=np.sqrt(points.sigma_mm**2 + np.maximum(pose, 0.0)))


def _concatenate(parts: list[PointSet]) -> PointSet:
    """Concatenate point sets; attributes that one of them lacks are None."""
    joined: dict[str, Any] = {}
    for field in fields(PointSet):
        values = [getattr(part, field.name) for part in parts]
        joined[field.name] = (
            None if any(value is None for value in values) else np.concatenate(values)
        )
    return PointSet(**joined)
