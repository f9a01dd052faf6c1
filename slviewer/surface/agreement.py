"""Agreement of overlapping scans: their distances, the gate within which they are one surface, and
brightness gains."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from slviewer.geometry.robust import robust_sigma
from slviewer.reconstruction.cloud import choose_pixels
from slviewer.surface.overlap_kernels import measure_heights
from slviewer.surface.view import View

_SAMPLES = 20_000
_LEAST_PLACES = 30
_WINDOW_SPACINGS = 6.0  # largest distance of points that may be of one surface, in point spacings
_WINDOW_SIGMAS = 12.0  # and in standard deviations, whichever is larger
_GATE_SIGMAS = 6.0


@dataclass(frozen=True)
class SurfaceAgreement:
    """Comparison of two scans where they overlap.

    ``places``: number of compared points; ``rms_mm`` and ``bias_mm`` (median): height of the second
    scan's surface above the first's along the normal; ``gate_mm``: height within which both are one
    surface; ``log_gain``: median logarithm of the second's brightness over the first's, None
    without colours.
    """

    places: int
    rms_mm: float
    bias_mm: float
    gate_mm: float
    log_gain: float | None


Views = Mapping[str, View]
Agreements = Mapping[tuple[str, str], SurfaceAgreement]
"""Of overlapping scans, by their names."""


def compare_views(
    views: Views, progress: Callable[[float], None]
) -> dict[tuple[str, str], SurfaceAgreement]:
    """Compare every ordered pair of scans; pairs that overlap in too few points are missing from
    the result."""
    agreements: dict[tuple[str, str], SurfaceAgreement] = {}
    pairs = list(permutations(views, 2))
    for i, (a, b) in enumerate(pairs):
        progress(i / len(pairs))
        agreement = _compare_pair(views[a], views[b])
        if agreement is not None:
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
    noise = float(np.median(first.noise[mask][subset])) + float(
        np.median(second.noise[second.mask])
    )
    window = max(_WINDOW_SPACINGS * spacing, _WINDOW_SIGMAS * noise)
    heights = np.empty((len(points), 2))
    measure_heights(points, normals, spacing, window, second.grid, heights)
    height, overlaps = heights[:, 0], heights[:, 1] >= 0
    if overlaps.sum() < _LEAST_PLACES:
        return None
    height = height[overlaps]
    log_gain = None
    if first.colours is not None and second.colours is not None:
        there = second.colours.reshape(-1, 3)[heights[overlaps, 1].astype(int)]
        log_gain = _estimate_log_gain(first.colours[mask][subset][overlaps], there)
    gate = min(
        max(_GATE_SIGMAS * robust_sigma(height, about=0.0), 3.0 * noise, 0.25 * spacing), window
    )
    return SurfaceAgreement(
        places=int(overlaps.sum()),
        rms_mm=float(np.sqrt(np.mean(height[np.abs(height) <= gate] ** 2))),
        bias_mm=float(np.median(height)),
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
            row = np.zeros(len(names))
            weight = np.sqrt(pair.places)
            row[names.index(a)], row[names.index(b)] = -weight, weight
            rows.append(row)
            values.append(-weight * pair.log_gain)
    solution, *_ = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)
    return {name: float(np.exp(value)) for name, value in zip(names, solution, strict=True)}
