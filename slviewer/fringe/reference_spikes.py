"""Spikes of one period and pixels without support, in NumPy: the definition of `kernels_spikes`."""

import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.kernels_spikes import SpikeRules, spike_rules
from slviewer.fringe.layout import Layout
from slviewer.fringe.phase import Reason

TWO_PI = 2 * np.pi


def repair_spikes(
    layout: Layout, phase: np.ndarray, reason: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return phase and reason, (h, w) each, new arrays, corrected by each pixel's neighbourhood.

    A plain Gray code may be read on the wrong side of its edge: where a clear majority of the
    neighbours indicates this, such a pixel is moved by the one period. A pixel that still has too
    few supporting neighbours is INCONSISTENT. A depth step has enough neighbours on its own side,
    and is not changed.
    """
    rules = spike_rules(layout)
    phase, reason = phase.copy(), reason.copy()
    if rules.is_plain:
        v, u, votes = _count_votes(phase, rules)
        part = (phase[v, u] - np.float32(rules.origin_rad)) * np.float32(1 / TWO_PI)
        part -= np.floor(part)
        at_edge = (part < np.float32(limits.EDGE)) | (part >= np.float32(1 - limits.EDGE))
        enough = at_edge & (votes["valid"] >= limits.SPIKE_NEIGHBOURS)
        for word, shift in (("above", 1), ("below", -1)):
            move = enough & (votes[word] >= limits.SPIKE_MAJORITY * votes["valid"])
            phase[v[move], u[move]] += np.float32(shift * TWO_PI)
    v, u, votes = _count_votes(phase, rules)
    lonely = (votes["valid"] < limits.LONELY_NEIGHBOURS) | (
        votes["agree"] < limits.LONELY * votes["valid"]
    )
    reason[v[lonely], u[lonely]] = Reason.INCONSISTENT
    with np.errstate(invalid="ignore"):
        reason[(reason == Reason.VALID) & ((phase < rules.low_rad) | (phase > rules.high_rad))] = (
            Reason.OUTSIDE
        )
    return np.where(reason == Reason.VALID, phase, np.float32(np.nan)), reason


def _count_votes(
    phase: np.ndarray, rules: SpikeRules
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return row and column of the pixels that differ from one of their four neighbours, and the
    votes of their window.

    ``valid`` neighbours; those that ``agree``; those that are just one cell ``above``, ``below``.
    The phase is known modulo ``rules.repeat`` cells.
    """
    margin, repeat = limits.WINDOW, rules.repeat
    padded = np.pad(phase, margin, constant_values=np.nan)
    per_cell = np.float32(1 / rules.cell_rad)
    centre = padded[margin:-margin, margin:-margin]
    suspect = np.zeros(phase.shape, bool)
    with np.errstate(invalid="ignore"):
        for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            near = padded[
                margin + dv : margin + dv + phase.shape[0],
                margin + du : margin + du + phase.shape[1],
            ]
            suspect |= ~(np.abs(np.rint((near - centre) * per_cell)) < 0.5)
        v, u = np.nonzero(suspect & np.isfinite(phase))
        votes = {word: np.zeros(len(v), np.int32) for word in ("valid", "agree", "above", "below")}
        for dv, du in np.ndindex(2 * margin + 1, 2 * margin + 1):
            if dv == du == margin:
                continue
            cells = (padded[v + dv, u + du] - phase[v, u]) * per_cell
            if np.isfinite(repeat):
                cells -= np.float32(repeat) * np.rint(cells * np.float32(1 / repeat))
            nearest = np.rint(cells)
            whole = np.abs(cells - nearest) < np.float32(limits.WHOLE_PERIOD)
            votes["valid"] += np.isfinite(cells)
            votes["agree"] += nearest == 0
            votes["above"] += whole & (nearest == 1)
            votes["below"] += whole & (nearest == -1)
    return v, u, votes
