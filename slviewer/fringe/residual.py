"""Whether the frames of a capture fit together: what each leaves unexplained, and which of them stand out.

Phase-shifted frames are one cosine per pixel, so that more than three of them say too much, and contradict each other
when one was late, lost or repeated. Frames of unequal light are compared as they would be under equal light. What the
projector's gamma adds is common to all frames, and is not held against one of them; where it shifts the phase of three
or four steps, it is reported. Frames of a Gray code contradict
each other too: see `description_check`.
"""

from dataclasses import dataclass, replace

import numpy as np

from slviewer.fringe.aliased_harmonics import describe_gamma, estimate_aliased_harmonics
from slviewer.fringe.description_check import find_contradictions
from slviewer.fringe.frame_light import CLIPPED, FrameLight, detect_light_faults, equalize_frames, estimate_frame_light
from slviewer.fringe.layout import Layout, axis_layout, check_stack, white_level
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.residual_order import detect_foreign_frames, detect_misordered_steps
from slviewer.fringe.residual_sample import Fringe, fringe
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

    About 100,000 pixels of evenly spread rows are looked at. Gamma raises `sigmas` of all frames alike; a suspect is
    only who contradicts the others.
    """
    check_stack(sequence, stack)
    layout = axis_layout(sequence, axis)
    light = estimate_frame_light(sequence, stack)
    white, factor = white_level(stack, sequence.select(axis)), 1.0
    if not light.is_significant:
        return _compare(sequence, layout, stack, white, light, factor)
    if light.drift < SMALL_DRIFT and light.wave < SMALL_DRIFT:
        # A frame out of its place is a simpler explanation than many frames each in a light of its own.
        as_seen = _compare(sequence, layout, stack, white, light, factor)
        if any(suspect.fault in ORDER_FAULTS for suspect in as_seen.suspects):
            return as_seen
    stack, factor = equalize_frames(stack, light, sequence)
    compared = _compare(sequence, layout, stack, CLIPPED, light, factor)
    if any(suspect.fault != "gamma" for suspect in compared.suspects):
        return compared  # a frame out of its place spoils what is known of the light, too
    return replace(compared, suspects=tuple(_deduplicate([*detect_light_faults(sequence, light), *compared.suspects])))


def _compare(
    sequence: PatternSequence, layout: Layout, stack: np.ndarray, white: float, light: FrameLight, factor: float
) -> FrameResiduals:
    """The residuals of one axis, from frames whose grey levels were multiplied by ``factor``."""
    axis = layout.axis
    noise = measure_noise(layout, stack, white)
    residuals: list[FrameResidual] = []
    suspects: list[Suspect] = []
    said: list[str] = []
    for shift in layout.shifts:
        sampled = fringe(stack, shift, noise, white)
        what = f"axis {axis}, period {shift.period_px:g} px"
        if sampled is None:
            residuals += [FrameResidual(i, np.nan, np.nan, np.nan) for i in shift.indices]
            said.append(f"{what}: too few pixels see fringes to judge its frames")
            continue
        if len(shift.indices) == 3:
            said.append(f"{what}: three steps fit any three frames, so that only a repeated one can be told")
        suspects += detect_misordered_steps(sampled) or detect_foreign_frames(sampled)
        residuals += _residuals(sampled, _light(sampled) * light.light.gain[list(shift.indices)], factor)
    suspects += describe_gamma(estimate_aliased_harmonics(layout, stack, white, noise), layout)
    if layout.gray and not suspects:
        suspects += _detect_code_faults(sequence, stack, axis)
    return FrameResiduals(axis, tuple(residuals), tuple(_deduplicate(suspects)), "; ".join(said))


def _detect_code_faults(sequence: PatternSequence, stack: np.ndarray, axis: Axis) -> list[Suspect]:
    """What contradicts the order of the frames that are no phase steps; of all frames, if they are late by as many."""
    out = []
    for c in find_contradictions(sequence, stack, with_steps=False):
        if c.cause in _CODE_FAULTS and c.axis in (axis, None) and c.value is not None:
            is_common = c.cause == "frame-lag" and c.axis is None
            frame = 0 if is_common else int(c.value)
            if is_common or sequence.frames[frame].kind != "phase":
                out.append(Suspect(frame, _CODE_FAULTS[c.cause], c.message))
    return out


def _residuals(sampled: Fringe, gain: np.ndarray, factor: float) -> list[FrameResidual]:
    n = sampled.steps
    if n == 3:
        return [FrameResidual(i, np.nan, np.nan, np.nan) for i in sampled.shift.indices]
    left = sampled.frames - sampled.fitted
    a, b = sampled.noise
    expected = np.maximum((a + b * sampled.fitted.mean(axis=0)) * (1 - 3 / n), 1e-6)
    rms, sigmas = (np.sqrt(np.mean(square, axis=1)) for square in (left**2, left**2 / expected))
    return [
        FrameResidual(i, float(rms[k]) / factor, float(sigmas[k]), float(gain[k]))
        for k, i in enumerate(sampled.shift.indices)
    ]


def _light(sampled: Fringe) -> np.ndarray:
    """(n,) relative light of each frame, 1 in the middle; NaN where it cannot be told from a fringe.

    To first order a frame of light 1 + e leaves e times itself, less the part that the fit of the cosine takes up.
    """
    n = sampled.steps
    if n == 3 or not sampled.turns:
        return np.full(n, np.nan)
    predicted, keep = sampled.fitted, sampled.keep
    left = keep.astype(np.float32) @ sampled.frames
    normal = keep * (predicted @ predicted.T)
    moment = np.einsum("kp,kp->k", predicted, left)
    excess = np.linalg.pinv(normal.astype(float), rcond=1e-3) @ moment.astype(float)
    return 1 + excess - np.median(excess)


def _deduplicate(suspects: list[Suspect]) -> list[Suspect]:
    """Of the findings about the order of a frame the first, and all about light; in the order of the frames."""
    kept: dict[tuple[int, str], Suspect] = {}
    for suspect in suspects:
        kept.setdefault((suspect.frame, suspect.fault if suspect.fault in LIGHT_FAULTS else ""), suspect)
    return [kept[key] for key in sorted(kept)]
