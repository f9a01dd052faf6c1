"""Captures from the terminal: real commands, with the simulated rig and with recordings."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from colour_camera import coloured
from facts import missing_facts, raises

from slviewer.cli import main
from slviewer.devices.drivers import Driver, drivers
from slviewer.devices.simulated import preset_rig
from slviewer.errors import Cancelled, DeviceError, InputError, SessionError
from slviewer.fringe.decode import decode
from slviewer.fringe.presets import p18
from slviewer.pipeline.capture import RigSettings, capture, set_camera
from slviewer.pipeline.capture_phases import capture_texture
from slviewer.pipeline.rig_choice import RigSetup, devices, set_up
from slviewer.session.store import Session
from slviewer.session.toml import to_toml
from slviewer.target.board import Board
from slviewer.target.detect import detect

BOARD = "circles:11x9:14"
RIG = {"driver": "simulated", "scale": 0.25}
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session with one pose in a single exposure, and one in three; and a rig's file beside
    it."""
    folder = tmp_path_factory.mktemp("captures")
    (folder / "rig.toml").write_text(to_toml({"what": "Quarter size.", **RIG, "exposure_ms": 0.9}))
    begin = ["capture", str(folder / "session")]
    rig = ["--rig", str(folder / "rig.toml"), "--board", BOARD]
    assert main([*begin, "pose_01", *rig]) == 0
    assert main([*begin, "pose_02", *rig, "--exposures-ms", "8", "0.5", "2"]) == 0
    return folder


@pytest.mark.computes
def test_what_the_file_and_the_command_say_is_what_is_kept(folder: Path):
    with Session.open(folder / "session") as store:
        one, three = store.captures("calibration")
    assert one.lens == three.lens and one.lens["focus"] == pytest.approx(3565, abs=1)
    known = {"purpose": "pose", "exposure_ms": 0.9, "gain": 1.0, "lens": one.lens}
    assert one.meta["settings"] == known
    assert one.meta["board"] == three.meta["board"] == BOARD
    assert one.exposures_ms == () and three.exposures_ms == (0.5, 2.0, 8.0)
    assert one.size == three.size == (400, 300) and one.meta["source"] == "simulated"


@pytest.mark.computes
def test_several_exposures_measure_the_dark_circles_and_find_the_board_where_it_is(folder: Path):
    with Session.open(folder / "session") as store:
        one, three = store.captures("calibration")
    board = Board.parse(BOARD)
    maps, pixels = [], []
    for shot in (one, three):
        frames = shot.frames
        maps.append(decode(shot.sequence, frames, "x"))
        pixels.append(detect(board, capture_texture(shot, frames)).pixels)
    assert np.abs(pixels[0] - pixels[1]).max() < 0.15  # single circles of 8 px, in other noise
    single, several = maps
    dark = (three.exposure_choice == 2) & single.mask & several.mask
    assert np.count_nonzero(dark) > 1000
    gain = np.median(single.sigma_phase[dark]) / np.median(several.sigma_phase[dark])
    assert 3 < gain < 10  # 9 times the light, whose own noise grows too
    # the first of both has the same noise
    both = single.mask & several.mask & (three.exposure_choice > 0)
    z = (single.phase - several.phase)[both] / np.hypot(single.sigma_phase, several.sigma_phase)[
        both
    ]
    assert (
        0.9 < np.median(np.abs(z)) / 0.6745 < 1.1
        and np.count_nonzero(np.abs(z) > 8) < 1e-3 * z.size
    )


@pytest.mark.computes
def test_a_recording_is_captured_again_to_the_last_bit(folder: Path, run: Run, tmp_path: Path):
    (tmp_path / "replay.toml").write_text(
        to_toml({"driver": "replay", "source": str(folder / "session")})
    )
    status, text, _ = run(
        "capture",
        tmp_path / "session",
        "scan_01",
        "--rig",
        tmp_path / "replay.toml",
        "--role",
        "scan",
    )
    assert status == 0 and not missing_facts(
        text, "scan_01", "400x300", "912x1140", "x and y", "32 frames"
    )
    with Session.open(folder / "session") as old, Session.open(tmp_path / "session") as new:
        again = new.load_capture("scan_01")
        np.testing.assert_array_equal(again.frames, old.load_capture("pose_01").frames)
    assert again.role == "scan" and again.meta["board"] is None
    status, _, error = run(
        "capture",
        tmp_path / "session",
        "scan_02",
        "--rig",
        tmp_path / "replay.toml",
        "--exposures-ms",
        1,
        2,
    )
    assert status == 1 and error


@pytest.mark.computes
def test_patterns_names_and_force(run: Run, tmp_path: Path):
    (tmp_path / "rig.toml").write_text(to_toml({**RIG, "scale": 0.1}))
    begin = ("capture", tmp_path / "session", "a", "--rig", tmp_path / "rig.toml")
    assert run(*begin, "--patterns", "p18", "--exposure-ms", 0.5)[0] == 0
    status, _, error = run(*begin)
    assert status == 1 and "--force" in error
    status, text, _ = run(*begin, "--force", "--patterns", "gray", "--exposures-ms", 1, 4)
    assert status == 0 and not missing_facts(text, "exposures 1, 4 ms")
    with Session.open(tmp_path / "session") as store:
        assert [folder.name[:2] for folder in (store.folder / "trash").iterdir()] == ["a-"]
        assert store.load_capture("a").sequence != p18((912, 1140))
    assert "exposures 1, 4 ms" in run("inspect", tmp_path / "session")[1]


@pytest.mark.parametrize(
    ("arguments", "status", "facts"),
    [
        (("--rig", "nothing"), 1, ["'nothing'", "simulated"]),
        (("--rig", "simulated", "--patterns", "zigzag"), 2, ["'zigzag'", "complementary", "p18"]),
        (("--rig", "simulated", "--exposures-ms", "4", "4"), 1, ["4", "once"]),
        (
            ("--rig", "simulated", "--exposures-ms", "4", "8", "--exposure-ms", "2"),
            1,
            ["exposure", "several"],
        ),
        (
            ("--rig", "simulated", "--auto-exposure", "--exposure-ms", "2"),
            1,
            ["exposure", "several"],
        ),
        (("--rig", "simulated", "--auto-exposure", "--budget-s", "0"), 1, ["above 0"]),
        (
            ("--rig", "simulated", "--auto-exposure", "--region", "900", "0", "5", "5"),
            1,
            ["region", "900 0 5 5"],
        ),
        (("--rig", "simulated", "--board", "squares:3"), 1, ["squares:3"]),
        (("--rig", "simulated", "--role", "pose"), 2, ["pose"]),
        ((), 2, ["--rig"]),
    ],
)
def test_capture_refuses_wrong_arguments_and_leaves_nothing(
    run: Run, tmp_path: Path, arguments, status: int, facts
):
    ended, _, error = run("capture", tmp_path / "session", "a", *arguments)
    assert ended == status and not missing_facts(error, *facts), error
    assert not (tmp_path / "session").exists()


@pytest.mark.computes
def test_a_capture_that_is_cancelled_leaves_nothing(tmp_path: Path):
    def stop(share: float, doing: str) -> None:
        if "frame 9 of" in doing:
            raise Cancelled("enough")

    with raises(Cancelled):
        capture(tmp_path / "session", "a", RIG, progress=stop)
    assert not (tmp_path / "session").exists()
    with raises(InputError, "a/b"):
        capture(tmp_path / "session", "a/b", RIG)


def test_a_disk_without_room_is_found_before_the_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    import shutil

    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=3_000_000))
    with raises(SessionError, "3.8 MB", "3.0 MB"):
        capture(tmp_path / "session", "a", RIG)


@pytest.mark.computes
def test_colours_are_kept(tmp_path: Path):
    def in_colour(choice, board) -> RigSetup:
        return RigSetup(coloured(set_up(choice, board).rig))

    shot = capture(tmp_path / "session", "a", {**RIG, "scale": 0.1}, role="scan", set_up=in_colour)
    assert shot.texture is not None and shot.texture.shape == (120, 160, 3)
    assert capture_texture(shot, shot.frames).shape == (120, 160, 3)


def test_devices_says_what_there_is(run: Run):
    status, text, _ = run("devices")
    assert status == 0
    missing = missing_facts(
        text,
        "simulated (turntable, rig)",
        "grbl (turntable)",
        "browser (camera, projector)",
        "projector page",
        "rigs:",
        "replay:",
    )
    assert not missing


def entries_of_drivers(text: str) -> dict[str, str]:
    """The lines on each driver of the list, by its name."""
    entries = re.split(r"\n(?! )", text)
    return {entry.split(" ")[0]: entry for entry in entries}


def test_devices_says_what_is_connected_and_what_is_missing(
    run: Run, monkeypatch: pytest.MonkeyPatch
):
    def none_to_ask() -> list[str]:
        raise DeviceError("no producer is installed: install one")

    def camera() -> None: ...

    for added in (
        Driver(
            "far",
            "nothing",
            packages={"no_such_package": "pip install it"},
            camera=camera,
            list_connected=lambda: ["never"],
        ),
        Driver(
            "near",
            "nothing",
            camera=camera,
            list_connected=lambda: ["the camera A", "the camera B"],
        ),
        Driver("empty", "nothing", camera=camera, list_connected=list),
        Driver("blind", "nothing", camera=camera, list_connected=none_to_ask),
    ):
        monkeypatch.setitem(drivers(), added.name, added)
    text = run("devices")[1]
    facts = (
        "no_such_package",
        "pip install it",
        "the camera A",
        "the camera B",
        "no producer is installed: install one",
    )
    assert not missing_facts(text, *facts)
    assert "never" not in text
    found = entries_of_drivers(text)
    assert "connected" not in found["far"] and "can be used" not in found["far"]
    assert "connected: the camera A\n" in found["near"] and "can be used" in found["near"]
    assert "connected: no device" in found["empty"] and "can be used" in found["empty"]
    assert "  connected:" not in found["blind"]


@pytest.mark.computes
def test_a_capture_that_is_saved_outlives_the_look_at_its_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from slviewer.pipeline import capture as module

    def interrupted(*_: object) -> list[str]:
        raise KeyboardInterrupt

    def refused(*_: object) -> list[str]:
        raise SessionError("the disk is full: free some space")

    monkeypatch.setattr(module, "load_or_save_examination", interrupted)
    with raises(KeyboardInterrupt):
        capture(tmp_path / "fresh", "a", {"driver": "simulated", "scale": 0.1})
    monkeypatch.setattr(module, "load_or_save_examination", refused)
    said: list[str] = []
    capture(tmp_path / "fresh", "b", {"driver": "simulated", "scale": 0.1}, warn=said.append)
    assert len(said) == 1 and not missing_facts(
        said[0], "b", "saved", "the disk is full: free some space"
    )
    with Session.open(tmp_path / "fresh") as store:
        assert [len(shot.frames) for shot in store.captures()] == [32, 32]


@pytest.mark.computes
def test_what_the_camera_took_in_place_of_a_setting_is_reported(tmp_path: Path):
    rig = preset_rig(scale=0.1)
    said: list[str] = []
    with rig.opened():
        set_camera(rig, {"exposure_ms": 1000.0}, RigSettings(gain=20.0, warn=said.append))
        assert [
            missing_facts(*note)
            for note in zip(said, ("100 ms", "16"), ("1000 ms", "20"), strict=True)
        ] == [
            [],
            [],
        ]
        said.clear()
        # rounding by a few percent is normal
        set_camera(rig, {}, RigSettings(exposure_ms=105.0, warn=said.append))
        rig.camera.notes = ("its exposure is 100 ms, 1000 ms were requested",)  # type: ignore[attr-defined]
        set_camera(rig, {}, RigSettings(exposure_ms=1000.0, warn=said.append))
    assert said == ["its exposure is 100 ms, 1000 ms were requested"]
    said.clear()
    capture(
        tmp_path / "fresh",
        "a",
        {"driver": "simulated", "scale": 0.1},
        exposures_ms=[0.5, 1000],
        warn=said.append,
    )
    assert any(not missing_facts(text, "100 ms", "1000 ms") for text in said)


def test_a_driver_that_fails_in_its_own_way_hides_no_other(monkeypatch: pytest.MonkeyPatch):
    def broken() -> list[str]:
        raise ImportError("libGenApi.so cannot be opened")

    for added in (
        Driver("broken", "a camera", list_connected=broken),
        Driver("whole", "a camera", list_connected=lambda: ["source 0: one"]),
    ):
        monkeypatch.setitem(drivers(), added.name, added)
    found = entries_of_drivers(devices())
    assert not missing_facts(found["broken"], "libGenApi.so", "ImportError")
    assert "connected: source 0: one" in found["whole"]
