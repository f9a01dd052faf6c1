"""What a description says is compared with the frames, and the hypothesis that explains them is
named."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from facts import missing_facts
from fringe_scene import variants

from slviewer.devices.capture import capture_frames
from slviewer.devices.protocols import Rig
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld, Thing
from slviewer.fringe.decode import decode
from slviewer.fringe.description_check import check_description
from slviewer.fringe.frame_light import detect_light_faults, estimate_frame_light
from slviewer.fringe.frame_likeness import FrameLikeness
from slviewer.fringe.line_sample import sample_lines
from slviewer.fringe.presets import (
    AXES,
    bits_for,
    complementary,
    gray,
    gray_bits,
    multifrequency,
    p18,
    phase_steps,
)
from slviewer.fringe.sequence import Frame, PatternSequence, PerAxis
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

PROJECTOR = (912, 1140)
Capture = tuple[PatternSequence, np.ndarray]


def three_steps() -> PatternSequence:
    frames: list[Frame] = []
    for axis, extent in zip(AXES, PROJECTOR, strict=True):
        frames += [*phase_steps(axis, 3, 18.0), *gray_bits(axis, bits_for(extent / 18))]
    return PatternSequence(PROJECTOR, (*frames, Frame("texture")))


def with_white_and_black() -> PatternSequence:
    frames = [frame for axis in AXES for frame in gray_bits(axis, 11)]
    return PatternSequence(PROJECTOR, (*frames, Frame("white"), Frame("black")))


def with_inverses() -> PatternSequence:
    frames: list[Frame] = []
    for axis in AXES:
        frames += phase_steps(axis, 5, 18.0)
        for bit in range(6 if axis == "x" else 7):
            frames += [Frame("gray", axis, bit=bit), Frame("inverse", axis, bit=bit)]
    return PatternSequence(PROJECTOR, tuple(frames))


SEQUENCES = {
    "p18": lambda: p18(PROJECTOR),
    "gray": lambda: gray(PROJECTOR),
    "complementary": lambda: complementary(PROJECTOR, 4, 24.0),
    "multifrequency": lambda: multifrequency(PROJECTOR, 6),
    "three": three_steps,
    "white": with_white_and_black,
    "inverses": with_inverses,
}
STEPS_AND_CODE = ["p18", "complementary", "three", "inverses"]


@cache
def rig_before(thing: Thing, gamma: float) -> Rig:
    """A simulated rig that sees a thing: its rays are traced for the first capture alone."""
    world = SimulatedWorld(letter(0.25, 0, gamma=gamma))
    world.place(thing)
    return simulated_rig(world)


@cache
def taken(name: str, thing: Thing = "board", gamma: float = 1.0) -> Capture:
    rig, sequence = rig_before(thing, gamma), SEQUENCES[name]()
    with rig.opened():
        frames = capture_frames(rig, sequence)
    frames.setflags(write=False)
    return sequence, frames


def causes(sequence: PatternSequence, frames: np.ndarray) -> list[tuple[str, str | None]]:
    return [(c.cause, c.axis) for c in check_description(sequence, np.array(frames))]


@pytest.mark.parametrize("name", variants(SEQUENCES, "three"))
@pytest.mark.parametrize(("thing", "gamma"), [("board", 1.0), ("object", 2.2)])
def test_a_right_description_is_not_doubted(name: str, thing: Thing, gamma: float) -> None:
    sequence, frames = taken(name, thing, gamma)
    assert causes(sequence, frames) == []
    dim = np.rint(frames * 0.15 + 20).astype(np.uint8)
    assert causes(sequence, dim) == []
    blurred = np.stack([cv2.GaussianBlur(frame, (0, 0), 0.8) for frame in frames])
    assert causes(sequence, blurred) == []


def late(frames: np.ndarray) -> np.ndarray:
    return np.roll(frames, 1, axis=0)


def early(frames: np.ndarray) -> np.ndarray:
    return np.roll(frames, -1, axis=0)


@pytest.mark.parametrize("name", variants(SEQUENCES, "three"))
def test_frames_that_are_all_late_are_named(name: str) -> None:
    sequence, frames = taken(name)
    found = check_description(sequence, late(frames))
    assert [(c.cause, c.value) for c in found] == [("frame-lag", 1.0)]


@pytest.mark.parametrize(
    "name", variants([name for name in SEQUENCES if name != "three"], "complementary")
)
def test_frames_that_are_all_early_are_named(name: str) -> None:
    """Of three steps the first may be missed, and nothing is left of that phase."""
    sequence, frames = taken(name)
    found = check_description(sequence, early(frames))
    assert [(c.cause, c.value) for c in found] == [("frame-lag", -1.0)]


EXCHANGED = [("p18", 4), ("gray", 24), ("complementary", 5), ("multifrequency", 20)]


@pytest.mark.parametrize(("name", "frame"), variants(EXCHANGED, ("complementary", 5)))
def test_exchanged_frames_are_named(name: str, frame: int) -> None:
    sequence, frames = taken(name)
    order = list(range(len(frames)))
    order[frame], order[frame + 1] = frame + 1, frame
    found = check_description(sequence, frames[order])
    assert found[0].cause == "frame-order"
    assert not missing_facts(found[0].message, f"frames {frame + 1} and {frame + 2}")


@pytest.mark.parametrize(
    ("name", "frame"),
    variants([("gray", 24), ("complementary", 16), ("white", 3)], ("complementary", 16)),
)
def test_a_missing_frame_is_named(name: str, frame: int) -> None:
    sequence, frames = taken(name)
    short = np.concatenate([np.delete(frames, frame, axis=0), frames[-1:]])
    found = check_description(sequence, short)
    assert (found[0].cause, found[0].value) == ("missing-frame", frame)


REPEATED = [("gray", 25), ("gray", 26), ("complementary", 7), ("inverses", 14)]


@pytest.mark.parametrize(("name", "frame"), variants(REPEATED, ("complementary", 7)))
def test_a_repeated_image_is_named(name: str, frame: int) -> None:
    sequence, frames = taken(name)
    repeated = frames.copy()
    repeated[frame] = frames[frame - 1]
    found = check_description(sequence, repeated)
    assert [(c.cause, c.value) for c in found] == [("duplicate-frame", float(frame))]
    assert not missing_facts(found[0].message, f"frame {frame + 1}", f"frame {frame}")


@pytest.mark.slow
@pytest.mark.parametrize("frame", [5, 6])
def test_room_light_among_gray_frames_is_corrected(frame: int) -> None:
    sequence, frames = taken("complementary")
    brighter = np.minimum(
        0.7 * frames + 60 * (np.arange(len(frames)) >= frame)[:, None, None], 255
    ).astype(np.uint8)
    assert check_description(sequence, brighter) == ()
    suspects = detect_light_faults(sequence, estimate_frame_light(sequence, brighter))
    assert [(s.fault, s.frame) for s in suspects] == [("room-light", frame)]
    for axis in AXES:
        # Copies, as kernels are compiled anew for arrays that cannot be written.
        truth, seen = (
            decode(sequence, stack.copy(), axis).coordinate for stack in (frames, brighter)
        )
        assert np.isfinite(seen).sum() > 0.99 * np.isfinite(truth).sum()
        # px; rounding to 0.7 of the levels
        assert 0.01 < np.sqrt(np.nanmean((seen - truth) ** 2)) < 0.08


@pytest.mark.parametrize(
    "name", variants([name for name in SEQUENCES if name != "multifrequency"], "three")
)
def test_bits_in_reverse_order_are_named(name: str) -> None:
    sequence, frames = taken(name)
    frames = frames.copy()
    for axis in AXES:
        for kind in ("gray", "inverse"):
            there = sequence.find(kind, axis)
            frames[there] = frames[there[::-1]]
    assert causes(sequence, frames) == [("bit-order", "x"), ("bit-order", "y")]


@pytest.mark.parametrize("name", variants(["gray", "inverses"], "inverses"))
def test_inverses_taken_for_patterns_are_named(name: str) -> None:
    sequence, frames = taken(name)
    frames = frames.copy()
    for axis in AXES:
        pattern, inverse = sequence.find("gray", axis), sequence.find("inverse", axis)
        frames[pattern + inverse] = frames[inverse + pattern]
    found = check_description(sequence, frames)
    assert [(c.cause, c.axis) for c in found] == [("bit-order", "x"), ("bit-order", "y")]
    assert not any(missing_facts(c.message, "inverse") for c in found)


@pytest.mark.parametrize("name", variants(SEQUENCES, "three"))
def test_exchanged_axes_are_named(name: str) -> None:
    sequence, frames = taken(name)
    other = {"x": "y", "y": "x", None: None}
    exchanged = replace(
        sequence, frames=tuple(replace(f, axis=other[f.axis]) for f in sequence.frames)
    )
    assert causes(exchanged, frames) == [("axes-swapped", None)]


@pytest.mark.parametrize(
    "kinds", [["phase"], pytest.param(["gray", "complementary"], marks=pytest.mark.slow)]
)
def test_steps_or_bits_of_the_other_axis_are_named(kinds: list[str]) -> None:
    sequence, frames = taken("complementary")
    x, y = (
        [i for i, f in enumerate(sequence.frames) if f.axis == axis and f.kind in kinds]
        for axis in AXES
    )
    order = np.arange(len(frames))
    order[x], order[y] = y, x
    assert causes(sequence, frames[order])[0][0] == "axes-swapped"


@pytest.mark.slow
def test_bits_in_reverse_order_after_the_complementary_one_are_named() -> None:
    sequence, frames = taken("complementary")
    order = np.arange(len(frames))
    for axis in AXES:
        places = [
            i
            for i, f in enumerate(sequence.frames)
            if f.axis == axis and f.kind in ("gray", "complementary")
        ]
        order[places] = places[::-1]
    assert causes(sequence, frames[order]) == [("bit-order", "x"), ("bit-order", "y")]


@pytest.mark.slow
@pytest.mark.parametrize(
    "steps", [[*range(0, 18, 2), *range(1, 18, 2)], [k // 2 + 9 * (k % 2) for k in range(18)]]
)
def test_all_steps_in_another_order_are_named(steps: list[int]) -> None:
    sequence, frames = taken("p18")
    order = np.arange(len(frames))
    places = np.array(sequence.find("phase", "y"))
    order[places] = places[steps]
    (contradiction,) = check_description(sequence, frames[order])
    assert (contradiction.cause, contradiction.axis) == ("step-order", "y")
    assert not missing_facts(contradiction.message, ", ".join(map(str, steps)))


@pytest.mark.slow
def test_a_lamp_that_saturates_the_later_frames_is_named() -> None:
    sequence, frames = taken("p18")
    lamp = np.where(np.arange(len(frames)) >= 20, 170, 0)[:, None, None]
    switched_on = np.clip(frames.astype(int) + lamp, 0, 255).astype(np.uint8)
    (contradiction,) = check_description(sequence, switched_on)
    assert (contradiction.cause, contradiction.value) == ("room-light", 20.0)
    assert not missing_facts(contradiction.message, "frame 21")


@pytest.mark.parametrize("name", variants(STEPS_AND_CODE, "three"))
def test_the_sign_of_one_axis_is_named(name: str) -> None:
    sequence, frames = taken(name)
    found = check_description(replace(sequence, phase_sign=PerAxis(1, -1)), frames)
    assert [(c.cause, c.axis, c.value) for c in found] == [("step-order", "y", 1.0)]


@pytest.mark.slow
def test_the_sign_of_one_axis_mirrors_a_phase_without_code() -> None:
    sequence, frames = taken("multifrequency")
    found = check_description(replace(sequence, phase_sign=PerAxis(-1, 1)), frames)
    assert (found[0].cause, found[0].axis, found[0].value) == ("step-order", "x", 1.0)


@pytest.mark.parametrize("name", variants(STEPS_AND_CODE, "three"))
def test_steps_in_reverse_order_are_named(name: str) -> None:
    sequence, frames = taken(name)
    steps = tuple(
        replace(f, step=f.steps - 1 - f.step) if f.kind == "phase" else f for f in sequence.frames
    )
    found = check_description(replace(sequence, frames=steps), frames)
    assert [(c.cause, c.axis) for c in found] == [("step-order", "x"), ("step-order", "y")]
    assert not any(missing_facts(c.message, "reverse") for c in found)


@pytest.mark.parametrize("name", variants(["p18", "complementary", "three"], "three"))
@pytest.mark.parametrize("turns", [0.25, 0.5])
def test_a_stated_origin_is_compared_with_the_fringes(name: str, turns: float) -> None:
    sequence, frames = taken(name)
    period = sequence.period_px("x")
    found = check_description(replace(sequence, gray_origin_px=-0.5 + turns * period), frames)
    origins = [c.value for c in found if c.cause == "gray-origin"]
    assert origins == pytest.approx([-0.5, -0.5], abs=0.15)
    offsets = [c.value for c in found if c.cause == "phase-offset"]
    assert np.abs(offsets) == pytest.approx(2 * np.pi * turns, abs=0.06)
    assert found[0].cause == ("gray-origin" if turns == 0.5 else "phase-offset")


def test_steps_that_begin_later_are_named_with_the_offset() -> None:
    sequence, frames = taken("complementary")
    steps = tuple(
        replace(f, step=(f.step - 1) % 4) if f.kind == "phase" else f for f in sequence.frames
    )
    found = check_description(replace(sequence, frames=steps), frames)
    assert found[0].cause == "phase-offset"
    assert found[0].value == pytest.approx(np.pi / 2, abs=0.03)


CELLS = [("p18", 16.0), ("p18", 36.0), ("three", 20.25), ("complementary", 27.0)]


@pytest.mark.parametrize(("name", "cell"), variants(CELLS, ("three", 20.25)))
def test_cells_unlike_the_fringes_are_named(name: str, cell: float) -> None:
    """The frames' cells are as wide as their period; described is a period for which they would not
    be."""
    sequence, frames = taken(name)
    true = sequence.period_px("x")
    described = tuple(
        replace(f, period_px=true**2 / cell) if f.kind == "phase" else f for f in sequence.frames
    )
    bits = replace(sequence, frames=described, gray_cell_px=true)
    found = check_description(bits, frames)
    assert found[0].cause == "gray-cell"
    assert found[0].value == pytest.approx(true**2 / cell, rel=0.003)


@pytest.mark.parametrize("name", variants(["gray", "p18", "multifrequency", "three"], "three"))
def test_a_projector_that_is_too_small_is_named(name: str) -> None:
    sequence, frames = taken(name)
    found = check_description(replace(sequence, projector_size=(600, 1140)), frames)
    assert (found[0].cause, found[0].axis) == ("projector-size", "x")
    assert 660 < (found[0].value or 0) < 700


@pytest.mark.parametrize(
    ("spoil", "cause"),
    [
        (lambda frames: (frames * 0.01).astype(np.uint8), "dark"),
        (lambda frames: np.full_like(frames, 255), "saturation"),
        (lambda frames: np.repeat(frames[-1:], len(frames), axis=0), "dark"),
    ],
)
def test_frames_without_a_pattern_are_named(
    spoil: Callable[[np.ndarray], np.ndarray], cause: str
) -> None:
    sequence, frames = taken("three")
    found = check_description(sequence, spoil(frames))
    assert [c.cause for c in found] == [cause]
    assert not missing_facts(found[0].message, "0.0 %")


def test_a_dim_wall_does_not_decide() -> None:
    """Half of the image sees the patterns by scattered light alone: dimly, and a third of a period
    away."""
    sequence, frames = taken("complementary")
    dim = np.rint(np.roll(frames, 41, axis=2) * 0.06 + 5).astype(np.uint8)
    both = np.concatenate([frames, dim], axis=2)
    assert causes(sequence, both) == []


@pytest.mark.slow
def test_frames_of_no_pattern_that_was_described_are_unreadable() -> None:
    sequence, frames = taken("complementary")
    order = np.random.default_rng(3).permutation(len(frames))
    assert [cause for cause, _ in causes(sequence, frames[order])][-1] in (
        "unreadable",
        "frame-order",
    )


def test_three_frames_may_be_saturated_and_repeated() -> None:
    sequence = PatternSequence((320, 240), tuple(phase_steps("x", 3, 360.0)))
    angle = 2 * np.pi * np.arange(320) / 360
    frames = np.stack(
        [np.tile(140 + 130 * np.cos(angle - 2 * np.pi * k / 3), (240, 1)) for k in (0, 1, 1)]
    )
    found = check_description(sequence, np.clip(frames, 0, 255).astype(np.uint8))
    assert found and found[0].cause in ("saturation", "frame-repeated", "step-order", "unreadable")


def test_inverses_may_be_captured_in_another_order_than_their_bits() -> None:
    sequence, frames = taken("inverses")
    blurred = np.stack([cv2.GaussianBlur(frame, None, 16.0) for frame in frames])
    last = [i for axis in AXES for i in reversed(sequence.find("inverse", axis))]
    order = [*(i for i in range(len(frames)) if i not in last), *last]
    turned = replace(sequence, frames=tuple(sequence.frames[i] for i in order))
    as_captured, by_bit = (
        FrameLikeness(each, sample_lines(each, stack))._finest
        for each, stack in ((turned, blurred[order]), (sequence, blurred))
    )
    # the finest bits are blurred to one grey
    assert as_captured == by_bit and max(by_bit.values()) < 6
