"""Whether the frames of a capture fit together: what each leaves unexplained, and which of them stand out.

Phase-shifted frames are one cosine per pixel, so that more than three of them say too much, and contradict each other
when one was late, lost or repeated. Frames of unequal light are compared as they would be under equal light. What the
projector's gamma adds is common to all frames, and is not held against one of them; where it shifts the phase of three
or four steps, it is reported. Frames of a Gray code contradict
each other too: see `description_check`.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.aliased_harmonics import describe_gamma, estimate_aliased_harmonics
from slviewer.fringe.contradiction import Contradiction
from slviewer.fringe.description_check import find_contradictions
from slviewer.fringe.frame_light import CLIPPED, FrameLight, detect_light_faults, equalize_frames, estimate_frame_light
from slviewer.fringe.layout import Layout, axis_layout, white_level
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.residual_order import detect_foreign_frames, detect_misordered_steps
from slviewer.fringe.residual_sample import Fringe, sample_fringe
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.fringe.suspect import LIGHT_FAULTS, ORDER_FAULTS, Fault, Suspect

SMALL_DRIFT = 0.05
"""rms variation of the light up to which a misplaced frame is recognised without correcting the light first."""
_CODE_FAULTS: dict[str, Fault] = {
    "frame-lag": "lag", "frame-order": "swapped", "missing-frame": "dropped", "duplicate-frame": "late"
}  # fmt: skip


@dataclass(frozen=True)
class FrameResidual:
    """What the cosine fitted through all frames of its period leaves in one of them.

    ``rms``: grey levels, over the valid pixels that were sampled; ``sigmas``: the same as a multiple of what the noise
    leads to expect, 1 for a frame that fits. Both NaN where there are no more than three steps, or no valid pixels.
    ``light``: relative light of this frame, 1 like the others'; NaN where it cannot be told.
    """

    frame: int
    rms: float
    sigmas: float
    light: float


@dataclass(frozen=True)
class FrameResiduals:
    """The residual of each phase-shifted frame of one axis, and the frames of that axis that stand out.

    ``said``: in words what could not be judged, empty otherwise.
    """

    axis: Axis
    frames: tuple[FrameResidual, ...]
    suspects: tuple[Suspect, ...]
    said: str = ""


def frame_residuals(sequence: PatternSequence, stack: np.ndarray, axis: Axis) -> FrameResiduals:
    """How the (n, h, w) frames of one axis fit together. Raises InputError like `decode`.

    About 100,000 pixels of evenly spread rows are sampled. Gamma raises `sigmas` of all frames alike; a suspect is
    only a frame that contradicts the others.
    """
    return _axis_residuals(_Frames(sequence, stack, estimate_frame_light(sequence, stack)), axis)


def capture_residuals(sequence: PatternSequence, stack: np.ndarray) -> list[FrameResiduals]:
    """`frame_residuals` of each axis of a capture (n, h, w); an axis that cannot be decoded is skipped."""
    frames = _Frames(sequence, stack, estimate_frame_light(sequence, stack))
    residuals = []
    for axis in sequence.axes:
        with suppress(InputError):  # decoding reports it, with the remedy
            residuals.append(_axis_residuals(frames, axis))
    return residuals


@dataclass(frozen=True, eq=False)
class _Frames:
    """The frames of a capture, their grey levels multiplied by ``factor``, and what all axes share, computed once."""

    sequence: PatternSequence
    stack: np.ndarray
    light: FrameLight
    factor: float = 1.0

    @cached_property
    def equalized(self) -> "_Frames":
        """The frames under equal light."""
        stack, factor = equalize_frames(self.stack, self.light, self.sequence)
        return _Frames(self.sequence, stack, self.light, factor)

    @cached_property
    def contradictions(self) -> tuple[Contradiction, ...]:
        """What contradicts the description, phase steps aside."""
        return find_contradictions(self.sequence, self.stack, with_steps=False)

    def white(self, axis: Axis) -> float:
        """Grey level at which the frames of an axis are clipped."""
        return CLIPPED if self.factor != 1 else white_level(self.stack, self.sequence.select(axis))


def _axis_residuals(frames: _Frames, axis: Axis) -> FrameResiduals:
    """`frame_residuals` of one axis, of frames whose light is known."""
    sequence, light = frames.sequence, frames.light
    layout = axis_layout(sequence, axis)
    if not light.is_significant:
        return _compare(frames, layout)
    if light.drift < SMALL_DRIFT and light.wave < SMALL_DRIFT:
        # A frame out of its place is a simpler explanation than many frames each in a light of its own.
        as_seen = _compare(frames, layout)
        if any(suspect.fault in ORDER_FAULTS for suspect in as_seen.suspects):
            return as_seen
    compared = _compare(frames.equalized, layout)
    if any(suspect.fault != "gamma" for suspect in compared.suspects):
        return compared  # a frame out of its place spoils what is known of the light, too
    return replace(compared, suspects=tuple(_deduplicate([*detect_light_faults(sequence, light), *compared.suspects])))


def _compare(frames: _Frames, layout: Layout) -> FrameResiduals:
    """The residuals of one axis."""
    axis, stack, white = layout.axis, frames.stack, frames.white(layout.axis)
    noise = measure_noise(layout, stack, white)
    residuals: list[FrameResidual] = []
    suspects: list[Suspect] = []
    remarks: list[str] = []
    for shift in layout.shifts:
        sampled = sample_fringe(stack, shift, noise, white)
        what = f"axis {axis}, period {shift.period_px:g} px"
        if sampled is None:
            residuals += [FrameResidual(i, np.nan, np.nan, np.nan) for i in shift.indices]
            remarks.append(f"{what}: too few pixels see fringes to judge its frames")
            continue
        if len(shift.indices) == 3:
            remarks.append(f"{what}: three steps fit any three frames, so that only a repeated one can be told")
        suspects += detect_misordered_steps(sampled) or detect_foreign_frames(sampled)
        gain = frames.light.light.gain[list(shift.indices)]
        residuals += _measure_residuals(sampled, _estimate_relative_light(sampled) * gain, frames.factor)
    suspects += describe_gamma(estimate_aliased_harmonics(layout, stack, white, noise), layout)
    if layout.gray and not suspects:
        suspects += _detect_code_faults(frames, axis)
    return FrameResiduals(axis, tuple(residuals), tuple(_deduplicate(suspects)), "; ".join(remarks))


def _detect_code_faults(frames: _Frames, axis: Axis) -> list[Suspect]:
    """What contradicts the order of the frames that are no phase steps; of all frames, if they are late by as many."""
    out = []
    for c in frames.contradictions:
        if c.cause in _CODE_FAULTS and c.axis in (axis, None) and c.value is not None:
            is_common = c.cause == "frame-lag" and c.axis is None
            frame = 0 if is_common else int(c.value)
            if is_common or frames.sequence.frames[frame].kind != "phase":
                out.append(Suspect(frame, _CODE_FAULTS[c.cause], c.message))
    return out


def _measure_residuals(sampled: Fringe, gain: np.ndarray, factor: float) -> list[FrameResidual]:
    """The residual of each frame of one period."""
    n = sampled.steps
    if n == 3:
        return [FrameResidual(i, np.nan, np.nan, np.nan) for i in sampled.shift.indices]
    differences = sampled.frames - sampled.fitted
    a, b = sampled.noise
    expected = np.maximum((a + b * sampled.fitted.mean(axis=0)) * (1 - 3 / n), 1e-6)
    rms, sigmas = (np.sqrt(np.mean(square, axis=1)) for square in (differences**2, differences**2 / expected))
    return [
        FrameResidual(i, float(rms[k]) / factor, float(sigmas[k]), float(gain[k]))
        for k, i in enumerate(sampled.shift.indices)
    ]


def _estimate_relative_light(sampled: Fringe) -> np.ndarray:
    """(n,) relative light of each frame, 1 in the middle; NaN where it cannot be told from a fringe.

    To first order a frame of light 1 + e leaves e times itself, less the part that the fit of the cosine takes up.
    """
    n = sampled.steps
    if n == 3 or not sampled.turns:
        return np.full(n, np.nan)
    predicted, keep = sampled.fitted, sampled.keep
    residuals = keep.astype(np.float32) @ sampled.frames
    normal = keep * (predicted @ predicted.T)
    moment = np.einsum("kp,kp->k", predicted, residuals)
    excess = np.linalg.pinv(normal.astype(float), rcond=1e-3) @ moment.astype(float)
    return 1 + excess - np.median(excess)


def _deduplicate(suspects: list[Suspect]) -> list[Suspect]:
    """Of the findings about the order of a frame the first, and all about light; in the order of the frames."""
    first_by_frame: dict[tuple[int, str], Suspect] = {}
    for suspect in suspects:
        first_by_frame.setdefault((suspect.frame, suspect.fault if suspect.fault in LIGHT_FAULTS else ""), suspect)
    return [first_by_frame[key] for key in sorted(first_by_frame)]
