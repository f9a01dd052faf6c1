"""Light of each frame of a capture, and frames as they would be under equal light.

Frame i shows ``g_i(v) S_i(p) + o_i(p)``: S_i is what the scene shows of its pattern; the gain g_i
varies with automatic exposure and unsteady lamps, under a rolling shutter also from image row to
row, v; o_i is the room light in excess of that of the other frames, uniform or in proportion to the
scene's albedo. `slviewer.examination.light` estimates it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal

import cv2
import numpy as np

from slviewer.fringe.cosines import fit_cosine
from slviewer.fringe.kernels_light import equalize
from slviewer.fringe.layout import white_level
from slviewer.fringe.sequence import Indices, PatternSequence
from slviewer.geometry.jit import run_rows

Term = Literal["gain", "wave", "room"]

FEW_STEPS = 4
"""Largest number of steps between which a change of room light is not corrected reliably: with four
steps on a textured board, light of a quarter of the mean caused an error of 1.4 px when modelled as
uniform."""
CLIPPED = 65535.0
"""The grey level of equalized frames where the camera clipped."""


@dataclass(frozen=True, eq=False)
class FrameLight:
    """Light of each of n frames; gains relative to the mean of the frames of their kind, the steps
    of a period or the other frames of an axis.

    ``terms``: terms of the light that are to be corrected, empty where no correction is necessary
    or possible; ``unexplained``: terms by which the frames differ, although these explain too
    little to be corrected.

    ``gain`` (n,); ``wave`` (n, 2): relative cosine and sine of ``cycles`` per image height. The
    room light, ``uniform`` (n,) grey levels and ``albedo`` (n, 3) times the scene's albedo (in grey
    levels: constant, along rows, along columns, both -0.5 ... 0.5), changes before the frames
    ``changes`` only: if it varied freely, a part in step with the fringes could not be separated
    from them. ``room`` (n,): its excess over the darkest frame, as a share of the mean grey level.
    """

    gain: np.ndarray
    wave: np.ndarray
    uniform: np.ndarray
    albedo: np.ndarray
    room: np.ndarray
    cycles: float = 0.0
    changes: Indices = ()
    terms: tuple[Term, ...] = ()
    unexplained: tuple[Term, ...] = ()

    @classmethod
    def constant(cls, count: int) -> "FrameLight":
        """Return equal light for ``count`` frames."""
        zero = np.zeros(count)
        return cls(np.ones(count), np.zeros((count, 2)), zero, np.zeros((count, 3)), zero)

    @property
    def is_significant(self) -> bool:
        """Whether the light differs between the frames by more than can be neglected."""
        return bool(self.terms)

    @property
    def drift(self) -> float:
        """Rms of the gains' logarithm."""
        return float(np.std(np.log(self.gain)))

    def count_open_steps(self, sequence: PatternSequence, k: int) -> int:
        """Return the number of steps of the period in which a change of the room's light before
        frame ``k`` falls, if they are too few to tell uniform light from light in proportion to the
        albedo; else 0."""
        shifts = [s for s in list_shifts(sequence) if min(s) < k <= max(s)]
        return next((len(steps) for steps in shifts if len(steps) <= FEW_STEPS), 0)


def equalize_frames(
    sequence: PatternSequence,
    stack: np.ndarray,
    light: FrameLight,
    frames: Sequence[int] | None = None,
) -> tuple[PatternSequence, np.ndarray, float]:
    """Scale frames to equal light: their sequence, (k, h, w) uint16, and the factor that multiplied
    the grey levels.

    ``frames``: indices of the frames to scale, all if None. Phase-shifted frames are 65535
    throughout at pixels that the camera clipped in one of the frames of their period, and nowhere
    else. Room light is added to the frames that lack it rather than subtracted, so that nothing
    becomes negative.
    """
    chosen = list(range(len(stack)) if frames is None else frames)
    v = np.linspace(0, 1, stack.shape[1])
    angle = 2 * np.pi * light.cycles * v
    gain = light.gain[:, None] * (1 + light.wave @ np.stack([np.cos(angle), np.sin(angle)]))
    along_rows = light.albedo[:, :1] + light.albedo[:, 1:2] * (v - 0.5)
    along_rows = along_rows - along_rows.max(axis=0)
    offset = light.uniform - light.uniform.max()
    along_columns = light.albedo[:, 2] - light.albedo[:, 2].max()
    white = white_level(sequence, stack, chosen)
    albedo = np.zeros((0, 0), np.float32)
    highest = white - offset.min()
    if light.albedo.any():
        albedo = estimate_albedo(sequence, stack, light.changes)
        # A column's part reaches from -0.5 to 0.5 of its slope.
        along_rows = along_rows - 0.5 * np.abs(along_columns).max()
        highest -= float(albedo.max()) * along_rows.min()
    scale = float(min(256.0, 65000.0 / (highest / gain.min())))
    out = np.empty((len(chosen), *stack.shape[1:]), np.uint16)
    values = [a[chosen].astype(np.float32) for a in (gain, offset, along_rows, along_columns)]
    run_rows(equalize, stack.shape[1], stack, np.array(chosen), *values, albedo, scale, out)
    for steps in list_shifts(sequence):
        if places := [k for k, i in enumerate(chosen) if i in steps]:
            clipped = reduce(np.maximum, (stack[chosen[k]] for k in places)) >= white
            for k in places:
                out[k][clipped] = CLIPPED
    full_scale = None if sequence.full_scale is None else int(CLIPPED)
    return (
        replace(sequence, frames=tuple(sequence.frames[i] for i in chosen), full_scale=full_scale),
        out,
        scale,
    )


def estimate_albedo(
    sequence: PatternSequence, frames: np.ndarray, changes: Sequence[int]
) -> np.ndarray:
    """Return half of the projector's light in grey levels, float32 of the shape of one of the
    ``frames`` (n, ...).

    The modulation of the last phase shift between whose frames no light ``changes``; where there is
    none the largest half difference of a bit and its inverse, which see the same room light, else
    half the range of the longest run of frames between two changes.
    """
    shifts = list_shifts(sequence)
    if steady := [s for s in shifts if not any(min(s) < k <= max(s) for k in changes)]:
        chosen = np.stack([frames[i] for i in steady[-1]]).astype(np.float32)
        return np.abs(fit_cosine(chosen.reshape(len(chosen), -1))[1]).reshape(frames.shape[1:])
    pairs = [
        pair
        for axis in sequence.axes
        for pair in zip(sequence.bits("gray", axis), sequence.bits("inverse", axis), strict=False)
    ]
    if pairs:
        differences = reduce(np.maximum, (cv2.absdiff(frames[i], frames[j]) for i, j in pairs))
        # OpenCV makes columns of vectors
        return np.float32(0.5) * differences.reshape(frames.shape[1:])
    runs = np.split(sequence.patterns, np.searchsorted(sequence.patterns, changes))
    longest = frames[max(runs, key=len)]
    return np.float32(0.5) * (longest.max(axis=0) - longest.min(axis=0)).astype(np.float32)


def list_shifts(sequence: PatternSequence) -> tuple[Indices, ...]:
    """Return the frames of every phase-shifted period, of all axes."""
    return tuple(steps for axis in sequence.axes for _, steps in sequence.phase_shifts(axis))
