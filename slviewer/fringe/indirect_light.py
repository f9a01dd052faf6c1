"""Pixels whose frames contradict a single reflection: light reached them by way of other surfaces
or the material too.

Where one reflection alone lights a pixel, every Gray bit that is not an edge there has the same
black and the same white, and the fringes span as much of the white light as they do elsewhere.
Light from other surfaces, or scattered in the material, follows wide stripes, so that bits differ,
and averages over narrow ones, so that the fringes are weak for their white light (Nayar et al.,
"Fast separation of direct and global components", SIGGRAPH 2006).

Light that comes from less than a stripe away can be seen by its weak fringes alone, and where
nearly all of the image is like that, by nothing.
"""

import numpy as np

from slviewer.fringe.decoding_task import DecodingTask
from slviewer.fringe.kernels import prefetch_row
from slviewer.fringe.kernels_spikes import allocate_lists, mask_phases
from slviewer.fringe.phase import Reason
from slviewer.geometry.jit import kernel, read_only, run_rows, subtract_fixed_width

INDIRECT = np.uint8(Reason.INDIRECT)
Maps = tuple[np.ndarray, ...]
"""Phase, wrapped phase, modulation, background and reason, (h, w) each."""
BIT_SHARE = 0.65
"""Difference between the contrasts of a pixel's bits, as a share of the largest, up to which no bit
is misread: that takes as much indirect light as direct. Adhesive tape on a board differs by up to a
half, and is measured well."""
BIT_SIGMAS = 8.0
"""... and in standard deviations of a grey level: noise alone does not make such a range."""
EDGE_CELLS = 0.4
"""Distance from the edge of a bit, in cells, within which it is not compared."""
EDGE_PX = 5.0
"""... and in px: Gray code alone has cells narrower than the blur."""
FEWEST_STEPS = 4
"""With three steps gamma makes the amplitude of the fringes depend on the phase."""
WEAK = 0.35
"""Share by which fringes are weaker, for their white light, than those of the image, that blur may
explain: of fringes of 18 px one of 2.6 px. Bits are misread only where indirect light exceeds the
direct: fringes have less than half."""
WEAK_NARROW = 0.5
"""... where all periods are narrow: indirect light then misleads no fringe order, and is masked
where it prevails."""
NARROW = 2.0
"""Ratio of the longest to the finest period up to which all are narrow."""
WINDOW_PX = 7
"""Side of the window in which fringes and white light are averaged: one pixel's noise is no
evidence."""
REACH = WINDOW_PX // 2
SAMPLES = 6000
"""Pixels, evenly spread, that the strength of the image's fringes is fitted to."""
FEWEST = 200
UPPER = 0.95
"""Weight of the samples above the fit: those below have indirect light."""
PENALTIES = (0.0, 0.1, 0.1, 0.1, 0.02, 0.1)
"""Of the fit's terms, in shares of the samples' weight; the phase's square alone follows the blur
of a deep surface."""
CONVERGED = 1e-4
"""Change of the strengths that the fit expects, from which on it is not iterated."""
NOISE_SIGMAS = 4.0
"""Standard deviations of their noise by which fringes must be weaker as well."""
SPREADS = 1.0
"""Spreads of the samples above the fit by which fringes must be weaker as well."""
STEEPEST = 4.0
"""Largest squared gradient of the phase on a surface, (rad / px)^2."""
PLAUSIBLE = (0.4, 1.3)
"""Amplitude of the fringes over half of the white light, also under gamma; another image is no
white light."""
MOST_SPREAD = 0.1
"""Of the samples above the fit: where they scatter more, the image does not show the scene under
the same light."""


def mask_indirect_light(task: DecodingTask, maps: Maps) -> None:
    """Mask, in place, the pixels of decoded ``maps`` whose frames contradict a single reflection;
    reason INDIRECT."""
    layout = task.layout
    whites = [
        i
        for kind in ("texture", "white")
        for i, frame in enumerate(task.sequence.frames)
        if frame.kind == kind
    ]
    if layout.steps >= FEWEST_STEPS and whites:
        _mask_weak_fringes(task, task.stack[whites[0]], maps)
    if layout.gray:
        _mask_unequal_bits(task, maps)


def _mask_unequal_bits(task: DecodingTask, maps: Maps) -> None:
    """Mask the pixels where bits that have no edge nearby differ in black or white."""
    layout, (phase, _, _, background, reason) = task.layout, maps
    count, cell = len(layout.gray), layout.gray_cell_px
    spans = [cell * 2.0 ** (count - bit) for bit in range(count)]
    guard = max(EDGE_CELLS * cell, EDGE_PX)
    wide = [k for k, span in enumerate(spans) if span > 4 * guard]
    if len(wide) < 2:
        return
    frames = np.array([layout.gray[k] for k in wide])
    inverses = np.array([layout.inverse[k] for k in wide] if layout.inverse else [], np.int64)
    spacing, to_px = spans[wide[-1]] / 2, layout.period_px / (2 * np.pi)
    edges = np.array([to_px / spacing, layout.gray_origin_px / spacing, guard / spacing])
    stack = read_only(task.stack)

    def compare(first: int, last: int) -> None:
        """Compare the bits of a range of rows."""
        rows = (each[first:last] for each in (phase, background, reason))
        _compare_bits(stack, first, frames, inverses, edges, task.noise, *rows)

    run_rows(compare, stack.shape[1])


@kernel()
def _compare_bits(stack, first, frames, inverses, edges, noise, phase, background, reason):
    """Mask pixels in rows from ``first`` on; the three maps contain only these rows.

    ``frames``: bits, most significant first; ``inverses``: of these, or none; ``edges`` as
    `_number_bits` has them.
    """
    width, grey = phase.shape[1], stack.dtype.type
    full = grey(65535 if stack.itemsize == 2 else 255)
    place = np.empty(width, np.float32)
    level, bits = np.empty(width, stack.dtype), np.empty(width, stack.dtype)
    values, most = np.empty(width, stack.dtype), np.empty(width, stack.dtype)
    fewest, over_least = np.empty(width, stack.dtype), np.empty(width, stack.dtype)
    under_most = np.empty(width, stack.dtype)
    ranges = most, fewest, over_least, under_most
    for i in range(len(phase)):
        A = background[i]
        _number_bits(phase[i], edges, place, bits)
        for x in range(width):
            level[x] = grey(0) if len(inverses) else grey(np.int32(A[x]))
            most[x] = under_most[x] = grey(0)
            fewest[x] = over_least[x] = full
        for b in range(len(frames)):
            frame = stack[frames[b], first + i]
            inverse = stack[inverses[b] if len(inverses) else frames[b], first + i]
            prefetch_row(stack, frames[b], first + i)
            if len(inverses):
                prefetch_row(stack, inverses[b], first + i)
                for x in range(width):
                    values[x] = max(frame[x], inverse[x]) - min(frame[x], inverse[x])
            else:
                for x in range(width):
                    values[x] = frame[x]
            _extend_ranges(values, level, bits, grey(len(frames) - b), ranges)
        if _select_ranges(ranges, np.sqrt(noise[0]), reason[i], values):
            _mask_ranges(values, A, level, len(inverses) > 0, noise, ranges, phase[i], reason[i])


@kernel()
def _number_bits(phase, edges, place, bits):
    """Fill ``bits`` with the number of the bit, 1 for the least, an edge of which is near a pixel;
    0 where there is none.

    ``edges``: how many there are in a rad, how many the code's origin is from phase 0, and the
    share of their distance, less than half, that is near. Counted from the origin, bit k has those
    whose numbers are odd multiples of 2^(k - 1). ``place`` (w,) float32 is a buffer.
    """
    scale, offset, share = np.float32(edges[0]), np.float32(edges[1]), np.float32(edges[2])
    for x in range(len(phase)):
        at = phase[x] * scale - offset
        nearest = np.floor(at + np.float32(0.5))
        # false for NaN as well
        edge = np.int32(nearest if abs(at - nearest) < share else np.float32(0))
        place[x] = np.float32(np.int32(edge & np.int32(-edge)))  # its last binary 1
    exponents = place.view(np.int32)
    for x in range(len(phase)):
        bits[x] = max(np.int32(np.int32(exponents[x] >> 23) - np.int32(126)), np.int32(0))


@kernel()
def _extend_ranges(values, level, bits, bit, ranges):
    """Extend the ranges of levels by a bit's ``values`` where it has no edge: the largest, the
    least, the least above ``level``, and the largest that is not above it.

    The frames' own numbers are compared, of which most fit a vector register.
    """
    most, fewest, over_least, under_most = ranges
    grey = values.dtype.type
    none, full = grey(0), grey(65535 if values.itemsize == 2 else 255)
    for x in range(len(values)):
        is_far, is_over = bits[x] != bit, values[x] > level[x]
        low, high = values[x] if is_far else full, values[x] if is_far else none
        # all are read before one is written: else the compiler takes them one by one
        a, b, c, d = most[x], fewest[x], over_least[x], under_most[x]
        most[x], fewest[x] = max(a, high), min(b, low)
        over_least[x] = min(c, low if is_over else full)
        under_most[x] = max(d, none if is_over else high)


@kernel()
def _select_ranges(ranges, sigma, reason, selected):
    """Set ``selected`` (w,), not 0 where a pixel of a row may have unequal bits, for a grey level's
    standard deviation of at least ``sigma``; return whether any may."""
    most, fewest, over_least, under_most = ranges
    grey = most.dtype.type
    largest = 32767.0 if most.itemsize == 2 else 127.0
    least, found = grey(min(BIT_SIGMAS * sigma, largest)), grey(0)
    for x in range(len(reason)):
        # at least 0 where no bit is white, or black
        white = subtract_fixed_width(max(most[x], over_least[x]), over_least[x])
        black = subtract_fixed_width(max(under_most[x], fewest[x]), fewest[x])
        spread = max(white, black)
        # of white and black, one is half of the whole range at least
        whole = subtract_fixed_width(max(most[x], fewest[x]), fewest[x])
        is_wide = (spread >= max(least, grey(whole >> 2))) & (reason[x] == 0)
        selected[x] = spread if is_wide else grey(0)
        found = max(found, spread if is_wide else grey(0))
    return found != 0


@kernel()
def _mask_ranges(selected, background, level, has_inverses, noise, ranges, phase, reason):
    """Mask the ``selected`` pixels of a row whose levels range over more than shares and noise
    allow, in white or in black. Levels of inverses are twice their distance from the mean of black
    and white."""
    most, fewest, over_least, under_most = ranges
    a, b, zero = np.float32(noise[0]), np.float32(noise[1]), np.float32(0)
    share, sigmas = np.float32(BIT_SHARE), np.float32(BIT_SIGMAS)
    part = np.float32(0.5 if has_inverses else 1)
    base = np.float32(0 if has_inverses else 1)
    for x in range(len(reason)):
        if selected[x] == 0:
            continue
        middle = base * background[x]
        white = max((np.float32(most[x]) - middle) * part, zero)
        black = max((middle - np.float32(fewest[x])) * part, zero)
        least_white = (np.float32(over_least[x]) - middle) * part
        least_black = (middle - np.float32(under_most[x])) * part
        range_white = white - least_white if most[x] > level[x] else zero
        range_black = black - least_black if fewest[x] <= level[x] else zero
        spread = max(range_white, range_black)
        variance = max(a + b * (background[x] + white), zero)
        is_unequal = (spread > share * max(white, black)) & (spread > sigmas * np.sqrt(variance))
        if is_unequal:
            phase[x], reason[x] = np.nan, INDIRECT


def _mask_weak_fringes(task: DecodingTask, white_frame: np.ndarray, maps: Maps) -> None:
    """Mask the pixels whose fringes are weak for their white light, compared with the image's.

    Of sharp fringes the amplitude is half of the white light. Blur makes them weaker: the
    projector's, which changes evenly over a depth range, and the camera's, by the square of the
    phase's gradient. Both are fitted to a sample; only then is every pixel compared.
    """
    layout = task.layout
    is_narrow = (
        not layout.gray
        and len(layout.shifts) > 1
        and layout.shifts[0].period_px < NARROW * layout.period_px
    )
    share = WEAK_NARROW if is_narrow else WEAK
    arrays = tuple(read_only(each) for each in (white_frame, *maps[:1], *maps[2:]))
    limits = np.array([task.white, *task.noise])
    sampled = _sample_strength(arrays, limits)
    if len(sampled) < FEWEST:
        return
    strength, terms = sampled[:, 0], sampled[:, 2:]
    fit, spread = _fit_strength(strength, terms)
    typical = float(np.exp(np.median(terms @ fit)))
    if not PLAUSIBLE[0] < typical < PLAUSIBLE[1] or spread > MOST_SPREAD:
        return
    margin = SPREADS * spread - np.log(1 - share)
    if is_narrow:
        # narrow fringes: the more unsharp they are, the more blur varies
        margin -= min(np.log(typical), 0.0)
    candidates, weak = allocate_lists(white_frame.shape), allocate_lists(white_frame.shape)
    height, fitted = len(white_frame), (fit, margin)
    run_rows(_list_candidates, height, arrays, task.white, *fitted, candidates[0], candidates[2])
    if candidates[2].any():
        run_rows(_list_weak, height, arrays, limits, *fitted, candidates[0], candidates[2], *weak)
        mask_phases(*weak, maps[0], maps[-1])


def _sample_strength(arrays: Maps, limits: np.ndarray) -> np.ndarray:
    """Return `_measure_strength` (n, 8) of evenly spread pixels where it is known, on a grid that
    is finer where few are."""
    height, width = arrays[0].shape
    step = max(1, int(np.sqrt(height * width / SAMPLES)))
    while True:
        rows, columns = (np.arange(step // 2, size, step) for size in (height, width))
        out = np.empty((len(rows), len(columns), 2 + len(PENALTIES)))
        run_rows(_measure_samples, len(rows), arrays, limits, rows, columns, out)
        out = out[np.isfinite(out[..., 0])]
        if len(out) >= SAMPLES / 8 or step == 1:
            return out
        step //= 2


@kernel()
def _reflect(i, size):
    """Return the row or column that stands for one beside the image of this size."""
    return -1 - i if i < 0 else 2 * size - 1 - i if i >= size else i


@kernel()
def _measure_light(arrays, white, i, x):
    """Return half of the white light of a pixel, in grey levels; 0 where it is unknown."""
    white_frame, _, _, background, reason = arrays
    light = np.float32(white_frame[i, x]) - background[i, x]
    is_known = (reason[i, x] == 0) & (white_frame[i, x] < white) & (light > 0)
    return light if is_known else np.float32(0)


@kernel()
def _measure_square_gradient(phase, i, x):
    """Return the square of the phase's gradient, (rad / px)^2; NaN at a depth step, and where it is
    unknown."""
    height, width = phase.shape
    if i == 0 or x == 0 or i == height - 1 or x == width - 1:
        return np.nan
    along_row = np.float64(phase[i, x + 1] - phase[i, x - 1])
    along_column = np.float64(phase[i + 1, x] - phase[i - 1, x])
    square = (along_row**2 + along_column**2) / 4
    return square if square < STEEPEST else np.nan


@kernel()
def _measure_strength(arrays, limits, i, x, out):
    """Fill ``out`` (8,) of a pixel: strength of the fringes, four of its standard deviations, and
    the terms that the strength is modelled by. The strength is NaN where it is unknown.

    Strength: log of the fringes' amplitude over half of the white light, both averaged over a
    window. Terms: a constant, the place in the image and the phase, which together follow the
    depth, the phase's square, as blur grows by the square of the distance from focus, and the
    squared gradient, beside depth steps that of the neighbours.
    """
    _, phase, modulation, background, _ = arrays
    white, noise_a, noise_b = limits
    height, width = phase.shape
    out[0] = np.nan
    if _measure_light(arrays, white, i, x) == 0:
        return
    half, fringes, count, slope, slopes = 0.0, 0.0, 0, 0.0, 0
    own_slope = _measure_square_gradient(phase, i, x)
    for k in range(WINDOW_PX):
        v = _reflect(i + k - REACH, height)
        for j in range(WINDOW_PX):
            u = _reflect(x + j - REACH, width)
            light = _measure_light(arrays, white, v, u)
            half, count = half + light, count + (light > 0)
            fringes += float(modulation[v, u]) if light > 0 else 0.0
    if np.isnan(own_slope):
        for k in range(WINDOW_PX):
            for j in range(WINDOW_PX):
                v, u = _reflect(i + k - REACH, height), _reflect(x + j - REACH, width)
                square = _measure_square_gradient(phase, v, u)
                if not np.isnan(square):
                    slope, slopes = slope + square, slopes + 1
    # Mostly of the white frame; the fringes are of several frames.
    level = background[i, x] + half / WINDOW_PX**2
    noise = np.sqrt(max(noise_a + noise_b * level, 0.0))
    out[0] = np.log(fringes / half) if fringes > 0 else np.nan
    out[1] = NOISE_SIGMAS * noise * np.sqrt(count) / half
    scaled = phase[i, x] / 100.0
    out[2], out[3], out[4] = 1.0, x / width, i / height
    out[5], out[6] = scaled, scaled**2
    out[7] = slope / max(slopes, 1) if np.isnan(own_slope) else own_slope


@kernel()
def _measure_samples(first, last, arrays, limits, rows, columns, out):
    """Fill ``out[first:last]`` (len(rows), len(columns), 8) as `_measure_strength` does."""
    for k in range(first, last):
        for j in range(len(columns)):
            _measure_strength(arrays, limits, rows[k], columns[j], out[k, j])


@kernel()
def _list_candidates(first, last, arrays, white, fit, margin, columns, counts):
    """List, in a range of rows, where the fringes in WINDOW_PX pixels of the row may be weaker by
    the margin than the strongest that the fitted terms (6,) expect in the rows nearby: in row v
    ``counts[v]`` pixels, at ``columns[v]``.

    A pixel whose fringes are weak is listed in one row of its window at least.
    """
    white_frame, phase, modulation, background, reason = arrays
    height, width = phase.shape
    excess, is_weak = np.empty(width + 2 * REACH, np.float32), np.empty(width, np.uint8)
    strongest = np.full(WINDOW_PX, -np.inf)
    for row in range(first - REACH, last + REACH):
        is_inside = 0 <= row < height
        strongest[row % WINDOW_PX] = (
            _bound_strength(fit, row / height, phase[row]) if is_inside else -np.inf
        )
        i = row - REACH
        if i < first:
            continue
        limit = np.float32(1.001 * np.exp(strongest.max() - margin))
        frames = white_frame[i], modulation[i], background[i], reason[i]
        _measure_excess(frames, np.float32(white), limit, excess)
        counts[i] = 0
        if _compare_windows(excess, is_weak):
            for x in range(width):
                if is_weak[x]:
                    columns[i, counts[i]] = x
                    counts[i] += 1


@kernel()
def _list_weak(
    first, last, arrays, limits, fit, margin, columns, counts, weak, reasons, weak_counts
):
    """List in ``weak`` the pixels of a range of rows near candidates whose fringes are weaker than
    the fitted terms expect there by the margin and their noise; ``reasons`` are INDIRECT."""
    height, width = arrays[0].shape
    measured, is_near = np.empty(2 + len(fit)), np.empty(width, np.bool_)
    for i in range(first, last):
        weak_counts[i] = 0
        rows = range(max(i - REACH, 0), min(i + REACH + 1, height))
        if not counts[rows.start : rows.stop].any():
            continue
        is_near[:] = False
        for v in rows:
            for k in range(counts[v]):
                is_near[columns[v, k]] = True
        for x in np.flatnonzero(is_near):
            _measure_strength(arrays, limits, i, x, measured)
            expected = 0.0
            for k in range(len(fit)):
                expected += fit[k] * measured[2 + k]
            if measured[0] < expected - margin - measured[1]:
                weak[i, weak_counts[i]], reasons[i, weak_counts[i]] = x, INDIRECT
                weak_counts[i] += 1


@kernel()
def _measure_excess(frames, white, limit, excess):
    """Fill ``excess`` (w + 6,), reflected at the image's borders: a row's amplitudes less ``limit``
    times its white light.

    ``frames``: the row's white light, modulation, background and reason.
    """
    white_frame, modulation, background, reason = frames
    inner = excess[REACH:-REACH]
    for x in range(len(modulation)):
        level = np.float32(white_frame[x])
        half = level - background[x]
        is_known = (reason[x] == 0) & (level < white) & (half > np.float32(0))
        inner[x] = modulation[x] - limit * half if is_known else np.float32(0)
    for k in range(REACH):
        excess[REACH - 1 - k] = excess[REACH + k]
        excess[k - REACH] = excess[-1 - k - REACH]


@kernel()
def _compare_windows(excess, is_weak):
    """Set ``is_weak`` (w,): where the ``excess`` (w + 6,) in the window is negative; return whether
    it is anywhere."""
    for x in range(len(is_weak)):
        both = excess[x]
        for k in range(1, WINDOW_PX):
            both += excess[x + k]
        is_weak[x] = both < np.float32(0)
    found = np.uint8(0)
    for each in is_weak:
        found |= each
    return found != 0


@kernel()
def _bound_strength(fit, place, phase):
    """Return the largest strength that the fitted terms (6,) give in a row (w,) at this place, 0 to
    1 in the image."""
    low, high = np.float32(np.inf), np.float32(-np.inf)
    for value in phase:
        low = value if value < low else low
        high = value if value > high else high
    if not low <= high:
        return -np.inf
    a, b = low / 100.0, high / 100.0
    most = max(a * (fit[3] + a * fit[4]), b * (fit[3] + b * fit[4]))
    if fit[4] < 0:
        top = min(max(-fit[3] / (2 * fit[4]), a), b)
        most = max(most, top * (fit[3] + top * fit[4]))
    return fit[0] + max(fit[1], 0.0) + place * fit[2] + most


def _fit_strength(strength: np.ndarray, terms: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit the terms (6,) to the upper side of the strengths; second, the mean distance of those
    above the fit.

    ``strength`` (n,): log of the fringes' amplitude over half of the white light; ``terms`` (n, 6)
    of its model. Penalised, so that place and phase, nearly the same on a flat surface, do not
    cancel to follow indirect light; blur never makes the fringes of a steep surface stronger.
    """
    middle, size = terms.mean(axis=0), np.maximum(terms.std(axis=0), 1e-9)
    middle[0], size[0] = 0.0, 1.0
    terms = (terms - middle) / size
    weight, rest = np.ones(len(terms)), strength
    for _ in range(20):
        penalty, weighted = np.diag(PENALTIES) * weight.sum(), terms.T * weight
        normal, moment = weighted @ terms + penalty, weighted @ strength
        fit = np.linalg.solve(normal, moment)
        if fit[-1] > 0:
            fit = np.append(np.linalg.solve(normal[:-1, :-1], moment[:-1]), 0.0)
        before, rest = rest, strength - terms @ fit
        if np.abs(rest - before).max() < CONVERGED:
            break
        weight = np.where(rest > 0, UPPER, 1 - UPPER) / np.maximum(np.abs(rest), 0.005)
    above = rest > 0
    slopes = fit / size
    slopes[0] = fit[0] - slopes[1:] @ middle[1:]
    return slopes, float(rest[above].mean()) if above.any() else 0.0
