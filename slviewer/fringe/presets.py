"""Ready-made pattern sequences."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil, log2
from typing import Literal, get_args

from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis, Frame, PatternSequence, Size

PresetName = Literal["p18", "gray", "complementary", "multifrequency", "micro"]
"""Each is a function of that name."""
AXES: tuple[Axis, ...] = ("x", "y")
MICRO_PX = (12.0, 16.0)
"""Shortest period of micro phase shifting, and about the longest."""


def p18(projector: Size, steps: int = 18) -> PatternSequence:
    """Return 18 steps at a period of 18 px, seven Gray bits (more if the projector needs them),
    then white.

    X, then y.
    """
    frames: list[Frame] = []
    for axis, extent in zip(AXES, projector, strict=True):
        frames += phase_steps(axis, steps, 18.0) + gray_bits(axis, max(7, bits_for(extent / 18)))
        frames.append(Frame("texture"))
    return PatternSequence(projector, tuple(frames))


def gray(projector: Size, cell_px: int = 1) -> PatternSequence:
    """Return Gray code alone, each bit followed by its inverse; x, then y, white, black
    (procam-calibration layout). Its cells are ``cell_px`` wide."""
    if not 1 <= cell_px <= min(projector):
        raise InputError(f"Gray code in cells of {cell_px} px is not possible", "give 1 px or more")
    frames: list[Frame] = []
    for axis, extent in zip(AXES, projector, strict=True):
        for bit in gray_bits(axis, bits_for(extent / cell_px)):
            frames += [bit, replace(bit, kind="inverse")]
    cell = None if cell_px == 1 else float(cell_px)
    return PatternSequence(projector, (*frames, Frame("white"), Frame("black")), gray_cell_px=cell)


def complementary(projector: Size, steps: int = 8, period_px: float = 16.0) -> PatternSequence:
    """Return phase steps, Gray bits of the fringe order and the complementary bit; x, then y, then
    white."""
    frames: list[Frame] = []
    for axis, extent in zip(AXES, projector, strict=True):
        frames += phase_steps(axis, steps, period_px) + gray_bits(
            axis, bits_for(extent / period_px)
        )
        frames.append(Frame("complementary", axis))
    return PatternSequence(projector, (*frames, Frame("texture")))


def multifrequency(
    projector: Size, steps: int = 6, periods_px: Sequence[float] | None = None
) -> PatternSequence:
    """Return phase steps at several periods, longest first; x, then y, then white.

    ``periods_px`` defaults to 16 px, and as many periods eight times as long each as it takes to
    cover the axis.
    """
    frames: list[Frame] = []
    for axis, extent in zip(AXES, projector, strict=True):
        periods = list(periods_px) if periods_px is not None else covering_periods(extent)
        if len(set(periods)) != len(periods) or not periods:
            raise InputError(f"periods of {periods} px", "give one or more, each once")
        for period in sorted(periods, reverse=True):
            frames += phase_steps(axis, steps, period)
    return PatternSequence(projector, (*frames, Frame("texture")))


def micro(projector: Size) -> PatternSequence:
    """Return phase steps at four periods from 12 to at most 17 px, for surfaces with
    interreflections; x, y, white.

    Micro phase shifting (Gupta and Nayar, "Micro phase shifting", CVPR 2012): light that reaches a
    point by way of other surfaces, or through the material, averages over such narrow stripes and
    shifts no phase. There is no long period and no Gray code that it could mislead; beats of the
    periods replace them. The beats' ratios are equal, so that no unwrapping step is weaker than the
    others. Eight steps of the finest period, four of the others.
    """
    periods = 4
    frames: list[Frame] = []
    for axis, extent in zip(AXES, projector, strict=True):
        # of small projectors too: shorter beats need wider stripes
        longest = max(1.1 * extent, 700.0)
        ratio = (longest / MICRO_PX[1]) ** (1 / (periods - 1))
        # of neighbouring frequencies
        differences = [1 / (longest / ratio**k) for k in range(periods - 1)]
        frequencies = [1 / MICRO_PX[0] - sum(differences[k:]) for k in range(periods)]
        for i, frequency in enumerate(frequencies):
            frames += phase_steps(axis, 8 if i == periods - 1 else 4, 1 / frequency)
    return PatternSequence(projector, (*frames, Frame("texture")))


def short(projector: Size, axis: Axis) -> PatternSequence:
    """Return 11 frames of one axis, for live scanning: 3 + 3 + 4 phase steps of three periods, then
    white.

    Three steps each of a period longer than the axis and of an intermediate one, four of the
    finest, 16 px. The ratios of the periods are equal, so that neither unwrapping step is the
    weaker. Four steps of the finest suppress the second harmonic of the projector, and contradict
    each other where something moved.
    """
    finest, longest = 16.0, 1.1 * projector[AXES.index(axis)]
    between = (finest * longest) ** 0.5
    frames = (
        phase_steps(axis, 3, longest) + phase_steps(axis, 3, between) + phase_steps(axis, 4, finest)
    )
    return PatternSequence(projector, (*frames, Frame("texture")))


PRESETS: dict[str, Callable[[Size], PatternSequence]] = {
    name: globals()[name] for name in get_args(PresetName)
}


def find_preset(name: str) -> Callable[[Size], PatternSequence]:
    """Return the preset of that name. Raises InputError where there is none."""
    if name not in PRESETS:
        raise InputError(f"no pattern sequence is called {name!r}", f"use {', '.join(PRESETS)}")
    return PRESETS[name]


def phase_steps(axis: Axis, steps: int, period_px: float) -> list[Frame]:
    """Return all steps of one period, in order."""
    return [
        Frame("phase", axis, step=k, steps=steps, period_px=float(period_px)) for k in range(steps)
    ]


def gray_bits(axis: Axis, bits: int) -> list[Frame]:
    """Return the frames of a Gray code, most significant bit first."""
    return [Frame("gray", axis, bit=b, bits=bits) for b in range(bits)]


def bits_for(cells: float) -> int:
    """Return the number of bits that number ``cells`` cells."""
    return max(1, ceil(log2(max(1, ceil(cells)))))


def covering_periods(extent: int) -> list[float]:
    """Return periods px from 16 px up to one that covers the axis, each eight times as long as the
    one before.

    The last is a tenth longer than the axis so that its ends cannot be confused.
    """
    periods = [16.0]
    while periods[-1] * 8 < extent:
        periods.append(periods[-1] * 8)
    return [*periods, 1.1 * extent] if extent > periods[-1] else periods
