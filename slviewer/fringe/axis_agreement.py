"""Agreement of the frames of one axis with each other, under a hypothesis of what each of them
shows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.axis_reader import (
    FEWEST_PIXELS,
    RECENT,
    AxisFrames,
    AxisReader,
    BitReading,
    Images,
)
from slviewer.fringe.levels import lowest_coordinate, plan_levels, unwrap_levels
from slviewer.fringe.limits import OUTSIDE_PX

TWO_PI = 2 * np.pi
REACH = (4, 16)
"""Smallest and largest distance, px, of decided pixels that count as neighbours: an edge may be
blurred over it. In between it is a third of the finest stripe's width, which excludes the next
edge."""
READABLE_STRIPE = 6.0
"""Mean width of stripes, px, from which most pixels are inside a stripe."""
READABLE_SHARE = 0.5
FEWEST_EDGES = 50
"""Number of code edges below which shares are not tested: they are accurate to no better than 7
%."""
FEWEST_OF_BIT = 10
"""Edges of one bit that must contradict the other bits before its own share is tested."""
MIN_KEPT = 0.15
"""Smallest share of pixels at which all readable bits are decided; with stripes of 6 px it is more
than a third."""


@dataclass(frozen=True)
class Agreement:
    """Measured agreement of the frames of one axis; shares are weighted by modulation, NaN where
    unknown.

    ``opposed``: share of the pixels inside stripes that are bright in a bit and dark in its
    inverse, or vice versa; the minimum over all bits. ``edges``: number of code edges. ``rule``:
    share of the edges that obey the Gray code; the minimum over all bits. ``common``: length of the
    mean unit vector of the wrapped phases at code edges; ``rising``: share of the edges at which
    the phase rises with the code; ``begin_turns``: position within a period (-0.5 ... 0.5) at which
    the cells of the code begin; ``turns_per_cell``: fringe periods per cell of the Gray code.

    ``level_common``, ``level_turns``: length and mean, in periods, of the step from each period to
    the next finer one. ``outside``: share of the coordinates beyond the projector; ``reach_px``:
    their 99.5 % quantile. ``unreadable``: the first bit, from 0, that cannot be read although its
    stripes are wide. ``borders``: phase (rad), number and weight of the cell borders in view.
    """

    opposed: float = np.nan
    edges: int = 0
    rule: float = np.nan
    common: float = np.nan
    rising: float = np.nan
    begin_turns: float = np.nan
    turns_per_cell: float = np.nan
    level_common: tuple[float, ...] = ()
    level_turns: tuple[float, ...] = ()
    outside: float = np.nan
    reach_px: float = np.nan
    unreadable: int | None = None
    borders: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


def measure_agreement(reader: AxisReader, frames: AxisFrames) -> Agreement:
    """Measure how well the frames of an axis agree under a hypothesis; the result is cached by the
    reader."""
    return reader.recall(_measure_agreement, frames)


def measure_code_agreement(reader: AxisReader, frames: AxisFrames) -> Agreement:
    """Measure only the agreement of the Gray code: `opposed`, `rule`, `edges` and `unreadable` of
    an `Agreement`.

    Without Gray bits, or with too few illuminated pixels, all values are unknown.
    """
    if len(reader.swing) < FEWEST_PIXELS or not frames.bits:
        return Agreement()
    code, edges, rule = reader.recall(
        _read_checked_code, frames.bits, frames.inverse, frames.inverted, most=RECENT
    )
    return Agreement(
        opposed=_measure_opposition(reader, frames),
        rule=rule,
        edges=edges.shape[1],
        unreadable=code.unreadable,
    )


def _measure_agreement(reader: AxisReader, frames: AxisFrames) -> Agreement:
    """Compute `measure_agreement` for a hypothesis that is not cached."""
    result = measure_code_agreement(reader, frames)
    if len(reader.swing) < FEWEST_PIXELS:
        return result
    if not frames.bits:
        return _measure_level_agreement(reader, frames, result)
    code, edges, _ = reader.recall(
        _read_checked_code, frames.bits, frames.inverse, frames.inverted, most=RECENT
    )
    if not code.is_complete:  # only the bits above the missing one number anything
        missing = code.count - ((1 << code.count) - 1 - code.known).bit_length()
        bits = tuple(image if b < missing else None for b, image in enumerate(frames.bits))
        inverse = tuple(image if b < missing else None for b, image in enumerate(frames.inverse))
        code, edges, _ = reader.recall(
            _read_checked_code, bits, inverse, frames.inverted, most=RECENT
        )
    if frames.fringe is not None and edges.shape[1] >= FEWEST_EDGES:
        result = _add_phase_agreement(reader, frames, code, edges, result)
    return _add_coordinate_range(reader, frames, code, result)


@dataclass(frozen=True, eq=False)
class _Code:
    """Gray code of the sampled pixels at which all readable bits are decided.

    ``kept`` (k,): indices of these pixels. ``gray``, ``binary`` (k,) int32: the first ``count``
    bits as a Gray and as a binary number; ``known``: mask of the bits that have an image.
    ``unreadable``: see `Agreement`. ``reach``: largest distance, px, between neighbours.
    """

    kept: np.ndarray
    gray: np.ndarray
    binary: np.ndarray
    count: int
    known: int
    unreadable: int | None
    reach: float = REACH[0]

    @property
    def is_complete(self) -> bool:
        """Whether all of the first bits have an image."""
        return self.known == (1 << self.count) - 1


def _read_checked_code(
    reader: AxisReader, bits: Images, inverse: Images, inverted: bool
) -> tuple[_Code, np.ndarray, float]:
    """Return the Gray code, its edges, and the share of the edges that obey the Gray code.

    The edges (2, e) are neighbouring pixels whose codes differ by one, as indices into
    ``_Code.kept``: the pixels with the lower, and those with the higher code.
    """
    code = _read_code(reader, bits, inverse, inverted)
    rule, edges = _check_code_rule(reader, code)
    return code, edges, rule


def _read_code(reader: AxisReader, images: Images, inverse: Images, inverted: bool) -> _Code:
    """Read the Gray bits, from the most significant one down to the finest that is readable."""
    bits = [
        None if image is opposite is None else reader.bit(image, opposite)
        for image, opposite in zip_longest(images, inverse)
    ]
    count, chosen, unreadable = _choose_readable(reader, bits)
    if not chosen:
        return _Code(
            np.zeros(0, int), np.zeros(0, np.int32), np.zeros(0, np.int32), 0, 0, unreadable
        )
    pixels = np.flatnonzero(np.logical_and.reduce([bit.decided for bit in chosen.values()]))
    gray, known = np.zeros(len(pixels), np.int32), sum(1 << (count - 1 - b) for b in chosen)
    for b, bit in chosen.items():
        gray |= bit.value[pixels].astype(np.int32) << (count - 1 - b)
    if inverted:
        gray ^= known
    reach = float(np.clip(chosen[max(chosen)].stripe_px / 3, *REACH))
    return _Code(pixels, gray, _convert_gray(gray, count), count, known, unreadable, reach)


def _choose_readable(
    reader: AxisReader, bits: Sequence[BitReading | None]
) -> tuple[int, dict[int, BitReading], int | None]:
    """Return the number of readable bits, those of them that have an image, by number, and an
    unreadable one.

    The last is the first bit that should be readable, and is not; None without one.
    """
    readable = [bit is None or _is_readable(bit) for bit in bits]
    count = readable.index(False) if False in readable else len(bits)
    while count and bits[count - 1] is None:
        count -= 1
    unreadable = _locate_unreadable_bit(reader, bits, count)
    while chosen := {b: bit for b, bit in enumerate(bits[:count]) if bit is not None}:
        decided = np.logical_and.reduce([bit.decided for bit in chosen.values()])
        if np.count_nonzero(decided) >= MIN_KEPT * len(decided):
            break
        worst, finest = min(chosen, key=lambda b: chosen[b].share), max(chosen)
        if worst != finest or len(chosen) == 1:
            return count, chosen, worst if unreadable is None else unreadable
        count = finest  # stripes that blur has almost closed
    return count, chosen, unreadable


def _convert_gray(gray: np.ndarray, count: int) -> np.ndarray:
    """Return the binary numbers, int32, that Gray codes of ``count`` bits encode."""
    binary = gray.copy()
    shift = 1
    while shift < count:
        binary ^= binary >> shift
        shift *= 2
    return binary


def _is_readable(bit: BitReading) -> bool:
    """Return whether enough pixels of a bit are decided and its stripes are wide enough."""
    return bit.share > READABLE_SHARE and bit.stripe_px >= READABLE_STRIPE


def _measure_opposition(reader: AxisReader, frames: AxisFrames) -> float:
    """Return the smallest share, over all bits, of pixels at which a bit and its inverse are
    opposite.

    NaN without inverses.

    Only bits down to the finest one whose stripes are clearly wider than the blur are compared:
    blur makes both images of a finer bit one grey.
    """
    pairs = list(zip(frames.bits, frames.inverse, strict=False))
    readable = [
        b
        for b, pair in enumerate(pairs)
        if None not in pair
        and _is_readable(bit := reader.bit(*pair))
        and bit.stripe_px >= 1.5 * READABLE_STRIPE
    ]
    shares = [reader.opposed(*pair) for pair in pairs[: max(readable, default=-1) + 1]]
    return min(filter(np.isfinite, shares), default=np.nan)


def _locate_unreadable_bit(
    reader: AxisReader, bits: Sequence[BitReading | None], count: int
) -> int | None:
    """Return the index of the first bit that is unreadable although its stripes should be wide.

    None if there is none.
    """
    if count == len(bits) or bits[count] is None or len(reader.swing) < FEWEST_PIXELS:
        return None
    widths = [bit.stripe_px for bit in bits[:count] if bit is not None]
    later = [bit for bit in bits[count + 1 :] if bit is not None]
    expected = widths[-1] / 2 if widths else np.inf
    wider = any(bit.share > READABLE_SHARE and bit.stripe_px > 2 * READABLE_STRIPE for bit in later)
    # Few edges in view make a stripe seem wider than it is, by a factor that its neighbours in
    # order share.
    wide = expected > 2 * READABLE_STRIPE and len(widths) >= 2 and widths[-2] < 3 * widths[-1]
    return count if wider or wide or not widths else None


def _check_code_rule(reader: AxisReader, code: _Code) -> tuple[float, np.ndarray]:
    """Return the share of code edges that obey the Gray code, the minimum over all bits, and the
    edges that obey it."""
    pixels = code.kept
    at = np.flatnonzero(code.gray[1:] != code.gray[:-1])
    first, second = pixels[at], pixels[at + 1]
    at = at[
        (reader.place[second] - reader.place[first] <= code.reach)
        & (reader.line[second] == reader.line[first])
    ]
    change = code.gray[at] ^ code.gray[at + 1]
    single = (change & (change - 1)) == 0
    below = change - 1  # the bits below the one that changes: 1, 0, 0 ...
    wanted = (change >> 1) & code.known
    obeys = single & ((code.gray[at] & below & code.known) == wanted)
    weight = np.minimum(reader.swing[pixels[at]], reader.swing[pixels[at + 1]])
    shares = []
    if len(change) >= FEWEST_EDGES:
        shares.append(float(weight[obeys].sum() / weight.sum()))
        for b in range(code.count):
            of_bit = single & (change == 1 << b)
            if np.count_nonzero(of_bit & ~obeys) >= FEWEST_OF_BIT:
                shares.append(float(weight[of_bit & obeys].sum() / weight[of_bit].sum()))
    at = at[obeys]
    up = code.binary[at + 1] > code.binary[at]
    return min(shares, default=np.nan), np.stack([at + ~up, at + up])


def _add_phase_agreement(
    reader: AxisReader, frames: AxisFrames, code: _Code, edges: np.ndarray, result: Agreement
) -> Agreement:
    """Return ``result`` with the agreement of the fringe phase with the code edges added; unchanged
    without fringes."""
    assert frames.fringe is not None
    phasor = reader.phasor(frames.fringe[1], frames)
    if phasor is None:
        return result
    turned, gaps = reader.unwrapped_phase(frames.fringe[1], frames), reader.gaps
    first, second = code.kept[edges]
    below, above = phasor[first], phasor[second]
    # Between an edge's pixels, several px apart, a fine fringe turns by more than half a period.
    weight = np.minimum(np.abs(below), np.abs(above)) * (gaps[first] == gaps[second])
    step = turned[second] - turned[first]
    angle = np.angle(below) + step / 2
    border = code.binary[edges[1]].astype(np.float64)
    per_cell = _estimate_turns_per_cell(code, edges, turned, gaps)
    cell = frames.cell_of(code.count)
    common, begin = common_phase(angle, border * cell / frames.fringe[0], weight)
    return replace(
        result,
        common=common,
        begin_turns=begin,
        rising=float(weight[step > 0].sum() / max(float(weight.sum()), 1e-9)),
        turns_per_cell=per_cell * frames.cell_px / cell,
        borders=(angle, border * cell / frames.cell_px, weight),
    )


def common_phase(
    angle: np.ndarray, border_turns: np.ndarray, weight: np.ndarray
) -> tuple[float, float]:
    """Return length and direction (turns, -0.5 ... 0.5) of the mean unit vector of the phases at
    cell borders.

    ``angle`` (e,): phases (rad); ``border_turns`` (e,): periods from code 0 to each border, which
    are subtracted; ``weight`` (e,). The direction is averaged over the phases near the common one
    only: the others are depth steps.
    """
    unit = np.exp(1j * (angle - TWO_PI * border_turns))
    mean = complex((weight * unit).sum()) / max(float(weight.sum()), 1e-9)
    centre = np.angle(mean)
    for _ in range(3):
        apart = np.angle(unit * np.exp(-1j * centre))
        near = np.abs(apart) < np.pi / 4
        if near.any():
            centre += float(np.average(apart[near], weights=weight[near] + 1e-9))
    return abs(mean), float((centre / TWO_PI + 0.5) % 1 - 0.5)


def fit_turns(
    angle: np.ndarray, place: np.ndarray, ratios: np.ndarray, weight: np.ndarray | float = 1.0
) -> float:
    """Return the one of evenly spaced ``ratios`` by which ``place`` predicts ``angle``, (e,) rad
    each, best.

    The mean unit vector of the difference, weighted by ``weight``, is then the longest.
    """
    # From one ratio to the next each unit vector rotates by the same angle.
    unit = weight * np.exp(1j * (angle - ratios[0] * place))
    step = np.exp(1j * (ratios[0] - ratios[1]) * place)
    lengths = []
    for _ in ratios:
        lengths.append(abs(complex(unit.sum())))
        unit *= step
    return float(ratios[int(np.argmax(lengths))])


def _estimate_turns_per_cell(
    code: _Code, edges: np.ndarray, angle: np.ndarray, gaps: np.ndarray
) -> float:
    """Return the median number of fringe periods between two successive code edges along a line;
    NaN for too few edges.

    ``angle`` (p,): unwrapped phase (rad); ``gaps`` (p,): see `AxisReader.gaps`.
    """
    here, there = code.kept[edges]
    order = np.argsort(np.minimum(here, there))
    lower_cell, middle = np.minimum(here, there)[order], ((angle[here] + angle[there]) / 2)[order]
    rising, cell = (there > here)[order], code.binary[edges[1]][order]
    consecutive = (
        (rising[1:] == rising[:-1])
        & (np.abs(np.diff(cell)) == 1)
        & (gaps[lower_cell[1:]] == gaps[lower_cell[:-1]])
    )
    if np.count_nonzero(consecutive) < FEWEST_EDGES // 2:
        return np.nan
    return float(np.median(np.abs(np.diff(middle))[consecutive])) / TWO_PI


def _add_coordinate_range(
    reader: AxisReader, frames: AxisFrames, code: _Code, result: Agreement
) -> Agreement:
    """Return ``result`` with the range of the coordinates that the code gives, to within the cells
    that were read."""
    if not code.is_complete or len(code.kept) < FEWEST_PIXELS:
        return result
    cell = frames.cell_of(code.count)
    return _measure_coordinate_range(
        code.binary * cell + frames.origin_px, reader.swing[code.kept], cell, frames.extent, result
    )


def _measure_coordinate_range(
    coordinate: np.ndarray, weight: np.ndarray, cell: float, extent: int | None, result: Agreement
) -> Agreement:
    """Return ``result`` with the largest coordinate and the share of coordinates outside the
    projector.

    ``coordinate`` (p,): px at which the cell of each pixel begins; ``weight`` (p,); ``cell``: width
    of the cells, px.
    """
    result = replace(
        result, reach_px=float(np.quantile(coordinate + cell, 0.995)) if len(coordinate) else np.nan
    )
    if extent is None:
        return result
    beyond = (coordinate > extent - 0.5 + OUTSIDE_PX) | (coordinate + cell < -0.5 - OUTSIDE_PX)
    return replace(result, outside=float(weight[beyond].sum() / max(float(weight.sum()), 1e-9)))


def estimate_coordinates(reader: AxisReader, frames: AxisFrames) -> np.ndarray:
    """Return the projector coordinate px, (p,) float64, of all pixels of the sample; NaN where it
    cannot be read.

    A Gray code gives it to within a cell of the finest readable bit.
    """
    out = np.full(len(reader.illuminated), np.nan)
    if len(reader.swing) == 0:
        return out
    if frames.bits:
        code = _read_code(reader, frames.bits, frames.inverse, frames.inverted)
        out[reader.seen[code.kept]] = code.binary * frames.cell_of(code.count) + frames.origin_px
    else:
        levels = _unwrap_levels_of_sample(reader, frames)
        if levels is not None:
            out[reader.seen] = levels[2]
    return out


def _measure_level_agreement(
    reader: AxisReader, frames: AxisFrames, result: Agreement
) -> Agreement:
    """Return ``result`` with the agreement of several fringe periods with each other, without a
    Gray code."""
    levels = _unwrap_levels_of_sample(reader, frames)
    if levels is None:
        return result
    common, turns, coordinate, weight = levels
    result = replace(result, level_common=common, level_turns=turns)
    return _measure_coordinate_range(coordinate, weight, 0.0, frames.extent, result)


def _unwrap_levels_of_sample(
    reader: AxisReader, frames: AxisFrames
) -> tuple[tuple[float, ...], tuple[float, ...], np.ndarray, np.ndarray] | None:
    """Unwrap the fringe periods of the sample from the longest to the finest; None where they
    cannot be unwrapped.

    Returns the concentration and the mean, in periods, of the step to each finer level, and
    coordinate px and weight (p,) of each pixel.
    """
    phasors = [reader.phasor(images, frames) for _, images in frames.shifts]
    if any(p is None for p in phasors) or not len(reader.swing):
        return None
    wrapped = [np.angle(p) for p in phasors if p is not None]
    weight = np.minimum.reduce([np.abs(p) for p in phasors if p is not None])
    periods = tuple(period for period, _ in frames.shifts)
    try:
        levels = plan_levels(periods, frames.extent or 1)
    except InputError:  # the periods do not cover the projector: the phase is relative
        return None
    low = lowest_coordinate(levels[0].period_px, frames.extent or int(levels[0].period_px))
    coordinate, _, turns = unwrap_levels(levels, wrapped, low)
    total = max(float(weight.sum()), 1e-9)
    means = [complex((weight * np.exp(1j * TWO_PI * each)).sum()) / total for each in turns]
    return (
        tuple(map(abs, means)),
        tuple(float(np.angle(mean)) / TWO_PI for mean in means),
        coordinate,
        weight,
    )
