"""A capture that was saved says which of its frames do not fit."""

import json

import pytest
from facts import missing_facts
from imperfect_rig import Imperfections, imperfect

from slviewer.devices.capture import capture
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.fringe.presets import complementary, gray, multifrequency, p18
from slviewer.pipeline.frame_check import FrameCheck, check_frames, load_check, save_check
from slviewer.session.store import Session
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes


def taken(sequence_of=p18, gamma=1.0, thing="board", seed=0, **wrong):
    world = SimulatedWorld(letter(0.2, seed, gamma=gamma))
    world.place(thing)
    rig, _ = imperfect(simulated_rig(world), Imperfections(**wrong))
    sequence = sequence_of(rig.projector.size)
    with rig.opened():
        return sequence, capture(rig, sequence)


@pytest.mark.parametrize(
    ("sequence_of", "gamma", "thing", "seed"),
    [
        *((sequence_of, 2.2, "plane", 1) for sequence_of in (p18, gray, complementary, multifrequency)),
        (p18, 1.0, "board", 0),
        (complementary, 1.0, "object", 2),
    ],
)
def test_sound_captures_are_saved_without_a_word(sequence_of, gamma, thing, seed):
    assert check_frames(*taken(sequence_of, gamma, thing, seed)).warnings() == []


@pytest.mark.parametrize(
    ("wrong", "facts"),
    [
        ({"late": {6}}, ["frame 7", "frame 6"]),
        ({"repeated": {30}}, ["frame 31", "frame 30"]),
        ({"swapped": 4}, [5, 6, "changed places"]),
        ({"dropped": 9}, ["frame 10", "missing"]),
        ({"lag": 1}, ["one image", "behind"]),
        ({"late": {21}}, ["frame 22", "frame 21"]),
    ],
)
def test_frames_that_do_not_fit_are_reported(wrong, facts):
    messages = check_frames(*taken(**wrong)).warnings()
    assert any(not missing_facts(message, *facts) for message in messages), messages
    assert len(messages) <= 4


def test_a_check_survives_json():
    check = check_frames(*taken(late={6}))
    plain = json.loads(json.dumps(check.to_json()))
    assert [axis["axis"] for axis in plain["axes"]] == ["x", "y"]
    assert len(plain["axes"][0]["frames"]) == 18 and check.suspects[0].frame == 6
    assert all(0.8 < frame["sigmas"] < 1.3 for frame in plain["axes"][1]["frames"])
    read = FrameCheck.from_json(plain)
    assert read.suspects == check.suspects and read.warnings() == check.warnings() != []
    assert read.axes[1].frames[3].rms == pytest.approx(check.axes[1].frames[3].rms, abs=1e-4)


def test_a_saved_check_is_read_until_the_checks_change(tmp_path):
    sequence, stack = taken(lag=1)
    with Session.create(tmp_path / "session") as session:
        session.save_capture("part", "scan", sequence, stack, source="a test")
        assert load_check(session, "part") is None
        saved = save_check(session, session.load_capture("part"))
        assert saved.warnings() and load_check(session, "part").warnings() == saved.warnings()
        meta, _ = session.load_result("trust/part")
        session.save_result("trust/part", {**meta, "version": meta["version"] - 1}, {})
        assert load_check(session, "part") is None
