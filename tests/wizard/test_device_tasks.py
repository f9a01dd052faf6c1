"""Other work on the devices' thread, captures in several exposures and in colour: they end as
captures do."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from colour_camera import coloured
from facts import missing_facts, raises
from test_acquisition import FRAMES, SEQUENCE, Bench, bench
from wizard_events import HANG_S, until

from slviewer.devices.protocols import CameraSettings
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.presets import complementary
from slviewer.pipeline.capture import save_frames
from slviewer.session.store import Session

__all__ = ["bench"]

pytestmark = pytest.mark.computes


def test_a_task_has_the_open_rig_and_everything_is_restored_after_it(bench: Bench) -> None:
    views = []
    results: list[float] = []

    def task(rig, progress) -> float:
        progress(0.0, "measuring the delay")
        rig.camera.apply(CameraSettings(0.2, 4.0))
        rig.projector.load(complementary(rig.projector.size, 4, 32.0))
        rig.projector.show(2)
        frame = np.empty((120, 160), np.uint8)
        rig.camera.grab(frame)
        progress(0.5, "measuring the light")
        views.append(bench.acquisition.view().capture)
        return float(frame.mean())

    with raises(DeviceError, "Checking the rig"):
        bench.acquisition.run_task("Checking the rig", task, results.append)
    bench.open()
    bench.previews_go_on()
    bright = bench.previews[-1].mean()
    bench.acquisition.run_task("Checking the rig", task, results.append)
    until(lambda: bool(results) and bench.acquisition.idle)
    assert 1 < results[0] < bright
    assert (views[0].name, views[0].stage, views[0].frame, views[0].frames) == (
        "Checking the rig",
        "measuring the light",
        50,
        100,
    )
    bench.previews_go_on()
    assert bench.rig.camera.settings() == CameraSettings(1.0, 1.0)
    assert bench.previews[-1].mean() == pytest.approx(bright, rel=0.02)
    assert bench.texts == []


def test_a_task_can_be_cancelled_and_waits_for_its_turn(bench: Bench) -> None:
    began, done = threading.Event(), []

    def task(rig, progress) -> None:
        rig.camera.apply(CameraSettings(0.1))
        began.set()
        while True:
            progress(0.3, "waiting")
            time.sleep(0.01)

    bench.open()
    bench.acquisition.capture(*bench.request("first"))
    bench.acquisition.run_task("Checking the rig", task, done.append)
    assert bench.acquisition.names() == ["first", "Checking the rig"] or began.is_set()
    assert began.wait(HANG_S)
    assert [name for name, _, _ in bench.saved] == ["first"] and not bench.acquisition.idle
    bench.acquisition.cancel()
    until(lambda: bench.acquisition.idle)
    assert missing_facts(
        bench.texts[0], "Checking the rig", "cancelled"
    ) == [] and bench.levels == ["info"]
    assert done == []
    bench.previews_go_on()
    assert bench.rig.camera.settings().exposure_ms == 1.0


def test_a_fault_in_a_task_is_treated_as_in_a_capture(bench: Bench) -> None:
    def lost(rig, progress) -> None:
        bench.faults.plan("unplugged", 1)
        rig.projector.load(SEQUENCE)
        rig.projector.show(1)
        rig.camera.grab(np.empty((120, 160), np.uint8))

    def refused(rig, progress) -> None:
        raise InputError("the scene is too dark: open the aperture")

    bench.open()
    bench.acquisition.run_task("Checking the rig", refused, lambda _: None)
    until(lambda: bool(bench.texts))
    assert bench.levels == ["error"]
    assert (
        missing_facts(
            bench.texts[0], "Checking the rig", "the scene is too dark: open the aperture"
        )
        == []
    )
    assert bench.acquisition.view().state == "open"
    bench.acquisition.run_task("Checking the rig", lost, lambda _: None)
    until(lambda: len(bench.texts) >= 3)
    assert missing_facts(bench.texts[1], "camera") == [] and bench.levels == [
        "error",
        "error",
        "good",
    ]
    bench.previews_go_on()


def test_a_capture_in_several_exposures_is_saved_whole(bench: Bench, tmp_path: Path) -> None:
    with Session.create(tmp_path / "session") as store:
        bench.open()
        bench.acquisition.capture(
            "pose_01",
            SEQUENCE,
            lambda taken: save_frames(store, "pose_01", "pose", taken),
            (4.0, 0.5),
        )
        until(lambda: bench.acquisition.idle)
        assert {capture.frames for capture in bench.progress} == {2 * FRAMES} and bench.texts == []
        capture = store.load_capture("pose_01")
        assert capture.exposures_ms == (0.5, 4.0) and capture.frames.shape == (FRAMES, 120, 160)
        assert capture.meta["settings"] == {"purpose": "pose", "gain": 1.0}
        assert 0.05 < np.mean(capture.exposure_choice) < 0.95
    bench.previews_go_on()
    assert bench.rig.camera.settings().exposure_ms == 1.0


def test_a_fault_while_exposures_change_leaves_no_capture_and_the_old_exposure(
    bench: Bench,
) -> None:
    bench.open()
    bench.faults.plan("unplugged", 5)
    bench.acquisition.capture(*bench.request("broken"), (0.5, 4.0))
    until(lambda: len(bench.texts) >= 2)
    assert missing_facts(bench.texts[0], "discarded") == [] and bench.levels == ["error", "good"]
    assert bench.saved == []
    bench.previews_go_on()
    assert bench.rig.camera.settings().exposure_ms == 1.0


def test_a_colour_camera_leaves_its_texture_in_the_session(bench: Bench, tmp_path: Path) -> None:
    bench.rig = coloured(bench.rig)
    with Session.create(tmp_path / "session") as store:
        bench.open()
        bench.acquisition.capture(
            "scan_01",
            SEQUENCE,
            lambda taken: save_frames(store, "scan_01", "scan", taken),
        )
        until(lambda: bench.acquisition.idle and bool(store.capture_names()))
        texture = store.load_capture("scan_01").texture
    assert texture is not None and texture.shape == (120, 160, 3)
    assert texture[..., 0].mean() == pytest.approx(0.8 * texture[..., 1].mean(), rel=0.02)


def test_what_the_camera_could_not_be_set_to_is_seen(bench: Bench) -> None:
    bench.rig.camera.notes = ("its gain cannot be set",)  # type: ignore[attr-defined]
    bench.open()
    assert bench.acquisition.view().notes == ("its gain cannot be set",)
    bench.acquisition.set_camera(CameraSettings(1000.0, 1.0))
    until(lambda: bench.acquisition.view().exposure_ms == 100)
    assert any(
        missing_facts(note, "100 ms", "1000 ms") == [] for note in bench.acquisition.view().notes
    )


def test_another_rig_ends_what_the_one_before_was_doing(bench: Bench) -> None:
    began, done = threading.Event(), []

    def task(rig, progress) -> None:
        while True:
            progress(0.1, "measuring")
            began.set()
            time.sleep(0.01)

    bench.open()
    bench.acquisition.set_light("dark")
    bench.acquisition.run_task("Checking the rig", task, done.append)
    assert began.wait(HANG_S)
    bench.acquisition.capture(*bench.request("waits"))
    other = replace(bench.rig, name="another")
    bench.acquisition.use(other)
    # not before the task has ended: nobody may close what it saves into
    assert not bench.acquisition.idle
    until(lambda: bench.acquisition.idle and bench.acquisition.view().state == "open")
    assert (bench.acquisition.view().name, bench.acquisition.view().light) == ("another", "white")
    assert not done and not bench.saved
    assert bench.levels == ["info", "info"]
    cancelled, dropped = sorted(bench.texts)
    assert (
        missing_facts(cancelled, "Checking the rig", "cancelled") == []
        and missing_facts(dropped, "waits") == []
    )


def test_a_camera_that_opens_and_gives_no_picture_is_reported_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.open()
    gone, opened = [True], []
    grab, opens = bench.rig.camera.grab, bench.rig.camera.open

    def no_picture(out: np.ndarray) -> None:
        if gone:
            raise DeviceError("the camera gave no frame: check its trigger")
        grab(out)

    monkeypatch.setattr(bench.rig.camera, "grab", no_picture)
    monkeypatch.setattr(bench.rig.camera, "open", lambda: (opened.append(1), opens()))
    until(lambda: len(opened) > 3)
    assert bench.texts == ["the camera gave no frame: check its trigger"]
    gone.clear()
    until(lambda: bench.acquisition.view().state == "open" and len(bench.texts) > 1)
    assert bench.levels == ["error", "good"]
