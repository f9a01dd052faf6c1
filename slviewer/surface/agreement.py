"""How scans that overlap agree: in place, which says within which distance they are one surface, and in brightness."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from slviewer.surface.meeting_kernels import compare
from slviewer.surface.view import View

_SAMPLES = 20_000
_LEAST_PLACES = 30
_WINDOW_SPACINGS = 6.0  # nothing further away is taken for the same surface
_WINDOW_SIGMAS = 12.0
_GATE_SIGMAS = 6.0


@dataclass(frozen=True)
class SurfaceAgreement:
    """Two scans where they overlap: ``places`` compared; ``rms_mm``, ``bias_mm`` (median), of the distance of the
    second's surface above the first's along the normal; ``gate_mm``, within which they are one; ``log_gain``, the
    median logarithm of the second's brightness over the first's, or None without colours."""

    places: int
    rms_mm: float
    bias_mm: float
    gate_mm: float
    log_gain: float | None


def agreements(views: Mapping[str, View], say: Callable[[float], None]) -> dict[tuple[str, str], SurfaceAgreement]:
    """Every ordered pair of scans of which the first meets the second in enough places."""
    found: dict[tuple[str, str], SurfaceAgreement] = {}
    ways = list(permutations(views, 2))
    for i, (a, b) in enumerate(ways):
        say(i / len(ways))
        agreement = _compared(views[a], views[b])
        if agreement is not None:
            found[a, b] = agreement
    return found


def _compared(here: View, there: View) -> SurfaceAgreement | None:
    mask = here.mask
    every = slice(None, None, max(1, int(mask.sum()) // _SAMPLES))
    T = np.linalg.inv(there.T) @ here.T
    points = np.ascontiguousarray(here.points[mask][every] @ T[:3, :3].T + T[:3, 3])
    normals = np.ascontiguousarray(here.normals[mask][every] @ T[:3, :3].T)
    spacing = max(here.spacing, there.spacing)
    noise = float(np.median(here.noise[mask][every])) + float(np.median(there.noise[there.mask]))
    window = max(_WINDOW_SPACINGS * spacing, _WINDOW_SIGMAS * noise)
    out = np.empty((len(points), 2))
    compare(
        points, normals, spacing, window, there.points, there.normals, there.noise, there.lasting, there.inner,
        there.to_pixel, out,
    )  # fmt: skip
    height, met = out[:, 0], out[:, 1] >= 0
    if met.sum() < _LEAST_PLACES:
        return None
    height = height[met]
    scatter = 1.4826 * float(np.median(np.abs(height)))
    gate = min(max(_GATE_SIGMAS * scatter, 3.0 * noise, 0.25 * spacing), window)
    return SurfaceAgreement(
        places=int(met.sum()),
        rms_mm=float(np.sqrt(np.mean(height[np.abs(height) <= gate] ** 2))),
        bias_mm=float(np.median(height)),
        gate_mm=gate,
        log_gain=_log_gain(here, there, mask, every, out[met, 1].astype(int), met),
    )


def _log_gain(
    here: View, there: View, mask: np.ndarray, every: slice, pixel: np.ndarray, met: np.ndarray
) -> float | None:
    if here.colours is None or there.colours is None:
        return None
    first = here.colours[mask][every][met].mean(axis=1, dtype=float)
    second = there.colours.reshape(-1, 3)[pixel].mean(axis=1, dtype=float)
    exposed = (first > 8) & (first < 250) & (second > 8) & (second < 250)
    if exposed.sum() < _LEAST_PLACES:
        return None
    return float(np.median(np.log(second[exposed] / first[exposed])))


def colour_gains(
    views: Mapping[str, View], pairs: Mapping[tuple[str, str], SurfaceAgreement]
) -> dict[str, float] | None:
    """What each scan's colours are multiplied by so that overlapping ones agree; their mean logarithm is 0.

    None where a scan has no colours.
    """
    if any(view.colours is None for view in views.values()):
        return None
    names = list(views)
    rows, values = [np.full(len(names), 1e-3)], [0.0]  # the mean, and 0 for a scan that meets none
    for k in range(len(names)):
        row = np.zeros(len(names))
        row[k] = 1e-6
        rows.append(row)
        values.append(0.0)
    for (a, b), pair in pairs.items():
        if pair.log_gain is not None:
            row = np.zeros(len(names))
            weight = np.sqrt(pair.places)
            row[names.index(a)], row[names.index(b)] = -weight, weight
            rows.append(row)
            values.append(-weight * pair.log_gain)
    solution, *_ = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)
    return {name: float(np.exp(value)) for name, value in zip(names, solution, strict=True)}
