"""Decoding of Gray code alone, compiled; defined by `tests/decode_reference.py`."""

from typing import NamedTuple

import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.kernels import HALF, NAN, ZERO, Scale, bit_height, is_dark, select_reason
from slviewer.geometry.jit import kernel, read_only, run_rows

TWO_PI = 2 * np.pi


class GrayRules(NamedTuple):
    """Frames and cells of a Gray code without phase steps.

    ``gray``, ``inverse``: frames of the bits, most significant first, and of their inverses, or
    none; ``white`` and ``black``: frames, or -1. Cells of ``cell`` px begin at ``origin`` px; the
    projector ends at ``high`` px. ``sigma_part``: noise of a bit over that of a grey level.
    ``binary``: the bits are plain binary numbers.
    """

    gray: np.ndarray
    inverse: np.ndarray
    white: int
    black: int
    origin: float
    cell: float
    high: float
    sigma_part: float
    binary: bool


def decode_gray(
    stack: np.ndarray, scale: Scale, rules: GrayRules, maps: tuple[np.ndarray, ...]
) -> None:
    """Decode the projector's column or row from Gray bits alone.

    Fills the five (h, w) ``maps``, see `kernels.decode_rows`; the wrapped phase is NaN.
    """
    run_rows(_decode_gray_rows, stack.shape[1], read_only(stack), scale, rules, *maps)


@kernel()
def _decode_gray_rows(
    start, stop, stack, scale, rules, phase, wrapped, modulation, background, reason
):
    """Decode a range of rows, see `decode_gray`."""
    gray, inverse, white, black = rules.gray, rules.inverse, rules.white, rules.black
    width = stack.shape[2]
    per_px = TWO_PI / rules.cell
    for row in range(start, stop):
        for x in range(width):
            B, A = ZERO, ZERO
            if white >= 0 and black >= 0:
                bright, dim = np.float32(stack[white, row, x]), np.float32(stack[black, row, x])
                B, A = (bright - dim) * HALF, (bright + dim) * HALF
            else:
                for b in range(len(gray)):
                    bright = np.float32(stack[gray[b], row, x])
                    dim = np.float32(stack[inverse[b], row, x])
                    B += abs(bright - dim)
                    A += bright + dim
                B *= np.float32(0.5 / len(gray))
                A *= np.float32(0.5 / len(gray))
            sigma = np.sqrt(np.float32(scale.noise_a) + np.float32(scale.noise_b) * A) * np.float32(
                rules.sigma_part
            )
            limit = max(
                np.float32(limits.GRAY_UNDECIDED_SIGMAS) * sigma,
                np.float32(limits.GRAY_UNDECIDED_PART) * B,
            )
            code, other, bit, flipped, doubts = 0, 0, 0, 0, 0
            for b in range(len(gray)):
                bit_above = bit_height(stack, gray, inverse, b, row, x, A)
                doubt = int(abs(bit_above) < limit)
                if rules.binary:
                    bit, flipped = 0, 0
                bit ^= int(bit_above > 0)
                flipped ^= int(bit_above > 0) ^ doubt
                code, other = 2 * code + bit, 2 * other + flipped
                doubts += doubt
            unclear = doubts > 1 or abs(code - other) > 1
            modulation[row, x], background[row, x], wrapped[row, x] = B, A, NAN
            dark = (doubts >= limits.DARK_BITS) | is_dark(B, A, scale)
            reason[row, x] = select_reason(dark, False, unclear)
            start = rules.origin + rules.cell * min(code, other)
            end = rules.origin + rules.cell * (max(code, other) + 1)
            first, last = max(start, -0.5), min(end, rules.high)
            centre = 0.5 * (first + last if first < last else start + end)
            phase[row, x] = NAN if dark | unclear else np.float32(per_px * centre)
