"""Initial alignment of a scan to a nominal model."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from slviewer.errors import SlviewerError
from slviewer.geometry.vectors import unit_vectors
from slviewer.inspection.nominal_surface import NominalSurface
from slviewer.registration.pairwise import MOST_ATTEMPTS, Registration, register_prepared
from slviewer.registration.refusal import Refused
from slviewer.registration.scan import PreparedScan, prepare_scan
from slviewer.registration.start import search_starts

SAMPLES = 60_000
"""Points of the nominal that a scan is aligned with, all around it."""
MAX_POINTS = 40_000
MIN_VISIBLE = 2_000
GOOD_RMS = 0.002
"""Of the nominal's diagonal: no better place is looked for than one that leaves less, or thrice the
noise, of most of the scan."""
GOOD_OVERLAP = 0.6
LEAST_SCORE = 0.1
"""Share of the scan that must lie on the nominal after the coarse search: from there on a pose is
refined. The part itself reaches 0.5 and more, other parts below 0.15."""
VIEWS = [
    unit_vectors(np.array(view))
    for view in sorted(
        product((-1, 0, 1), repeat=3), key=lambda v: (np.count_nonzero(v), -abs(v[2]))
    )[1:]
]
"""From where a model is looked at: its sides, from below and above first, then its edges, then its
corners."""
MIN_FACING_COSINE = 0.1
AWAY = 3.0
"""Diagonals: from so far."""


def search_start(
    points: np.ndarray,
    normals: np.ndarray | None,
    surface: NominalSurface,
    sigma_mm: float | None,
    report: Callable[[float], None],
    views: Sequence[np.ndarray] = VIEWS,
) -> Registration:
    """The scan (n, 3) registered to the nominal.

    A scan shows one side of a part: the nominal is tried as a camera sees it from each of
    ``views``, until one fits well; else the best that is accepted. Raises the first refusal where
    none is.
    """
    places, facing = surface.sample(SAMPLES)
    step = -(-len(points) // MAX_POINTS)
    scan = prepare_scan(
        "scan", points[::step], None if normals is None else normals[::step], sigma_mm
    )
    good = max(GOOD_RMS * surface.diagonal, 3.0 * (sigma_mm or 0.0))
    refusal: SlviewerError | None = None
    best: Registration | None = None
    for turn, view in enumerate(views):
        report(turn / len(views))
        visible = surface.seen_from(places, facing, view, MIN_FACING_COSINE)
        if np.count_nonzero(visible) < MIN_VISIBLE:
            continue
        camera = surface.middle + AWAY * surface.diagonal * view
        try:
            result = _register_symmetric(
                scan, prepare_scan("nominal model", places[visible] - camera, facing[visible])
            )
        except SlviewerError as error:
            refusal = refusal or error
            continue
        T = result.T_reference_scan.copy()
        T[:3, 3] += camera
        result = replace(result, T_reference_scan=T)
        if best is None or result.rms_mm / result.overlap < best.rms_mm / best.overlap:
            best = result
        if best.rms_mm <= good and best.overlap >= GOOD_OVERLAP:
            break
    if best is None and isinstance(refusal, Refused):
        raise refusal.with_context(
            "The scan could not be aligned to the nominal model: see that it shows this part, at"
            " this size, and that little else is in view. One of the tries ended so:"
        )
    if best is None:
        raise refusal or SlviewerError(
            "The nominal model shows no side that a scan could lie on: check the file."
        )
    return best


def _register_symmetric(scan: PreparedScan, reference: PreparedScan) -> Registration:
    """Register as ``register_prepared``; of a part with symmetries return the pose of least
    residuals: the choice among them does not change the deviations."""
    size = min(scan.size, reference.size)
    starts = search_starts(scan, reference, size)
    if starts[0].score < LEAST_SCORE:
        raise Refused(
            "overlap",
            f"At most {100 * starts[0].score:.0f} % of the scan lies on a side of the model, in any"
            " of its poses.",
        )
    try:
        return register_prepared(scan, reference, size, starts)
    except Refused as error:
        if error.reason != "ambiguous":
            raise
        refusal = error
    alike = []
    for start in starts[:MOST_ATTEMPTS]:
        try:
            given = replace(start, start="initial")
            alike.append(register_prepared(scan, reference, size, given))
        except Refused:
            continue
    if not alike:
        raise refusal
    return min(alike, key=lambda result: result.rms_mm / result.overlap)
