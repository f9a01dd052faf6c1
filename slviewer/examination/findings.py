"""Findings in words: for each cause what was observed, and what to do."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from math import ceil, floor
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.examination import limits
from slviewer.examination.evaluate import Evaluator, Hypothesis, Images, described
from slviewer.examination.hypotheses import change_conventions, change_period
from slviewer.examination.sample import CaptureSample
from slviewer.fringe.aliased_harmonics import AliasedHarmonics
from slviewer.fringe.frame_light import FrameLight, Term, list_shifts
from slviewer.fringe.layout import Layout, axis_layout
from slviewer.fringe.levels import layout_levels
from slviewer.fringe.origin import LATEST_TURNS
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry.vectors import rms
from slviewer.records.verdict import Cause, Finding, Severity

LINES = {"x": "columns", "y": "rows"}
REMEDIES: dict[Cause, str] = {
    "missing-frame": "add the image, or capture again",
    "duplicate-frame": "look at this image, and capture again",
    "frame-order": "exchange these two files, or capture again",
    "axes-swapped": "exchange the x and y (V and H) frames in the description",
    "projector-size": "give the size of the projector that was used, or correct the periods",
    "room-light": "keep the light of the room constant, or switch it off",
    "flicker": (
        "make the exposure time a multiple of 10 ms (8.33 ms where the mains have 60 Hz) and of the"
        " projector's frame, and switch off the lamps of the room"
    ),
    "exposure-drift": "lock the camera's exposure, gain and white balance",
    "gamma": ("make the responses of projector and camera linear, or use 5 phase steps or more"),
    "ghosting": (
        "the projector changes its image slowly, or the camera exposes during the change; wait"
        " longer after each pattern"
    ),
    "dark": (
        "raise the exposure or the projector's brightness, and check that the projector showed the"
        " patterns"
    ),
    "moved": "hold scene, camera and projector still, and capture again",
    "blur": "leave out these bits, or focus the camera and the projector",
    "unreadable": (
        "check that all frames belong to one capture, that nothing moved, and the periods, steps"
        " and bits of the description"
    ),
    "saturation": "lower the exposure or the gain, and capture again",
}
"""What to do, where it does not depend on values."""


AND, OFFSETS, JOINT = " and phase_offset = ", 48, 0.5
"""Between two values of a remedy; offsets of the phase that are tried with another width of cells;
and by how much more these must explain."""
_Change = tuple[str, Mapping[str, PatternSequence]]
"""A remedy with {} for its value, and the description that follows from each value."""


def _find(cause: Cause, observation: str, severity: Severity = "rejected", **place: Any) -> Finding:
    """Return the finding of a cause whose remedy depends on no value; ``place``: its frames, axis
    and value."""
    return Finding(cause, severity, observation, REMEDIES[cause], **place)


def describe_hypothesis(hypothesis: Hypothesis, evaluator: Evaluator, base: Hypothesis) -> Finding:
    """Return the finding that a hypothesis stands for; ``base``: the capture as described."""
    cause, axis = hypothesis.cause, hypothesis.axis
    assert cause is not None
    if axis is None:
        text, remedy = _describe_order(hypothesis, cause)
    else:
        text, changes = _describe_convention(hypothesis, base.sequence, axis)
        tried = (_try_changes(evaluator, hypothesis, axis, *change) for change in changes)
        remedy = ", or ".join(filter(None, tried)) or REMEDIES["unreadable"]
    value = None if hypothesis.value is None else float(hypothesis.value)
    return Finding(cause, "rejected", text, remedy, (), hypothesis.frames, axis, value)


def _try_changes(
    evaluator: Evaluator,
    hypothesis: Hypothesis,
    axis: Axis,
    text: str,
    sequences: Mapping[str, PatternSequence],
) -> str:
    """Return the remedy ``text`` with the value, of those of the ``sequences`` that make the
    capture decode, that explains the images best; empty where none explains them as well as the
    hypothesis."""
    misfits = {}
    for value, sequence in sequences.items():
        if contradict(sequence, axis):
            continue
        if (m := evaluator.match(described(sequence), axis)) is not None:
            misfits[value] = float(m.misfit.mean())
    own = evaluator.match(hypothesis, axis)
    if own is None or not misfits:
        return ""
    best = min(misfits, key=lambda value: misfits[value] * (1 + JOINT * (AND in value)))
    is_as_good = misfits[best] <= limits.AS_LITTLE * float(own.misfit.mean()) + limits.SMALL_LOSS
    return text.format(best) if is_as_good else ""


def contradict(sequence: PatternSequence, axis: Axis) -> InputError | None:
    """Return the error by which the periods and codes of an axis contradict each other or the
    projector's size; None where they do not. Plain binary numbers beside fringes are read as Gray
    code."""
    try:
        layout = axis_layout(replace(sequence, binary=False), axis)
        if layout.shifts and not layout.numbers_periods:
            layout_levels(layout)
    except InputError as error:
        return error
    return None


def _describe_lag(hypothesis: Hypothesis) -> tuple[str, str]:
    """Return observation and remedy of a lag of all images, or from a frame on."""
    value = hypothesis.value or 1
    if hypothesis.frames:
        number = hypothesis.frames[0] + 1
        return (
            f"from frame {number} on the camera is one image behind the projector: image {number}"
            " repeats the one before",
            "let the camera wait longer after each pattern, and capture again",
        )
    count = "one image" if abs(value) == 1 else f"{abs(value):g} images"
    if value > 0:
        return (
            f"all frames are {count} late, so that each shows the pattern before its own",
            "let the camera wait longer after each pattern, or switch its buffering off, where it"
            " hands out old images (the preflight shows which); capture again, or move the files"
            f" by {count}",
        )
    return (
        f"all frames are {count} early, so that each shows the pattern after its own, and the first"
        " is missing",
        f"let the camera begin with the first pattern; capture again, or move the files by {count}",
    )


def _describe_file_order(images: Images) -> tuple[str, str]:
    """Return observation and remedy of images that come backwards, or some of which belong behind
    the last."""
    first = next(k for k, image in enumerate(images) if image != k)
    last = images[first] or 0
    moved = (
        f"image {first + 1} belongs"
        if last == first + 1
        else f"images {first + 1} to {last} belong"
    )
    backwards = images[0] == len(images) - 1 and images[1] == len(images) - 2
    return (
        "the images come in the opposite order" if backwards else f"{moved} behind the last one",
        "name the files in the order of the patterns, or list them in the description",
    )


def _describe_exchange(sequence: PatternSequence, frames: Sequence[int]) -> tuple[str, str]:
    """Return observation and remedy of two frames that have changed places."""
    text = f"frames {frames[0] + 1} and {frames[1] + 1} have changed places"
    remedy, axis = REMEDIES["frame-order"], sequence.frames[frames[0]].axis
    if axis and {*(_find_reversing_pair(sequence, axis) or ())} == {*frames}:
        remedy += f", or set phase_sign = {-sequence.sign(axis)} for axis {axis}"
    return text, remedy


def _describe_order(hypothesis: Hypothesis, cause: Cause) -> tuple[str, str]:
    """Return observation and remedy of an order of the images."""
    frames, value = hypothesis.frames, hypothesis.value
    numbers = [i + 1 for i in frames]
    if cause == "frame-lag":
        return _describe_lag(hypothesis)
    if cause == "missing-frame":
        text = f"frame {numbers[0]} is missing, and those that follow come one place too early"
    elif cause == "axes-swapped":
        kinds = hypothesis.sequence.frames
        is_phase = kinds[hypothesis.changed[0]].kind == "phase"
        kind = "phase steps" if is_phase else "Gray bits"
        text = f"the {kind} of axis x show those of axis y, and the other way round"
    elif cause == "step-order":
        steps = [
            ", ".join(str(hypothesis.images[i]) for i in indices)
            for axis in hypothesis.sequence.axes
            for _, indices in hypothesis.sequence.phase_shifts(axis)[-1:]
        ]
        return (
            "the phase steps do not come in the described order",
            f"number the frames so that the steps follow each other: {' and '.join(steps)}",
        )
    elif hypothesis.is_of_files:
        return _describe_file_order(hypothesis.images)
    elif len(numbers) == 2:
        return _describe_exchange(hypothesis.sequence, frames)
    elif value is not None:
        late = "late or repeated" if value < frames[0] else "too early"
        text = f"frame {numbers[0]} shows the pattern of frame {int(value) + 1}: it is {late}"
        return text, "put the frames in order, or capture again"
    else:
        text = f"frame {numbers[0]} does not show the pattern described for it"
    return text, REMEDIES[cause]


def _describe_convention(
    hypothesis: Hypothesis, base: PatternSequence, axis: Axis
) -> tuple[str, list[_Change]]:
    """Return observation and possible remedies of a convention of one axis."""
    sequence, value = hypothesis.sequence, hypothesis.value or 0.0
    offset = sequence.offset_rad(axis)
    turns = (offset - base.offset_rad(axis)) / (2 * np.pi)
    cause = hypothesis.cause
    if cause == "phase-offset":
        text = "set phase_offset = {} (rad; of a PatternSequence: phase_offset_rad)"
        changes = [_change(text, base, axis, "phase_offset_rad", f"{offset:.3f}")]
        if base.find("gray", axis):
            period = base.periods_px(axis)[-1]
            begin = base.origin_px(axis) / period + turns
            origin = (begin - np.ceil(begin - LATEST_TURNS)) * period
            text = "set gray_origin = {} (px; gray_origin_px) if the phase is right"
            changes.append(_change(text, base, axis, "gray_origin_px", f"{origin:.2f}"))
        return (
            f"the phase steps of axis {axis} begin {describe_turns(turns)} than described",
            changes,
        )
    if cause == "step-order":
        also = f" and phase_offset = {offset:.3f}" if abs(turns) > 1e-6 else ""
        order = ", or number the steps backwards" if also else ""
        if (pair := _find_reversing_pair(base, axis)) and not also:
            order = f", or exchange images {pair[0] + 1} and {pair[1] + 1}"
        text = f"set phase_sign = {sequence.sign(axis)}{also} for axis {axis}{order}"
        return (
            f"the fringes of axis {axis} shift in the opposite direction to the description",
            [(text, {"": sequence})],
        )
    if cause == "bit-order":
        return _describe_bits(sequence, base, axis)
    if cause == "gray-cell":
        period = base.period_px(axis)
        widths = [f"{cell / period:.3g}" for cell in (value, base.gray_cell(axis))]
        return (
            f"a cell of the Gray code of axis {axis} is {widths[0]} times as wide as a fringe, and"
            f" {widths[1]} times by the description",
            [_change_cell("set gray_cell_px = {}", base, axis, value)],
        )
    if cause == "gray-origin":
        text = "set gray_origin = {} (px; of a PatternSequence: gray_origin_px)"
        return (
            f"the Gray code of axis {axis} begins elsewhere than described",
            [_change(text, base, axis, "gray_origin_px", f"{value:.2f}")],
        )
    return _describe_period(sequence, base, axis, value)


def _find_reversing_pair(sequence: PatternSequence, axis: Axis) -> tuple[int, int] | None:
    """Return the frames of the one phase shift of an axis, of three or four steps, whose exchange
    is the other sign of the phase; None where there is none."""
    shifts = sequence.phase_shifts(axis)
    if len(shifts) != 1 or len(shifts[0][1]) > 4:
        return None
    _, second, *_, last = shifts[0][1]
    return second, last


def _describe_period(
    sequence: PatternSequence, base: PatternSequence, axis: Axis, value: float
) -> tuple[str, list[_Change]]:
    """Return observation and possible remedies of a period of ``value`` px."""
    kept = sequence.periods_px(axis)
    described_px = next(px for px in base.periods_px(axis) if px not in kept)
    near = {text: float(text) for text in _list_near(value)}
    if base.projector_size:  # mostly a whole number of fringes
        extent = base.extent(axis)
        count = max(1, round(extent / value))
        if abs(np.log(extent / count / value)) < limits.WHOLE:
            near = {f'"{extent}/{count}"': extent / count}
    periods = dict[str, PatternSequence]()
    for text, period in near.items():
        with suppress(InputError):  # it is another of the periods
            periods[text] = change_period(base, axis, described_px, period)
    changes: list[_Change] = [("set period_px = {}", periods)]
    if base.find("gray", axis):
        cell = base.gray_cell(axis) * described_px / value
        text = "set gray_cell_px = {} if the period is right"
        changes.append(_change_cell(text, base, axis, cell))
    which = "finest fringe period" if described_px == base.periods_px(axis)[-1] else "fringe period"
    return (
        f"the {which} of axis {axis} is {value:.3g} px, and the description says"
        f" {described_px:.3g}",
        changes,
    )


def _describe_bits(
    sequence: PatternSequence, base: PatternSequence, axis: Axis
) -> tuple[str, list[_Change]]:
    """Return observation and remedy of bits of another code, inverted, or in another order."""
    if sequence.binary != base.binary:
        codes = [("Gray code", "gray"), ("plain binary numbers", "binary")]
        (is_shown, code), (is_described, _) = codes[sequence.binary], codes[base.binary]
        remedy = f'describe the images in a TOML with code = "{code}", and `slviewer import frames`'
        observation = f"the bits of axis {axis} are {is_shown}, not {is_described}"
        return observation, [(remedy, {"": sequence})]
    bits = "bits" if base.binary else "Gray bits"
    if sequence.find("gray", axis) != base.find("gray", axis):
        return (
            f"the {bits} of axis {axis} and their inverses have changed places",
            [("exchange gray and inverse frames in the description", {"": sequence})],
        )
    order = ", ".join(str(sequence.frames[i].bit) for i in base.bits("gray", axis))
    return (
        f"the {bits} of axis {axis} do not have the described order",
        [(f"number them {order} (0 is the most significant)", {"": sequence})],
    )


def _change_cell(text: str, sequence: PatternSequence, axis: Axis, cell_px: float) -> _Change:
    """Return the change of the Gray cells of a sequence to widths near one that was measured; also
    to whole ones of phase steps that begin elsewhere, which imitate another width."""
    text, tried = _change(text, sequence, axis, "gray_cell_px", *_list_near(cell_px))
    joint = dict(tried)
    widths = {f(px) for px in (cell_px, sequence.gray_cell(axis)) for f in (floor, ceil)}
    for width in sorted(widths - {0}) if sequence.periods_px(axis) else ():
        for k in range(1, OFFSETS):
            offset = sequence.offset_rad(axis) + 2 * np.pi * wrap(k / OFFSETS)
            values = {"gray_cell_px": float(width), "phase_offset_rad": round(offset, 3)}
            key = f"{width}{AND}{offset:.3f}"
            joint[key] = change_conventions(sequence, axis, **values)
    return text, joint


def _list_near(value: float) -> list[str]:
    """Return a width in px as it was measured, and whole and half ones beside it, as text."""
    return list(dict.fromkeys((f"{round(value):g}", f"{round(2 * value) / 2:g}", f"{value:.4g}")))


def _change(text: str, sequence: PatternSequence, axis: Axis, name: str, *values: str) -> _Change:
    """Return the change of one entry of a sequence to each of the values, which are in place of {}
    in the text."""
    return text, {v: change_conventions(sequence, axis, **{name: float(v)}) for v in values}


def wrap(turns: float) -> float:
    """Wrap a number of periods to the range -0.5 ... 0.5."""
    return float((turns + 0.5) % 1 - 0.5)


def describe_turns(turns: float) -> str:
    """Return a share of a period with its direction as text: "a quarter period later"."""
    turns = wrap(turns)
    share = {0.25: "a quarter period", 0.5: "half a period"}.get(round(abs(turns) * 20) / 20)
    return f"{share or f'{abs(turns):.2f} periods'} {'later' if turns > 0 else 'earlier'}"


def describe_mirroring(sequence: PatternSequence, jacobian: np.ndarray) -> Iterator[Finding]:
    """Yield the finding of axes that are exchanged or reversed, by the change (2, 2) of the
    projector's coordinates with the camera's; nothing where they are not mirrored.

    Camera and projector both see the scene from the front, so that neither sees a mirror image:
    which of them is mirrored, the coordinates do not show.
    """
    if np.linalg.det(jacobian) > 0:
        return
    seen = "the projector's coordinates are a mirror image of what the camera sees"
    if (axis := reversed_axis(jacobian)) is None:
        text = f"{seen}, as if x and y were exchanged"
        remedy = mirroring_remedy(REMEDIES["axes-swapped"])
        yield Finding("axes-swapped", "rejected", text, remedy)
        return
    text = f"{seen}, as if axis {axis} were reversed"
    remedy = "switch off the projector's mirror or rear mode"
    if not sequence.find("gray", axis):
        remedy += f", or set phase_sign = {-sequence.sign(axis)} for axis {axis}"
    yield Finding("axis-reversed", "rejected", text, mirroring_remedy(remedy), axis=axis)


def reversed_axis(jacobian: np.ndarray) -> Axis | None:
    """Return the axis that is reversed in mirrored coordinates, by their change (2, 2) with the
    camera's; None where x and y are exchanged."""
    if np.abs(np.diag(jacobian[::-1])).sum() > np.abs(np.diag(jacobian)).sum():
        return None
    return "x" if jacobian[0, 0] < 0 else "y"


def mirroring_remedy(of_projector: str) -> str:
    """Return the remedy where camera or projector is mirrored, with that for the projector."""
    return (
        "look at some text in the camera's image. Where it is mirrored, switch off the camera's"
        f" mirror (selfie) or flip mode; where it is readable, {of_projector}. A board with a mark"
        " or a ChArUco board decides it as well"
    )


def describe_reach(
    axis: Axis, extent: int, coordinate: np.ndarray, share: float, others: Iterable[str]
) -> Finding:
    """Return the finding of coordinates (p,) px of which a ``share`` lies beyond the projector;
    ``others``: remedies beside the usual one."""
    reach = float(np.quantile(coordinate, 0.995))
    text = (
        f"{100 * share:.0f} % of the {axis} codes lie outside the projector's {extent}"
        f" {LINES[axis]} and reach {reach:.0f}"
    )
    remedy = ", or ".join((REMEDIES["projector-size"], *others))
    return Finding("projector-size", "rejected", text, remedy, axis=axis, value=reach)


def describe_apart_periods(sequence: PatternSequence, axis: Axis, grown: float) -> Finding:
    """Return the finding of coordinates by several periods whose distance grows over the projector,
    to ``grown`` of the shorter one."""
    periods = " and ".join(f"{px:.4g}" for px in sequence.periods_px(axis))
    return Finding(
        "fringe-period",
        "rejected",
        f"the coordinates along {axis} by the periods {periods} px drift apart over the projector,"
        f" to {grown:.2g} fringes: one of the periods is another",
        "correct period_px",
        axis=axis,
    )


def describe_missing_pattern(sample: CaptureSample) -> Finding:
    """Return the finding of a capture of which too few pixels show patterns."""
    is_mostly = limits.LEAST_LIT <= sample.lit < 2 * sample.saturated
    if sample.saturated > limits.MOSTLY or is_mostly:
        text = (
            f"{100 * sample.saturated:.0f} % of the pixels are saturated in a tenth of the frames"
            " or more, so that too few carry a readable pattern"
        )
        return _find("saturation", text)
    text = (
        f"{100 * sample.lit:.1f} % of the pixels carry a readable pattern, and the median pixel"
        f" changes by {sample.swing:.1f} grey levels over the frames"
    )
    return _find("dark", text)


def describe_unreadable(axis: Axis, is_weak: bool) -> Finding:
    """Return the finding of an axis whose frames fit no pattern; ``is_weak``: for noise."""
    if is_weak:
        text = f"the {axis} patterns are hardly stronger than the noise of the images"
        return _find("dark", text, axis=axis)
    text = (
        f"the frames of axis {axis} fit neither their description, nor another order, numbering or"
        " size"
    )
    return _find("unreadable", text, axis=axis)


def describe_unresolved(sequence: PatternSequence, frames: Sequence[int]) -> Finding:
    """Return the finding of Gray bits, by their frames, whose stripes the camera does not
    resolve."""
    bits = sorted({(str(f.axis), f.bit) for f in (sequence.frames[i] for i in frames)})
    names = ", ".join(f"{bit} of {axis}" for axis, bit in bits)
    text = f"the camera does not resolve the stripes of Gray bit {names}"
    return _find("blur", text, "doubtful", frames=tuple(frames))


def describe_motion(sequence: PatternSequence, axis: Axis, displacement: float) -> Finding:
    """Return the finding of a scene, or a rig, that moved during the phase steps of an axis;
    ``displacement`` px of the projector."""
    period = sequence.period_px(axis)
    is_much = abs(displacement) > limits.MUCH_MOTION * period
    text = (
        f"something moved: from the first to the last image the pattern of axis {axis} shifted"
        f" by {abs(displacement):.1f} px of the projector"
    )
    severity: Severity = "rejected" if is_much else "doubtful"
    return _find("moved", text, severity, axis=axis, value=displacement)


def describe_ghost(share: float) -> Finding:
    """Return the finding of images that hold a share of the one before."""
    text = f"the images hold {100 * share:.0f} % of the image before them (ghosting)"
    return _find("ghosting", text, "doubtful")


def describe_light(sequence: PatternSequence, light: FrameLight) -> Iterator[Finding]:
    """Yield a finding for each variation of the light that the operator should correct, of gains
    and room light the larger one first: a tone curve makes a lamp change the gains too."""
    used = sequence.patterns
    gain = light.gain[used]
    span = float(gain.max() / gain.min()) - 1
    wave = rms(light.wave)
    # of stripes motion is measured only where a bit and its inverse differ
    moving = "" if list_shifts(sequence) else ", or a scene that comes nearer or moves away"
    if "wave" in light.terms and wave > limits.REPORTED / 3:
        text = (
            f"the light varies from image row to image row by {100 * np.sqrt(2) * wave:.0f} %, in"
            f" {light.cycles:.1f} waves per image (mains flicker under a rolling shutter),"
            " which is corrected"
        )
        yield _find("flicker", text, "doubtful", frames=(used[0],))
    found = list[tuple[float, Finding]]()
    if "gain" in light.terms and span > limits.REPORTED:
        text = (
            f"the brightness varies by {100 * span:.1f} % among frames of a kind (automatic"
            f" exposure, or an unsteady lamp{moving}), which is corrected"
        )
        frame = used[int(np.argmax(np.abs(np.log(gain))))]
        size = rms(np.log(gain))
        found.append((size, _find("exposure-drift", text, "doubtful", frames=(frame,))))
    for k in light.changes if "room" in light.terms else ():
        change = float(light.room[k] - light.room[k - 1])
        text = (
            f"the light of the room changed: from frame {k + 1} on the scene is"
            f" {100 * abs(change):.0f} % {'brighter' if change > 0 else 'darker'}"
        )
        if steps := light.count_open_steps(sequence, k):
            text += f"; between {steps} phase steps this cannot be corrected reliably"
        else:
            text += ", which is corrected"
        found.append((abs(change) / 2, _find("room-light", text, "doubtful", frames=(k,))))
    yield from (each for _, each in sorted(found, key=lambda sized: -sized[0]))


def describe_disturbance(terms: Sequence[Term]) -> Finding:
    """Return the finding of light that varies by more than can be corrected; ``terms``: how."""
    if "wave" in terms:
        cause: Cause = "flicker"
        text = "the light varies from image row to image row and between the frames"
    elif "room" in terms:
        cause, text = "room-light", "the light of the room changes between the frames"
    else:
        cause, text = "exposure-drift", "the brightness varies from frame to frame"
    return _find(cause, f"{text} by more than can be corrected")


def describe_gamma(
    harmonics: AliasedHarmonics, layout: Layout, finest_px: float
) -> Iterator[Finding]:
    """Yield the finding of a significant ripple of the phase by the projector's response; a note
    where the finest period, which alone shifts the coordinates, has more steps."""
    if not harmonics.is_significant:
        return
    per_rad = layout.period_px / (2 * np.pi)
    theta = np.linspace(0, 2 * np.pi, 361)
    largest = float(np.abs(harmonics.correction(theta)).max()) * per_rad
    outcome = (
        "corrected"
        if harmonics.is_corrected
        else "it could not be measured well enough to correct it"
    )
    outcome += f", and {harmonics.error_rad * per_rad:.2g} px was added to the uncertainty"
    severity: Severity = "doubtful"
    if layout.period_px > finest_px:
        outcome, severity = "the finest period has more steps, and is shifted less", "note"
    text = (
        f"the projector response is nonlinear (gamma): with {harmonics.steps} phase steps this"
        f" shifts the coordinates of axis {layout.axis} by up to {largest:.2g} px ({outcome})"
    )
    frames = layout.shifts[-1].indices[:1]
    yield _find("gamma", text, severity, frames=frames, axis=layout.axis)
