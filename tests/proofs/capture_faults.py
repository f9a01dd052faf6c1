"""Faults of simulated captures: of the order of the frames, of their description, of the light and
of the scene."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import TypeVar
from zlib import crc32

import numpy as np

from slviewer.fringe.patterns import profile
from slviewer.fringe.sequence import Axis, Frame, PerAxis
from tests.proofs.simulated_capture import (
    AXES,
    BLACK,
    FOREIGN,
    KINDS,
    CaptureKind,
    CaptureSetup,
    draw_setup,
    gray_code,
)

Rng = np.random.Generator
T = TypeVar("T")


@dataclass(frozen=True)
class FaultyCapture:
    """A faulty capture, and ``sound``: the same one without the fault.

    ``causes``: each of them names the fault rightly. ``frames``: of which a finding must name one
    if the fault is of one frame; else empty.
    """

    setup: CaptureSetup
    sound: CaptureSetup
    causes: frozenset[str]
    frames: tuple[int, ...] = ()


Kinds = tuple[CaptureKind, ...]
Strike = Callable[[CaptureSetup, Rng], FaultyCapture]


@dataclass(frozen=True)
class CaptureFault:
    """``strike`` puts the fault into a sound capture; ``kinds``: captures that can have it."""

    strike: Strike
    kinds: Kinds = KINDS


PHASE: Kinds = tuple(k for k in KINDS if k != "gray")
CODED: Kinds = ("p18", "complementary")
"""With phase steps and Gray bits."""
BITS: Kinds = (*CODED, "gray")
FEW: Kinds = ("complementary", "multifrequency", "heterodyne", "micro")
"""With three or four phase steps."""


def _faulty(
    sound: CaptureSetup,
    causes: Sequence[str],
    frames: Sequence[int] = (),
    **changes: object,
) -> FaultyCapture:
    """The capture with ``changes`` of its setup."""
    changed = replace(sound, **changes)  # type: ignore[arg-type]
    return FaultyCapture(changed, sound, frozenset(causes), tuple(frames))


def _change(cause: str, **changes: object) -> Strike:
    """What only changes some fields of the setup."""
    return lambda setup, rng: _faulty(setup, [cause], (), **changes)


def _count(setup: CaptureSetup) -> int:
    """Number of images."""
    return len(setup.shown.frames)


def _coded(setup: CaptureSetup) -> list[int]:
    """Indices of the frames that decoding needs."""
    return [i for i, frame in enumerate(setup.shown.frames) if frame.kind != "texture"]


def _steps(setup: CaptureSetup) -> list[tuple[int, ...]]:
    """Indices of the phase steps of each period and axis."""
    shown = setup.shown
    return [indices for axis in shown.axes for _, indices in shown.phase_shifts(axis)]


def _show(setup: CaptureSetup, instead: Mapping[int, int]) -> tuple[int, ...]:
    """The order of the patterns, with others at some places."""
    return tuple(instead.get(i, i) for i in range(_count(setup)))


def _is_same_pattern(setup: CaptureSetup, a: int, b: int) -> bool:
    """Whether two frames show the same, as two bits that are black all over the projector."""
    (axis, levels), (other_axis, others) = (profile(setup.shown, k) for k in (a, b))
    if axis == other_axis:
        return bool(np.array_equal(levels, others))
    return bool((levels == others[0]).all() and (others == levels[0]).all())


def _same_run(setup: CaptureSetup, k: int) -> list[int]:
    """The frames about ``k`` that show the same as it, without a gap."""
    first = last = k
    while first > 0 and _is_same_pattern(setup, first - 1, k):
        first -= 1
    while last + 1 < _count(setup) and _is_same_pattern(setup, last + 1, k):
        last += 1
    return list(range(first, last + 1))


def _draw_middle(setup: CaptureSetup, rng: Rng, low: float = 0.25, high: float = 0.75) -> int:
    """A coded frame from the middle of the capture."""
    n = _count(setup)
    return int(rng.choice([i for i in _coded(setup) if low * n <= i < high * n]))


def _draw_axes(rng: Rng) -> tuple[Axis, ...]:
    """One axis or both."""
    choices: tuple[tuple[Axis, ...], ...] = (("x",), ("y",), ("x", "y"))
    return choices[rng.integers(3)]


def _set_axes(axes: Sequence[Axis], value: T, otherwise: T) -> PerAxis[T]:
    """A pair of values: one for some of the axes, and another for the others."""
    return PerAxis(*(value if axis in axes else otherwise for axis in AXES))


def _cover(setup: CaptureSetup) -> CaptureSetup:
    """The capture of a plane that reaches beyond the projector's field on all sides, so that all
    coordinates occur."""
    return replace(setup, view=replace(setup.view, scene="plane", field=0.85))


# The order of the frames


def _late_from_start(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """Each image shows the pattern before its own; the first shows none, or the last."""
    n = _count(setup)
    first = BLACK if rng.random() < 0.5 else n - 1
    return _faulty(setup, ["frame-lag"], order=(first, *range(n - 1)))


def _late_from_frame(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """From one image on, which repeats the one before, all come one late."""
    n, k = _count(setup), _draw_middle(setup, rng)
    order = (*range(k), *range(k - 1, n - 1))
    places = [i + 1 for i in _same_run(setup, k - 1)]
    return _faulty(setup, ["frame-lag", "duplicate-frame"], places, order=order)


def _missing_frame(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """One frame is missing, later ones are early, and the last is repeated or black."""
    n, k = _count(setup), _draw_middle(setup, rng)
    last = BLACK if rng.random() < 0.5 else n - 1
    order = (*range(k), *range(k + 1, n), last)
    return _faulty(setup, ["missing-frame"], _same_run(setup, k), order=order)


def _exchange(setup: CaptureSetup, a: int, b: int) -> FaultyCapture:
    """Two frames have changed places."""
    causes = ["frame-order"]
    first, second = setup.shown.frames[a], setup.shown.frames[b]
    if any(a in steps and b in steps for steps in _steps(setup)):
        causes.append("step-order")
    elif first.kind == second.kind == "gray" and first.axis == second.axis:
        causes.append("bit-order")  # the same images
    return _faulty(setup, causes, [a, b], order=_show(setup, {a: b, b: a}))


def _exchange_neighbours(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """Two neighbouring frames have changed places."""
    pairs = [
        (a, b)
        for a, b in pairwise(_coded(setup))
        if b == a + 1 and not _is_same_pattern(setup, a, b)
    ]
    return _exchange(setup, *rng.choice(pairs).tolist())


def _exchange_distant(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """Two frames have changed places, with several between them."""
    coded = _coded(setup)
    while True:
        a, b = sorted(rng.choice(coded, 2, replace=False).tolist())
        if b - a >= 4 and not _is_same_pattern(setup, a, b):
            return _exchange(setup, a, b)


def _repeat_frame(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """One frame shows the pattern before its own, or is a copy of the image before."""
    k = int(rng.choice([k for k in _coded(setup)[1:] if not _is_same_pattern(setup, k, k - 1)]))
    if rng.random() < 0.5:
        return _faulty(setup, ["duplicate-frame"], [k], copies=((k, k - 1),))
    return _faulty(setup, ["duplicate-frame"], [k], order=_show(setup, {k: k - 1}))


def _replace_frame(setup: CaptureSetup, rng: Rng, pattern: int) -> FaultyCapture:
    """One frame shows something else."""
    usable = [k for k in _coded(setup) if profile(setup.shown, k)[1].any()]
    k = int(rng.choice(usable))
    order = _show(setup, {k: pattern})
    return _faulty(setup, ["duplicate-frame", "frame-order"], [k], order=order)


def _order_steps(setup: CaptureSetup, permute: Callable[[int], Sequence[int]]) -> FaultyCapture:
    """The steps of every period are shown in the order ``permute(steps)``."""
    counts = {len(steps) for steps in _steps(setup)}
    orders = {n: permute(n) for n in sorted(counts)}
    instead = {
        place: steps[step]
        for steps in _steps(setup)
        for place, step in zip(steps, orders[len(steps)], strict=True)
    }
    causes = ["step-order"]
    if all(sum(k != step for k, step in enumerate(order)) == 2 for order in orders.values()):
        causes.append("frame-order")  # two steps of each period have changed places
    return _faulty(setup, causes, order=_show(setup, instead))


def _reverse_steps(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The steps of every period are shown from the last to the first."""
    return _order_steps(setup, lambda n: range(n - 1, -1, -1))


def _permute_steps(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The steps of every period are shown in an order that neither shifts nor reverses them."""

    def permute(n: int) -> list[int]:
        """A random order."""
        while True:
            order = rng.permutation(n)
            differences = {int(d) for d in np.diff(order, append=order[0]) % n}
            if differences not in ({1}, {n - 1}):
                return order.tolist()

    return _order_steps(setup, permute)


# The description


def _describe(setup: CaptureSetup, causes: Sequence[str], **changes: object) -> FaultyCapture:
    """The capture whose description has ``changes``."""
    described = replace(setup.described, **changes)  # type: ignore[arg-type]
    return _faulty(setup, causes, described=described)


def _flip_sign(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The phase sign of an axis is wrong; without Gray code that is the same as a mirrored axis."""
    # phase steps alone, reversed along both axes, are those of a projector upside down
    axes = _draw_axes(rng) if setup.kind in CODED else (AXES[rng.integers(2)],)
    causes = ["step-order"] if setup.kind in CODED else ["step-order", "axis-reversed"]
    return _describe(setup, causes, phase_sign=_set_axes(axes, -1, 1))


def _omit_offset(setup: CaptureSetup, rng: Rng, offset: float) -> FaultyCapture:
    """The phase steps begin elsewhere than described."""
    causes = ["phase-offset"]
    if setup.kind in CODED and abs(offset) > 3:
        causes.append("gray-origin")  # half a period: the same images
    values = _set_axes(_draw_axes(rng), offset, 0.0)
    return _faulty(setup, causes, shown=replace(setup.shown, phase_offset_rad=values))


def _move_origin(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The Gray code begins half a period earlier than described."""
    values = _set_axes(_draw_axes(rng), -0.5 - setup.shown.period_px("x") / 2, -0.5)
    shown = replace(setup.shown, gray_origin_px=values)
    return _faulty(setup, ["gray-origin", "phase-offset"], shown=shown)


def _scale_cell(setup: CaptureSetup, rng: Rng, factor: float) -> FaultyCapture:
    """The Gray cells are described ``factor`` times as wide as they are."""
    cell = factor * setup.shown.gray_cell("x")
    causes = ["gray-cell"]
    # without fringes, codes outside the projector are all that shows
    causes += ["fringe-period"] if setup.kind in CODED else ["projector-size"]
    return _describe(_cover(setup), causes, gray_cell_px=cell)


def _renumber_bits(
    setup: CaptureSetup, causes: Sequence[str], renumber: Callable[[Frame], int]
) -> FaultyCapture:
    """The capture whose description has other numbers of bits."""
    frames = tuple(
        replace(f, bit=renumber(f)) if f.kind in ("gray", "inverse") else f
        for f in setup.described.frames
    )
    return _describe(setup, causes, frames=frames)


def _reverse_bits(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The bits are numbered from the least significant one."""
    return _renumber_bits(setup, ["bit-order"], lambda f: f.bits - 1 - f.bit)


def _exchange_bits(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The numbers of two bits are exchanged, along both axes."""
    fewest = min(f.bits for f in setup.shown.frames if f.kind == "gray")
    # the first bits of p18 may be the same all over a small projector
    a, b = (int(k) for k in fewest - 1 - rng.choice(min(fewest, 4), 2, replace=False))
    number = {a: b, b: a}
    bits = {f.axis: f.bits for f in setup.shown.frames if f.kind == "gray"}

    def renumber(frame: Frame) -> int:
        """The described number, counted back from the least significant bit."""
        shift = bits[frame.axis] - fewest
        return number.get(frame.bit - shift, frame.bit - shift) + shift

    return _renumber_bits(setup, ["bit-order", "frame-order"], renumber)


def _scale_period(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The finest period is described 12 % longer than it is.

    With Gray code half of the captures state the width of the cells; in the others it is the
    described period, so that all coordinates are too large.
    """
    finest = {axis: setup.shown.periods_px(axis)[-1] for axis in AXES}
    frames = tuple(
        replace(f, period_px=1.12 * f.period_px)
        if f.kind == "phase" and f.axis and f.period_px == finest[f.axis]
        else f
        for f in setup.described.frames
    )
    if setup.kind not in CODED:
        return _describe(setup, ["fringe-period"], frames=frames)
    if rng.random() < 0.5:
        cell = setup.shown.gray_cell("x")
        return _describe(setup, ["fringe-period", "gray-cell"], frames=frames, gray_cell_px=cell)
    return _describe(_cover(setup), ["fringe-period", "projector-size"], frames=frames)


def _exchange_axes(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The frames of x are described as those of y, and the other way round."""
    other: dict[Axis | None, Axis] = {"x": "y", "y": "x"}
    frames = tuple(replace(f, axis=other[f.axis]) if f.axis else f for f in setup.described.frames)
    return _describe(setup, ["axes-swapped"], frames=frames)


def _mirror_projector(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The projector shows everything mirrored along one axis."""
    causes = ["axis-reversed"] if setup.kind in BITS else ["axis-reversed", "step-order"]
    return _faulty(setup, causes, reversed=(AXES[rng.integers(2)],))


def _scale_projector(setup: CaptureSetup, rng: Rng, factor: float) -> FaultyCapture:
    """The projector is described ``factor`` times as large as it is."""
    size = tuple(round(factor * extent) for extent in setup.shown.projector)
    return _describe(_cover(setup), ["projector-size"], projector_size=size)


# The light


def _drift(setup: CaptureSetup, rng: Rng, share: float) -> FaultyCapture:
    """The exposure drifts by ``share`` over the capture."""
    n = _count(setup)
    gains = np.linspace(1, 1 - share, n)
    gains = gains[::-1] if rng.random() < 0.5 else gains
    return _faulty(setup, ["exposure-drift"], gains=tuple(gains.tolist()))


def _vary_exposure(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The exposure of each image differs at random by 5 %."""
    gains = 1 + 0.05 * np.clip(rng.standard_normal(_count(setup)), -2.5, 2.5)
    return _faulty(setup, ["exposure-drift"], gains=tuple(gains.tolist()))


def _bend_response(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """A linear projector gets a gamma of 2.2."""
    return _faulty(replace(setup, gamma=1.0), ["gamma"], gamma=2.2)


def _clip_cosine(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """A linear projector shows cosines of mean 40 and amplitude 215, clipped at 0."""
    levels = np.rint(40 + 215 * np.linspace(-1, 1, 256)).clip(0, 255).astype(int)
    shown = replace(setup.shown, levels=tuple(levels.tolist()))
    return _faulty(replace(setup, gamma=1.0), ["gamma", "saturation"], shown=shown)


def _switch_lamp(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """A lamp is switched on in the middle, of 30 % of the mean grey level."""
    k = _draw_middle(setup, rng, 0.35, 0.65)
    return _faulty(setup, ["room-light"], room_step=(k, 0.3))


# The scene


def _move(setup: CaptureSetup, rng: Rng, steadily: bool) -> FaultyCapture:
    """The scene moves by 1.5 camera pixels, or by 0.15 in each image, beside the optical axis and
    along it, so that the pattern on it moves as far.

    The one movement is during the steps of the finest period along the baseline, if there are any.
    """
    n, (beside, above) = _count(setup), setup.view.baseline
    angle, depth = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0]) / np.hypot(beside, above)
    direction = (float(np.cos(angle)), float(np.sin(angle)), float(depth))
    shifts = setup.shown.phase_shifts("x" if beside else "y")
    k = int(rng.choice(shifts[-1][1][1:])) if shifts else _draw_middle(setup, rng, 0.35, 0.65)
    motion = 0.15 * np.arange(n) if steadily else 1.5 * (np.arange(n) >= k)
    motion_px = tuple(motion.tolist())
    return _faulty(setup, ["moved"], motion_px=motion_px, direction=direction)


def _narrow_stripes(setup: CaptureSetup, rng: Rng) -> FaultyCapture:
    """The stripes of the last three bits are too narrow for the camera.

    The sound capture is of the same projector, in cells as wide as its camera resolves.
    """
    camera = setup.view.camera
    view = replace(setup.view, projector=(6 * camera[0], 6 * camera[1]), field=1.0)
    full_scale = setup.shown.full_scale
    fine, coarse = (
        replace(gray_code(view.projector, cell), full_scale=full_scale) for cell in (1.0, 8.0)
    )
    sound = replace(setup, view=view, shown=coarse, described=coarse, blur_px=0.5)
    return _faulty(sound, ["blur"], shown=fine, described=fine)


CAPTURE_FAULTS: Mapping[str, CaptureFault] = {
    "late from the start": CaptureFault(_late_from_start),
    "late from one frame on": CaptureFault(_late_from_frame),
    "frame missing": CaptureFault(_missing_frame),
    "neighbours exchanged": CaptureFault(_exchange_neighbours),
    "distant frames exchanged": CaptureFault(_exchange_distant),
    "frame repeated": CaptureFault(_repeat_frame),
    "foreign frame": CaptureFault(partial(_replace_frame, pattern=FOREIGN)),
    "black frame": CaptureFault(partial(_replace_frame, pattern=BLACK)),
    "steps reversed": CaptureFault(_reverse_steps, PHASE),
    # each order of three steps is a shift or a reversal
    "steps permuted": CaptureFault(_permute_steps, (*CODED, "micro")),
    "phase sign flipped": CaptureFault(_flip_sign, PHASE),
    "offset of a quarter period": CaptureFault(partial(_omit_offset, offset=np.pi / 2), PHASE),
    "offset of half a period": CaptureFault(partial(_omit_offset, offset=np.pi), PHASE),
    "Gray origin moved": CaptureFault(_move_origin, CODED),
    "Gray cell halved": CaptureFault(partial(_scale_cell, factor=0.5), BITS),
    "Gray cell doubled": CaptureFault(partial(_scale_cell, factor=2.0), BITS),
    "bits reversed": CaptureFault(_reverse_bits, BITS),
    "two bits exchanged": CaptureFault(_exchange_bits, BITS),
    "period 12 % too long": CaptureFault(_scale_period, PHASE),
    "axes exchanged": CaptureFault(_exchange_axes),
    "axis mirrored": CaptureFault(_mirror_projector),
    "projector too small": CaptureFault(partial(_scale_projector, factor=0.7)),
    "projector too large": CaptureFault(partial(_scale_projector, factor=1.5)),
    "drift of 8 %": CaptureFault(partial(_drift, share=0.08)),
    "drift of 30 %": CaptureFault(partial(_drift, share=0.3)),
    "random exposure": CaptureFault(_vary_exposure),
    "flicker": CaptureFault(_change("flicker", flicker=0.1)),
    "lamp switched on": CaptureFault(_switch_lamp),
    "saturated": CaptureFault(_change("saturation", clipped_share=0.3)),
    "dark": CaptureFault(_change("dark", exposure=0.025)),
    # few steps do not average it out
    "gamma 2.2": CaptureFault(_bend_response, FEW),
    "clipped cosine": CaptureFault(_clip_cosine, PHASE),
    "moved": CaptureFault(partial(_move, steadily=False)),
    "moving": CaptureFault(partial(_move, steadily=True)),
    "ghosting": CaptureFault(_change("ghosting", ghost=0.15)),
    "narrow stripes": CaptureFault(_narrow_stripes, ("gray",)),
}


def draw_faulty(fault: str, kind: CaptureKind, seed: int, pipeline: str = "") -> FaultyCapture:
    """A capture of a kind with a fault, seen through a pipeline, the same for the same seed."""
    own = crc32(f"{fault} {seed}".encode())  # other qualities for each fault
    return CAPTURE_FAULTS[fault].strike(draw_setup(kind, own, pipeline), np.random.default_rng(own))
