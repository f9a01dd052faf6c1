"""A start from points that an operator picked on both scans."""

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rigid import fit_rigid, move_points
from slviewer.geometry.vectors import diagonal, lengths
from slviewer.registration.refusal import Refused
from slviewer.registration.start import Candidate

LEAST_PICKS = 3
_THIN = 0.1
"""Picks whose second extent is a smaller share of the first lie on a line: they leave the turn
about it open."""
_WORST = 0.15
"""Of the picks' extent: what is worse was not the same points, and ICP would not find back."""


def fit_picked_start(
    scan_points: np.ndarray, reference_points: np.ndarray
) -> tuple[Candidate, np.ndarray]:
    """The pose that brings three or more picked points (n, 3) mm of the scan onto those of the
    reference, in order, and how far each pair (n,) stays apart in mm.

    Raises ``InputError`` for picks that do not belong together, and ``Refused`` for ones that lie
    on a line or that no rigid motion brings near each other.
    """
    p, q = np.asarray(scan_points, dtype=np.float64), np.asarray(reference_points, dtype=np.float64)
    if p.shape != q.shape or p.ndim != 2 or p.shape[1] != 3:
        raise InputError(
            f"Picked points of shapes {p.shape} and {q.shape} are not pairs: pick as many on both"
            " scans."
        )
    if len(p) < LEAST_PICKS:
        raise InputError(
            f"{len(p)} point pairs were picked: pick {LEAST_PICKS} or more, well apart."
        )
    if not (np.isfinite(p).all() and np.isfinite(q).all()):
        raise InputError("A picked point lies where nothing was measured: pick on the surface.")
    for name, points in (("scan", p), ("reference", q)):
        extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if not extents[1] > _THIN * extents[0] or not extents[0] > 0:
            raise Refused(
                "picks",
                f"The points picked on the {name} lie on one line, which leaves the turn about it"
                " open: pick one more beside it.",
            )
    T = fit_rigid(p, q)
    residual = lengths(move_points(T, p) - q)
    extent = diagonal(q)
    if residual.max() > _WORST * extent:
        raise Refused(
            "picks",
            f"The picked pairs stay up to {residual.max():.1f} mm apart (pair"
            f" {int(residual.argmax()) + 1} the most): pick the same points, in the same order, on"
            " both scans.",
        )
    return Candidate(T, "picked"), np.asarray(residual)
