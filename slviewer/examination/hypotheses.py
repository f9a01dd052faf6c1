"""Hypotheses of faults: orders of the images, and changes of the description."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, permutations
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.examination.evaluate import Evaluator, Hypothesis, described
from slviewer.examination.limits import CHANGE_COST, LOST_COST, PER_FRAME_COST
from slviewer.fringe.sequence import Axis, Frame, Indices, Kind, PatternSequence, PerAxis
from slviewer.records.verdict import Cause

Change = Callable[..., Hypothesis]
"""Of a cause, a value, and a multiple of the cost, with the conventions as keywords."""
FRACTIONS, LEAST_TURNS = 16, 0.1
"""Parts of a period by which the phase may be shifted, and the least shift that harms and that blur
does not imitate: Gray code is unwrapped within a quarter."""
MOTIONS, JUMPS = (0.1, 0.2, 0.4, 0.8, 1.6), (0.12, 0.4)
"""Displacements in finest periods that are tried: from first to last image; in one."""


def list_orders(sequence: PatternSequence) -> Iterator[Hypothesis]:
    """Yield the orders that cameras and projectors make: a lag, a lost image, an exchange of
    neighbours, a frame that shows something else, and other orders of few phase steps; and those
    that names of files make: backwards, and with some that belong behind the last."""
    n = len(sequence.frames)
    yield from list_lags(sequence)
    kinds = [frame.kind for frame in sequence.frames]
    yield from (
        exchange(sequence, k, k + 1) for k in range(n - 1) if "texture" not in kinds[k : k + 2]
    )
    for k in range(1, n):
        shifted = lag_from(sequence, k), _miss(sequence, k)
        yield from (hypothesis for hypothesis in shifted if _moves_several(hypothesis))
    yield from _exchange_axes(sequence)
    for k in range(n):
        images = [None if i == k else i for i in range(n)]
        yield _order("duplicate-frame", sequence, images, (k,))
    yield from _permute_steps(sequence)
    every: list[int | None] = list(range(n))
    yield _reorder_files(sequence, every[::-1])
    for first in range(n):
        # of the first ones fewer are a lag
        for last in range(first + 4, n - 1) if first == 0 else range(first + 1, min(first + 4, n)):
            images = every[:first] + every[last:] + every[first:last]
            yield _reorder_files(sequence, images)


def _reorder_files(sequence: PatternSequence, images: Sequence[int | None]) -> Hypothesis:
    """Return the hypothesis of an order that the files' names made."""
    return replace(_order("frame-order", sequence, images), cost=3 * CHANGE_COST)


def list_lags(sequence: PatternSequence) -> Iterator[Hypothesis]:
    """Yield the orders of images that are all late, or early."""
    n = len(sequence.frames)
    for lag in (1, 2, 3, -1):
        images = [i + lag if 0 <= i + lag < n else None for i in range(n)]
        hypothesis = _order("frame-lag", sequence, images, value=lag)
        # what the lost images show is not explained
        yield replace(hypothesis, cost=hypothesis.cost + LOST_COST * abs(lag))


def _permute_steps(sequence: PatternSequence) -> Iterator[Hypothesis]:
    """Yield all orders of three or four phase steps, the same for all periods."""
    groups = [steps for axis in sequence.axes for _, steps in sequence.phase_shifts(axis)]
    for count in sorted({len(steps) for steps in groups if len(steps) <= 4}):
        for order in [*permutations(range(count))][1:]:
            yield _reorder(sequence, {s: order for s in groups if len(s) == count})


def _exchange_axes(sequence: PatternSequence) -> Iterator[Hypothesis]:
    """Yield the exchange of the phase steps of one axis with those of the other, and of the bits,
    where there are both."""
    kinds = [frame.kind for frame in sequence.frames]
    if len(sequence.axes) < 2 or not {"phase", "gray"}.issubset(kinds):
        return
    for own in (("phase",), ("gray", "inverse", "complementary")):
        x, y = ([i for i in sequence.select(axis) if kinds[i] in own] for axis in ("x", "y"))
        if x and [kinds[i] for i in x] == [kinds[i] for i in y]:
            images = list(range(len(kinds)))
            for i, j in zip(x, y, strict=True):
                images[i], images[j] = j, i
            yield _order("axes-swapped", sequence, images)


def list_neighbours(hypothesis: Hypothesis) -> Iterator[Hypothesis]:
    """Yield a lag, or a lost image, up to three frames earlier or later, and an offset of the phase
    up to a thirtieth of a period less or more."""
    if hypothesis.cause == "phase-offset" and hypothesis.axis and hypothesis.value is not None:
        for k in (-2, -1, 1, 2):
            offset = hypothesis.value + 2 * np.pi * k / (4 * FRACTIONS)
            sequence = change_conventions(
                hypothesis.sequence, hypothesis.axis, phase_offset_rad=offset
            )
            yield replace(hypothesis, sequence=sequence, value=offset, cost=1.5 * CHANGE_COST)
    if hypothesis.cause == "moved" and hypothesis.axis and hypothesis.value:
        shape = np.array(hypothesis.motion_px) / hypothesis.value
        for factor in (0.6, 0.8, 1.25, 1.6):
            px = factor * hypothesis.value
            yield _move(hypothesis.sequence, hypothesis.axis, shape, px)
    shift = {"frame-lag": lag_from, "missing-frame": _miss}.get(str(hypothesis.cause))
    if shift and len(hypothesis.frames) == 1:
        first = hypothesis.frames[0]
        for k in range(max(1, first - 3), min(len(hypothesis.images), first + 4)):
            neighbour = shift(hypothesis.sequence, k)
            if _moves_several(neighbour):
                yield neighbour


def exchange(sequence: PatternSequence, a: int, b: int) -> Hypothesis:
    """Return the hypothesis that two frames have changed places."""
    images: list[int | None] = list(range(len(sequence.frames)))
    images[a], images[b] = b, a
    first, second = sequence.frames[a], sequence.frames[b]
    is_reversal = first.kind == second.kind == "phase" and first.axis == second.axis
    hypothesis = _order("frame-order", sequence, images, (a, b))
    # in three or four steps that is the other sign of the phase as well
    is_reversal = is_reversal and first.steps <= 4
    if is_reversal:
        return replace(hypothesis, cost=4 * CHANGE_COST)
    # a bit and its inverse count backwards, as the other sign does
    is_inversion = {first.kind, second.kind} == {"gray", "inverse"} and first.bit == second.bit
    return replace(hypothesis, cost=1.5 * CHANGE_COST) if is_inversion else hypothesis


def recover_orders(evaluator: Evaluator, sequence: PatternSequence) -> Iterator[Hypothesis]:
    """Yield the orders of many phase steps in which their images lie on a circle.

    The frames less their mean span the plane of the vectors cos(2 pi k / n) and sin(2 pi k / n): in
    any orthonormal basis of this plane the position of a frame is its step, rotated or mirrored.
    """
    places: dict[Indices, np.ndarray] = {}
    for axis, sample in evaluator.sample.by_axis.items():
        for _, steps in sequence.phase_shifts(axis):
            n = len(steps)
            levels = sample.levels[list(steps), 1].astype(float)
            levels -= levels.mean(axis=0)
            basis = np.linalg.eigh(levels @ levels.T)[1][:, -2:]
            turns = np.arctan2(basis[:, 1], basis[:, 0]) * n / (2 * np.pi)
            turns -= np.angle(np.mean(np.exp(2j * np.pi * turns))) / (2 * np.pi)
            place = np.rint(turns).astype(int) % n
            steps_between = {int(d) for d in np.diff(place, append=place[:1]) % n}
            if n > 4 and len(set(place.tolist())) == n and steps_between not in ({1}, {n - 1}):
                # the same for all axes, which a basis of their own turns and mirrors
                place = (place - place[0]) % n
                places[steps] = min(place, -place % n, key=lambda each: each.tolist())
    for n in {len(place) for place in places.values()}:
        own = {steps: place for steps, place in places.items() if len(place) == n}
        for sign in (1, -1):
            for first in range(n):
                orders = {s: np.argsort((sign * p + first) % n).tolist() for s, p in own.items()}
                yield _reorder(sequence, orders)


def lag_from(sequence: PatternSequence, k: int) -> Hypothesis:
    """Return the hypothesis that image k repeats the one before, and later ones are late."""
    every = range(len(sequence.frames))
    return _order("frame-lag", sequence, [*every[:k], *every[k + 1 :], None], (k,), 1)


def _miss(sequence: PatternSequence, k: int) -> Hypothesis:
    """Return the hypothesis that the image of frame k is missing, and later ones are early."""
    every = range(len(sequence.frames))
    return _order("missing-frame", sequence, [*every[:k], None, *every[k:-1]], (k,))


def _moves_several(hypothesis: Hypothesis) -> bool:
    """Return whether several images show other patterns: of one alone, the next image need not be
    that of another pattern."""
    return sum(hypothesis.images[i] is not None for i in hypothesis.changed) > 1


def _reorder(sequence: PatternSequence, orders: Mapping[Indices, Sequence[int]]) -> Hypothesis:
    """Return the hypothesis that the images of phase steps, by their frames, come in other
    orders."""
    images: list[int | None] = list(range(len(sequence.frames)))
    for steps, order in orders.items():
        for k, i in enumerate(steps):
            images[i] = steps[order[k]]
    return replace(_order("step-order", sequence, images), cost=3 * CHANGE_COST)


def _order(
    cause: Cause,
    sequence: PatternSequence,
    images: Sequence[int | None],
    frames: tuple[int, ...] = (),
    value: float | None = None,
) -> Hypothesis:
    """Return the hypothesis of an order, which costs by the frames that it moves and loses; frames
    that are late or early from one on are moved by one event."""
    hypothesis = Hypothesis(cause, sequence, tuple(images), frames, value=value)
    changed = hypothesis.changed
    lost = sum(images[i] is None for i in changed)
    events = 1 if cause in ("frame-lag", "missing-frame") else len(changed)
    return replace(hypothesis, cost=PER_FRAME_COST * events + LOST_COST * lost)


def list_descriptions(sequence: PatternSequence, axis: Axis) -> Iterator[Hypothesis]:
    """Yield changes of the description of an axis: sign and offset of the phase, numbers of the
    bits, width and origin of the Gray cells, and the finest period."""
    bits, cell = len(sequence.find("gray", axis)), sequence.gray_cell(axis)

    def change(cause: Cause, value: float, times: float = 1.0, **values: float) -> Hypothesis:
        """Return the hypothesis of other conventions, which costs so many times a change."""
        changed = change_conventions(sequence, axis, **values)
        cost = times * CHANGE_COST
        return replace(described(changed), cause=cause, axis=axis, value=value, cost=cost)

    if shifts := sequence.phase_shifts(axis):
        yield from _list_phases(sequence, axis, len(shifts[-1][1]), change)
        yield from _scale_periods(sequence, axis)
    every = range(bits)
    numbers = [{b: bits - 1 - b for b in every}, *({a: b, b: a} for a, b in combinations(every, 2))]
    changes: list[Callable[[Frame], Frame]] = [partial(_renumber, n) for n in numbers if bits > 1]
    if sequence.find("inverse", axis):
        changes.append(_invert)
    for change_frame in changes:
        changed = change_frames(sequence, axis, change_frame)
        yield replace(described(changed), cause="bit-order", axis=axis, cost=CHANGE_COST)
    if bits > 1:
        other = described(replace(sequence, binary=not sequence.binary))
        yield replace(other, cause="bit-order", axis=axis, cost=CHANGE_COST)
    for ratio in (0.5, 2.0) if bits else ():
        yield change("gray-cell", cell * ratio, gray_cell_px=cell * ratio)
    for turns in (0.25, 0.5, 0.75) if bits and shifts else ():
        origin = sequence.origin_px(axis) + (turns - 1) * cell
        yield change("gray-origin", origin, 3, gray_origin_px=origin)


def list_motions(sequence: PatternSequence, axis: Axis) -> Iterator[Hypothesis]:
    """Yield displacements of the pattern along an axis: steady, and all at once in one image."""
    steps = [i for _, indices in sequence.phase_shifts(axis) for i in indices]
    if not steps:  # blur of stripes imitates motion
        return
    frames = sequence.select(axis)
    span, every = sequence.period_px(axis), np.arange(len(sequence.frames))
    steady = np.clip((every - frames[0]) / max(1, frames[-1] - frames[0]), 0, 1)
    for shape in (steady, *((every >= i) * 1.0 for i in steps)):
        for share in MOTIONS if shape is steady else JUMPS:
            for px in (-share * span, share * span):
                yield _move(sequence, axis, shape, px)


def _move(sequence: PatternSequence, axis: Axis, shape: np.ndarray, px: float) -> Hypothesis:
    """Return the hypothesis of a displacement by ``px`` in all, of a ``shape`` (n,) from 0 to 1."""
    motion = tuple((px * shape).tolist())
    cost = 1.5 * CHANGE_COST
    return replace(
        described(sequence), cause="moved", axis=axis, value=px, motion_px=motion, cost=cost
    )


def _list_phases(
    sequence: PatternSequence, axis: Axis, steps: int, change: Change
) -> Iterator[Hypothesis]:
    """Yield other signs and offsets of the phase: quarters of a period and whole steps; and other
    offsets of the described sign."""
    sign = sequence.sign(axis)
    usual, fine = (
        {round(j / m, 6) for m in each for j in range(m)} for each in ((4, steps), (FRACTIONS,))
    )
    for turns in sorted(usual | fine):
        offset = float(np.angle(np.exp(1j * (sequence.offset_rad(axis) + 2 * np.pi * turns))))
        values = {"phase_offset_rad": offset}
        if turns not in usual:
            if LEAST_TURNS < turns < 1 - LEAST_TURNS:
                yield change("phase-offset", offset, 1.5, **values)
            continue
        if turns:
            yield change("phase-offset", offset, **values)
        # steps in reverse order begin one step later as well
        times = 1 if turns == 0 else 2 if turns * steps % 1 < 1e-6 else 4
        yield change("step-order", -sign, times, phase_sign=-sign, **values)


def _scale_periods(sequence: PatternSequence, axis: Axis) -> Iterator[Hypothesis]:
    """Yield other periods, up to a quarter longer or shorter, of the finest beside bits, else of
    any of several, which the others contradict; in steps that change the phase by a third of a
    period over the projector, and to whole numbers of fringes."""
    bits, periods = sequence.find("gray", axis), sequence.periods_px(axis)
    cell = {"gray_cell_px": sequence.gray_cell(axis)} if bits else {}
    for old in periods[-1:] if bits else periods[::-1] if len(periods) > 1 else ():
        extent = sequence.extent(axis) if sequence.projector_size else 64 * periods[-1]
        count = int(np.clip(0.75 * extent / old, 6, 60))
        every = [old * float(np.exp(0.25 * k / count)) for k in range(-count, count + 1) if k]
        if sequence.projector_size:  # mostly a whole number of fringes
            whole = (extent / n for n in range(1, int(2 * extent / old) + 1))
            every += [px for px in whole if 1e-4 < abs(np.log(px / old)) < 0.25]
        for period in every:
            try:
                scaled = change_period(sequence, axis, old, period)
            except InputError:  # it is another of the periods
                continue
            changed = described(change_conventions(scaled, axis, **cell))
            yield replace(changed, cause="fringe-period", axis=axis, value=period, cost=CHANGE_COST)


def change_period(
    sequence: PatternSequence, axis: Axis, old_px: float, period_px: float
) -> PatternSequence:
    """Return the sequence with another period of an axis in place of an old one. Raises InputError
    where it is another of the periods."""
    return change_frames(
        sequence,
        axis,
        lambda f: replace(f, period_px=period_px) if f.period_px == old_px else f,
    )


def change_frames(
    sequence: PatternSequence, axis: Axis, change: Callable[[Frame], Frame]
) -> PatternSequence:
    """Return the sequence with each frame of an axis changed."""
    frames = (change(frame) if frame.axis == axis else frame for frame in sequence.frames)
    return replace(sequence, frames=tuple(frames))


def change_conventions(sequence: PatternSequence, axis: Axis, **values: float) -> PatternSequence:
    """Return the sequence with other conventions of one axis."""
    pairs: dict[str, Any] = {}
    for name, value in values.items():
        old = getattr(sequence, name)
        pair = list(old) if isinstance(old, PerAxis) else [old, old]
        pair["xy".index(axis)] = value
        pairs[name] = PerAxis(*pair)
    return replace(sequence, **pairs)


def _invert(frame: Frame) -> Frame:
    """Return a Gray bit as its inverse, or the other way round."""
    other: dict[Kind, Kind] = {"gray": "inverse", "inverse": "gray"}
    return replace(frame, kind=other.get(frame.kind, frame.kind))


def _renumber(number: Mapping[int, int], frame: Frame) -> Frame:
    """Return a frame with the other number of its bit, if it has one."""
    is_bit = frame.kind in ("gray", "inverse")
    return replace(frame, bit=number.get(frame.bit, frame.bit)) if is_bit else frame
