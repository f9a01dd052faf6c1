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
from scipy.ndimage import uniform_filter

from slviewer.fringe.decoding_task import DecodingTask
from slviewer.fringe.phase import Reason
from slviewer.geometry.jit import kernel, read_only, run_rows

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
SAMPLES = 6000
"""Pixels, evenly spread, that the strength of the image's fringes is fitted to."""
FEWEST = 200
UPPER = 0.95
"""Weight of the samples above the fit: those below have indirect light."""
PENALTIES = (0.0, 0.1, 0.1, 0.1, 0.02, 0.1)
"""Of the fit's terms, in shares of the samples' weight; the phase's square alone follows the blur
of a deep surface."""
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
    layout, phase, reason = task.layout, maps[0], maps[-1]
    whites = [
        i
        for kind in ("texture", "white")
        for i, frame in enumerate(task.sequence.frames)
        if frame.kind == kind
    ]
    if layout.steps >= FEWEST_STEPS and whites:
        reason[_detect_weak_fringes(task, task.stack[whites[0]], maps)] = Reason.INDIRECT
    if layout.gray:
        _mask_unequal_bits(task, maps)
    phase[reason == Reason.INDIRECT] = np.nan


def _mask_unequal_bits(task: DecodingTask, maps: Maps) -> None:
    """Set the reason INDIRECT where bits that have no edge near a pixel differ in black or
    white."""
    layout, (phase, _, _, background, reason) = task.layout, maps
    count, cell = len(layout.gray), layout.gray_cell_px
    spans = [cell * 2.0 ** (count - bit) for bit in range(count)]
    frames, inverses = list(layout.gray), list(layout.inverse) or [-1] * count
    if layout.complementary is not None:
        frames, inverses, spans = [*frames, layout.complementary], [*inverses, -1], [*spans, cell]
    guard = max(EDGE_CELLS * cell, EDGE_PX)
    wide = [k for k, span in enumerate(spans) if span > 4 * guard]
    if len(wide) < 2:
        return
    bits = (
        np.array([frames[k] for k in wide]),
        np.array([inverses[k] for k in wide]),
        np.array([spans[k] for k in wide]),
    )
    limits = np.array(
        [layout.period_px / (2 * np.pi), layout.gray_origin_px, guard, *task.noise], np.float64
    )
    stack = read_only(task.stack)

    def compare(first: int, last: int) -> None:
        """Compare the bits of a range of rows."""
        _compare_bits(
            stack, first, *bits, limits, *(each[first:last] for each in (phase, background, reason))
        )

    run_rows(compare, stack.shape[1])


@kernel()
def _compare_bits(stack, first, frames, inverses, spans, limits, phase, background, reason):
    """Set the reason INDIRECT in rows from ``first`` on; the three maps contain only these rows."""
    to_px, origin, guard, noise_a, noise_b = limits
    for i in range(len(phase)):
        for x in range(phase.shape[1]):
            if reason[i, x] != 0:
                continue
            place, level = phase[i, x] * to_px - origin, background[i, x]
            most_white, least_white, most_black, least_black = 0.0, 1e9, 0.0, 1e9
            for b in range(len(frames)):
                turns = place / spans[b]
                if abs(turns - np.floor(turns) - 0.5) * spans[b] < guard:
                    continue
                value = np.float64(stack[frames[b], first + i, x])
                if inverses[b] >= 0:
                    height = abs(value - np.float64(stack[inverses[b], first + i, x])) / 2
                else:
                    height = value - level
                if height > 0:
                    most_white, least_white = max(most_white, height), min(least_white, height)
                else:
                    most_black, least_black = max(most_black, -height), min(least_black, -height)
            swing = max(most_white, most_black)
            sigma = np.sqrt(max(noise_a + noise_b * (level + most_white), 0.0))
            if max(most_white - least_white, most_black - least_black) > max(
                BIT_SHARE * swing, BIT_SIGMAS * sigma
            ):
                reason[i, x] = INDIRECT


def _detect_weak_fringes(task: DecodingTask, white_frame: np.ndarray, maps: Maps) -> np.ndarray:
    """Return (h, w) bool: valid pixels whose fringes are weak for their white light, compared with
    the image's.

    Of sharp fringes the amplitude is half of the white light. Blur makes them weaker: the
    projector's, which changes evenly over a depth range, and the camera's, by the square of the
    phase's gradient. Both are fitted.
    """
    layout, noise, (phase, _, modulation, background, reason) = task.layout, task.noise, maps
    nothing = np.zeros(phase.shape, bool)
    is_narrow = (
        not layout.gray
        and len(layout.shifts) > 1
        and layout.shifts[0].period_px < NARROW * layout.period_px
    )
    share = WEAK_NARROW if is_narrow else WEAK
    valid = (reason == Reason.VALID) & (white_frame < task.white) & (white_frame > background)
    if np.count_nonzero(valid) < FEWEST:
        return nothing
    weight = valid.astype(np.float32)
    half = uniform_filter(
        np.where(valid, white_frame - background, 0).astype(np.float32), WINDOW_PX
    )
    fringes = uniform_filter(modulation * weight, WINDOW_PX)
    count = WINDOW_PX**2 * uniform_filter(weight, WINDOW_PX)
    with np.errstate(divide="ignore", invalid="ignore"):
        strength = np.where(valid, np.log(fringes / half), np.nan)
        # Mostly of the white frame; the fringes are of several frames.
        own = np.sqrt(
            np.maximum(noise[0] + noise[1] * (background + half / np.maximum(weight, 0.1)), 0)
        )
        margin = NOISE_SIGMAS * own * np.sqrt(count) / (half * WINDOW_PX**2) - np.log(1 - share)
    slope = _square_gradient(phase, valid)
    rows, columns = np.nonzero(valid & np.isfinite(strength) & np.isfinite(slope))
    if len(rows) < FEWEST:
        return nothing
    some = np.s_[:: max(1, len(rows) // SAMPLES)]
    at = rows[some], columns[some]
    terms = _model_terms(phase, slope, *at)
    fit, spread = _fit_strength(strength[at], terms)
    typical = float(np.exp(np.median(terms @ fit)))
    if not PLAUSIBLE[0] < typical < PLAUSIBLE[1] or spread > MOST_SPREAD:
        return nothing
    if is_narrow:
        # narrow fringes: the more unsharp they are, the more blur varies
        margin = margin - min(np.log(typical), 0.0)
    expected = np.full(phase.shape, np.inf)
    expected[rows, columns] = _model_terms(phase, slope, rows, columns) @ fit
    with np.errstate(invalid="ignore"):
        return np.asarray(
            valid & np.isfinite(expected) & (strength < expected - margin - SPREADS * spread)
        )


def _model_terms(
    phase: np.ndarray, slope: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Return (n, 6): what the strength of fringes is linear in, of pixels at ``rows`` and
    ``columns``.

    A constant, the place in the image and the phase, which together follow the depth, the phase's
    square, as blur grows by the square of the distance from focus, and the squared gradient.
    """
    height, width = phase.shape
    scaled = phase[rows, columns] / 100.0
    place = [columns / width, rows / height, scaled, scaled**2]
    return np.stack([np.ones(len(rows)), *place, slope[rows, columns]], axis=1).astype(np.float64)


def _square_gradient(phase: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the square of the phase's gradient (h, w), (rad / px)^2; beside masked pixels that of
    the neighbours."""
    out = np.full(phase.shape, np.nan, np.float32)
    inner = phase[1:-1, 2:] - phase[1:-1, :-2], phase[2:, 1:-1] - phase[:-2, 1:-1]
    out[1:-1, 1:-1] = (inner[0] ** 2 + inner[1] ** 2) / 4
    known = np.isfinite(out) & (out < STEEPEST)  # else a depth step
    share = uniform_filter(known.astype(np.float32), WINDOW_PX)
    mean = uniform_filter(np.where(known, out, 0).astype(np.float32), WINDOW_PX) / np.maximum(
        share, 1e-3
    )
    return np.where(known, out, mean)


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
    weight = np.ones(len(terms))
    for _ in range(20):
        penalty = np.diag(PENALTIES) * weight.sum()
        normal, moment = (terms.T * weight) @ terms + penalty, (terms.T * weight) @ strength
        fit = np.linalg.solve(normal, moment)
        if fit[-1] > 0:
            fit = np.append(np.linalg.solve(normal[:-1, :-1], moment[:-1]), 0.0)
        rest = strength - terms @ fit
        weight = np.where(rest > 0, UPPER, 1 - UPPER) / np.maximum(np.abs(rest), 0.005)
    above = rest > 0
    slopes = fit / size
    slopes[0] = fit[0] - slopes[1:] @ middle[1:]
    return slopes, float(rest[above].mean()) if above.any() else 0.0
