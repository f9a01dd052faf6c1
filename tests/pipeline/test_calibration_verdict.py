"""The verdict in a session: kept with the calibration, and asked before it is used."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from copies import copy_session
from facts import missing_facts
from operations import reconstructed

from slviewer.calibration.observe import Smoothing
from slviewer.fringe.presets import p18
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate, choose_poses
from slviewer.pipeline.models import (
    available_models,
    load_last_verdict,
    load_stereo,
    rejection_reason,
    save_model,
    save_verdict,
    trash_models,
)
from slviewer.pipeline.poses import load_judged
from slviewer.records.verdict import Finding, Verdict
from slviewer.session.capture import NewCapture
from slviewer.session.store import Session
from slviewer.simulation.rig import letter
from tests.proofs.causes import BOARD, FaultBench

pytestmark = pytest.mark.computes


def test_frames_that_are_there_twice_count_once(tmp_path: Path) -> None:
    sequence = p18((64, 64))
    stacks = np.random.default_rng(0).integers(0, 256, (2, len(sequence.frames), 48, 64), np.uint8)
    poses = [NewCapture(f"pose_{k}", sequence, stacks[k % 2]) for k in range(5)]
    settings, warned = CalibrateSettings("circles:9x7:20"), list[str]()
    with Session.create(tmp_path / "session") as store:
        store.save_captures(poses, "calibration", board=str(settings.target))
        names, excluded = choose_poses(store, settings, warned.append)
        assert names == ["pose_0", "pose_1"]
        assert list(excluded) == ["pose_2", "pose_3", "pose_4"] and "pose_1" in excluded["pose_3"]
        assert len(warned) == 3 and not missing_facts(warned[0], "pose_2", "pose_0")
        without = replace(settings, exclude=["pose_0"])  # then a copy is used
        assert choose_poses(store, without, warned.append)[0] == ["pose_1", "pose_2"]


Run = Callable[..., tuple[int, str, str]]
POSES = 7


@pytest.fixture(scope="module")
def bench() -> FaultBench:
    return FaultBench(letter(0.2, 3), count=POSES, steps=6)


def fill(folder: Path, bench: FaultBench, period_px: float = 18.0, force: bool = False) -> None:
    """Save the poses, their fringes described as of this period."""
    frames = tuple(
        replace(f, period_px=period_px) if f.kind == "phase" else f for f in bench.sequence.frames
    )
    sequence = replace(bench.sequence, frames=frames)
    with Session.open_or_create(folder) as store:
        for i in range(POSES):
            name = f"pose_{i:02d}"
            store.save_capture(
                name,
                "calibration",
                sequence,
                bench.frames(i),
                source="test",
                board=BOARD,
                force=force,
            )


@pytest.fixture
def session(recorded: Path, tmp_path: Path) -> Path:
    """A copy of a session with a sound calibration."""
    others = shutil.ignore_patterns("object_*", "plane_*", "sphere_*")
    return copy_session(recorded / "session", tmp_path / "session", ignore=others)


@pytest.fixture
def made(bench: FaultBench, tmp_path: Path) -> Path:
    """A session of the bench, with a sound calibration."""
    fill(tmp_path / "made", bench)
    calibrate(tmp_path / "made", str(BOARD), models=("stereo", "pixelwise"))
    return tmp_path / "made"


@pytest.mark.slow
def test_a_verdict_is_told_and_kept(session: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "found.json"
    status, text, _ = run(
        "calibrate", session, "--target", BOARD, "--models", "stereo", "--json", out
    )
    assert status == 0 and not missing_facts(text, "good")
    assert json.loads(out.read_text())["calibration"]["stereo"]["verdict"] == {
        "level": "good",
        "findings": [],
    }
    assert not missing_facts(run("inspect", session)[1], "verdict", "good")
    with Session.open(session) as store:
        assert (
            store.state_of("verdict/1") == "fresh" and store.state_of("evidence/pose_01") == "fresh"
        )
        assert rejection_reason(store) == ""


def test_a_rejected_calibration_is_refused_by_every_command(
    session: Path, tmp_path: Path, run: Run
) -> None:
    finding = Finding("fringe-period", "rejected", "the period differs", "set period_px = 16")
    with Session.open(session, write=True) as store:
        stereo = load_stereo(store)
        verdict = Verdict((finding,))
        with store.together():
            trash_models(store, available_models(store))
            save_model(store, stereo, verdict, store.input_hashes(*stereo.poses))
            save_verdict(store, verdict, tuple(stereo.poses))
        verdict = load_last_verdict(store)
        assert (
            verdict is not None
            and verdict.level == "rejected"
            and verdict.causes == ("fringe-period",)
        )
        assert available_models(store) == ("stereo",)
        assert "period_px" in rejection_reason(store)
    refuse(session, "pose_01", "pose_02", tmp_path / "cloud.ply", run)
    status, _, error = run(
        "reconstruct", session, "pose_01", "--out", tmp_path / "cloud.ply", "--accept-rejected"
    )
    assert status == 0 and missing_facts(error, "rejected")
    # as a batch does, without the runner of operations
    made = reconstructed(session, "pose_01", out=tmp_path / "cloud.ply", accept_rejected=True)
    assert made.points > 0


def refuse(session: Path, pose: str, other: str, ply: Path, run: Run) -> None:
    """Have a rejected calibration refused by all that uses one."""
    for command in (
        ("reconstruct", session, pose, "--out", ply),
        ("reconstruct", session, pose, "--out", ply, "--model", "stereo"),
        ("verify", session, pose, "--shape", "plane"),
        ("merge", session, pose, other, "--reference", pose, "--out", ply),
    ):
        status, _, error = run(*command)
        assert status == 3 and not missing_facts(
            error, "rejected", "--accept-rejected", "period_px"
        )
    assert not ply.exists()


@pytest.mark.slow
def test_a_rejected_calibration_is_kept_and_refused(
    bench: FaultBench, made: Path, tmp_path: Path, run: Run
) -> None:
    session, ply = made, tmp_path / "cloud.ply"
    fill(session, bench, period_px=16.0, force=True)
    status, _, error = run("calibrate", session, "--target", BOARD)
    assert status == 3 and not missing_facts(error, "16 px")
    with Session.open(session) as store:
        verdict = load_last_verdict(store)
        assert (
            verdict is not None
            and verdict.level == "rejected"
            and verdict.causes[0] == "fringe-period"
        )
        # those of the poses before do not belong to it
        assert available_models(store) == ("stereo",)
        assert "period_px" in rejection_reason(store)
    refuse(session, "pose_00", "pose_01", ply, run)
    pose = ("pose_00", "--out", ply)
    status, _, error = run("reconstruct", session, *pose, "--accept-rejected")
    assert missing_facts(error, "rejected")
    # an attempt of which nothing comes does not make it any better
    assert run("calibrate", session, "--target", "circles:20x16:9")[0] == 3
    assert run("reconstruct", session, *pose)[0] == 3
    fill(session, bench, force=True)
    assert run("calibrate", session, "--target", BOARD, "--models", "stereo")[0] == 0
    assert run("reconstruct", session, *pose)[0] == 0 and ply.exists()


@pytest.mark.slow
def test_where_nothing_came_of_it_the_session_keeps_what_it_had(
    session: Path, tmp_path: Path, run: Run
) -> None:
    status, _, error = run(
        "calibrate", session, "--target", "circles:20x16:9", "--poses", "pose_0[1-4]"
    )
    assert status == 3 and not missing_facts(error, "21x16", "20x16")
    with Session.open(session) as store:
        assert available_models(store) == ("stereo", "pixelwise", "splined")
        verdict = load_last_verdict(store)
        assert verdict is not None and verdict.causes[0] == "board-size"
        again = load_judged(store, "pose_01", BOARD, Smoothing())
        assert again is None  # the pose was read for the other board
    assert run("reconstruct", session, "pose_01", "--out", tmp_path / "cloud.ply")[0] == 0


def test_a_description_that_contradicts_itself(session: Path, run: Run) -> None:
    with Session.open(session, write=True) as store:
        for shot in store.captures("calibration")[:3]:
            frames = tuple(
                replace(f, period_px=6.0) if f.kind == "phase" else f for f in shot.sequence.frames
            )
            sequence = replace(shot.sequence, frames=frames)
            store.save_capture(
                shot.name, "calibration", sequence, shot.frames, source="", board=BOARD, force=True
            )
    status, _, error = run("calibrate", session, "--target", BOARD, "--poses", "pose_0[1-3]")
    assert status == 3 and not missing_facts(error, "128 periods")
    with Session.open(session) as store:
        verdict = load_last_verdict(store)
        assert verdict is not None and verdict.causes == ("fringe-period",)


@pytest.mark.slow
def test_a_pose_that_moved_is_left_out_with_its_reason(
    bench: FaultBench, made: Path, run: Run
) -> None:
    session = made
    frames = bench.frames(2).copy()
    pose = bench.poses[2]
    half = len(frames) // 2
    frames[half:] = bench.render(replace(pose, t=pose.t + np.array([0.6, 0.2, 0.0])), 2)[half:]
    with Session.open(session, write=True) as store:
        store.save_capture(
            "pose_02", "calibration", bench.sequence, frames, source="test", board=BOARD, force=True
        )
    status, text, error = run("calibrate", session, "--target", BOARD, "--models", "stereo")
    assert status == 0 and not missing_facts(error, "pose_02")
    assert not missing_facts(text, "good", "pose_02")


@pytest.mark.slow
def test_gamma_below_five_steps_is_named_and_not_taken_for_another_period() -> None:
    three = FaultBench(letter(0.2, 3), count=6, steps=3)
    curve = np.round(255 * (np.arange(256) / 255) ** (1 / 2.2)).astype(np.uint8)
    sound = three.attempt(three.examine_clean())
    bent = three.attempt([three.examine(i, curve[three.frames(i)]) for i in range(6)])
    assert "gamma" not in sound.verdict.causes
    assert bent.verdict.level == "doubtful" and "gamma" in bent.verdict.causes
    assert "fringe-period" not in bent.verdict.causes


def test_calibrate_from_some_poses(session: Path, run: Run) -> None:
    chosen = ("--models", "stereo", "--poses", "pose_0[1-6]", "--exclude", "pose_06")
    status, text, error = run("calibrate", session, "--target", BOARD, "-v", *chosen)
    assert status == 0 and not missing_facts(text, "5 of 8") and error.count("excluded") == 0
    assert not missing_facts(text, "pose_06", "pose_07", "pose_08")
    status, _, error = run("calibrate", session, "--target", BOARD, "--exclude", "pose_9")
    assert status == 2 and not missing_facts(error, "'pose_9'", "pose_08")
