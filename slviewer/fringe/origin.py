"""Estimation of the origin of another tool's Gray code from its own frames."""

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.axis_agreement import FEWEST_EDGES, measure_agreement
from slviewer.fringe.axis_reader import AxisReader, described_frames
from slviewer.fringe.frame_light import equalize_frames, estimate_frame_light
from slviewer.fringe.layout import axis_layout, check_stack
from slviewer.fringe.line_sample import coded_frames, sample_lines
from slviewer.fringe.sequence import Axis, PatternSequence

MIN_EDGES = FEWEST_EDGES
"""Smallest number of code edges between neighbouring pixels."""
MIN_CONCENTRATION = 0.7
"""Length of the mean unit vector of the phases at code edges, weighed by modulation; 1 where all
edges fall at one phase, 0 anywhere."""
MIN_RISING = 0.8
"""Share of code edges at which the phase must rise with the code."""
LATEST_TURNS = 0.25
"""Where code 0 begins at the latest, in periods."""
PIXELS = 60_000
"""Number of pixels on rows, and on columns: the origin is then accurate to a few hundredths of a
pixel."""


def estimate_gray_origin(sequence: PatternSequence, stack: np.ndarray, axis: Axis) -> float:
    """Estimate the projector coordinate, px, at which Gray code 0 begins.

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
    light = estimate_frame_light(sequence, stack)
    if light.is_significant:
        sequence, stack, _ = equalize_frames(sequence, stack, light)
    if not (layout.shifts and layout.gray):
        raise InputError(
            f"axis {axis}: the origin of a Gray code shows only beside a phase shift: there is none"
            " to compare"
        )
    reader = AxisReader(sample_lines(sequence, stack, PIXELS), coded_frames(sequence, axis))
    frames = described_frames(sequence, axis)
    agreement = measure_agreement(reader, frames)
    assert frames.fringe is not None
    if agreement.edges < MIN_EDGES:
        raise InputError(
            f"axis {axis}: {agreement.edges} code edges are in view, too few to tell where the code"
            " begins"
        )
    if agreement.rising < 1 - MIN_RISING:
        raise InputError(
            f"axis {axis}: the code falls where the phase rises: set phase_sign to"
            f" {-sequence.sign(axis)}, or correct the order of the steps"
        )
    if not (agreement.common >= MIN_CONCENTRATION and agreement.rising >= MIN_RISING):
        raise InputError(
            f"axis {axis}: the code edges fall at no common phase: check the period, the order of"
            " the bits, and which frames belong together"
        )
    turns = agreement.begin_turns
    return float((turns - np.ceil(turns - LATEST_TURNS)) * frames.fringe[0])
