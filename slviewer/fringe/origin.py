"""Phase at which a Gray code begins, from the phases at its edges."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.frame_light import FrameLight, equalize_frames
from slviewer.fringe.layout import Layout, axis_layout, check_stack, white_level
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.phase_shifting import bit_heights, dark_limit, dark_sigmas, phase_shift
from slviewer.fringe.sequence import Axis, PatternSequence

LINES = 150
"""Image lines along which the edges are located."""
MIN_EDGES = 50
"""Smallest number of code edges between neighbouring pixels."""
MIN_CONCENTRATION = 0.7
"""Share of the edges inside which a phase must lie, or length of the mean unit vector of their
phases; 1 where all edges fall at one phase."""
MIN_RISING = 0.8
"""Share of code edges at which the phase must rise with the code."""
LATEST_TURNS = 0.25
"""Where code 0 begins at the latest, in periods."""
_CANDIDATES = 4000  # phases per period
_BEST_SHARE = 0.97  # phases inside this share of the largest number of intervals are averaged


@dataclass(frozen=True)
class CodeOrigin:
    """Phase at which a code begins.

    ``turns``: in periods, -0.5 to 0.5, NaN where the edges do not agree; ``edges``: their number;
    ``rising``: share of them at which the phase rises with the code; ``is_exact``: whether it lies
    between the pixels of most edges, rather than being the mean of blurred ones.
    """

    turns: float
    edges: int
    rising: float
    is_exact: bool = True


def estimate_gray_origin(
    sequence: PatternSequence, stack: np.ndarray, axis: Axis, light: FrameLight | None = None
) -> float:
    """Estimate the projector coordinate, px, at which Gray code 0 begins; ``light`` of the frames,
    equal if None.

    Between two neighbouring camera pixels whose codes are consecutive there is a code edge, and the
    wrapped phase there is that of the origin (half a period more at every other edge of a
    complementary code). The mean over all edges does not depend on the sequence's own
    ``gray_origin_px``. Whole periods, which no frame determines, are chosen so that code 0 contains
    the projector's first column, or begins at most a quarter of a period after it: no code is
    negative.

    Raises InputError where the code falls as the phase rises (the frames have the other
    ``phase_sign``), and where the edges have no common phase (wrong period, order of bits, or order
    of frames).
    """
    check_stack(sequence, stack)
    layout = axis_layout(sequence, axis)
    if light is not None and light.is_significant:
        sequence, stack, _ = equalize_frames(sequence, stack, light)
    if not (layout.shifts and layout.gray):
        raise InputError(
            f"axis {axis}: the origin of a Gray code shows only beside a phase shift",
            "there is none to compare",
        )
    white = white_level(sequence, stack, sequence.select(axis))
    found = measure_code_origin(layout, stack, white)
    if found.edges < MIN_EDGES:
        raise InputError(
            f"axis {axis}: {found.edges} code edges are in view, too few to tell where the code"
            " begins"
        )
    if found.rising < 1 - MIN_RISING:
        other = replace(layout, sign=-layout.sign)
        is_sign = measure_code_origin(other, stack, white).rising >= 1 - MIN_RISING
        sign = f"set phase_sign to {other.sign}, or " if is_sign else ""
        raise InputError(
            f"axis {axis}: the code falls where the phase rises",
            f"{sign}correct the order of the steps",
        )
    if not np.isfinite(found.turns):
        raise InputError(
            f"axis {axis}: the code edges fall at no common phase",
            "check the period, the order of the bits, and which frames belong together",
        )
    turns = found.turns - np.ceil(found.turns - LATEST_TURNS)
    return float(turns * layout.period_px)


def measure_code_origin(layout: Layout, stack: np.ndarray, white: float) -> CodeOrigin:
    """Measure the phase at which the codes of a stack (n, h, w) start, whose pixels clip at
    ``white``.

    An edge is at a phase between those of two neighbouring pixels. The result is the phase inside
    the largest number of these intervals, which is more precise than any one of them. Of blurred
    edges, which lie beside their pixels, it is the mean of the intervals' middles.
    """
    start, length = _list_edges(layout, stack, white)
    rises = length > 0
    rising = float(rises.mean()) if len(rises) else 0.0
    none = CodeOrigin(np.nan, len(rises), rising)
    if len(rises) < MIN_EDGES or rising < MIN_RISING:
        return none
    start, length = start[rises], length[rises]
    places = np.linspace(-np.pi, np.pi, _CANDIDATES, endpoint=False)
    inside = _count_intervals(start, length)
    is_exact = inside.max() >= MIN_CONCENTRATION * len(start)
    chosen = np.exp(1j * places)[inside > _BEST_SHARE * inside.max()]
    if not is_exact:
        middle = np.exp(1j * (start + length / 2))
        common = complex(middle.mean())
        if abs(common) < MIN_CONCENTRATION:
            return none
        chosen = middle[np.abs(np.angle(middle / common)) < np.pi / 4]
    return CodeOrigin(float(np.angle(chosen.mean()) / (2 * np.pi)), len(start), rising, is_exact)


def _list_edges(layout: Layout, stack: np.ndarray, white: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the phase (k,) rad of the pixel before each code edge, less half a period where the
    cell that begins there is the second half of one, and the change (k,) of the phase to the pixel
    behind it."""
    along_x = layout.axis == "x"
    step = max(1, stack.shape[1 if along_x else 2] // LINES)
    stack = np.ascontiguousarray(stack[:, ::step] if along_x else stack[:, :, ::step])
    wrapped, modulation, background, _ = phase_shift(
        stack, layout.shifts[-1].indices, layout.sign, layout.offset_rad
    )
    noise = measure_noise(layout, stack, white)
    illuminated = modulation >= dark_limit(background, noise, white, dark_sigmas(layout))
    code, digit = np.zeros(illuminated.shape, np.int32), np.zeros(illuminated.shape, np.int32)
    for i in [*layout.gray] + ([] if layout.complementary is None else [layout.complementary]):
        digit ^= bit_heights(layout, stack, i, background) > 0
        code = 2 * code + digit
    if not along_x:
        wrapped, illuminated, code = wrapped.T, illuminated.T, code.T
    wrapped = _average_noisy(np.exp(1j * wrapped) * illuminated)
    first, second = np.s_[:, :-1], np.s_[:, 1:]
    starts, lengths = [], []
    for here, there in ((first, second), (second, first)):
        edge = illuminated[here] & illuminated[there] & (code[there] == code[here] + 1)
        below, above = wrapped[here][edge].astype(float), wrapped[there][edge].astype(float)
        lengths.append(np.angle(np.exp(1j * (above - below))))
        if layout.complementary is not None:
            below = below - (code[there][edge] & 1) * np.pi
        starts.append(below)
    return np.concatenate(starts), np.concatenate(lengths)


def _average_noisy(phasors: np.ndarray) -> np.ndarray:
    """Return the phases (h, w) rad of unit phasors (h, w), 0 where dark, averaged along the rows
    over so many pixels that the noise of neighbours stays below half of their difference."""
    products = phasors[:, 1:] * phasors[:, :-1].conj()
    products = products[products != 0]
    mean = complex(products.mean()) if len(products) else 1.0
    change = max(abs(np.angle(mean)), 1e-6)
    noise = np.sqrt(max(-2 * np.log(max(abs(mean), 1e-6)), 0.0))
    count = int(min(np.ceil(2 * noise / change), np.pi / 2 / change))
    if count > 1:
        kernel = count | 1, 1
        phasors = cv2.blur(phasors.real, kernel) + 1j * cv2.blur(phasors.imag, kernel)
    return np.angle(phasors)


def _count_intervals(start: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return how many of the intervals of phase (k,) rad hold each of the candidates from -pi on;
    those that pass pi continue at -pi."""
    first = np.mod((start + np.pi) / (2 * np.pi), 1.0) * _CANDIDATES
    change = np.zeros(3 * _CANDIDATES)
    np.add.at(change, np.ceil(first).astype(int), 1.0)
    np.add.at(change, np.floor(first + length / (2 * np.pi) * _CANDIDATES).astype(int) + 1, -1.0)
    return np.asarray(np.cumsum(change).reshape(3, _CANDIDATES).sum(0))
