"""Guess of the description of a capture from its images alone, with the evidence and the open
questions."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from slviewer.errors import InputError
from slviewer.examination import limits
from slviewer.examination.evaluate import Evaluator, described
from slviewer.examination.examine import examine
from slviewer.examination.findings import LINES, wrap
from slviewer.examination.hypotheses import change_conventions, change_frames
from slviewer.examination.sample import sample_capture
from slviewer.fringe.sequence import (
    Axis,
    Frame,
    Indices,
    PatternSequence,
    Size,
    select_axis_value,
)
from slviewer.session.importers.frame_blocks import (
    BlockReader,
    Doubt,
    FrameBlocks,
    GrayBlock,
    PhaseRun,
    group_frames,
)
from slviewer.session.importers.line_sample import sample_lines

ASSUMED_PX = 16.0
"""px of the finest period where nothing states it: a scale, and no measurement."""
DIAGONAL = (0.67, 1.5)
"""Slopes of stripes within 11 degrees of a diagonal, which determine no axis."""
WHOLE = 0.02
"""Tolerance of a measured ratio that should be a whole number: its uncertainty over some ten
fringes is less."""
SAME_PERIOD = 0.015
TURN = 2 * np.pi
WINDOW = 24
"""Camera px over which two phases are compared."""
FINEST_PX = 2.0
MOST_EXPLAINED = 0.7
"""Share of the pixels that a code explains that is sure: depth edges and shadows take a tenth."""
SNAPPED = 0.06
"""Periods within which an offset is a quarter or a step."""
NO_OFFSET = 0.1
"""Periods up to which an offset is the origin of the code, half a projector pixel before its
first."""
CELL_ERROR = 0.15
"""Uncertainty of a cell's width by the number of edges in view."""


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
            f"a stack of shape {stack.shape} is not a capture",
            "give three or more images of one size",
        )
    reader = BlockReader(sample_lines(stack))
    everything = tuple(range(len(stack)))
    frames: list[Frame | None] = [None] * len(stack)
    share = float(reader.illuminated.mean())
    if share < limits.LEAST_LIT or reader.count < 500:
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
    evaluator = Evaluator(sample_capture(sequence, stack))
    for axis in sequence.axes:
        sequence = _apply_conventions(sequence, axis, axes[axis], evaluator, reader, findings)
    if not findings.doubts:
        findings.doubts.extend(
            (everything, found.text()) for found in examine(sequence, stack).rejected
        )
    if not findings.doubts:
        for axis in sequence.axes:
            sequence = _scale_to_projector(sequence, axis, evaluator, projector, findings)
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
    ratios = rough * np.linspace(1 - reach, 1 + reach, 401)
    # from one ratio to the next each unit vector rotates by the same angle
    unit = np.exp(1j * (np.angle(fine) - ratios[0] * angle))
    turn, lengths = np.exp(1j * (ratios[0] - ratios[1]) * angle), []
    for _ in ratios:
        lengths.append(abs(complex(unit.sum())))
        unit *= turn
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
    evaluator: Evaluator,
    reader: BlockReader,
    findings: _Findings,
) -> PatternSequence:
    """Return the sequence with the conventions of one axis that follow from its code and fringes.

    These are the complementary bit, the width of the Gray cells, and sign and offset of the phase.
    """
    if parts.code is None:
        return _check_fringes(sequence, axis, parts.runs, reader, findings)
    images = _list_images(sequence, axis)
    if not parts.runs:
        codes = [replace(sequence, binary=binary) for binary in (False, True)]
        sequence = max(codes, key=lambda code: _share_explained(code, axis, evaluator))
        name = "plain binary code" if sequence.binary else "Gray code"
        findings.notes.append(
            f"axis {axis}: {name} alone, taken to number the projector's {LINES[axis]} one by one"
        )
    else:
        sequence = _fit_code(sequence, axis, parts, evaluator, findings)
    explained = _share_explained(sequence, axis, evaluator)
    if explained < MOST_EXPLAINED:
        text = f"axis {axis}: {100 * explained:.0f} % of the pixels fit this code"
        findings.doubts.append((images, f"{text}, of {100 * MOST_EXPLAINED:.0f} % at least"))
    if parts.runs and parts.runs[-1].gradient["xy".index(axis)] * sequence.sign(axis) < 0:
        text = describe_reversal(axis, "the code falls", "or a most significant bit is missing")
        findings.doubts.append((images, text))
    return sequence


def _share_explained(sequence: PatternSequence, axis: Axis, evaluator: Evaluator) -> float:
    """Return the share of the pixels that the patterns of an axis explain."""
    m = evaluator.match(described(sequence), axis)
    return 0.0 if m is None else float(np.mean(m.misfit < limits.GOOD))


def _list_images(sequence: PatternSequence, axis: Axis) -> Indices:
    """Return the images that show a pattern along an axis."""
    return tuple(i for i, frame in enumerate(sequence.frames) if frame.axis == axis)


def _fit_code(
    sequence: PatternSequence,
    axis: Axis,
    parts: _AxisBlocks,
    evaluator: Evaluator,
    findings: _Findings,
) -> PatternSequence:
    """Return the sequence with the cells of the code, and the sign and the offset of the phase,
    that explain the images of the axis best."""
    assert parts.code is not None
    last = parts.code.bits[-1]
    marked = [_mark_complementary(sequence, axis, last.image)] if last.inverse is None else []
    widths = [change_conventions(sequence, axis, gray_cell_px=w) for w in _list_cells(parts)]
    kinds = [[sequence], marked, widths]
    steps = len(parts.runs[-1].images)
    kind, found = _choose_code(kinds, axis, steps, evaluator)
    if kind == 1:
        text = "its edges lie half way: 0.5 fringes per cell of all bits"
        findings.evidence.append((last.image, text))
    elif kind == 2:
        ratio = found.gray_cell(axis) / sequence.periods_px(axis)[-1]
        findings.evidence.append((last.image, f"{ratio:.3g} fringes per Gray cell"))
    if found.sign(axis) < 0:
        text = "the phase falls where the code rises"
        findings.evidence.append((parts.runs[-1].images[0], text))
    if offset := found.offset_rad(axis):
        findings.notes.append(
            f"axis {axis}: the phase is {offset:g} rad where the Gray code begins; written as"
            " phase_offset, it may as well be gray_origin"
        )
    return found


def _choose_code(
    kinds: Sequence[Sequence[PatternSequence]], axis: Axis, steps: int, evaluator: Evaluator
) -> tuple[int, PatternSequence]:
    """Return the kind of the candidates that explains the images best, the first of about equal
    ones; and the best of it, with the sign and the offset of its phase of so many ``steps``."""

    def rate(candidate: PatternSequence, sample: Evaluator = evaluator) -> float:
        """Return the misfit of a candidate."""
        m = sample.match(described(candidate), axis)
        return 1.0 if m is None else float(m.misfit.mean())

    def turn(candidate: PatternSequence, sign: int, turns: float) -> PatternSequence:
        """Return a candidate with a sign of the phase, and an offset of a share of the period."""
        offset = float(f"{TURN * wrap(turns):.4g}")
        return change_conventions(candidate, axis, phase_sign=sign, phase_offset_rad=offset)

    best = {}
    for kind, candidates in enumerate(kinds):
        turned = [turn(c, sign, k / 8) for c in candidates for sign in (1, -1) for k in range(8)]
        if turned:
            best[kind] = min(turned, key=lambda c: rate(c, evaluator.coarse))
    losses = {kind: rate(candidate) for kind, candidate in best.items()}
    most = 2 * min(losses.values()) + 10 * limits.CHANGE_COST
    kind = min(kind for kind, loss in losses.items() if loss <= most)
    found, sign = best[kind], best[kind].sign(axis)
    near = found.offset_rad(axis) / TURN + np.arange(-4, 5) / 64
    exact = float(min(near, key=lambda turns: rate(turn(found, sign, turns))))
    usual = [k / m for m in (4, steps) for k in range(m)]
    snapped = min(usual, key=lambda turns: abs(wrap(exact - turns)))
    exact = snapped if abs(wrap(exact - snapped)) < SNAPPED else exact
    return kind, turn(found, sign, exact if abs(wrap(exact)) > NO_OFFSET else 0.0)


def _list_cells(parts: _AxisBlocks) -> list[float]:
    """Return widths of the Gray cells, px, that are possible by the edges of the code and the phase
    gradient of the finest fringes; in steps of a third of a period over the whole code."""
    assert parts.code is not None
    bits = parts.code.bits
    b, bit = [(b, bit) for b, bit in enumerate(bits) if bit.is_readable and bit.even is None][-1]
    if not max(bit.edges):
        return []
    cell = 1 / (2.0 ** (len(bits) - b) * max(bit.edges))  # two cells from edge to edge of the last
    turns = cell * _compute_fringe_frequency(parts.runs[-1]) / TURN
    count = int(np.clip(3 * 2 ** len(bits) * turns * CELL_ERROR, 4, 40))
    around = turns * (1 + CELL_ERROR * np.arange(-count, count + 1) / count)
    whole = [float(round(turns))] if turns > 0.9 else []
    return [float(f"{ASSUMED_PX * each:.4g}") for each in (*whole, *around)]


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
        text = describe_reversal(axis, "the phase falls", "or phase_sign is -1")
        findings.doubts.append((_list_images(sequence, axis), text))
    if len(runs) == 1:
        findings.notes.append(
            f"axis {axis}: one period without Gray code gives a phase that is not absolute"
        )
        return replace(sequence, relative=True)
    if _detect_empty_phase(reader.phasor(runs[0].images)) is None:
        text = f"axis {axis}: its longest period repeats in the view: state period_px"
        findings.doubts.append((runs[0].images, text))
    return sequence


def _scale_to_projector(
    sequence: PatternSequence,
    axis: Axis,
    evaluator: Evaluator,
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
    m = evaluator.match(described(sequence), axis)
    assert m is not None
    reach = float(np.quantile(m.coordinate[m.misfit < limits.GOOD], 0.995))
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
    sequence = change_frames(
        sequence,
        axis,
        lambda f: replace(f, period_px=float(f"{f.period_px * scale:.5g}")) if f.steps else f,
    )
    cell = select_axis_value(sequence.gray_cell_px, axis)
    if cell is None:
        return sequence
    return change_conventions(sequence, axis, gray_cell_px=float(f"{cell * scale:.4g}"))


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


def describe_reversal(axis: Axis, observation: str, other: str) -> str:
    """Return the text of the doubt that an axis is reversed, by a device turned by 180 degrees or
    by ``other``."""
    side = "to the right" if axis == "x" else "downwards"
    return (
        f"axis {axis}: {observation} {side} in the camera: camera or projector is turned by half a"
        f" turn, {other}"
    )
