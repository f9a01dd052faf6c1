"""Consistency of the frames of a capture: the residual of each frame, and the frames that stand
out.

Phase-shifted frames are one cosine per pixel, so that more than three of them are redundant, and
contradict each other when one was late, lost or repeated. Frames of unequal light are compared as
they would be under equal light. The harmonics that the projector's gamma adds are common to all
frames, and are not counted against one of them; where they shift the phase of three or four steps,
this is reported. Frames of a Gray code contradict each other too: see `description_check`.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.aliased_harmonics import describe_gamma, estimate_aliased_harmonics
from slviewer.fringe.contradiction import Contradiction
from slviewer.fringe.description_check import FrameReadings, find_contradictions
from slviewer.fringe.frame_light import (
    CLIPPED,
    FrameLight,
    detect_light_faults,
    equalize_frames,
    estimate_frame_light,
)
from slviewer.fringe.layout import Layout, axis_layout, white_level
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.residual_order import detect_foreign_frames, detect_misordered_steps
from slviewer.fringe.residual_sample import Fringe, sample_fringe
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.fringe.suspect import LIGHT_FAULTS, ORDER_FAULTS, Fault, Suspect

SMALL_DRIFT = 0.05
"""rms variation of the light up to which a misplaced frame is detected without correcting the light
first."""
_CODE_FAULTS: dict[str, Fault] = {
    "frame-lag": "lag", "frame-order": "swapped", "missing-frame": "dropped",
    "duplicate-frame": "late"
}  # fmt: skip


@dataclass(frozen=True)
class FrameResidual:
    """Residual of one frame from the cosine fitted through all frames of its period.

    ``rms``: grey levels, over the valid pixels that were sampled; ``sigmas``: the same as a
    multiple of the expected noise, 1 for a frame that fits. Both NaN where there are no more than
    three steps, or no valid pixels. ``light``: relative light of this frame, 1 like the others';
    NaN where it cannot be measured.
    """

    frame: int
    rms: float
    sigmas: float
    light: float


@dataclass(frozen=True)
class FrameResiduals:
    """Residual of each phase-shifted frame of one axis, and the frames of that axis that stand out.

    ``message``: text that reports which frames could not be judged, empty otherwise.
    """

    axis: Axis
    frames: tuple[FrameResidual, ...]
    suspects: tuple[Suspect, ...]
    message: str = ""


def frame_residuals(sequence: PatternSequence, stack: np.ndarray, axis: Axis) -> FrameResiduals:
    """Measure how well the (n, h, w) frames of one axis fit each other. Raises InputError like
    `decode`.

    About 60,000 pixels of evenly spread rows are sampled. Gamma raises `sigmas` of all frames
    alike; only a frame that contradicts the others is a suspect.
    """
    light = estimate_frame_light(sequence, stack)
    return _measure_axis_residuals(_Frames(FrameReadings(sequence, stack), light), axis)


def capture_residuals(
    sequence: PatternSequence, stack: np.ndarray, readings: FrameReadings | None = None
) -> list[FrameResiduals]:
    """Return `frame_residuals` of each axis of a capture (n, h, w); an axis that cannot be decoded
    is skipped.

    ``readings``: of the stack, new ones if None.
    """
    frames = _Frames(
        readings or FrameReadings(sequence, stack), estimate_frame_light(sequence, stack)
    )
    residuals = []
    for axis in sequence.axes:
        with suppress(InputError):  # decoding reports it, with the remedy
            residuals.append(_measure_axis_residuals(frames, axis))
    return residuals


@dataclass(frozen=True, eq=False)
class _Frames:
    """Frames of a capture, their grey levels multiplied by ``factor``, and cached results that all
    axes share."""

    readings: FrameReadings
    light: FrameLight
    factor: float = 1.0

    @property
    def sequence(self) -> PatternSequence:
        """The description of the frames."""
        return self.readings.sequence

    @property
    def stack(self) -> np.ndarray:
        """The frames (n, h, w)."""
        return self.readings.stack

    @cached_property
    def equalized(self) -> "_Frames":
        """The frames scaled to equal light."""
        sequence, stack, factor = equalize_frames(self.sequence, self.stack, self.light)
        return _Frames(FrameReadings(sequence, stack), self.light, factor)

    @cached_property
    def contradictions(self) -> tuple[Contradiction, ...]:
        """Contradictions between the frames and their description, except for those of the phase
        steps."""
        return find_contradictions(self.readings, with_steps=False)

    def white(self, axis: Axis) -> float:
        """Return the grey level at which the frames of an axis are clipped."""
        return (
            CLIPPED
            if self.factor != 1
            else white_level(self.sequence, self.stack, self.sequence.select(axis))
        )


def _measure_axis_residuals(frames: _Frames, axis: Axis) -> FrameResiduals:
    """Compute `frame_residuals` of one axis for frames whose light has been estimated."""
    sequence, light = frames.sequence, frames.light
    layout = axis_layout(sequence, axis)
    if not light.is_significant:
        return _compare_frames(frames, layout)
    if light.drift < SMALL_DRIFT and light.wave < SMALL_DRIFT:
        # One misplaced frame is a simpler explanation than different light in many frames.
        as_seen = _compare_frames(frames, layout)
        if any(suspect.fault in ORDER_FAULTS for suspect in as_seen.suspects):
            return as_seen
    compared = _compare_frames(frames.equalized, layout)
    if any(suspect.fault != "gamma" for suspect in compared.suspects):
        return compared  # a misplaced frame distorts the estimate of the light, too
    return replace(
        compared,
        suspects=tuple(
            _deduplicate_suspects([*detect_light_faults(sequence, light), *compared.suspects])
        ),
    )


def _compare_frames(frames: _Frames, layout: Layout) -> FrameResiduals:
    """Compute the residuals and the suspects of one axis for frames that are taken to be of equal
    light."""
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
            remarks.append(
                f"{what}: three steps fit any three frames, so that only a repeated one can be told"
            )
        suspects += detect_misordered_steps(sampled) or detect_foreign_frames(sampled)
        gain = frames.light.light.gain[list(shift.indices)]
        residuals += _measure_residuals(
            sampled, _estimate_relative_light(sampled) * gain, frames.factor
        )
    suspects += describe_gamma(estimate_aliased_harmonics(layout, stack, white, noise), layout)
    if layout.gray and not suspects:
        suspects += _detect_code_faults(frames, axis)
    return FrameResiduals(
        axis, tuple(residuals), tuple(_deduplicate_suspects(suspects)), "; ".join(remarks)
    )


def _detect_code_faults(frames: _Frames, axis: Axis) -> list[Suspect]:
    """Return a suspect for each contradiction in the order of the frames that are not phase steps.

    Phase steps are included only if all frames are late by the same number of images.
    """
    out = []
    for c in frames.contradictions:
        if c.cause in _CODE_FAULTS and c.axis in (axis, None) and c.value is not None:
            is_common = c.cause == "frame-lag" and c.axis is None
            frame = 0 if is_common else int(c.value)
            if is_common or frames.sequence.frames[frame].kind != "phase":
                out.append(Suspect(frame, _CODE_FAULTS[c.cause], c.message))
    return out


def _measure_residuals(sampled: Fringe, gain: np.ndarray, factor: float) -> list[FrameResidual]:
    """Return the residual of each frame of one period.

    ``gain`` (n,): relative light of each frame; ``factor``: that of `_Frames`, by which the rms is
    divided.
    """
    n = sampled.steps
    if n == 3:
        return [FrameResidual(i, np.nan, np.nan, np.nan) for i in sampled.shift.indices]
    differences = sampled.frames - sampled.fitted
    a, b = sampled.noise
    expected = np.maximum((a + b * sampled.fitted.mean(axis=0)) * (1 - 3 / n), 1e-6)
    rms, sigmas = (
        np.sqrt(np.mean(square, axis=1)) for square in (differences**2, differences**2 / expected)
    )
    return [
        FrameResidual(i, float(rms[k]) / factor, float(sigmas[k]), float(gain[k]))
        for k, i in enumerate(sampled.shift.indices)
    ]


def _estimate_relative_light(sampled: Fringe) -> np.ndarray:
    """Estimate the relative light (n,) of each frame of a period, with median 1.

    NaN where a fringe does not determine it.

    To first order a frame of light 1 + e has a residual of e times itself, less the part that the
    fit of the cosine absorbs.
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


def _deduplicate_suspects(suspects: list[Suspect]) -> list[Suspect]:
    """Return the first suspect about the order of each frame, and all about light, sorted by
    frame."""
    first_by_frame: dict[tuple[int, str], Suspect] = {}
    for suspect in suspects:
        first_by_frame.setdefault(
            (suspect.frame, suspect.fault if suspect.fault in LIGHT_FAULTS else ""), suspect
        )
    return [first_by_frame[key] for key in sorted(first_by_frame)]
