"""A capture that was saved says which of its frames do not fit."""

import json

import pytest
from imperfect_rig import Imperfections, imperfect

from slviewer.devices.capture import capture
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.fringe.description_check import check_description
from slviewer.fringe.presets import complementary, gray, multifrequency, p18
from slviewer.fringe.residual import capture_residuals
from slviewer.pipeline.frame_residuals import (
    capture_warnings,
    describe,
    frame_warnings,
    save_residuals,
    warnings_of,
)
from slviewer.session.store import Session
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.slow


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
    assert capture_warnings(*taken(sequence_of, gamma, thing, seed)) == []


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"late": {6}}, "frame 7 shows the pattern of frame 6"),
        ({"repeated": {30}}, "frame 31 shows the pattern of frame 30"),
        ({"swapped": 4}, "frames 5 and 6 have changed places"),
        ({"dropped": 9}, "frame 10 is missing"),
        ({"lag": 1}, "on the camera is one image behind the projector"),
        ({"late": {21}}, "frame 22 shows the pattern of frame 21"),
    ],
)
def test_frames_that_do_not_fit_are_told(wrong, said):
    told = capture_warnings(*taken(**wrong))
    assert any(said in sentence for sentence in told), told
    assert len(told) <= 4


def test_residuals_are_kept_as_plain_values():
    sequence, stack = taken(late={6})
    found = capture_residuals(sequence, stack)
    plain = json.loads(json.dumps(describe(found)))
    assert [axis["axis"] for axis in plain] == ["x", "y"]
    assert len(plain[0]["frames"]) == 18 and plain[0]["suspects"][0]["frame"] == 6
    assert all(0.8 < frame["sigmas"] < 1.3 for frame in plain[1]["frames"])
    assert warnings_of(found, check_description(sequence, stack)) == capture_warnings(sequence, stack)


def test_what_was_kept_is_told_again(tmp_path):
    sequence, stack = taken(lag=1)
    with Session.create(tmp_path / "session") as session:
        session.save_capture("part", "scan", sequence, stack, source="a test")
        found = frame_warnings(session, "part", stack)
        assert found
        assert save_residuals(session, "part") == found == frame_warnings(session, "part", stack[:0])
