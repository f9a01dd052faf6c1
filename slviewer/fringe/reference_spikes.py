"""Spikes of one period, and pixels that nothing vouches for, in NumPy: the definition of `kernels_spikes`."""

import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.layout import Layout
from slviewer.fringe.levels import unambiguous_px
from slviewer.fringe.phase import Reason

TWO_PI = 2 * np.pi
OFFSETS = [
    (dv, du)
    for dv in range(-limits.WINDOW, limits.WINDOW + 1)
    for du in range(-limits.WINDOW, limits.WINDOW + 1)
    if (dv, du) != (0, 0)
]


def settle(found: Layout, phase: np.ndarray, reason: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Phase and reason after a look at each pixel's neighbourhood; (h, w) each, new arrays.

    A plain Gray code may be read from the wrong side of its edge: where a clear majority of the neighbours says so,
    such a pixel is moved by the one period. What then still stands alone is INCONSISTENT. A depth step has enough
    neighbours on its own side, and is left as it is.
    """
    cell = cell_rad(found)
    if is_plain(found):
        phase = _repaired(found, phase, cell)
    reason = reason.copy()
    v, u, votes = _votes(phase, cell, repeat_cells(found))
    few = votes["valid"] < limits.LONELY_NEIGHBOURS
    lonely = votes["agree"] < limits.LONELY * votes["valid"]
    wrong = few | lonely
    reason[v[wrong], u[wrong]] = Reason.INCONSISTENT
    low, high = border_rad(found)
    with np.errstate(invalid="ignore"):
        reason[(reason == Reason.VALID) & ((phase < low) | (phase > high))] = Reason.OUTSIDE
    return np.where(reason == Reason.VALID, phase, np.float32(np.nan)), reason


def is_plain(found: Layout) -> bool:
    """Whether the order comes from a plain Gray code, whose edges coincide with the wraps of the phase."""
    return found.numbers_periods and found.complementary is None


def cell_rad(found: Layout) -> float:
    """Phase by which neighbours must differ to count as a cell apart: a period, or for Gray code alone so much that
    neighbouring cells agree."""
    return TWO_PI if found.shifts else TWO_PI * max(limits.GRAY_CELL_PX / found.gray_cell_px, limits.GRAY_CELLS)


def repeat_cells(found: Layout) -> float:
    """Cells after which a relative phase repeats; infinite for an absolute one."""
    return unambiguous_px(found) / found.period_px


def border_rad(found: Layout) -> tuple[float, float]:
    """The phases of the projector's two borders, a tolerance outside; infinite for a relative phase."""
    if np.isfinite(unambiguous_px(found)):
        return -np.inf, np.inf
    scale = TWO_PI / found.period_px
    return (-0.5 - limits.OUTSIDE_PX) * scale, (found.extent - 0.5 + limits.OUTSIDE_PX) * scale


def _repaired(found: Layout, phase: np.ndarray, cell: float) -> np.ndarray:
    v, u, votes = _votes(phase, cell, np.inf)
    enough = (votes["valid"] >= limits.SPIKE_NEIGHBOURS) & _at_edge(found, phase[v, u])
    phase = phase.copy()
    for word, shift in (("above", 1), ("below", -1)):
        move = enough & (votes[word] >= limits.SPIKE_MAJORITY * votes["valid"])
        phase[v[move], u[move]] += np.float32(shift * TWO_PI)
    return phase


def _at_edge(found: Layout, phase: np.ndarray) -> np.ndarray:
    part = (phase - np.float32(found.origin_rad)) * np.float32(1 / TWO_PI)
    part -= np.floor(part)
    return (part < np.float32(limits.EDGE)) | (part >= np.float32(1 - limits.EDGE))


def _votes(phase: np.ndarray, cell: float, repeat: float) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Pixels that differ from one of their four neighbours, and how their window votes.

    ``valid`` neighbours; those that ``agree``; those that are just one cell ``above``, ``below``. The phase is
    known modulo ``repeat`` cells.
    """
    margin = limits.WINDOW
    padded = np.pad(phase, margin, constant_values=np.nan)
    per_cell = np.float32(1 / cell)
    centre = padded[margin:-margin, margin:-margin]
    suspect = np.zeros(phase.shape, bool)
    with np.errstate(invalid="ignore"):
        for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            near = padded[margin + dv : margin + dv + phase.shape[0], margin + du : margin + du + phase.shape[1]]
            suspect |= ~(np.abs(np.rint((near - centre) * per_cell)) < 0.5)
        v, u = np.nonzero(suspect & np.isfinite(phase))
        votes = {word: np.zeros(len(v), np.int32) for word in ("valid", "agree", "above", "below")}
        for dv, du in OFFSETS:
            cells = (padded[v + margin + dv, u + margin + du] - phase[v, u]) * per_cell
            if np.isfinite(repeat):
                cells -= np.float32(repeat) * np.rint(cells * np.float32(1 / repeat))
            nearest = np.rint(cells)
            whole = np.abs(cells - nearest) < np.float32(limits.WHOLE_PERIOD)
            votes["valid"] += np.isfinite(cells)
            votes["agree"] += nearest == 0
            votes["above"] += whole & (nearest == 1)
            votes["below"] += whole & (nearest == -1)
    return v, u, votes
