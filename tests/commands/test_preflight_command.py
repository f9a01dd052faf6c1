"""`slviewer preflight`: what it says, what it writes, and how it ends."""

import json
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts

from slviewer.cli import main
from slviewer.devices.drivers import Driver, drivers
from slviewer.devices.protocols import CameraSettings, Openable
from slviewer.devices.simulated import preset_rig
from slviewer.pipeline.rig_choice import save_rig
from slviewer.session.store import Session
from slviewer.session.toml import to_toml


class BlindCamera(Openable):
    """Looks elsewhere: noise that no projector changes."""

    size, dtype = (160, 120), np.dtype(np.uint8)
    notes = ("its gain cannot be set",)

    def __init__(self) -> None:
        super().__init__("the blind camera")
        self._rng = np.random.default_rng(0)

    def grab(self, out: np.ndarray) -> None:
        out[:] = np.clip(self._rng.normal(60, 2, out.shape), 0, 255)

    def settings(self) -> CameraSettings:
        return CameraSettings(8.0)

    def apply(self, settings: CameraSettings) -> CameraSettings:
        return self.settings()


@pytest.mark.computes
def test_a_sound_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Session.create(tmp_path / "session") as store:
        save_rig(store, "small", {"driver": "simulated", "scale": 0.25, "exposure_ms": 0.9})
    found = tmp_path / "found.json"
    arguments = [
        "preflight",
        "--rig",
        "small",
        "--session",
        str(tmp_path / "session"),
        "--json",
        str(found),
    ]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "good     screen: " in said and "settle_ms = " in said and "bad" not in said
    written = json.loads(found.read_text())
    assert written["verdict"] == "good" and 0.1 < written["seconds"] < 3600
    assert {check["name"] for check in written["checks"]} >= {
        "screen",
        "latency",
        "order",
        "flicker",
    }


def test_a_rig_that_is_not_fit_ends_with_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lamp = preset_rig(scale=0.1).projector
    blind = Driver("blind", "nothing", camera=BlindCamera, projector=lambda: lamp)
    monkeypatch.setitem(drivers(), "blind", blind)
    file = tmp_path / "blind.toml"
    file.write_text(to_toml({"camera": {"driver": "blind"}, "projector": {"driver": "blind"}}))
    assert main(["preflight", "--rig", str(file), "--json", str(tmp_path / "found.json")]) == 1
    said = capsys.readouterr()
    assert "bad " in said.out and "-> " in said.out
    assert "gain" in said.err
    assert json.loads((tmp_path / "found.json").read_text())["verdict"] == "bad"


class FailingCamera(BlindCamera):
    """Fails in the way of its maker's library, not of slviewer."""

    def __init__(self, fault: Exception) -> None:
        super().__init__()
        self.fault = fault

    def grab(self, out: np.ndarray) -> None:
        raise self.fault


@pytest.mark.parametrize(
    "fault", [OSError("vendor error 0x17"), TypeError("grab() takes no array")]
)
@pytest.mark.parametrize(
    "command", [["preflight"], ["capture", "session", "one"]], ids=["preflight", "capture"]
)
def test_a_fault_of_a_driver_is_named_as_such(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: list[str],
    fault: Exception,
) -> None:
    monkeypatch.chdir(tmp_path)
    lamp = preset_rig(scale=0.1).projector
    failing = Driver(
        "failing", "nothing", camera=lambda: FailingCamera(fault), projector=lambda: lamp
    )
    monkeypatch.setitem(drivers(), "failing", failing)
    Path("failing.toml").write_text(
        to_toml({"camera": {"driver": "failing"}, "projector": {"driver": "failing"}})
    )
    assert main([*command, "--rig", "failing.toml"]) == 1
    message = " ".join(capsys.readouterr().err.split())
    assert not missing_facts(
        message, "driver", "the blind camera", f"{type(fault).__name__}: {fault}", "maker"
    )


def test_a_rig_that_is_none_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["preflight", "--rig", "nothing"]) == 1
    assert "'nothing'" in capsys.readouterr().err
    assert main(["preflight"]) == 2
