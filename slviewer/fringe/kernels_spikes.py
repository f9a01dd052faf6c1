"""Spikes of one period and pixels without support, compiled: the rule of a pixel, and kernels that
apply it to a map.

The rule is also compiled for CUDA devices (`geometry.cuda_device.device_function`);
`tests/decode_reference.py` defines it. All changes are listed before the first is made, because a
pixel's neighbours vote with their original phase. Nearly every pixel agrees with its four
neighbours, and is skipped at the speed of memory; the others are marked once, for both lists.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.layout import Layout
from slviewer.fringe.levels import unambiguous_px
from slviewer.fringe.phase import Reason
from slviewer.geometry.jit import kernel, run_rows

INCONSISTENT = np.uint8(Reason.INCONSISTENT)
OUTSIDE = np.uint8(Reason.OUTSIDE)
UNCHANGED = np.uint8(0)
UP, DOWN = np.uint8(1), np.uint8(2)
TURN, PER_TURN = np.float32(2 * math.pi), np.float32(0.5 / math.pi)
HALF, ONE, INVALID = np.float32(0.5), np.float32(1), np.float32(math.nan)
EDGE = np.float32(limits.EDGE)
FAR_EDGE = np.float32(1 - limits.EDGE)
WHOLE = np.float32(limits.WHOLE_PERIOD)
WINDOW, MAJORITY, NEIGHBOURS = limits.WINDOW, limits.SPIKE_MAJORITY, limits.SPIKE_NEIGHBOURS
LONELY, LONELY_NEIGHBOURS = limits.LONELY, limits.LONELY_NEIGHBOURS
ENOUGH = math.ceil(LONELY * ((2 * WINDOW + 1) ** 2 - 1))
"""Neighbours that agree with a pixel, which is not lonely however many others are valid."""
RUN = 8
"""Pixels that are passed over together where none is examined: their marks are one word."""


class SpikeRules(NamedTuple):
    """Parameters of a layout that the decision about a pixel from its neighbourhood needs;
    thresholds are in `limits`.

    ``cell_rad``: the phase by which neighbours differ that count as a cell apart; ``is_plain``: the
    order comes from a plain Gray code, whose edges are at ``origin_rad``; ``low_rad`` and
    ``high_rad``: phases of the projector's borders, a tolerance outside, infinite for a relative
    phase, which repeats after ``repeat`` cells.
    """

    cell_rad: float
    is_plain: bool
    origin_rad: float
    low_rad: float
    high_rad: float
    repeat: float


def spike_rules(layout: Layout) -> SpikeRules:
    """Return the rules for the phases of a layout."""
    period = 2 * np.pi
    # Gray code alone has no period: neighbouring cells agree
    cell_rad = (
        period
        if layout.shifts
        else period * max(limits.GRAY_CELL_PX / layout.gray_cell_px, limits.GRAY_CELLS)
    )
    unambiguous, low, high = unambiguous_px(layout), -np.inf, np.inf
    if not np.isfinite(unambiguous):  # absolute: of columns -0.5 ... extent - 0.5
        low, high = -0.5 - limits.OUTSIDE_PX, layout.extent - 0.5 + limits.OUTSIDE_PX
    per_px = period / layout.period_px
    return SpikeRules(
        cell_rad,
        layout.is_plain,
        layout.origin_rad,
        low_rad=low * per_px,
        high_rad=high * per_px,
        repeat=unambiguous / layout.period_px,
    )


@numba.njit
def do_agree(own, other, per_cell):
    """Return whether two phases differ by half a cell at most; False for NaN."""
    return abs((other - own) * per_cell) <= HALF


@numba.njit
def is_suspect(phase, row, x, per_cell):
    """Return whether one of a pixel's four neighbours is missing, or does not agree with it."""
    if row == 0 or row == phase.shape[0] - 1 or x == 0 or x == phase.shape[1] - 1:
        return True
    own = phase[row, x]
    vertical = do_agree(own, phase[row - 1, x], per_cell) and do_agree(
        own, phase[row + 1, x], per_cell
    )
    return not (
        vertical
        and do_agree(own, phase[row, x - 1], per_cell)
        and do_agree(own, phase[row, x + 1], per_cell)
    )


@numba.njit(inline="always")
def measure_cells(other, own, per_cell, rules):
    """Return the cells by which a phase is above a pixel's ``own``; NaN where either is."""
    cells = (other - own) * per_cell
    if rules.repeat < math.inf:
        repeats = round(cells * np.float32(1 / rules.repeat))
        cells -= np.float32(rules.repeat) * np.float32(repeats)
    return cells


@numba.njit(inline="always")
def count_votes(phase, row, x, rules):
    """Count the neighbours in a pixel's window that are valid, and that are a cell above or below
    it."""
    height, width = phase.shape
    per_cell, own = np.float32(1 / rules.cell_rad), phase[row, x]
    valid, above, below = -1, 0, 0  # the pixel itself is valid
    for v in range(max(0, row - WINDOW), min(height, row + WINDOW + 1)):
        for u in range(max(0, x - WINDOW), min(width, x + WINDOW + 1)):
            cells = measure_cells(phase[v, u], own, per_cell, rules)
            valid += cells == cells  # not NaN
            above += abs(cells - ONE) < WHOLE
            below += abs(cells + ONE) < WHOLE
    return valid, above, below


@numba.njit(inline="always")
def is_lonely(phase, row, x, rules):
    """Return whether too few neighbours in a pixel's window are valid, or agree with it."""
    height, width = phase.shape
    per_cell, own = np.float32(1 / rules.cell_rad), phase[row, x]
    valid, agreeing = 0, 0
    for v in range(max(0, row - WINDOW), min(height, row + WINDOW + 1)):
        for du in range(-WINDOW, WINDOW + 1):  # so many always: the compiler unrolls the loop
            u = x + du
            other = phase[v, u] if u >= 0 and u < width else INVALID
            cells = measure_cells(other, own, per_cell, rules)
            valid += cells == cells  # not NaN
            agreeing += abs(cells) <= HALF
        if agreeing - (v >= row) >= ENOUGH:  # less the pixel itself
            return False
    return valid - 1 < LONELY_NEIGHBOURS or agreeing - 1 < LONELY * (valid - 1)


@numba.njit
def period_change(phase, row, x, rules):
    """Return UP or DOWN for a pixel at a code edge that a clear majority of the neighbours moves by
    one period.

    Otherwise UNCHANGED.
    """
    part = (phase[row, x] - np.float32(rules.origin_rad)) * PER_TURN
    part = part - np.float32(math.floor(part))
    if part >= EDGE and part < FAR_EDGE:
        return UNCHANGED
    valid, above, below = count_votes(phase, row, x, rules)
    if valid < NEIGHBOURS:
        return UNCHANGED
    if above >= MAJORITY * valid:
        return UP
    return DOWN if below >= MAJORITY * valid else UNCHANGED


@numba.njit
def masking_reason(phase, row, x, suspect, rules):
    """Return the reason to mask a pixel, or UNCHANGED; neighbours vote only where one is
    ``suspect``."""
    if suspect and is_lonely(phase, row, x, rules):
        return INCONSISTENT
    is_outside = phase[row, x] < np.float32(rules.low_rad) or phase[row, x] > np.float32(
        rules.high_rad
    )
    return OUTSIDE if is_outside else UNCHANGED


def allocate_lists(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Allocate ``columns``, ``words`` and ``counts`` for `list_changes` of a map (h, w)."""
    return np.empty(shape, np.uint16), np.empty(shape, np.uint8), np.empty(shape[0], np.int64)


def allocate_marks(shape: tuple[int, int]) -> np.ndarray:
    """Allocate the marks (h, ceil(w / RUN)) of a map (h, w): a byte for each pixel that is
    examined, zero beyond the last."""
    return np.zeros((shape[0], -(-shape[1] // RUN)), np.uint64)


def list_changes(
    phase: np.ndarray,
    rules: SpikeRules,
    masking: bool,
    marks: np.ndarray,
    columns: np.ndarray,
    words: np.ndarray,
    counts: np.ndarray,
) -> None:
    """List the pixels to change in ``phase`` (h, w): in row v ``counts[v]`` pixels, at
    ``columns[v]``.

    ``masking``: pixels to mask, ``words[v]`` being their reasons; else those to be moved by a
    period, UP or DOWN. A plain code's are moved first: ``marks`` is written then, kept by
    `move_phases`, and read when masking.
    """
    run_rows(_list_rows, phase.shape[0], phase, rules, masking, marks, columns, words, counts)


@kernel()
def _list_rows(start, stop, phase, rules, masking, marks, columns, words, counts):
    """List the changes of a range of rows, see `list_changes`."""
    per_cell = np.float32(1 / rules.cell_rad)
    low, high = np.float32(rules.low_rad), np.float32(rules.high_rad)
    for row in range(start, stop):
        if not (masking and rules.is_plain):
            _mark_examined(phase, row, per_cell, low, high, marks[row].view(np.uint8))
        counts[row] = _list_row(phase, row, rules, masking, marks[row], columns[row], words[row])


@numba.njit
def _list_row(phase, row, rules, masking, runs, columns, words):
    """List the changes among the marked pixels of one row in ``columns`` and ``words``; return
    their number."""
    per_cell, examined, count = np.float32(1 / rules.cell_rad), runs.view(np.uint8), 0
    for run in range(len(runs)):
        if runs[run] == 0:
            continue
        for x in range(RUN * run, min(RUN * run + RUN, phase.shape[1])):
            if examined[x]:
                word, suspect = UNCHANGED, is_suspect(phase, row, x, per_cell)
                if masking:
                    word = masking_reason(phase, row, x, suspect, rules)
                elif suspect:
                    word = period_change(phase, row, x, rules)
                if word != UNCHANGED:
                    columns[count], words[count] = x, word
                    count += 1
    return count


@numba.njit(inline="always")
def _mark_examined(phase, row, per_cell, low, high, examined):
    """Mark the valid pixels of a row that are suspect, see `is_suspect`, or not in ``low`` to
    ``high``.

    Without branches, for vector instructions.
    """
    height, width = phase.shape
    own = phase[row]
    if row == 0 or row == height - 1:
        for x in range(width):
            examined[x] = own[x] == own[x]  # not NaN
        return
    over, under = phase[row - 1], phase[row + 1]
    for x in range(1, width - 1):
        vertical = do_agree(own[x], over[x], per_cell) & do_agree(own[x], under[x], per_cell)
        horizontal = do_agree(own[x], own[x - 1], per_cell) & do_agree(own[x], own[x + 1], per_cell)
        usual = vertical & horizontal & (own[x] >= low) & (own[x] <= high)
        examined[x] = (own[x] == own[x]) & (not usual)
    examined[0], examined[width - 1] = own[0] == own[0], own[width - 1] == own[width - 1]


@kernel()
def move_phases(columns, words, counts, phase, marks):
    """Move the listed phases by a period, in place, and mark their neighbours, which may no longer
    agree."""
    examined, (height, width) = marks.view(np.uint8), phase.shape
    for row in range(len(counts)):
        for i in range(counts[row]):
            x = columns[row, i]
            phase[row, x] += TURN if words[row, i] == UP else -TURN
            for v in range(max(0, row - 1), min(height, row + 2)):
                for u in range(max(0, x - 1), min(width, x + 2)):
                    examined[v, u] = phase[v, u] == phase[v, u]  # not NaN


@kernel()
def mask_phases(columns, words, counts, phase, reason):
    """Mask the listed phases, for the listed reasons, in place."""
    for row in range(len(counts)):
        for i in range(counts[row]):
            phase[row, columns[row, i]], reason[row, columns[row, i]] = INVALID, words[row, i]
