"""A capture that was saved says which of its frames do not fit."""

import json
from functools import cache

import numpy as np
import pytest
from facts import missing_facts

from slviewer.devices.capture import capture_frames
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.fringe.presets import complementary, gray, multifrequency, p18
from slviewer.fringe.sequence import one_axis
from slviewer.pipeline.examination import examine_frames, load_examination, load_or_save_examination
from slviewer.records.record import from_plain, to_plain
from slviewer.records.verdict import Examination
from slviewer.session.store import Session
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes


def placed_rig(gamma=1.0, thing="board", seed=0):
    world = SimulatedWorld(letter(0.15, seed, gamma=gamma))
    world.place(thing)
    return simulated_rig(world)


@cache
def captured(sequence_of, *scene):
    """A sequence and its frames (n, h, w), captured once for all tests."""
    rig = placed_rig(*scene)
    sequence = sequence_of(rig.projector.size)
    with rig.opened():
        return sequence, capture_frames(rig, sequence)


def captured_again(index):
    """Frame ``index`` of the board, in other noise."""
    rig = placed_rig()
    frame = np.empty(rig.camera.size[::-1], rig.camera.dtype)
    with rig.opened():
        rig.projector.load(p18(rig.projector.size))
        rig.projector.show(index)
        rig.camera.grab(frame)
    return frame


def displaced(late=None, repeated=None, dropped=None, swapped=None, lag=0, axes="xy"):
    """The sequence of a capture of the board, and frames that do not follow it.

    Frame ``late`` shows the pattern before; ``repeated`` is the image before once more; ``dropped``
    is lost, and all that follow come too early; ``swapped`` has changed places with the next one;
    all are ``lag`` images behind.
    """
    sequence, stack = captured(p18)
    order = np.arange(len(stack))
    if swapped is not None:
        order[[swapped, swapped + 1]] = swapped + 1, swapped
    if dropped is not None:
        order[dropped:] = np.minimum(order[dropped:] + 1, len(stack) - 1)
    if repeated is not None:
        order[repeated] -= 1
    frames = stack[np.maximum(order - lag, 0)]
    if late is not None:
        frames[late] = captured_again(late - 1)
    if dropped is not None:
        frames[-1] = captured_again(len(stack) - 1)
    if axes == "xy":
        return sequence, frames
    one = one_axis(sequence, axes)
    kinds = list(sequence.frames)
    return one, frames[[kinds.index(frame) for frame in one.frames]]


@cache
def examined_late():
    return examine_frames(*displaced(late=6))


@pytest.mark.parametrize(
    ("sequence_of", "scene"),
    [
        *(
            pytest.param(sequence_of, (2.2, "plane", 1), marks=pytest.mark.slow)
            for sequence_of in (p18, gray, complementary, multifrequency)
        ),
        (p18, ()),
        (complementary, (1.0, "object", 2)),
    ],
)
def test_sound_captures_have_no_warning(sequence_of, scene):
    """A camera of 240 pixels does not resolve stripes one projector pixel wide, and says so."""
    causes = [finding.cause for finding in examine_frames(*captured(sequence_of, *scene)).findings]
    assert causes == (["blur"] if sequence_of is gray else [])


@pytest.mark.parametrize(
    ("wrong", "facts"),
    [
        pytest.param({"repeated": 30}, ["frame 31", "frame 30"], marks=pytest.mark.slow),
        pytest.param({"swapped": 4}, [5, 6, "changed places"], marks=pytest.mark.slow),
        pytest.param({"dropped": 9}, ["frame 10", "missing"], marks=pytest.mark.slow),
        pytest.param({"lag": 1}, ["one image", "behind"], marks=pytest.mark.slow),
        pytest.param({"late": 21}, ["frame 22", "frame 21"], marks=pytest.mark.slow),
    ],
)
def test_frames_that_do_not_fit_are_reported(wrong, facts):
    messages = examine_frames(*displaced(**wrong)).warnings()
    assert any(not missing_facts(message, *facts) for message in messages), messages
    assert len(messages) <= 4


def test_a_late_frame_is_reported():
    (message,) = examined_late().warnings()
    assert not missing_facts(message, "frame 7", "frame 6")


def test_an_examination_survives_json():
    examination = examined_late()
    read = from_plain(json.loads(json.dumps(to_plain(examination))), Examination)
    assert read == examination and read.findings[0].frames == (6,)
    assert read.warnings() == examination.warnings() != []


def test_a_saved_examination_is_read_until_the_checks_change(tmp_path):
    sequence, stack = displaced(lag=1, axes="x")
    with Session.create(tmp_path / "session") as session:
        session.save_capture("part", "scan", sequence, stack, source="a test")
        assert load_examination(session, "part") is None
        saved = load_or_save_examination(session, session.load_capture("part"))
        assert load_examination(session, "part") == saved
        assert saved.findings[0].cause == "frame-lag" and len(saved.warnings()) <= 4
        meta, _ = session.load_result("trust/part")
        older = {key: meta[key] for key in ("inputs", "examination")}
        session.save_result("trust/part", {**older, "version": meta["version"] - 1}, {})
        assert load_examination(session, "part") is None
