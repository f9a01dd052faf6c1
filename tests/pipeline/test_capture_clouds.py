"""Commands refuse a capture that does not belong to the session's calibration, whichever command it
is."""

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
from slviewer.pipeline.measure import measure
from slviewer.pipeline.models import lens_warnings
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.session.ply import read_ply
from slviewer.session.store import Session
from slviewer.simulation.boards import FLAT, BoardScene, Pose
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

Run = Callable[..., tuple[int, str, str]]
RIG = letter(0.1, 3, local_distortion_px=0.0)


@pytest.fixture(scope="module")
def captured() -> tuple[PatternSequence, np.ndarray]:
    """A plate at 600 mm, both axes."""
    sequence = multifrequency(RIG.projector.size, 4)
    plate = BoardScene(
        Pose(np.eye(3), np.array([-60.0, -50.0, 600.0])),
        None,
        (0, 0),
        (120, 100),
        FLAT,
        np.zeros((0, 2)),
    )
    renderer = Renderer(RIG, plate)
    return sequence, renderer.capture(sequence, 1)


@pytest.fixture
def session(tmp_path: Path, captured: tuple[PatternSequence, np.ndarray]) -> Path:
    """The plate as it is, as a scan of a projector twice the size, and by a camera that was
    cropped."""
    sequence, frames = captured
    with Session.create(tmp_path / "session") as store:
        save_true_stereo(store, RIG)
        store.save_capture("sound", "scan", sequence, frames, source="test")
        large = replace(sequence, projector_size=tuple(2 * n for n in RIG.projector.size))
        store.save_capture("large", "scan", large, frames, source="test")
        store.save_capture(
            "cropped", "scan", sequence, np.ascontiguousarray(frames[:, :-4]), source="test"
        )
        save_sound_checks(store)
    return tmp_path / "session"


@pytest.mark.slow
def test_every_command_refuses_other_sizes_and_names_both(session: Path, run: Run) -> None:
    for command in (
        ("reconstruct", session, "large"),
        ("verify", session, "large", "--shape", "plane"),
        ("mesh", session, "large"),
        ("merge", session, "sound", "--reference", "large"),
        ("measure", session, "large", "distance", "--at", 60, 60, "--at", 70, 60),
        ("export", session, "cloud", "large"),
    ):
        status, _, error = run(*command)
        assert status == 1 and not missing_facts(error, "1824x2280", "912x1140"), command
    status, _, error = run("reconstruct", session, "cropped")
    assert status == 1 and not missing_facts(error, "160x116", "160x120")


def test_a_sound_capture_is_measured_without_a_word(session: Path, run: Run) -> None:
    with Session.open(session, write=True) as store:
        store.trash_result("trust/sound")
    status, text, error = run("reconstruct", session, "sound")
    assert (status, error) == (0, "") and re.search(r"\b600 +600\b", text)


def test_an_inverted_calibration_is_refused_and_may_be_insisted_on(session: Path, run: Run) -> None:
    with Session.open(session, write=True) as store:
        save_true_stereo(store, RIG, R=RIG.R.T, T=-RIG.R.T @ RIG.t)
    for command in (
        ("reconstruct", session, "sound"),
        ("mesh", session, "sound"),
        ("export", session, "cloud", "sound"),
    ):
        status, _, error = run(*command)
        assert status == 1 and not missing_facts(error, "R", "T", "inverted"), error
    _, _, error = run("reconstruct", session, "sound", "--accept-rejected")
    assert not missing_facts(error, "R", "T", "inverted")


def test_a_lens_that_was_set_otherwise_since_the_calibration_is_named(session: Path) -> None:
    with Session.open(session, write=True) as store:
        sound = store.load_capture("sound")
        for name, role, focus in (
            ("pose_01", "calibration", 40.0),
            ("pose_02", "calibration", 41.0),
            ("same", "scan", 41.0),
            ("moved", "scan", 46.0),
        ):
            lens = {"lens": {"focus": focus}}
            store.save_capture(name, role, sound.sequence, sound.frames, settings=lens)
        meta = store.load_result("calibration/stereo", only=())[0]
        inputs = store.input_hashes("pose_01", "pose_02")
        own = {key: meta[key] for key in ("imported", "source", "camera", "projector")}
        store.save_result("calibration/stereo", own | {"inputs": inputs}, {})
        for name in ("sound", "same"):
            assert lens_warnings(store, store.load_capture(name)) == ()
        (warning,) = lens_warnings(store, store.load_capture("moved"))
    assert not missing_facts(warning, "moved", "focus", "46", "40 to 41")


def test_a_misfit_of_the_axes_reaches_every_uncertainty(session: Path) -> None:
    """Of a projector that nodded by 0.2 mrad since it was calibrated, seen by both axes."""
    settings = {"scan": "sound", "model": "stereo"}
    distance = {**settings, "what": "distance", "at": (60, 60, 100, 60)}
    plane = {**settings, "what": "plane", "ball": (0.0, 0.0, 600.0, 45.0)}
    sound = [measure(session, **each).only for each in (distance, plane)]
    nod = np.linalg.svd(np.array([[1, 0, 0], [0, 1, -2e-4], [0, 2e-4, 1]]))
    with Session.open(session, write=True) as store:
        R = nod.U @ nod.Vh
        save_true_stereo(store, RIG, R=R @ RIG.R, T=R @ RIG.t)
    bumped = [measure(session, **each).only for each in (distance, plane)]
    assert all(each.warnings == () for each in sound)
    for each in bumped:
        assert not missing_facts(each.warnings[0], "x and y", "px", "U was raised")
    before, after = (each[0]["distance"].U for each in (sound, bumped))
    assert 1.5 * before < after < 20 * before
    assert not bumped[0]["distance"].whole
    before, after = (np.trace(np.array(each[1].feature.scatter)) for each in (sound, bumped))
    assert after == pytest.approx(before, rel=0.2)  # the raise is in the part that fits share


def test_sigma_is_raised_where_the_axes_miss_each_other(
    session: Path, run: Run, tmp_path: Path
) -> None:
    assert run("reconstruct", session, "sound", "--out", tmp_path / "sound.ply")[0] == 0
    nod = np.array([[1, 0, 0], [0, 1, -2e-4], [0, 2e-4, 1]])
    turn = np.linalg.svd(nod)
    with Session.open(session, write=True) as store:
        save_true_stereo(store, RIG, R=turn.U @ turn.Vh @ RIG.R, T=turn.U @ turn.Vh @ RIG.t)
    status, _, error = run("reconstruct", session, "sound", "--out", tmp_path / "bumped.ply")
    assert status == 0 and "factor" in error
    sound, bumped = (
        read_ply(tmp_path / f"{name}.ply").scalars[kind]
        for name, kind in (("sound", "sigma_noise"), ("bumped", "sigma"))
    )
    assert np.median(bumped) > 5 * np.median(sound)
