"""Where on a nominal model a scan lies, to begin with."""

from collections.abc import Callable
from itertools import product

import numpy as np

from slviewer.errors import SlviewerError
from slviewer.inspection.nominal_surface import NominalSurface
from slviewer.registration.pairwise import Registration, register

SAMPLES = 40_000
"""Points of the nominal that a scan is aligned with."""
MOST_POINTS = 40_000
GOOD_RMS = 0.002
"""Of the nominal's diagonal: no better place is looked for than one that leaves less, or thrice the noise, of most of
the scan."""
GOOD_OVERLAP = 0.6
VIEWS = [np.array(v) / np.linalg.norm(v) for v in sorted(product((-1, 0, 1), repeat=3), key=np.count_nonzero)[1:]]
"""From where a model is looked at: its sides, then its edges, then its corners."""
FACING = 0.1


def found_start(
    points: np.ndarray,
    normals: np.ndarray | None,
    surface: NominalSurface,
    sigma_mm: float | None,
    say: Callable[[float], None],
) -> Registration:
    """The scan (n, 3) registered to the nominal.

    A scan shows one side of a part, and what it does not see of the nominal leads a search for features astray: where
    the whole nominal is refused, each of its sides is tried alone. Raises the first refusal where no side is accepted.
    """
    places, facing = surface.sampled(SAMPLES)
    step = -(-len(points) // MOST_POINTS)
    points, normals = points[::step], None if normals is None else normals[::step]
    good = max(GOOD_RMS * surface.diagonal, 3.0 * (sigma_mm or 0.0))
    refusal: SlviewerError | None = None
    best: Registration | None = None
    for turn, view in enumerate([None, *VIEWS]):
        say(turn / (len(VIEWS) + 1))
        seen = slice(None) if view is None else surface.seen_from(places, facing, view, FACING)
        try:
            found = register(
                points,
                places[seen],
                scan_normals=normals,
                reference_normals=facing[seen],
                sigma_mm=sigma_mm,
            )
        except SlviewerError as error:
            refusal = refusal or error
            continue
        if best is None or found.rms_mm / found.overlap < best.rms_mm / best.overlap:
            best = found
        if best.rms_mm <= good and best.overlap >= GOOD_OVERLAP:
            break
    if best is None:
        assert refusal is not None
        raise refusal
    return best
