"""The checks of a rig on the frames of one recorded capture."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from slviewer.calibration.diagnosis.frames import gamma_from_harmonic, measure_second_harmonic
from slviewer.errors import InputError
from slviewer.fringe.layout import axis_layout, white_level
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.reference import dark_limit, dark_sigmas
from slviewer.fringe.residual import FrameResiduals
from slviewer.fringe.response import measure_nonlinearity, predict_phase_error
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.pipeline.capture_phases import NEAR_DARK, check_capture, decode_frames
from slviewer.pipeline.check_results import Check, CheckVerdict, Preflight
from slviewer.pipeline.exposure_check import check_capture_exposure
from slviewer.pipeline.feedback import Progress, ignore_progress
from slviewer.pipeline.frame_check import FrameCheck, check_frames, name_frames
from slviewer.preflight.light import MAX_NONLINEARITY
from slviewer.preflight.order import check_repeats
from slviewer.session.capture import Capture

_LIGHT_FAULTS = ("light", "flicker", "exposure-drift")
_ROOM_FAULTS = ("room-light",)
_RESPONSE_FAULTS = ("gamma",)
_FEW, _TOO_FEW = 0.75, 0.25
"""Shares of the illuminated pixels that must decode: below the first a warning, below the other
most is lost."""
_LEAST_ILLUMINATED = 0.005
"""Share of the image that must carry a pattern: half a percent is a board in a corner of the
image."""


def preflight_capture(capture: Capture, progress: Progress = ignore_progress) -> Preflight:
    """Check the rig of a capture from its frames, with the messages of `check_rig.preflight`."""
    began = time.monotonic()
    progress(0.0, "reading frames")
    frames, sequence = capture.stack(), capture.sequence
    progress(0.2, "decoding")
    try:
        phases = decode_frames(capture.name, sequence, frames)
    except InputError as error:
        failed = Check(
            "description",
            "bad",
            f"The frames cannot be decoded: {error}.",
            "Correct the description.",
            {},
        )
        return Preflight((failed,), None, None, None, time.monotonic() - began)
    progress(0.5, "comparing the frames")
    check = check_frames(sequence, frames, capture.files)
    fits, repeats = check.axes, check_repeats(sequence, frames)
    checks = (
        _check_description(capture.name, sequence, frames, phases, check),
        _check_order(sequence, fits),
        replace(repeats, sentence=name_frames(repeats.sentence, sequence, capture.files)),
        check_capture_exposure(sequence, frames, phases),
        _check_light(fits),
        _check_ambient_light(fits),
        _check_response(sequence, frames, fits),
        _check_noise(sequence, frames, phases),
        _check_decoded(phases),
    )
    progress(1.0, "checked")
    return Preflight(checks, None, None, None, time.monotonic() - began)


def _check_description(
    name: str,
    sequence: PatternSequence,
    frames: np.ndarray,
    phases: Mapping[Axis, PhaseMap],
    check: FrameCheck,
) -> Check:
    """Check that the frames (n, h, w) agree with the description of their patterns."""
    try:
        check_capture(name, sequence, frames, phases, check)
    except InputError as error:
        text = str(error).removeprefix(f"{name}: ")
        return Check(
            "description",
            "bad",
            f"{text}.",
            "Correct the description of the capture, then import again.",
            {},
        )
    return Check(
        "description", "good", "The frames agree with the description of the patterns.", "", {}
    )


def _check_order(sequence: PatternSequence, fits: Sequence[FrameResiduals]) -> Check:
    """Check that every frame shows the pattern of its place in the sequence."""
    others = _LIGHT_FAULTS + _ROOM_FAULTS + _RESPONSE_FAULTS
    suspects = [s for fit in fits for s in fit.suspects if s.fault not in others]
    n = len(sequence.frames)
    figures = {"frames": n, "misplaced_frames": sorted({s.frame + 1 for s in suspects})}
    if suspects:
        findings = "; ".join(dict.fromkeys(s.sentence for s in suspects[:3]))
        remedy = (
            "Capture again with a longer delay between showing and grabbing, or put the files in"
            " order."
        )
        return Check("order", "bad", f"Of {n} frames, {findings}.", remedy, figures)
    unknown = "; ".join(fit.message for fit in fits if fit.message)
    if unknown:
        return Check(
            "order",
            "unknown",
            f"The order of some frames cannot be checked: {unknown}.",
            "",
            figures,
        )
    return Check("order", "good", f"All {n} frames are in order.", "", figures)


def _check_light(fits: Sequence[FrameResiduals]) -> Check:
    """Check that the projector's light and the exposure are constant over the frames."""
    known = np.array([f.light for fit in fits for f in fit.frames if np.isfinite(f.light)])
    spread = float(np.sqrt(np.mean((known - 1) ** 2))) if known.size else None
    figures = {"rms_from_frame_to_frame": None if spread is None else round(spread, 5)}
    suspects = _list_suspects(fits, _LIGHT_FAULTS)
    if suspects:
        remedy = (
            "Lock the camera's exposure, gain and white balance; make the exposure a multiple of 10"
            " ms (8.33 ms where the mains have 60 Hz)."
        )
        return Check("flicker", "warning", _join_findings(suspects[:3]), remedy, figures)
    if spread is None:
        return Check(
            "flicker", "good", "No frame is brighter or darker than the others.", "", figures
        )
    return Check(
        "flicker",
        "good",
        f"The light is steady to {100 * spread:.2f} % from frame to frame.",
        "",
        figures,
    )


def _check_ambient_light(fits: Sequence[FrameResiduals]) -> Check:
    """Check that the ambient light is constant over the frames."""
    suspects = _list_suspects(fits, _ROOM_FAULTS)
    if suspects:
        remedy = "Keep lamps, doors and daylight as they are while capturing."
        return Check("ambient", "warning", _join_findings(suspects), remedy, {})
    return Check(
        "ambient", "good", "The light of the room did not change between the frames.", "", {}
    )


def _check_response(
    sequence: PatternSequence, frames: np.ndarray, fits: Sequence[FrameResiduals]
) -> Check:
    """Check the linearity of the projector's response by the second harmonic of the fringes."""
    remedy = "Straighten the projector's response, or use more steps."
    suspects = _list_suspects(fits, _RESPONSE_FAULTS)
    harmonics = {axis: measure_second_harmonic(sequence, frames, axis) for axis in sequence.axes}
    known = {axis: value for axis, value in harmonics.items() if np.isfinite(value)}
    if suspects:
        return Check("gamma", "warning", _join_findings(suspects), remedy, {})
    if not known:
        why = "fewer than five phase steps, or too few pixels that see fringes"
        return Check("gamma", "unknown", f"The response cannot be measured: {why}.", "", {})
    axis = max(known, key=lambda each: abs(known[each]))
    gamma, steps = gamma_from_harmonic(known[axis]), axis_layout(sequence, axis).steps
    shown = np.linspace(0, 255, 18)
    response = (shown / 255) ** gamma
    curved, error = (
        measure_nonlinearity(shown, response),
        predict_phase_error(shown, response, steps),
    )
    figures = {
        "second_harmonic": {a: round(h, 4) for a, h in known.items()},
        "gamma": round(gamma, 3),
    }
    findings = (
        f"a second harmonic of {100 * known[axis]:.1f} % of the fringe, as of a gamma of"
        f" {gamma:.2f}"
    )
    if curved <= MAX_NONLINEARITY:
        return Check("gamma", "good", f"The response is straight: {findings}.", "", figures)
    sentence = (
        f"The response is curved: {findings}; an error of {error:.4f} rad with {steps} steps."
    )
    return Check("gamma", "warning", sentence, remedy, figures)


def _check_noise(
    sequence: PatternSequence, frames: np.ndarray, phases: Mapping[Axis, PhaseMap]
) -> Check:
    """The check of median noise and modulation, grey levels, and coordinate sigma, px, by axis."""
    figures: dict[str, Any] = {}
    lines, weak = [], False
    for axis, phase in phases.items():
        valid = phase.mask
        if not valid.any():
            continue
        background, modulation = (
            float(np.median(values[valid])) for values in (phase.background, phase.modulation)
        )
        noise = float(np.sqrt(phase.noise[0] + phase.noise[1] * background))
        sigma = float(np.median(phase.sigma_phase[valid])) * phase.period_px / (2 * np.pi)
        white = white_level(sequence, frames, sequence.select(axis))
        least = dark_limit(
            np.array([background], np.float32),
            phase.noise,
            white,
            dark_sigmas(axis_layout(sequence, axis)),
        )
        weak |= modulation < NEAR_DARK * float(least[0])
        figures[axis] = {
            "noise_levels": round(noise, 3),
            "median_modulation_levels": round(modulation, 2),
            "median_sigma_px": round(sigma, 5),
        }
        lines.append(
            f"axis {axis}: noise {noise:.2f} of {modulation:.1f} grey levels of modulation,"
            f" {sigma:.3f} px"
        )
    if not lines:
        return Check("noise", "unknown", "The noise cannot be judged: no pixel is valid.", "", {})
    sentence = _join_findings(lines)
    if weak:
        remedy = (
            "Make the patterns brighter: longer exposure, wider aperture, darker room, or a nearer"
            " projector."
        )
        return Check(
            "noise", "warning", f"{sentence[:-1]}: near the least that is decoded.", remedy, figures
        )
    return Check("noise", "good", sentence, "", figures)


def _check_decoded(phases: Mapping[Axis, PhaseMap]) -> Check:
    """The check of the share of illuminated pixels that were decoded, by axis."""
    figures: dict[str, Any] = {}
    lines, worst, least = [], 1.0, 1.0
    for axis, phase in phases.items():
        illuminated = float(phase.illuminated.mean())
        counts = {reason: float(np.mean(phase.reason == reason)) for reason in Reason}
        share = counts[Reason.VALID] / illuminated if illuminated else 0.0
        worst, least = min(worst, share), min(least, illuminated)
        figures[axis] = {
            "illuminated_share": round(illuminated, 4),
            "decoded_share": round(share, 4),
        } | {f"{reason.name.lower()}_share": round(value, 4) for reason, value in counts.items()}
        lines.append(
            f"axis {axis}: {100 * share:.1f} % of the illuminated {100 * illuminated:.1f} % of the"
            " image decode"
        )
    verdict: CheckVerdict = "warning" if worst < _FEW else "good"
    if least < _LEAST_ILLUMINATED or worst < _TOO_FEW:
        verdict = "bad"
    remedy = (
        ""
        if verdict == "good"
        else "See the picture that `slviewer decode` writes: it shows where, and why."
    )
    return Check("decoding", verdict, _join_findings(lines), remedy, figures)


def _list_suspects(fits: Sequence[FrameResiduals], faults: Sequence[str]) -> list[str]:
    """List the sentences of the suspects of these faults."""
    return [suspect.sentence for fit in fits for suspect in fit.suspects if suspect.fault in faults]


def _join_findings(findings: Sequence[str]) -> str:
    """Join findings, each once, to a sentence."""
    text = "; ".join(dict.fromkeys(findings))
    return f"{text[0].upper()}{text[1:]}."
