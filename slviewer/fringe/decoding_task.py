"""Frames of one axis under equal light, from which a phase map is decoded."""

from dataclasses import dataclass

import numpy as np

from slviewer.fringe.frame_light import CLIPPED, FrameLight, equalize_frames
from slviewer.fringe.layout import Layout, axis_layout, check_stack, white_level
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.phase import Noise
from slviewer.fringe.sequence import Axis, PatternSequence


@dataclass(frozen=True, eq=False)
class DecodingTask:
    """Frames of one axis under equal light, and what their pixels are judged by.

    ``stack`` (k, h, w): the frames that ``sequence`` and ``layout`` describe, of ``noise``, clipped
    at ``white``. Their grey levels are ``factor`` times those of the capture; ``full_scale``: its
    full scale in these levels.
    """

    sequence: PatternSequence
    layout: Layout
    stack: np.ndarray
    noise: Noise
    white: float
    full_scale: float
    factor: float = 1.0


def prepare_decoding(
    sequence: PatternSequence, stack: np.ndarray, axis: Axis, light: FrameLight | None = None
) -> DecodingTask:
    """Return the frames of one axis of a capture (n, h, w), under equal light where ``light`` is
    that of the frames and needs a correction, else as captured.

    Raises InputError when the frames are not those of the sequence,
    or cannot give an absolute phase.
    """
    check_stack(sequence, stack)
    layout = axis_layout(sequence, axis)
    stack = np.ascontiguousarray(stack)
    white = white_level(sequence, stack, sequence.select(axis))
    if light is None or not light.is_significant:
        return DecodingTask(
            sequence, layout, stack, measure_noise(layout, stack, white), white, white
        )
    sequence, stack, factor = equalize_frames(sequence, stack, light, sequence.select(axis))
    layout = axis_layout(sequence, axis)
    noise = measure_noise(layout, stack, CLIPPED)
    return DecodingTask(sequence, layout, stack, noise, CLIPPED, white * factor, factor)
