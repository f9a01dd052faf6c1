"""Changes of the description of one axis that make its frames agree: bits, signs, offsets, cells,
periods and sizes."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from slviewer.fringe.agreement_tests import (
    MAX_BEGIN_TURNS,
    MAX_LEVEL_TURNS,
    MAX_OUTSIDE,
    SURE,
    Answer,
    explain,
    failed_tests,
    has_evidence,
    wrap,
)
from slviewer.fringe.axis_agreement import (
    FEWEST_EDGES,
    Agreement,
    common_phase,
    fit_turns,
    measure_agreement,
)
from slviewer.fringe.axis_reader import AxisFrames, AxisReader, described_frames, reversed_bits
from slviewer.fringe.contradiction import Contradiction
from slviewer.fringe.sequence import Axis, PatternSequence

CLEARLY = 0.1
"""Amount by which the shares of one hypothesis must exceed those of a simpler one."""
GAMMAS = (1.6, 1.9, 2.2, 2.5)
LINES = {"x": "columns", "y": "rows"}


def explain_axis(reader: AxisReader, sequence: PatternSequence, axis: Axis) -> list[Answer]:
    """Return the smallest changes of the description of an axis that make its frames agree, the
    best first.

    Several answers are returned if they explain the frames about equally well, none if no change
    does.
    """
    answers: list[Answer] = []
    for variant, changes in _list_variants(described_frames(sequence, axis), axis):
        fit = _fit_code_values if variant.bits else _fit_level_offset
        answer = fit(reader, variant, axis, changes)
        if answer is not None:
            answers.append(answer)
    if not answers:
        return []
    first, *others = sorted(answers, key=lambda answer: (len(answer.contradictions), -answer.score))
    # Several gammas fit more or less: only the best of them is returned.
    return [
        first,
        *(
            answer
            for answer in others
            if len(answer.contradictions) == len(first.contradictions)
            and answer.contradictions[0].cause != first.contradictions[0].cause
            and answer.score > first.score - CLEARLY
        ),
    ]


def _list_variants(
    frames: AxisFrames, axis: Axis
) -> Iterator[tuple[AxisFrames, list[Contradiction]]]:
    """Yield variants of the description (bit order, phase sign, gamma) and the contradictions that
    each stands for."""
    bits = [(frames, "")]
    if len(frames.bits) - frames.complementary > 1:
        bits.append(
            (
                reversed_bits(frames),
                "in reverse order, the finest stripes first: reverse the bit numbers",
            )
        )
        if frames.complementary:
            text = (
                "in reverse order, the complementary bit first: reverse the numbers of all of them"
            )
            bits.append((reversed_bits(frames, True), text))
        bits.append(
            (replace(frames, inverted=True), "inverted: exchange each bit with its inverse")
        )
    for variant, text in bits:
        changes = (
            [Contradiction("bit-order", f"the Gray bits of axis {axis} are {text}", axis, None)]
            if text
            else []
        )
        yield variant, changes
        if frames.shifts:
            flipped = replace(variant, sign=-variant.sign)
            text = (
                f"the fringes of axis {axis} shift in the opposite direction to the description:"
                f" set phase_sign = {flipped.sign} for axis {axis}"
            )
            yield flipped, [*changes, Contradiction("step-order", text, axis, float(flipped.sign))]
    if frames.shifts and not frames.bits:
        for gamma in GAMMAS:
            text = (
                "the light of the projector or the camera follows the grey level by a gamma of"
                f" about {gamma:g}, and {len(frames.shifts[-1][1])} phase steps cannot average that"
                " out: set the projector's gamma to 1, or take more steps"
            )
            yield replace(frames, gamma=gamma), [Contradiction("gamma", text, axis, gamma)]


def _fit_code_values(
    reader: AxisReader, frames: AxisFrames, axis: Axis, changes: list[Contradiction]
) -> Answer | None:
    """Fit cell width, offsets and size to frames with Gray bits; return the changes with which all
    tests pass.

    ``changes``: those that the variant ``frames`` already makes. None if no values fit, or if
    nothing changes.
    """
    a = measure_agreement(reader, frames)
    failed = failed_tests(frames, a)
    out = list(changes)
    if (
        failed & {"inverse", "bits", "rule", "rising"}
        or not a.rule > SURE
        or a.edges < FEWEST_EDGES
    ):
        return None
    if frames.fringe is not None:
        period = frames.fringe[0]
        if failed & {"common", "cell"}:
            cell, common, begin = _fit_cell_width(frames, a)
            if common < SURE or not a.rising > SURE:
                return None
            a = replace(a, common=common, begin_turns=begin)
            fitting = period * frames.cell_px / cell
            out.append(
                Contradiction(
                    "gray-cell",
                    f"a cell of the Gray code of axis {axis} covers {cell / period:.3g} fringe"
                    f" periods, and the description says {frames.cell_px / period:.3g}: set"
                    f" gray_cell_px = {cell:.4g}, or period_px = {fitting:.4g} if the cells are"
                    " right",
                    axis,
                    cell,
                )
            )
        elif a.common < SURE or a.rising < SURE:
            return None
        late = wrap(a.begin_turns - frames.origin_px / period)
        if (
            out
            and out[-1].cause == "step-order"
            and abs(wrap(late + 1 / len(frames.fringe[1]))) < abs(late)
        ):
            n = len(frames.fringe[1])
            text = (
                f"the {n} phase steps of axis {axis} are in reverse order: number them backwards,"
                f" or set phase_sign = {frames.sign} and phase_offset = {-2 * np.pi / n:.3f}"
            )
            out[-1] = Contradiction("step-order", text, axis, float(frames.sign))
            late = wrap(late + 1 / n)
        if abs(late) > MAX_BEGIN_TURNS:
            out += _describe_phase_shift(frames, a, late, axis)
    if a.outside > MAX_OUTSIDE:
        out += explain_reach(frames, a, axis)
    return explain(out, a) if out else None


def _fit_cell_width(frames: AxisFrames, a: Agreement) -> tuple[float, float, float]:
    """Fit the width of the Gray cells: all code edges then have one phase of the fringes.

    Returns the width in px, and the concentration and the mean (turns, -0.5 ... 0.5) of the phase,
    see `common_phase`.
    """
    assert frames.fringe is not None and a.borders is not None
    angle, border, weight = a.borders
    turns = a.turns_per_cell if np.isfinite(a.turns_per_cell) else frames.cell_px / frames.fringe[0]
    ratio = fit_turns(angle, 2 * np.pi * border, np.arange(0.88, 1.121, 0.0005) * turns, weight)
    return (ratio * frames.fringe[0], *common_phase(angle, border * ratio, weight))


def _describe_phase_shift(
    frames: AxisFrames, a: Agreement, late: float, axis: Axis
) -> list[Contradiction]:
    """Return the two contradictions that explain a shift of ``late`` periods between fringes and
    Gray code.

    Either the phase steps or the Gray code may begin elsewhere than described; the more probable
    contradiction comes first.
    """
    assert frames.fringe is not None
    period, steps = frames.fringe[0], len(frames.fringe[1])
    offset = wrap((frames.offset_rad + 2 * np.pi * late) / (2 * np.pi)) * 2 * np.pi
    share = describe_turns(2 * np.pi * late)
    shifted = Contradiction(
        "phase-offset",
        f"the phase steps of axis {axis} begin {share} than described: {_describe_offset(offset)}",
        axis,
        offset,
    )
    origin = a.begin_turns - np.ceil(a.begin_turns - 0.25)
    moved = Contradiction(
        "gray-origin",
        f"the Gray code of axis {axis} begins {share.rsplit(' ', 1)[0]} of the fringes from where"
        f" it was described: set gray_origin = {origin * period:.2f} (px; of a PatternSequence:"
        " gray_origin_px)",
        axis,
        float(origin * period),
    )
    by_step = (
        min(abs(wrap(late - k / steps)) for k in range(1, steps)) < 0.03
        and abs(abs(late) - 0.5) > 0.05
    )
    by_quarter = abs(abs(late) - 0.25) < 0.05
    return [shifted, moved] if by_quarter or by_step else [moved, shifted]


def explain_reach(frames: AxisFrames, a: Agreement, axis: Axis) -> list[Contradiction]:
    """Return the contradictions that explain coordinates outside the projector: its size, and the
    fringe period."""
    assert frames.extent is not None
    observation = (
        f"{100 * a.outside:.0f} % of the {axis} codes lie outside the projector's {frames.extent}"
        f" {LINES[axis]} and reach {a.reach_px:.0f}"
    )
    size = f"{observation}: give the size of the projector that was used"
    out = [Contradiction("projector-size", size, axis, a.reach_px)]
    if frames.shifts:
        period = frames.shifts[-1][0] * frames.extent / a.reach_px
        text = f"the fringe period of axis {axis} is {period:.3g} px or less: correct period_px"
        out.append(Contradiction("fringe-period", text, axis, period))
    return out


def _fit_level_offset(
    reader: AxisReader, frames: AxisFrames, axis: Axis, changes: list[Contradiction]
) -> Answer | None:
    """Fit the phase offset to frames of several periods without Gray bits; return the changes, None
    without any."""
    a = measure_agreement(reader, frames)
    failed = failed_tests(frames, a)
    if "levels" in failed or not has_evidence(frames, a):
        return None
    if not failed:
        return explain(changes, a) if changes else None
    if failed == {"outside"}:
        return explain((*changes, *explain_reach(frames, a, axis)), a)
    steps = len(frames.shifts[-1][1])
    best: tuple[float, AxisFrames, Agreement] | None = None
    for turns in step_turns(steps):
        turned = replace(frames, offset_rad=frames.offset_rad + 2 * np.pi * turns)
        b = measure_agreement(reader, turned)
        apart = max(map(abs, b.level_turns))
        if (
            not failed_tests(turned, b)
            and apart < MAX_LEVEL_TURNS / 4
            and (best is None or apart < best[0])
        ):
            best = apart, turned, b
    if best is None:
        return None
    offset = wrap(best[1].offset_rad / (2 * np.pi)) * 2 * np.pi
    text = (
        f"the phase steps of axis {axis} begin {describe_turns(offset - frames.offset_rad)} than"
        " described"
    )
    out = Contradiction("phase-offset", f"{text}: {_describe_offset(offset)}", axis, offset)
    if changes:  # a sign and an offset: the steps in reverse order
        text = (
            f"the {steps} phase steps of axis {axis} are in reverse order, or begin elsewhere: set"
            f" phase_sign = {frames.sign} and phase_offset = {offset:.3f} for axis {axis}"
        )
        out = Contradiction("step-order", text, axis, float(frames.sign))
    return explain([out], best[2])


def _describe_offset(offset: float) -> str:
    """Return the remedy of a wrong phase offset."""
    return f"set phase_offset = {offset:.3f} (rad; of a PatternSequence: phase_offset_rad)"


def step_turns(steps: int) -> tuple[float, ...]:
    """Return the usual offsets of a phase, in periods: quarters, a half, and whole steps."""
    return (0.25, -0.25, 0.5, *(wrap(k / steps) for k in range(1, steps)))


def describe_turns(angle: float) -> str:
    """Return an angle (rad) as text, a share of a period with its direction: "a quarter period
    later"."""
    turns = wrap(angle / (2 * np.pi))
    share = {0.25: "a quarter period", 0.5: "half a period"}.get(round(abs(turns) * 20) / 20)
    return f"{share or f'{abs(turns):.2f} periods'} {'later' if turns > 0 else 'earlier'}"
