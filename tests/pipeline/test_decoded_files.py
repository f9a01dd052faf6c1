"""`slviewer decode`: the files hold what was decoded, and say what they hold."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts
from sound_checks import save_sound_checks

from slviewer.devices.capture import capture_frames
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.fringe.phase import Reason
from slviewer.fringe.presets import complementary, gray
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.capture_phases import decode_capture
from slviewer.session.store import Session
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

Run = Callable[..., tuple[int, str, str]]


Captured = tuple[PatternSequence, np.ndarray]


def captured(sequence_of: Callable) -> Captured:
    world = SimulatedWorld(letter(0.15, 0))
    world.place("sphere")
    rig = simulated_rig(world)
    sequence = sequence_of(rig.projector.size)
    with rig.opened():
        return sequence, capture_frames(rig, sequence)


@pytest.fixture(scope="module")
def part() -> Captured:
    """A sphere in patterns of both axes: the sequence, and its frames (n, h, w), only to be
    read."""
    return captured(complementary)


def recorded_session(folder: Path, sequence: PatternSequence, stack: np.ndarray) -> Path:
    with Session.create(folder) as store:
        store.save_capture("part", "scan", sequence, stack, source="a test")
    return folder


def read_exr(path: Path) -> np.ndarray:
    """The one channel of an uncompressed EXR of 32-bit floats, by the offsets that the file
    states."""
    data = path.read_bytes()
    assert struct.unpack_from("<2i", data) == (20000630, 2)
    at, window = 8, (0, 0, 0, 0)
    while data[at]:
        name, kind = data[at:].split(b"\0", 2)[:2]
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<i", data, at)
        if name == b"dataWindow":
            window = struct.unpack_from("<4i", data, at + 4)
        assert name != b"compression" or data[at + 4] == 0
        at += 4 + size
    height, width = window[3] + 1, window[2] + 1
    offsets = struct.unpack_from(f"<{height}Q", data, at + 1)
    return np.stack([np.frombuffer(data, "<f4", width, offset + 8) for offset in offsets])


@pytest.mark.slow
@pytest.mark.parametrize("file_format", [pytest.param("npy", marks=pytest.mark.slow), "exr"])
def test_files_hold_what_was_decoded(
    tmp_path: Path, run: Run, part: Captured, file_format: str
) -> None:
    session, out = recorded_session(tmp_path / "session", *part), tmp_path / "out"
    with Session.open(session, write=True) as store:
        save_sound_checks(store)
    status, text, _ = run("decode", session, "part", "--out", out, "--format", file_format)
    assert status == 0
    with Session.open(session) as store:
        phases = decode_capture(store.load_capture("part"))

    def load(name: str) -> np.ndarray:
        file = out / described["files"][name]
        return np.load(file) if file.suffix == ".npy" else read_exr(file)

    described = json.loads((out / "decoded.json").read_text())
    for axis, phase in phases.items():
        stored, coordinate, sigma = (
            load(f"{name}_{axis}") for name in ("phase", "coordinate", "sigma")
        )
        assert stored.dtype == coordinate.dtype == np.float32
        assert np.array_equal(stored, phase.phase, equal_nan=True)
        assert np.array_equal(load(f"modulation_{axis}"), phase.modulation)
        assert np.allclose(
            2 * np.pi * coordinate / phase.period_px, stored, equal_nan=True, rtol=1e-6
        )
        file = out / described["files"][f"reason_{axis}"]
        reason = (
            np.load(file) if file.suffix == ".npy" else cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        )
        assert reason.dtype == np.uint8 and np.array_equal(reason, phase.reason)
        assert np.array_equal(reason == Reason.VALID, np.isfinite(stored)) and np.array_equal(
            np.isfinite(sigma), np.isfinite(stored)
        )
        figures = described["axes"][axis]
        assert sum(figures["shares"].values()) == pytest.approx(1, abs=1e-4)
        assert figures["shares"]["valid"] == pytest.approx(np.isfinite(stored).mean(), abs=1e-5)
        assert figures["median_sigma_px"] == pytest.approx(np.nanmedian(sigma), rel=1e-5)
        assert not missing_facts(text, f"axis {axis}", f"{100 * figures['shares']['valid']:.1f} %")
    assert set(described["reasons"]) == {str(int(reason)) for reason in Reason}
    picture = cv2.imread(str(out / "decoded.png"))
    assert picture.shape[1] > 1000 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


@pytest.mark.slow
def test_gray_code_alone_states_its_quantisation(tmp_path: Path, run: Run) -> None:
    session, out = recorded_session(tmp_path / "session", *captured(gray)), tmp_path / "out"
    assert run("decode", session, "part", "--out", out)[0] == 0
    axes = json.loads((out / "decoded.json").read_text())["axes"]
    assert all(
        axis["steps"] == 0 and axis["median_sigma_px"] == pytest.approx(0.29, abs=0.005)
        for axis in axes.values()
    )


@pytest.mark.slow
def test_frames_that_do_not_fit_are_reported(tmp_path: Path, run: Run, part: Captured) -> None:
    sequence, stack = part
    order = np.arange(len(stack))
    order[[4, 5]] = 5, 4
    session = recorded_session(tmp_path / "session", sequence, stack[order])
    status, _, warnings = run("decode", session, "part", "--out", tmp_path / "out")
    assert status == 0 and not missing_facts(warnings, 5, 6)


def test_an_unknown_format_is_refused(tmp_path: Path, run: Run) -> None:
    assert run("decode", tmp_path, "part", "--out", tmp_path / "out", "--format", "tiff")[0] == 2
