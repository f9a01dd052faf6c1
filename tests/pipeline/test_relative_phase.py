"""A scan whose patterns do not cover the projector: measured where its depths are known, refused
where not."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts
from sound_checks import save_sound_checks

from slviewer.fringe.presets import multifrequency
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.session.store import Session
from slviewer.simulation.boards import FLAT, BoardScene, Pose
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

Run = Callable[..., tuple[int, str, str]]
RIG = letter(0.25, 3, local_distortion_px=0.0)
DEPTH = 600.0


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plate at 600 mm: with patterns that cover the projector, with periods of 128 and 16 px
    alone, and with these by a tool that did not state the projector's size."""
    absolute = multifrequency(RIG.projector.size, 4)
    finer = [i for i, f in enumerate(absolute.frames) if f.axis is None or f.period_px < 200]
    relative = PatternSequence(
        RIG.projector.size, tuple(absolute.frames[i] for i in finer), relative=True
    )
    pose = Pose(np.eye(3), np.array([-90.0, -70.0, DEPTH]))
    plate = BoardScene(pose, None, (0, 0), (180, 140), FLAT, np.zeros((0, 2)))
    frames = Renderer(RIG, plate).capture(absolute, 1)
    folder = tmp_path_factory.mktemp("relative") / "session"
    with Session.create(folder) as store:
        save_true_stereo(store, RIG)
        store.save_capture("absolute", "scan", absolute, frames, source="test")
        store.save_capture("relative", "scan", relative, frames[finer], source="test")
        unknown = replace(relative, projector_size=None, relative=False)
        store.save_capture("unknown", "scan", unknown, frames[finer], source="test")
        store.save_capture("pose", "calibration", relative, frames[finer], source="test")
        save_sound_checks(store)
    return folder


def depths(run: Run, session: Path, name: str, *options: object) -> tuple[np.ndarray, str]:
    """(h, w) mm, and the messages of the command."""
    grid = session / f"{name}.npy"
    status, _, messages = run("reconstruct", session, name, "--axis", "x", "--grid", grid, *options)
    assert status == 0, messages
    return np.load(grid)[..., 2], messages


@pytest.mark.parametrize("name", ["relative", "unknown"])
def test_a_depth_range_makes_the_phase_absolute(session: Path, run: Run, name: str) -> None:
    expected, _ = depths(run, session, "absolute")
    measured, messages = depths(run, session, name, "--depth-range", 520, 680)
    both = np.isfinite(expected) & np.isfinite(measured)
    assert both.sum() > 0.98 * np.isfinite(expected).sum()
    assert np.abs(measured - expected)[both].max() < 1e-3
    assert np.abs(np.median(measured[both]) - DEPTH) < 0.2
    assert not missing_facts(messages, "128 px", 520, "680 mm")


def test_another_range_masks_what_it_does_not_hold(session: Path, run: Run) -> None:
    status, _, error = run(
        "reconstruct", session, "relative", "--axis", "x", "--depth-range", 700, 760
    )
    assert status == 1 and error


def test_a_range_that_holds_several_depths_is_refused_with_one_that_does_not(
    session: Path, run: Run
) -> None:
    status, _, error = run(
        "reconstruct", session, "relative", "--axis", "x", "--depth-range", 300, 1500
    )
    assert status == 1 and not missing_facts(error, "128 px", 300, "1500 mm", "narrower"), error
    (far,) = re.findall(r"\b300 to (\d+) mm", error)
    assert 320 < int(far) < 600
    _, _, error = run("reconstruct", session, "relative", "--depth-range", 300, far)
    assert missing_facts(error, "narrower")


def test_without_any_range_it_asks_for_one(session: Path, run: Run) -> None:
    status, _, error = run("reconstruct", session, "relative")
    assert status == 1 and not missing_facts(error, "--depth-range")


def test_what_needs_coordinates_refuses_and_says_what_does_not(session: Path, run: Run) -> None:
    with Session.open(session, write=True) as store:
        if store.has_result("clouds/relative"):  # of another test, which gave a range
            store.trash_result("clouds/relative")
    for command in (
        ("verify", session, "relative", "--shape", "plane"),
        ("export", session, "cloud", "relative"),
        ("mesh", session, "relative"),
    ):
        status, _, error = run(*command)
        assert status == 1 and not missing_facts(error, "128 px", "--depth-range"), command


def test_calibrate_refuses_poses_without_coordinates(session: Path, run: Run) -> None:
    status, _, error = run("calibrate", session, "--target", "circles:21x16:9")
    assert status == 1 and not missing_facts(error, "pose", "128 px")


def test_decode_writes_it_as_it_is(session: Path, run: Run, tmp_path: Path) -> None:
    status, out, _ = run("decode", session, "unknown", "--out", tmp_path)
    assert status == 0 and not missing_facts(out, "128 px")
    assert json.loads((tmp_path / "decoded.json").read_text())["axes"]["x"]["unambiguous_px"] == 128


def test_an_absolute_capture_has_no_use_for_a_range(session: Path, run: Run) -> None:
    _, messages = depths(run, session, "absolute", "--depth-range", 520, 680)
    assert not missing_facts(messages, "absolute")
