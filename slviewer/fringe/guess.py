"""Guess of the description of a capture from its images alone, with the evidence and the open
questions."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.agreement_tests import MAX_CELL, SURE, is_proven, wrap
from slviewer.fringe.axis_agreement import Agreement, fit_turns, measure_agreement
from slviewer.fringe.axis_reader import AxisFrames, AxisReader, described_frames
from slviewer.fringe.description_change import LINES, step_turns
from slviewer.fringe.description_check import LEAST_ILLUMINATED, check_description
from slviewer.fringe.frame_blocks import (
    Bit,
    BlockReader,
    Doubt,
    FrameBlocks,
    GrayBlock,
    PhaseRun,
    group_frames,
)
from slviewer.fringe.line_sample import LineSample, coded_frames, sample_frames
from slviewer.fringe.sequence import (
    Axis,
    Frame,
    Indices,
    PatternSequence,
    PerAxis,
    Size,
    select_axis_value,
)

ASSUMED_PX = 16.0
"""px of the finest period where nothing states it: a scale, and no measurement."""
DIAGONAL = (0.67, 1.5)
"""Slopes of stripes within 11 degrees of a diagonal, which determine no axis."""
WHOLE = 0.02
"""Tolerance of a measured ratio that should be a whole number: its uncertainty over some ten
fringes is less."""
SAME_PERIOD = 0.05
TURN = 2 * np.pi
WINDOW = 24
"""Camera px over which two phases are compared."""
FINEST_PX = 2.0


@dataclass(frozen=True)
class Guess:
    """Guessed description of a capture.

    ``sequence``: the frames in the order of the images, None where some image is not identified.
    ``frames``: content of each image, None where it is not identified. ``evidence``: (first image,
    text). ``doubts``: (images, text); empty where the description is certain up to ``notes``:
    assumptions that the images cannot confirm.
    """

    sequence: PatternSequence | None
    frames: tuple[Frame | None, ...]
    evidence: tuple[tuple[int, str], ...]
    doubts: tuple[Doubt, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Findings:
    """Evidence, doubts and notes of a `Guess`, as they are collected."""

    doubts: list[Doubt]
    evidence: list[tuple[int, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def guess(self, sequence: PatternSequence | None, frames: Sequence[Frame | None]) -> Guess:
        """Return the guess with these findings."""
        return Guess(
            sequence, tuple(frames), tuple(self.evidence), tuple(self.doubts), tuple(self.notes)
        )


@dataclass(frozen=True, eq=False)
class _AxisBlocks:
    """Runs of phase steps, longest period first, and the Gray code of one axis."""

    runs: list[PhaseRun]
    code: GrayBlock | None


def guess_sequence(stack: np.ndarray, projector: Size | None = None) -> Guess:
    """Guess the frames that the images of an (n, h, w) uint8 or uint16 stack show, in the order of
    the capture.

    ``projector``: (width, height) px where it is known. Periods in projector px follow from the
    images only where Gray code numbers the projector's pixels; else only their ratios do, and the
    finest period is set to 16 px. Raises InputError for an array that is not a stack.
    """
    if stack.ndim != 3 or len(stack) < 3:
        raise InputError(
            f"a stack of shape {stack.shape} is not a capture: give three or more images of one"
            " size"
        )
    sample = sample_frames(stack, list(range(len(stack))))
    reader = BlockReader(sample)
    everything = tuple(range(len(stack)))
    frames: list[Frame | None] = [None] * len(stack)
    share = float(reader.illuminated.mean())
    if share < LEAST_ILLUMINATED or reader.count < 500:
        text = (
            f"{100 * share:.1f} % of the pixels vary from image to image by more than the noise:"
            " too dark to be read"
        )
        return _Findings([(everything, text)]).guess(None, frames)
    blocks = group_frames(reader)
    findings = _Findings(list(blocks.doubts))
    axes = _assign_axes(blocks, findings.doubts)
    if not axes and not findings.doubts:
        findings.doubts.append((everything, "no image shows phase steps or stripes of a code"))
    _identify_frames(reader, blocks, axes, frames, findings)
    if findings.doubts:
        return findings.guess(None, frames)
    try:
        sequence = PatternSequence(None, tuple(frame for frame in frames if frame is not None))
    except InputError as error:
        findings.doubts.append((everything, str(error)))
        return findings.guess(None, frames)
    for axis in sequence.axes:
        sequence = _apply_conventions(sequence, axis, axes[axis], sample, reader, findings)
    if not findings.doubts:
        findings.doubts.extend(
            (everything, found.message) for found in check_description(sequence, stack)
        )
    if not findings.doubts:
        for axis in sequence.axes:
            sequence = _scale_to_projector(sequence, axis, sample, projector, findings)
        sequence = replace(sequence, projector_size=projector)
    findings.evidence.sort()
    return findings.guess(sequence, sequence.frames)


def _assign_axes(blocks: FrameBlocks, doubts: list[Doubt]) -> dict[Axis, _AxisBlocks]:
    """Assign the blocks to axes by the direction of their stripes: x for stripes that are rather
    upright in the camera.

    Adds to ``doubts`` stripes that are nearly diagonal, equal periods, and several codes of one
    axis.
    """
    runs: dict[Axis, list[PhaseRun]] = {"x": [], "y": []}
    codes: dict[Axis, list[GrayBlock]] = {"x": [], "y": []}
    every: list[PhaseRun | GrayBlock] = [*blocks.runs, *blocks.codes]
    for block in every:
        x, y = map(abs, block.gradient if isinstance(block, PhaseRun) else block.direction)
        axis: Axis = "x" if x >= y else "y"
        if DIAGONAL[0] < y / max(x, 1e-12) < DIAGONAL[1]:
            slope = np.degrees(np.arctan2(y, x))
            doubts.append(
                (
                    block.images,
                    f"their stripes are tilted by {slope:.0f} degrees: along x or y is open",
                )
            )
        if isinstance(block, PhaseRun):
            runs[axis].append(block)
        else:
            codes[axis].append(block)
    out: dict[Axis, _AxisBlocks] = {}
    for axis in ("x", "y"):
        ordered = sorted(runs[axis], key=_compute_fringe_frequency)
        for a, b in pairwise(ordered):
            if _compute_fringe_frequency(b) < (1 + SAME_PERIOD) * _compute_fringe_frequency(a):
                doubts.append(
                    (
                        a.images + b.images,
                        f"two runs of phase steps of axis {axis} have the same period",
                    )
                )
        if len(codes[axis]) > 1:
            images = tuple(image for code in codes[axis] for image in code.images)
            doubts.append(
                (
                    images,
                    f"{len(codes[axis])} blocks of stripes along {axis}, which should be one code",
                )
            )
        if ordered or codes[axis]:
            out[axis] = _AxisBlocks(ordered, codes[axis][0] if codes[axis] else None)
    return out


def _compute_fringe_frequency(run: PhaseRun) -> float:
    """Return the phase gradient of a run, rad per camera px."""
    return float(np.hypot(*run.gradient))


def _identify_frames(
    reader: BlockReader,
    blocks: FrameBlocks,
    axes: dict[Axis, _AxisBlocks],
    frames: list[Frame | None],
    findings: _Findings,
) -> None:
    """Set in ``frames`` what each image shows, with the evidence, and a doubt about images that are
    not identified."""
    kinds = set(blocks.even.values())
    for image, kind in blocks.even.items():
        frames[image] = Frame("texture" if kinds == {"white"} else kind)
        findings.evidence.append((image, f"evenly {'bright' if kind == 'white' else 'dark'}"))
    for axis, parts in axes.items():
        ratios = [_measure_period_ratio(reader, parts.runs[-1], run) for run in parts.runs]
        _add_frames(axis, parts, ratios, frames, findings.evidence)
    open_images = tuple(i for i, frame in enumerate(frames) if frame is None)
    if open_images and not any(set(open_images) & set(images) for images, _ in findings.doubts):
        findings.doubts.append((open_images, "what they show cannot be told"))


def _measure_period_ratio(reader: BlockReader, finest: PhaseRun, run: PhaseRun) -> float:
    """Return the ratio of a run's period to the finest, from the change of their phases over the
    same pixels."""
    if run is finest:
        return 1.0
    fine, coarse = (reader.phasor(each.images) for each in (finest, run))
    angle = [
        np.concatenate([[0.0], np.cumsum(np.angle(p[1:] * np.conj(p[:-1])))])
        for p in (fine, coarse)
    ]
    gaps = np.concatenate([[0], np.cumsum(~reader.adjacent)])
    whole = gaps[WINDOW:] == gaps[:-WINDOW]
    steps = [(a[WINDOW:] - a[:-WINDOW])[whole] for a in angle]
    weight = np.abs(steps[0])
    # Weighed by the phase passed, and the median against jumps at the borders of things.
    slope = steps[1] / np.where(weight > 1e-6, steps[0], np.inf)
    middle = float(np.quantile(slope, 0.5, weights=weight, method="inverted_cdf"))
    return _refine_period_ratio(fine, coarse, 1 / max(middle, 1e-6))


def _refine_period_ratio(fine: np.ndarray, coarse: np.ndarray, rough: float) -> float:
    """Refine the ratio ``rough`` of two periods: at the result the coarse phase predicts the fine
    one best.

    ``fine``, ``coarse`` (p,): phasors. The coarse phase is cut where no pixel has it; without such
    a phase ``rough`` is returned.
    """
    cut = _detect_empty_phase(coarse)
    if cut is None:
        return rough
    angle = (np.angle(coarse) - cut) % TURN
    span = float(np.quantile(angle, 0.99) - np.quantile(angle, 0.01)) / TURN
    reach = min(0.04, 0.4 / (rough * max(span, 0.05)) + 0.01)
    return fit_turns(np.angle(fine), angle, rough * np.linspace(1 - reach, 1 + reach, 401))


def _detect_empty_phase(phasor: np.ndarray) -> float | None:
    """Return a phase (rad) that hardly any pixel has; None where all of the period is in view."""
    counts, ends = np.histogram(np.angle(phasor), bins=36, range=(-np.pi, np.pi))
    return None if counts.min() > 0.2 * counts.mean() else float(ends[int(np.argmin(counts))])


def _add_frames(
    axis: Axis,
    parts: _AxisBlocks,
    ratios: Sequence[float],
    frames: list[Frame | None],
    evidence: list[tuple[int, str]],
) -> None:
    """Add the frames of one axis to ``frames`` and ``evidence``.

    The finest period is ASSUMED_PX; no bit is marked as complementary yet. ``ratios``: of the
    periods to the finest.
    """
    for run, ratio in zip(parts.runs, ratios, strict=True):
        n = len(run.images)
        period = float(f"{ASSUMED_PX * ratio:.5g}")
        for step, image in enumerate(run.images):
            frames[image] = Frame("phase", axis, step=step, steps=n, period_px=period)
        text = f"{n} steps equidistant over one period, " + (
            f"{100 * run.misfit:.1f} % of the amplitude off a cosine"
            if n > 3
            else "with one mean level in all pixels"
        )
        if len(parts.runs) > 1:
            text += f"; period {ratio:.4g} times the finest"
        evidence.append((run.images[0], f"{text}; stripes vary along {axis}"))
    if parts.code is None:
        return
    bits = len(parts.code.bits)
    for number, bit in enumerate(parts.code.bits):
        frames[bit.image] = Frame("gray", axis, bit=number, bits=bits)
        if bit.inverse is not None:
            frames[bit.inverse] = Frame("inverse", axis, bit=number, bits=bits)
        share = f"{bit.edges['xy'.index(axis)]:.3g} edges per camera px"
        observation = (
            f"even in all of the view: bit {number} by its place"
            if bit.even
            else f"stripes, {share}"
        )
        if not bit.is_readable:
            observation = f"too fine to be read: bit {number} by its place alone"
        evidence.append(
            (bit.image, observation + (", and its inverse" if bit.inverse is not None else ""))
        )


def _apply_conventions(
    sequence: PatternSequence,
    axis: Axis,
    parts: _AxisBlocks,
    sample: LineSample,
    blocks_reader: BlockReader,
    findings: _Findings,
) -> PatternSequence:
    """Return the sequence with the conventions of one axis that follow from its code and fringes.

    These are the complementary bit, the width of the Gray cells, and sign and offset of the phase.
    """
    if parts.code is None:
        return _check_fringes(sequence, axis, parts.runs, blocks_reader, findings)
    images = tuple(coded_frames(sequence, axis))
    reader = AxisReader(sample, list(images))
    if not parts.runs:
        findings.notes.append(
            f"axis {axis}: Gray code alone, taken to number the projector's {LINES[axis]} one"
            " by one"
        )
    elif not np.isfinite(_measure(sequence, axis, reader)[1].turns_per_cell):
        text = (
            f"too few edges of the code of axis {axis} are in view to compare it with the fringes"
        )
        findings.doubts.append((images, text))
        return sequence
    else:
        sequence = _fit_gray_cells(sequence, axis, parts.code.bits[-1], reader, findings)
        sequence = _fit_phase(sequence, axis, parts.runs[-1], reader, findings)
    _check_code(images, axis, *_measure(sequence, axis, reader), findings)
    if parts.runs and parts.runs[-1].gradient["xy".index(axis)] * sequence.sign(axis) < 0:
        text = _describe_reversal(axis, "the code falls", "or a most significant bit is missing")
        findings.doubts.append((images, text))
    return sequence


def _measure(
    sequence: PatternSequence, axis: Axis, reader: AxisReader
) -> tuple[AxisFrames, Agreement]:
    """Return the frames of an axis as the sequence describes them, and their agreement."""
    frames = described_frames(sequence, axis)
    return frames, measure_agreement(reader, frames)


def _check_fringes(
    sequence: PatternSequence,
    axis: Axis,
    runs: list[PhaseRun],
    reader: BlockReader,
    findings: _Findings,
) -> PatternSequence:
    """Return the sequence of fringes without a code, marked as relative where they have one
    period."""
    if runs[-1].gradient["xy".index(axis)] < 0:
        text = _describe_reversal(axis, "the phase falls", "or phase_sign is -1")
        findings.doubts.append((tuple(coded_frames(sequence, axis)), text))
    if len(runs) == 1:
        findings.notes.append(
            f"axis {axis}: one period without Gray code gives a phase that is not absolute"
        )
        return replace(sequence, relative=True)
    if _detect_empty_phase(reader.phasor(runs[0].images)) is None:
        text = f"axis {axis}: its longest period repeats in the view: state period_px"
        findings.doubts.append((runs[0].images, text))
    return sequence


def _fit_gray_cells(
    sequence: PatternSequence, axis: Axis, last: Bit, reader: AxisReader, findings: _Findings
) -> PatternSequence:
    """Return the sequence with the ``last`` bit as the complementary one, or with the measured
    width of the cells."""
    frames, a = _measure(sequence, axis, reader)
    # ``turns`` of the finest-like period that described_frames compares, per cell of all bits
    turns = a.turns_per_cell
    assert frames.fringe is not None
    if abs(2 * turns - 1) < MAX_CELL / 2 + WHOLE:
        if last.inverse is None:
            sequence = _mark_complementary(sequence, axis, last.image)
            text = f"its edges lie half way: {turns:.2f} fringes per cell of all bits"
            findings.evidence.append((last.image, text))
        return sequence
    cell = frames.fringe[0] * (
        round(turns) if turns > 0.9 and abs(turns - round(turns)) < MAX_CELL else turns
    )
    if abs(cell - sequence.gray_cell(axis)) > 0.01 * cell:
        sequence = replace(
            sequence, gray_cell_px=_replace_axis(sequence.gray_cell_px, axis, float(f"{cell:.4g}"))
        )
    findings.evidence.append((last.image, f"{turns:.3g} fringes per Gray cell"))
    return sequence


def _fit_phase(
    sequence: PatternSequence, axis: Axis, finest: PhaseRun, reader: AxisReader, findings: _Findings
) -> PatternSequence:
    """Return the sequence with the sign and the offset of the phase that follow from the Gray
    code."""
    if _measure(sequence, axis, reader)[1].rising < 0.5:
        sequence = replace(sequence, phase_sign=_replace_axis(sequence.phase_sign, axis, -1))
        findings.evidence.append((finest.images[0], "the phase falls where the code rises"))
    frames, a = _measure(sequence, axis, reader)
    late = wrap(a.begin_turns)
    if abs(late) > 0.1 and frames.fringe is not None:
        snapped = min(step_turns(len(frames.fringe[1])), key=lambda turns: abs(wrap(late - turns)))
        turns = snapped if abs(wrap(late - snapped)) < 0.06 else late
        offset = float(f"{TURN * turns:.4g}")
        sequence = replace(
            sequence, phase_offset_rad=_replace_axis(sequence.phase_offset_rad, axis, offset)
        )
        findings.notes.append(
            f"axis {axis}: the phase is {offset:g} rad where the Gray code begins; written as"
            " phase_offset, it may as well be gray_origin"
        )
    return sequence


def _scale_to_projector(
    sequence: PatternSequence,
    axis: Axis,
    sample: LineSample,
    projector: Size | None,
    findings: _Findings,
) -> PatternSequence:
    """Return the sequence with the periods of one axis scaled to projector px.

    The codes in view must be inside the projector, and all codes, or the longest period, must cover
    it.
    """
    periods, bits = sequence.periods_px(axis), len(sequence.find("gray", axis))
    images = tuple(sequence.find("phase", axis) or sequence.find("gray", axis))
    if projector is None:
        if periods:
            findings.notes.append(
                f"axis {axis}: the width of its fringes in projector px is unknown, only ratios are"
                f" measured; the finest is written as {periods[-1]:g} px: correct period_px, and"
                " add the projector's size"
            )
        return sequence
    extent = projector["xy".index(axis)]
    reach = _measure(sequence, axis, AxisReader(sample, coded_frames(sequence, axis)))[1].reach_px
    covered = sequence.gray_cell(axis) * 2**bits if bits else periods[0]
    if not periods:
        if covered < extent or reach > extent + 1:
            text = (
                f"{bits} bits number {covered:g} {LINES[axis]}, of which {reach:.0f} are in view,"
                f" not {extent}"
            )
            findings.doubts.append((images, f"{text}: correct projector, or add gray_cell_px"))
        return sequence
    low, high = extent / covered * periods[-1], extent / max(reach, 1.0) * periods[-1]
    finest = low
    if high >= 1.01 * low:
        finest = max(float(np.clip(periods[-1], low, high)), FINEST_PX)
        text = (
            f"the finest period lies between {low:.2f} and {high:.2f} px, as far as the view shows:"
            " state it"
        )
        findings.doubts.append((images, text))
    scale = finest / periods[-1]
    scaled = tuple(
        (
            replace(f, period_px=float(f"{f.period_px * scale:.5g}"))
            if f.kind == "phase" and f.axis == axis
            else f
        )
        for f in sequence.frames
    )
    cells = sequence.gray_cell_px
    if (cell := select_axis_value(cells, axis)) is not None:
        cells = _replace_axis(cells, axis, float(f"{cell * scale:.4g}"))
    return replace(sequence, frames=scaled, gray_cell_px=cells)


def _check_code(
    images: Indices, axis: Axis, frames: AxisFrames, a: Agreement, findings: _Findings
) -> None:
    """Add a doubt where the Gray code and the fringes of an axis do not agree."""
    if not is_proven(frames, a):
        shares = (
            f"{100 * a.rule:.0f} % of the edges obey the Gray code"
            if np.isfinite(a.rule)
            else "no edges are read"
        )
        if np.isfinite(a.common):
            shares += f", {100 * a.common:.0f} % of them fall at one phase"
        findings.doubts.append(
            (images, f"axis {axis}: {shares}, of {100 * SURE:.0f} % that would be sure")
        )


def _mark_complementary(sequence: PatternSequence, axis: Axis, image: int) -> PatternSequence:
    """Return the sequence with one Gray image as the complementary bit."""
    frames = []
    for index, frame in enumerate(sequence.frames):
        if index == image:
            frame = Frame("complementary", axis)
        elif frame.kind == "gray" and frame.axis == axis:
            frame = replace(frame, bits=frame.bits - 1)
        frames.append(frame)
    return replace(sequence, frames=tuple(frames))


def _describe_reversal(axis: Axis, observation: str, other: str) -> str:
    """Return the text of the doubt that an axis is reversed, by a device turned by 180 degrees or
    by ``other``."""
    side = "to the right" if axis == "x" else "downwards"
    return (
        f"axis {axis}: {observation} {side} in the camera: camera or projector is turned by half a"
        f" turn, {other}"
    )


def _replace_axis(values: object, axis: Axis, value: float) -> PerAxis:  # type: ignore[type-arg]
    """Return a pair of values with that of one axis replaced."""
    both = values if isinstance(values, PerAxis) else PerAxis(values, values)
    return both._replace(**{axis: value})
