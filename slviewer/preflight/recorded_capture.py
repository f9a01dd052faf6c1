"""The checks of a rig on the frames of one recorded capture."""

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import structs

from slviewer.errors import InputError
from slviewer.examination.light import look_at
from slviewer.examination.limits import LEAST_LIT
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.response import (
    gamma_from_harmonic,
    measure_nonlinearity,
    measure_second_harmonic,
    predict_phase_error,
)
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.pipeline.capture_phases import (
    NEAR_DARK,
    axis_figures,
    check_capture,
    decode_frames,
    least_modulation,
)
from slviewer.pipeline.examination import (
    Check,
    CheckName,
    CheckVerdict,
    Preflight,
    check_capture_exposure,
    examine_frames,
    name_frames,
)
from slviewer.pipeline.operation import Progress, part
from slviewer.preflight.light import MAX_NONLINEARITY
from slviewer.preflight.order import (
    MISPLACING_CAUSES,
    check_repeats,
    format_sentence,
    judge_order,
    rate_findings,
)
from slviewer.records.verdict import LIGHT_CAUSES, Cause, Examination
from slviewer.session.capture import Capture

_CAUSES_ELSEWHERE = (*MISPLACING_CAUSES, *LIGHT_CAUSES)
_STEADINESS: dict[CheckName, tuple[tuple[Cause, ...], str, str]] = {
    "flicker": (
        ("exposure-drift", "flicker"),
        "No frame is brighter or darker than the others.",
        "Lock the camera's exposure, gain and white balance; make the exposure a multiple of 10 ms"
        " (8.33 ms where the mains have 60 Hz).",
    ),
    "ambient": (
        ("room-light",),
        "The light of the room did not change between the frames.",
        "Keep lamps, doors and daylight as they are while capturing.",
    ),
}
"""By check: the causes that it reports, the sentence without them, and the remedy."""
_FEW, _TOO_FEW = 0.75, 0.25
"""Shares of the illuminated pixels that must decode: below the first a warning, below the other
most is lost."""


def preflight_capture(capture: Capture, progress: Progress) -> Preflight:
    """Check the rig of a capture from its frames, with the messages of `check_rig.preflight`; of
    two cameras as `Preflight.join`."""
    if capture.second is None:
        return _check_frames(capture, progress)
    first = _check_frames(capture, part(progress, 0.0, 0.5))
    return first.join(_check_frames(capture.second, part(progress, 0.5, 1.0)))


def _check_frames(capture: Capture, progress: Progress) -> Preflight:
    """Check the frames of one camera."""
    began = time.monotonic()
    progress(0.0, "reading frames")
    frames, sequence = capture.stack(), capture.sequence
    progress(0.2, "comparing the frames")
    look = look_at(sequence, frames)
    examination = examine_frames(sequence, frames, capture.files, look)
    progress(0.6, "decoding")
    phases = refusal = None
    try:
        phases = decode_frames("", sequence, frames, look.light)
        check_capture("", sequence, frames, phases, examination)
    except InputError as error:
        refusal = error.with_traceback(None)  # which holds the frames
    checks = [
        _check_description(examination, refusal),
        judge_order(sequence, examination),
        *_check_steadiness(examination),
    ]
    if phases is not None:
        repeats = check_repeats(sequence, frames)
        named = name_frames(repeats.observation, sequence, capture.files)
        checks += [
            structs.replace(repeats, observation=named),
            check_capture_exposure(sequence, frames, phases),
            _check_response(sequence, frames, examination),
            _check_noise(sequence, frames, phases),
            _check_decoded(phases),
        ]
    progress(1.0, "checked")
    return Preflight(tuple(checks), seconds=time.monotonic() - began)


def _check_description(examination: Examination, refusal: InputError | None) -> Check:
    """Check that the frames agree with the description of their patterns, and contradict each other
    in nothing that another check reports; ``refusal``: by which they were refused."""
    others = [f for f in examination.findings if f.cause not in _CAUSES_ELSEWHERE]
    if found := examination.rejected or (() if refusal else tuple(others)):
        observation = _join_findings([f.observation for f in found])
        remedy = _join_findings([f.remedy for f in found])
        return Check("description", rate_findings(found), observation, remedy)
    if refusal:
        observation = format_sentence(refusal.located_observation)
        return Check("description", "bad", observation, format_sentence(refusal.remedy))
    return Check("description", "good", "The frames agree with the description of the patterns.")


def _check_steadiness(examination: Examination) -> Iterator[Check]:
    """Yield the checks that the light is constant over the frames: of projector and camera, and of
    the room."""
    figures = {"rms_from_frame_to_frame": round(examination.light_rms, 5)}
    for name, (causes, good, remedy) in _STEADINESS.items():
        known = figures if name == "flicker" else {}
        if found := _list_observations(examination, *causes):
            yield Check(name, "warning", _join_findings(found[:3]), remedy, known)
        else:
            yield Check(name, "good", good, "", known)


def _check_response(
    sequence: PatternSequence, frames: np.ndarray, examination: Examination
) -> Check:
    """Check the linearity of the projector's response by the second harmonic of the fringes."""
    remedy = "Straighten the projector's response, or use more steps."
    harmonics = {axis: measure_second_harmonic(sequence, frames, axis) for axis in sequence.axes}
    known = {axis: value for axis, value in harmonics.items() if np.isfinite(value)}
    if found := _list_observations(examination, "gamma"):
        return Check("gamma", "warning", _join_findings(found), remedy)
    if not known:
        why = "fewer than five phase steps, or too few pixels that see fringes"
        return Check("gamma", "unknown", f"The response cannot be measured: {why}.")
    axis = max(known, key=lambda each: abs(known[each]))
    gamma, steps = gamma_from_harmonic(known[axis]), axis_layout(sequence, axis).steps
    shown = np.linspace(0, 255, 18)
    response = (shown / 255) ** gamma
    curved = measure_nonlinearity(shown, response)
    error = predict_phase_error(shown, response, steps)
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
        if not phase.mask.any():
            continue
        medians = axis_figures(phase)
        names = ("noise_levels", "median_modulation", "median_sigma_px")
        noise, modulation, sigma = (medians[name] for name in names)
        weak |= modulation < NEAR_DARK * least_modulation(sequence, frames, phase)
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
        return Check("noise", "unknown", "The noise cannot be judged: no pixel is valid.")
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
    if least < LEAST_LIT or worst < _TOO_FEW:
        verdict = "bad"
    remedy = (
        ""
        if verdict == "good"
        else "See the picture that `slviewer decode` writes: it shows where, and why."
    )
    return Check("decoding", verdict, _join_findings(lines), remedy, figures)


def _list_observations(examination: Examination, *causes: Cause) -> list[str]:
    """List the observations of the findings of these causes."""
    return [f.observation for f in examination.findings if f.cause in causes]


def _join_findings(findings: Sequence[str]) -> str:
    """Join findings, each once, to a sentence."""
    return format_sentence("; ".join(dict.fromkeys(findings)))
