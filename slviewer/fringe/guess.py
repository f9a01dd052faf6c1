"""Guess of the description of a capture from its images alone, with the evidence and the open questions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.agreement_tests import SURE, failed_tests, is_supported, wrap
from slviewer.fringe.axis_agreement import Agreement, measure_agreement
from slviewer.fringe.axis_reader import AxisFrames, AxisReader, described_frames
from slviewer.fringe.description_check import LEAST_ILLUMINATED, check_description
from slviewer.fringe.frame_blocks import BlockReader, FrameBlocks, GrayBlock, PhaseRun, group_frames, sample_undescribed
from slviewer.fringe.line_sample import LineSample, coded_frames
from slviewer.fringe.sequence import Axis, Frame, PatternSequence, PerAxis

ASSUMED_PX = 16.0
"""px of the finest period where nothing states it: a scale, and no measurement."""
DIAGONAL = (0.67, 1.5)
"""Slopes of stripes within 11 degrees of a diagonal, which determine no axis."""
WHOLE = 0.02
"""Tolerance of a measured ratio that should be a whole number: its uncertainty over some ten fringes is less."""
SAME_PERIOD = 0.05
TURN = 2 * np.pi
WINDOW = 24
"""Camera px over which two phases are compared."""
FINEST_PX = 2.0


@dataclass(frozen=True)
class Guess:
    """Guessed description of a capture.

    ``sequence``: the frames in the order of the images, None where some image is not identified. ``frames``: content of
    each image, None where it is not identified. ``evidence``: (first image, text). ``doubts``: (images, text); empty
    where the description is certain up to ``notes``: assumptions that the images cannot confirm.
    """

    sequence: PatternSequence | None
    frames: tuple[Frame | None, ...]
    evidence: tuple[tuple[int, str], ...]
    doubts: tuple[tuple[tuple[int, ...], str], ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _AxisBlocks:
    """Runs of phase steps, longest period first, and the Gray code of one axis."""

    runs: list[PhaseRun]
    code: GrayBlock | None


def guess_sequence(stack: np.ndarray, projector: tuple[int, int] | None = None) -> Guess:
    """Guess the frames that the images of an (n, h, w) uint8 or uint16 stack show, in the order of the capture.

    ``projector``: (width, height) px where it is known. Periods in projector px follow from the images only where Gray
    code numbers the projector's pixels; else only their ratios do, and the finest period is set to 16 px. Raises
    InputError for an array that is no stack.
    """
    if stack.ndim != 3 or len(stack) < 3:
        raise InputError(f"a stack of shape {stack.shape} is no capture: give three or more images of one size")
    sample = sample_undescribed(stack)
    reader = BlockReader(sample)
    nothing: tuple[Frame | None, ...] = (None,) * len(stack)
    share = float(reader.illuminated.mean())
    if share < LEAST_ILLUMINATED or reader.count < 500:
        text = f"{100 * share:.1f} % of the pixels vary from image to image by more than the noise: too dark to be read"
        return Guess(None, nothing, (), ((tuple(range(len(stack))), text),), ())
    blocks = group_frames(reader)
    doubts = list(blocks.doubts)
    axes = _assign_axes(blocks, doubts)
    if not axes and not doubts:
        doubts.append((tuple(range(len(stack))), "no image shows phase steps or stripes of a code"))
    return _propose_sequence(stack, sample, reader, blocks, axes, doubts, projector)


def _assign_axes(blocks: FrameBlocks, doubts: list[tuple[tuple[int, ...], str]]) -> dict[Axis, _AxisBlocks]:
    """Assign the blocks to axes by the direction of their stripes: x for stripes that are rather upright in the camera.

    Adds to ``doubts`` stripes that are nearly diagonal, equal periods, and several codes of one axis.
    """
    runs: dict[Axis, list[PhaseRun]] = {"x": [], "y": []}
    codes: dict[Axis, list[GrayBlock]] = {"x": [], "y": []}
    every: list[PhaseRun | GrayBlock] = [*blocks.runs, *blocks.codes]
    for block in every:
        x, y = map(abs, block.gradient if isinstance(block, PhaseRun) else block.direction)
        axis: Axis = "x" if x >= y else "y"
        if DIAGONAL[0] < y / max(x, 1e-12) < DIAGONAL[1]:
            slope = np.degrees(np.arctan2(y, x))
            doubts.append((block.images, f"their stripes are tilted by {slope:.0f} degrees: along x or y is open"))
        if isinstance(block, PhaseRun):
            runs[axis].append(block)
        else:
            codes[axis].append(block)
    out: dict[Axis, _AxisBlocks] = {}
    for axis in ("x", "y"):
        ordered = sorted(runs[axis], key=_compute_fringe_frequency)
        for a, b in pairwise(ordered):
            if _compute_fringe_frequency(b) < (1 + SAME_PERIOD) * _compute_fringe_frequency(a):
                doubts.append((a.images + b.images, f"two runs of phase steps of axis {axis} have the same period"))
        if len(codes[axis]) > 1:
            images = tuple(image for code in codes[axis] for image in code.images)
            doubts.append((images, f"{len(codes[axis])} blocks of stripes along {axis}, which should be one code"))
        if ordered or codes[axis]:
            out[axis] = _AxisBlocks(ordered, codes[axis][0] if codes[axis] else None)
    return out


def _compute_fringe_frequency(run: PhaseRun) -> float:
    """Return the phase gradient of a run, rad per camera px."""
    return float(np.hypot(*run.gradient))


def _propose_sequence(
    stack: np.ndarray,
    sample: LineSample,
    reader: BlockReader,
    blocks: FrameBlocks,
    axes: dict[Axis, _AxisBlocks],
    doubts: list[tuple[tuple[int, ...], str]],
    projector: tuple[int, int] | None,
) -> Guess:
    """Return the guess for blocks that are assigned to axes, with its evidence, doubts and notes.

    ``sequence`` is None if some image is not identified. ``projector``: (width, height) px, None where it is not known.
    """
    frames: list[Frame | None] = [None] * len(stack)
    evidence: list[tuple[int, str]] = []
    notes: list[str] = []
    kinds = set(blocks.even.values())
    for image, kind in blocks.even.items():
        frames[image] = Frame(kind if kinds == {"white", "black"} else "texture" if kind == "white" else "black")
        evidence.append((image, f"evenly {'bright' if kind == 'white' else 'dark'}"))
    for axis, parts in axes.items():
        ratios = [_measure_period_ratio(reader, parts.runs[-1], run) for run in parts.runs]
        _add_frames(axis, parts, ratios, frames, evidence)
    open_images = tuple(i for i, frame in enumerate(frames) if frame is None)
    if open_images and not any(set(open_images) & set(images) for images, _ in doubts):
        doubts.append((open_images, "what they show cannot be told"))
    if doubts:
        return Guess(None, tuple(frames), tuple(evidence), tuple(doubts), ())
    try:
        sequence = PatternSequence(None, tuple(frame for frame in frames if frame is not None))
    except InputError as error:
        return Guess(None, tuple(frames), tuple(evidence), ((tuple(range(len(frames))), str(error)),), ())
    for axis in sequence.axes:
        sequence = _apply_conventions(sequence, axis, axes[axis], sample, reader, evidence, doubts, notes)
    if not doubts:
        everything = tuple(range(len(frames)))
        doubts += [(everything, contradiction.message) for contradiction in check_description(sequence, stack)]
    if not doubts:
        for axis in sequence.axes:
            sequence = _scale_to_projector(sequence, axis, sample, projector, doubts, notes)
        sequence = replace(sequence, projector_size=projector)
    return Guess(sequence, sequence.frames, tuple(sorted(evidence)), tuple(doubts), tuple(notes))


def _measure_period_ratio(reader: BlockReader, finest: PhaseRun, run: PhaseRun) -> float:
    """Return the ratio of a run's period to the finest, from the change of their phases over the same pixels."""
    if run is finest:
        return 1.0
    fine, coarse = (reader.phasor(each.images) for each in (finest, run))
    angle = [np.concatenate([[0.0], np.cumsum(np.angle(p[1:] * np.conj(p[:-1])))]) for p in (fine, coarse)]
    gaps = np.concatenate([[0], np.cumsum(~reader.adjacent)])
    whole = gaps[WINDOW:] == gaps[:-WINDOW]
    steps = [(a[WINDOW:] - a[:-WINDOW])[whole] for a in angle]
    weight = np.abs(steps[0])
    # Weighed by the phase passed, and the median against jumps at the borders of things.
    slope = steps[1] / np.where(weight > 1e-6, steps[0], np.inf)
    order = np.argsort(slope)
    total = np.cumsum(weight[order])
    rough = 1 / max(float(slope[order][np.searchsorted(total, total[-1] / 2)]), 1e-6)
    return _refine_period_ratio(fine, coarse, rough)


def _refine_period_ratio(fine: np.ndarray, coarse: np.ndarray, rough: float) -> float:
    """Refine the ratio ``rough`` of two periods: at the result the coarse phase predicts the fine one best.

    ``fine``, ``coarse`` (p,): phasors. The coarse phase is cut where no pixel has it; without such a phase ``rough`` is
    returned.
    """
    cut = _detect_empty_phase(coarse)
    if cut is None:
        return rough
    angle = (np.angle(coarse) - cut) % TURN
    span = float(np.quantile(angle, 0.99) - np.quantile(angle, 0.01)) / TURN
    reach = min(0.04, 0.4 / (rough * max(span, 0.05)) + 0.01)
    ratios = rough * np.linspace(1 - reach, 1 + reach, 401)
    # From one ratio to the next each unit vector rotates by the same angle.
    unit, step = np.exp(1j * (np.angle(fine) - ratios[0] * angle)), np.exp(1j * (ratios[0] - ratios[1]) * angle)
    lengths = []
    for _ in ratios:
        lengths.append(abs(complex(unit.sum())))
        unit *= step
    return float(ratios[int(np.argmax(lengths))])


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

    The finest period is ASSUMED_PX; no bit is marked as complementary yet. ``ratios``: of the periods to the finest.
    """
    for run, ratio in zip(parts.runs, ratios, strict=True):
        n = len(run.images)
        period = float(f"{ASSUMED_PX * ratio:.5g}")
        for step, image in enumerate(run.images):
            frames[image] = Frame("phase", axis, step=step, steps=n, period_px=period)
        text = f"{n} steps equidistant over one period, " + (
            f"{100 * run.misfit:.1f} % of the amplitude off a cosine" if n > 3 else "with one mean level in all pixels"
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
        share = f"{bit.edges[0 if axis == 'x' else 1]:.3g} edges per camera px"
        observation = f"even in all of the view: bit {number} by its place" if bit.even else f"stripes, {share}"
        if not bit.is_readable:
            observation = f"too fine to be read: bit {number} by its place alone"
        evidence.append((bit.image, observation + (", and its inverse" if bit.inverse is not None else "")))


def _apply_conventions(
    sequence: PatternSequence,
    axis: Axis,
    parts: _AxisBlocks,
    sample: LineSample,
    blocks_reader: BlockReader,
    evidence: list[tuple[int, str]],
    doubts: list[tuple[tuple[int, ...], str]],
    notes: list[str],
) -> PatternSequence:
    """Return the sequence with the conventions of one axis that follow from its code and fringes.

    These are the complementary bit, the width of the Gray cells, and sign and offset of the phase. Adds to
    ``evidence``, ``doubts`` and ``notes``.
    """
    images = tuple(sorted(coded_frames(sequence, axis)))
    reader = AxisReader(sample, list(images))
    if parts.code is None:
        gradient = parts.runs[-1].gradient[0 if axis == "x" else 1]
        if gradient < 0:
            doubts.append((images, _describe_reversal(axis, "the phase falls", "or phase_sign is -1")))
        if len(parts.runs) == 1:
            notes.append(f"axis {axis}: one period without Gray code gives a phase that is not absolute")
            return replace(sequence, relative=True)
        if _detect_empty_phase(blocks_reader.phasor(parts.runs[0].images)) is None:
            doubts.append(
                (parts.runs[0].images, f"axis {axis}: its longest period repeats in the view: state period_px")
            )
        return sequence
    frames = described_frames(sequence, axis)
    if not parts.runs:
        a = measure_agreement(reader, frames)
        _check_code(frames, a, images, axis, doubts)
        notes.append(f"axis {axis}: Gray code alone, taken to number the projector's {_name_lines(axis)} one by one")
        return sequence
    a = measure_agreement(reader, frames)
    turns = a.turns_per_cell
    if not np.isfinite(turns):
        doubts.append((images, f"too few edges of the code of axis {axis} are in view to compare it with the fringes"))
        return sequence
    # ``turns`` of the finest-like period that described_frames compares, per cell of all bits
    assert frames.fringe is not None
    if abs(2 * turns - 1) < 0.12 / 2 + WHOLE:
        last = parts.code.bits[-1].image
        if parts.code.bits[-1].inverse is None:
            sequence = _mark_complementary(sequence, axis, last)
            evidence.append((last, f"its edges lie half way: {turns:.2f} fringes per cell of all bits"))
    else:
        cell = frames.fringe[0] * (round(turns) if turns > 0.9 and abs(turns - round(turns)) < 0.12 else turns)
        if abs(cell - sequence.gray_cell(axis)) > 0.01 * cell:
            sequence = replace(sequence, gray_cell_px=_replace_axis(sequence.gray_cell_px, axis, float(f"{cell:.4g}")))
        evidence.append((parts.code.bits[-1].image, f"{turns:.3g} fringes per Gray cell"))
    frames = described_frames(sequence, axis)
    a = measure_agreement(reader, frames)
    if a.rising < 0.5:
        sequence = replace(sequence, phase_sign=_replace_axis(sequence.phase_sign, axis, -1))
        evidence.append((parts.runs[-1].images[0], "the phase falls where the code rises"))
        frames = described_frames(sequence, axis)
        a = measure_agreement(reader, frames)
    late = wrap(a.begin_turns)
    if abs(late) > 0.1 and frames.fringe is not None:
        steps = len(frames.fringe[1])
        snapped = min(
            (0.25, -0.25, 0.5, *(wrap(k / steps) for k in range(1, steps))), key=lambda t: abs(wrap(late - t))
        )
        turn = snapped if abs(wrap(late - snapped)) < 0.06 else late
        offset = float(f"{TURN * turn:.4g}")
        sequence = replace(sequence, phase_offset_rad=_replace_axis(sequence.phase_offset_rad, axis, offset))
        notes.append(
            f"axis {axis}: the phase is {offset:g} rad where the Gray code begins; written as phase_offset, it may "
            "as well be gray_origin"
        )
        frames = described_frames(sequence, axis)
        a = measure_agreement(reader, frames)
    _check_code(frames, a, images, axis, doubts)
    gradient = parts.runs[-1].gradient[0 if axis == "x" else 1] * sequence.sign(axis)
    if gradient < 0:
        doubts.append((images, _describe_reversal(axis, "the code falls", "or a most significant bit is missing")))
    return sequence


def _scale_to_projector(
    sequence: PatternSequence,
    axis: Axis,
    sample: LineSample,
    projector: tuple[int, int] | None,
    doubts: list[tuple[tuple[int, ...], str]],
    notes: list[str],
) -> PatternSequence:
    """Return the sequence with the periods of one axis scaled to projector px.

    The codes in view must be inside the projector, and all codes, or the longest period, must cover it. Adds to
    ``doubts`` and ``notes``.
    """
    periods, bits = sequence.periods_px(axis), len(sequence.find("gray", axis))
    images = tuple(sequence.find("phase", axis) or sequence.find("gray", axis))
    if projector is None:
        if periods:
            notes.append(
                f"axis {axis}: the width of its fringes in projector px is unknown, only ratios are measured; the "
                f"finest is written as {periods[-1]:g} px: correct period_px, and add the projector's size"
            )
        return sequence
    extent = projector[0] if axis == "x" else projector[1]
    frames = described_frames(sequence, axis)
    reach = measure_agreement(AxisReader(sample, coded_frames(sequence, axis)), frames).reach_px
    covered = sequence.gray_cell(axis) * 2**bits if bits else periods[0]
    if not periods:
        if covered < extent or reach > extent + 1:
            text = f"{bits} bits number {covered:g} {_name_lines(axis)}, of which {reach:.0f} are in view, not {extent}"
            doubts.append((images, f"{text}: correct projector, or add gray_cell_px"))
        return sequence
    low, high = extent / covered * periods[-1], extent / max(reach, 1.0) * periods[-1]
    finest = low if high < 1.01 * low else max(float(np.clip(periods[-1], low, high)), FINEST_PX)
    if high >= 1.01 * low:
        doubts.append(
            (images, f"the finest period lies between {low:.2f} and {high:.2f} px, as far as the view shows: state it")
        )
    scale = finest / periods[-1]
    scaled = tuple(
        replace(f, period_px=float(f"{f.period_px * scale:.5g}")) if f.kind == "phase" and f.axis == axis else f
        for f in sequence.frames
    )
    cell = getattr(sequence.gray_cell_px, axis) if isinstance(sequence.gray_cell_px, PerAxis) else sequence.gray_cell_px
    cells = (
        sequence.gray_cell_px
        if cell is None
        else _replace_axis(sequence.gray_cell_px, axis, float(f"{cell * scale:.4g}"))
    )
    return replace(sequence, frames=scaled, gray_cell_px=cells)


def _check_code(
    frames: AxisFrames, a: Agreement, images: tuple[int, ...], axis: Axis, doubts: list[tuple[tuple[int, ...], str]]
) -> None:
    """Add a doubt where the Gray code and the fringes of an axis do not agree."""
    failed = failed_tests(frames, a)
    if failed or not is_supported(frames, a):
        shares = f"{100 * a.rule:.0f} % of the edges obey the Gray code" if np.isfinite(a.rule) else "no edges are read"
        if np.isfinite(a.common):
            shares += f", {100 * a.common:.0f} % of them fall at one phase"
        doubts.append((images, f"axis {axis}: {shares}, of {100 * SURE:.0f} % that would be sure"))


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
    """Return the text of the doubt that an axis is reversed, by a device turned by 180 degrees or by ``other``."""
    side = "to the right" if axis == "x" else "downwards"
    return f"axis {axis}: {observation} {side} in the camera: camera or projector is turned by half a turn, {other}"


def _name_lines(axis: Axis) -> str:
    """Return what a coordinate of an axis counts: "columns" or "rows"."""
    return "columns" if axis == "x" else "rows"


def _replace_axis(values: object, axis: Axis, value: float) -> PerAxis:  # type: ignore[type-arg]
    """Return a pair of values with that of one axis replaced."""
    both = values if isinstance(values, PerAxis) else PerAxis(values, values)
    return both._replace(**{axis: value})
