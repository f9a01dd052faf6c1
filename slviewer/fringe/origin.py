"""Where another tool's Gray code begins, read off its own frames."""

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.layout import Layout, check_stack, layout, white_level
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.reference import bit_heights, dark_limit, dark_sigmas, phase_shift
from slviewer.fringe.sequence import Axis, PatternSequence

TWO_PI = 2 * np.pi
MIN_EDGES = 50
"""Code edges between neighbouring pixels that a judgement needs."""
MIN_CONCENTRATION = 0.7
"""Length of the mean unit vector of the phases at code edges; 1 where all edges fall at one phase, 0 anywhere."""
MIN_RISING = 0.8
"""Share of code edges at which the phase must rise with the code."""
LATEST_TURNS = 0.25
"""Where code 0 begins at the latest, in periods."""
CLOSE_RAD = np.pi / 4
"""Edges farther than this from the common phase are depth steps, and left out of its mean."""


def estimate_gray_origin(sequence: PatternSequence, stack: np.ndarray, axis: Axis) -> float:
    """The projector coordinate, px, at which Gray code 0 begins.

    Between two neighbouring camera pixels whose codes follow upon each other lies a code edge, and the wrapped phase
    there is that of the origin (half a period more at every other edge of a complementary code). The mean over all
    edges does not depend on the sequence's own ``gray_origin_px``. Whole periods, which no frame can tell, are chosen
    so that code 0 holds the projector's first column, or begins at most a quarter of a period after it: no code is
    negative.

    Raises InputError where the code falls as the phase rises (the frames want the other ``phase_sign``), and where the
    edges fall at no common phase (wrong period, order of bits, or order of frames).
    """
    check_stack(sequence, stack)
    found = layout(sequence, axis)
    if not (found.shifts and found.gray):
        raise InputError(
            f"axis {axis}: the origin of a Gray code shows only beside a phase shift: there is none to compare"
        )
    phase, rising = _edges(found, stack, white_level(stack, sequence.select(axis)))
    if len(phase) < MIN_EDGES:
        raise InputError(f"axis {axis}: {len(phase)} code edges are in view, too few to tell where the code begins")
    if rising.mean() < 1 - MIN_RISING:
        raise InputError(
            f"axis {axis}: the code falls where the phase rises: set phase_sign to {-sequence.sign(axis)}, "
            "or mend the order of the steps"
        )
    mean = np.mean(np.exp(1j * phase))
    if abs(mean) < MIN_CONCENTRATION or rising.mean() < MIN_RISING:
        raise InputError(
            f"axis {axis}: the code edges fall at no common phase: check the period, the order of the bits, "
            "and which frames belong together"
        )
    turns = _robust_angle(phase) / TWO_PI
    return float((turns - np.ceil(turns - LATEST_TURNS)) * found.period_px)


def _edges(found: Layout, stack: np.ndarray, white: float) -> tuple[np.ndarray, np.ndarray]:
    """Wrapped phase (rad) at every code edge between neighbours, and whether it rises with the code there."""
    wrapped, modulation, background, _ = phase_shift(stack, found.shifts[0].indices, found.sign, found.offset_rad)
    lit = modulation >= dark_limit(background, measure_noise(found, stack, white), white, dark_sigmas(found))
    bits = [*found.gray] + ([] if found.complementary is None else [found.complementary])
    code, digit = np.zeros(lit.shape, np.int32), np.zeros(lit.shape, np.int32)
    for i in bits:
        digit ^= bit_heights(found, stack, i, background) > 0
        code = 2 * code + digit
    halves = found.complementary is not None
    phases, rises = [], []
    for here, there in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[:-1], np.s_[1:]),
        (np.s_[1:], np.s_[:-1]),
    ):
        edge = lit[here] & lit[there] & (code[there] == code[here] + 1)
        below, above = wrapped[here][edge].astype(np.float64), wrapped[there][edge].astype(np.float64)
        step = np.angle(np.exp(1j * (above - below)))
        # The cell that begins here is the second half of a period where its number is odd.
        half = (code[there][edge] & 1) * np.pi if halves else 0.0
        phases.append(below + step / 2 - half)
        rises.append(step > 0)
    return np.concatenate(phases), np.concatenate(rises)


def _robust_angle(angles: np.ndarray) -> float:
    """Circular mean in -pi ... pi, of the angles near it alone.

    A mean, for rising and falling edges lie to either side of it where the threshold is not half way between them.
    """
    mean = np.angle(np.mean(np.exp(1j * angles)))
    for _ in range(5):
        apart = np.angle(np.exp(1j * (angles - mean)))
        mean += np.mean(apart[np.abs(apart) < CLOSE_RAD])
    return float(np.angle(np.exp(1j * mean)))
