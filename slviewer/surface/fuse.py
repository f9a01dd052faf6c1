"""Several scans of one object made one surface: what they measure in common is averaged, not stacked.

Every point of a scan is moved along its normal to the weighted mean of all scans' surfaces there; of the scans that
see a place the one that knows it best keeps its points, the others' go. Weights are 1 / sigma2, and fall to nothing
towards each scan's border, so that no step shows where a scan ends. Another scan's surface is taken from the pixels
next to the place, and counts less where it bends between them: nothing is smoothed beyond what one scan resolves.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.reconstruction.cloud import Cloud
from slviewer.surface.agreement import SurfaceAgreement, agreements, colour_gains
from slviewer.surface.meeting_kernels import FIELDS, gather, vote
from slviewer.surface.shapes import PointSet
from slviewer.surface.view import View, prepare_view

Progress = Callable[[float], None]

SURE = 0.3
"""How far inside its border (as a weight, 0 to 1) a pixel must lie to deny another scan's point."""


@dataclass(frozen=True, eq=False)
class Fused:
    """The one surface of several scans, in the frame of their poses.

    ``surface``: its points, with normals towards the cameras, the sigma along them, colours where every scan has some.
    ``source`` (n,) uint8 says which of ``names`` a point's place across the normal comes from; ``seen_by`` (n,) uint8
    how many scans it is the mean of. ``excluded``: pixels of each scan that lie on no surface, and why; ``pairs``: how
    scans that overlap agree, by their names.
    """

    surface: PointSet
    source: np.ndarray
    seen_by: np.ndarray
    names: tuple[str, ...]
    excluded: dict[str, dict[str, int]]
    pairs: dict[tuple[str, str], SurfaceAgreement]

    @property
    def shared(self) -> float:
        """The share of the points that more than one scan measured."""
        return float((self.seen_by > 1).mean())


def fuse(
    scans: Mapping[str, Cloud], T_reference_scan: Mapping[str, np.ndarray], progress: Progress | None = None
) -> Fused:
    """Fuse organised clouds, each in its camera's frame, with the pose (4, 4) of each by the same name.

    ``progress`` receives the share of the work done, 0 to 1, and may raise to cancel. A single scan is cleaned only.
    Raises InputError for a scan without a pose, without a surface, or whose points are not those of one camera.
    """
    if not 1 <= len(scans) <= 255:
        raise InputError(f"{len(scans)} scans were given: fusing takes 1 to 255.")
    for name in scans:
        if name not in T_reference_scan:
            raise InputError(f"{name} has no pose: register it first, or leave it out.")
    say = progress or (lambda share: None)
    views = {}
    for i, (name, cloud) in enumerate(scans.items()):
        say(0.3 * i / len(scans))
        views[name] = prepare_view(name, cloud, T_reference_scan[name])
    names = tuple(views)
    pairs = agreements(views, lambda share: say(0.3 + 0.1 * share))
    excluded = {
        name: {
            "edges": v.cleaned.edges,
            "grazing": v.cleaned.grazing,
            "groups": v.cleaned.groups,
            "far": v.cleaned.far,
        }
        for name, v in views.items()
    }
    for name, denied in _denied(views, pairs, lambda share: say(0.4 + 0.1 * share)).items():
        excluded[name]["unconfirmed"] = int(denied.sum())
        views[name] = views[name].without(denied)
    gains = colour_gains(views, pairs)
    parts = []
    for i, name in enumerate(names):
        say(0.5 + 0.5 * i / len(names))
        parts.append(_fused_points(name, views, pairs, gains))
    say(1.0)
    return Fused(
        surface=_joined([part[0] for part in parts]),
        source=np.repeat(np.arange(len(names), dtype=np.uint8), [len(part[0]) for part in parts]),
        seen_by=np.concatenate([part[1] for part in parts]),
        names=names,
        excluded=excluded,
        pairs=pairs,
    )


def _denied(
    views: Mapping[str, View], pairs: Mapping[tuple[str, str], SurfaceAgreement], say: Progress
) -> dict[str, np.ndarray]:
    """By scan, (h, w) bool: the points that more scans see through than see."""
    sure = {name: _sure(view) for name, view in views.items()}
    denied = {}
    for i, (name, view) in enumerate(views.items()):
        say(i / len(views))
        mask = view.mask
        points = view.points[mask]
        seen, through = np.zeros(len(points), np.int16), np.zeros(len(points), np.int16)
        for other, there in views.items():
            if other != name:
                T = np.linalg.inv(there.T) @ view.T
                # along the line of sight a surface may lie further off than along its normal
                gate = max(2.0 * _gate(pairs, name, other, view, there), 2.0 * max(view.spacing, there.spacing))
                vote(_moved(points, T), gate, there.points, sure[other], there.to_pixel, seen, through)
        denied[name] = np.zeros(mask.shape, bool)
        denied[name][mask] = through > seen
    return denied


def _sure(view: View) -> np.ndarray:
    """Pixels that can deny: inside, with all their neighbours, and not seen too much from the side."""
    whole = cv2.erode(view.mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    towards = -np.einsum("ijk,ijk->ij", view.normals, view.points) / np.linalg.norm(view.points, axis=-1)
    return np.asarray(whole & (view.inner > SURE) & (towards > 0.25))


def _gate(pairs: Mapping[tuple[str, str], SurfaceAgreement], a: str, b: str, here: View, there: View) -> float:
    pair = pairs.get((a, b)) or pairs.get((b, a))
    return pair.gate_mm if pair else max(here.spacing, there.spacing)


def _fused_points(
    name: str,
    views: Mapping[str, View],
    pairs: Mapping[tuple[str, str], SurfaceAgreement],
    gains: Mapping[str, float] | None,
) -> tuple[PointSet, np.ndarray]:
    """The points that a scan keeps, in the reference's frame, and how many scans each is the mean of."""
    view, order = views[name], list(views)
    mask = view.mask
    points, normals = view.points[mask], view.normals[mask]
    noise, lasting, inner = view.noise[mask], view.lasting[mask], view.inner[mask]
    R = view.T[:3, :3]
    weight = inner / (noise.astype(np.float64) ** 2 + lasting.astype(np.float64) ** 2)
    sums = np.zeros((len(points), FIELDS))
    sums[:, 0], sums[:, 2], sums[:, 3] = weight, (weight * noise) ** 2, weight * lasting
    sums[:, 4:7] = weight[:, None] * (normals @ R.T)
    own_colours = None
    if gains is not None and view.colours is not None:
        own_colours = view.colours[mask]
        share = inner * -np.einsum("ij,ij->i", points, normals) / np.linalg.norm(points, axis=1)
        sums[:, 8] = share
        sums[:, 9:] = share[:, None] * gains[name] * own_colours
    scans = np.ones(len(points), np.uint8)
    lost = np.zeros(len(points), bool)
    for other, there in views.items():
        if (name, other) not in pairs and (other, name) not in pairs:
            continue
        T = np.linalg.inv(there.T) @ view.T
        here = (np.ascontiguousarray(_moved(points, T)), np.ascontiguousarray(normals @ T[:3, :3].T))
        meeting = np.zeros((len(points), FIELDS))
        gather(
            *here,
            view.quality[mask],
            np.ascontiguousarray(there.T[:3, :3]),
            max(view.spacing, there.spacing),
            _gate(pairs, name, other, view, there),
            there.points,
            there.normals,
            there.noise,
            there.lasting,
            there.inner,
            there.quality,
            there.colours if own_colours is not None else np.zeros((0, 0, 3), np.uint8),
            1.0 if gains is None else gains[other],
            order.index(other) < order.index(name),
            there.to_pixel,
            meeting,
            lost,
        )
        scans += (meeting[:, 7] > 0).astype(np.uint8)
        sums += meeting
    kept = ~lost
    return _settled(view, points[kept], normals[kept], sums[kept], own_colours is not None), scans[kept]


def _settled(view: View, points: np.ndarray, normals: np.ndarray, sums: np.ndarray, coloured: bool) -> PointSet:
    total = sums[:, 0]
    height = sums[:, 1] / total
    moved = _moved(points + height[:, None] * normals, view.T)
    mean_normals = sums[:, 4:7] / np.linalg.norm(sums[:, 4:7], axis=1, keepdims=True)
    sigma = np.hypot(np.sqrt(sums[:, 2]) / total, sums[:, 3] / total)
    colours = None
    if coloured:
        colours = np.clip(sums[:, 9:] / np.maximum(sums[:, 8:9], 1e-12) + 0.5, 0, 255).astype(np.uint8)
    return PointSet(moved, mean_normals, colours, sigma)


def _moved(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _joined(parts: list[PointSet]) -> PointSet:
    def each(field: str) -> np.ndarray | None:
        values = [getattr(part, field) for part in parts]
        return None if any(value is None for value in values) else np.concatenate(values)

    whole = PointSet(np.concatenate([part.points for part in parts]))
    return replace(whole, normals=each("normals"), colours=each("colours"), sigma_mm=each("sigma_mm"))
