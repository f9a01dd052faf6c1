"""Images of plain binary numbers beside phase steps, as images of Gray code."""

from dataclasses import replace

import numpy as np

from slviewer.fringe.sequence import Axis, PatternSequence


def has_binary_beside_phase(sequence: PatternSequence) -> bool:
    """Whether plain binary numbers count the periods of phase steps, along each of their axes."""
    coded = [axis for axis in sequence.axes if sequence.find("gray", axis)]
    return sequence.binary and bool(coded) and all(map(sequence.periods_px, coded))


def to_gray_code(
    sequence: PatternSequence, frames: np.ndarray
) -> tuple[PatternSequence, np.ndarray]:
    """Return a sequence of Gray code, and frames (n, h, w), or several exposures of them one after
    the other, in which each bit was combined with the one above it.

    Several bits of a binary number change at once, and a Gray bit is the exclusive or of two. Of
    heights a, b between 0 and 1, which the fringes' mean and amplitude scale, it is a + b - 2 a b:
    where both change at a blurred edge, it stays on its side of 1/2.
    """
    converted, count = frames.copy(), len(sequence.frames)
    for axis in (each for each in sequence.axes if sequence.find("gray", each)):
        for begin in range(0, len(frames), count):
            _convert(sequence, axis, frames[begin : begin + count], converted[begin:])
    return replace(sequence, binary=False), converted


def _convert(
    sequence: PatternSequence, axis: Axis, frames: np.ndarray, converted: np.ndarray
) -> None:
    """Write the frames (n, h, w) of an axis's bits to those of the same places in ``converted``."""
    bits, inverses = sequence.bits("gray", axis), sequence.bits("inverse", axis)
    mean, amplitude = _fringe(sequence, axis, frames)
    above = np.zeros_like(mean)
    last = sequence.find("complementary", axis)
    for k, index in enumerate((*bits, *last)):
        level = frames[index] - mean
        if k < len(inverses):
            level = (frames[index].astype(np.float32) - frames[inverses[k]]) / 2
        height = np.clip(0.5 + level / (2 * amplitude), 0, 1)
        signed = amplitude * (2 * (above + height - 2 * above * height) - 1)
        above = height
        most = np.iinfo(frames.dtype).max
        converted[index] = np.clip(np.rint(mean + signed), 0, most)
        if k < len(inverses):
            converted[inverses[k]] = np.clip(np.rint(mean - signed), 0, most)


def _fringe(
    sequence: PatternSequence, axis: Axis, frames: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and amplitude (h, w) of the finest fringes of an axis; the latter 1 or more."""
    _, indices = sequence.phase_shifts(axis)[-1]
    steps = frames[list(indices)].astype(np.float32)
    turns = np.exp(2j * np.pi * np.arange(len(steps)) / len(steps))
    amplitude = 2 * np.abs(np.tensordot(turns, steps, 1)) / len(steps)
    return steps.mean(axis=0), np.maximum(amplitude, 1).astype(np.float32)
