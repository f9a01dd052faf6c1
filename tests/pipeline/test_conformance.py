"""The checks for plugins accept the drivers that come with slviewer, and name what a bad one
does."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts

from slviewer.devices.protocols import CameraSettings, Openable, check_frame
from slviewer.devices.simulated import SimulatedTurntable, simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import gray_bits, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.plugins import (
    check_board,
    check_camera,
    check_exporter,
    check_importer,
    check_projector,
    check_turntable,
)
from slviewer.session.importers.imported import (
    ImportableRecording,
    check_complete,
    define_layout,
    has_images,
    match_images,
)
from slviewer.session.importers.layouts import BUILT_IN, detect_layout, layouts
from slviewer.session.shape_files import Exporter
from slviewer.simulation.rig import letter
from slviewer.target.board import EXAMPLES

PATTERN = re.compile(r"shot(\d+)")


class Camera(Openable):
    """A camera that keeps the protocol, for the bad ones to differ from."""

    size, dtype = (64, 48), np.dtype(np.uint8)

    def __init__(self) -> None:
        super().__init__("a camera")

    def grab(self, out: np.ndarray) -> None:
        self.check_open()
        check_frame(self, out)
        out[:] = 99

    def settings(self) -> CameraSettings:
        return CameraSettings(10.0, 1.0)

    def apply(self, settings: CameraSettings) -> CameraSettings:
        return self.settings()


class LeavesARow(Camera):
    def grab(self, out: np.ndarray) -> None:
        self.check_open()
        check_frame(self, out)
        out[:-1] = 99


class TakesAnyArray(Camera):
    def grab(self, out: np.ndarray) -> None:
        self.check_open()
        out[:] = 99


class NeverClosed(Camera):
    def grab(self, out: np.ndarray) -> None:
        check_frame(self, out)
        out[:] = 99


class CloseRaises(Camera):
    def close(self) -> None:
        raise RuntimeError("the library is gone")


class AppliesNothing(Camera):
    def apply(self, settings: CameraSettings) -> None:  # type: ignore[override]
        return None


class Nameless(Camera):
    dtype = "uint16"

    def __init__(self) -> None:
        Openable.__init__(self, "")


class UnderstatesItsFullScale(Camera):
    full_scale = 64


class StatesNoFullScale(Camera):
    dtype = np.dtype(np.uint16)


class SizeInAList(Camera):
    size = [64, 48]  # type: ignore[assignment]  # noqa: RUF012


@pytest.mark.computes
def test_a_good_camera_has_no_fault():
    assert check_camera(Camera()) == []
    rig = simulated_rig(SimulatedWorld(letter(0.1)))
    assert check_camera(rig.camera) == [] and check_projector(rig.projector) == []
    assert check_turntable(SimulatedTurntable(SimulatedWorld(letter(0.1)))) == []


@pytest.mark.computes
def test_a_projector_that_takes_any_image_is_named(monkeypatch):
    rig = simulated_rig(SimulatedWorld(letter(0.1)))
    monkeypatch.setattr(rig.projector, "show_image", lambda image: None)
    faults = check_projector(rig.projector)
    assert len(faults) == 3
    assert not missing_facts(faults[0], "show_image", "InputError", "(1139, 912, 3)")


@pytest.mark.parametrize(
    ("camera", "facts"),
    [
        (LeavesARow(), ["64 of 3072 pixels"]),
        (TakesAnyArray(), ["shape"]),
        (NeverClosed(), ["before open"]),
        (CloseRaises(), ["the library is gone"]),
        (AppliesNothing(), ["apply", "CameraSettings"]),
        (UnderstatesItsFullScale(), ["full_scale", 64]),
        (StatesNoFullScale(), ["full_scale"]),
        (SizeInAList(), ["size", "[64, 48]", "tuple"]),
        (Nameless(), ["name", "empty"]),
        (Nameless(), ["dtype", "'uint16'"]),
    ],
)
def test_the_faults_of_a_bad_camera_are_listed(camera, facts):
    assert any(not missing_facts(fault, *facts) for fault in check_camera(camera))


@pytest.mark.parametrize("check", [check_camera, check_projector, check_turntable, check_exporter])
def test_a_class_in_place_of_an_object_is_named(check):
    (fault,) = check(Camera)
    assert not missing_facts(fault, "class", "Camera(...)")


def layout(describe=None, is_capture=None):
    def good(folder, name, projector):
        images, _ = match_images(folder, PATTERN)
        frames = tuple(phase_steps("x", 3, 30))
        return (
            ImportableRecording(
                name, PatternSequence(projector, frames), tuple(images.values()), folder
            ),
            [],
        )

    return define_layout(
        "shots",
        "images",
        describe or good,
        is_capture or (lambda f: has_images(f, PATTERN)),
        (90, 60),
    )


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    folder = tmp_path / "one"
    folder.mkdir()
    for k in range(3):
        cv2.imwrite(str(folder / f"shot{k}.png"), np.full((48, 64), 50 * k, np.uint8))
    return folder


def test_an_importer_that_reads_incomplete_captures_is_named(capture):
    assert any(not missing_facts(fault, "complete") for fault in check_importer(layout(), capture))


SHOWN = PatternSequence(
    (96, 72), (Frame("white"), Frame("black"), *phase_steps("x", 4, 12), *gray_bits("x", 3))
)


@pytest.fixture
def rendered(tmp_path: Path) -> Path:
    """A capture of the sequence SHOWN by a camera with the projector's own pixels, 16 bits with
    noise."""
    (folder := tmp_path / "rendered").mkdir()
    rng = np.random.default_rng(0)
    for k in range(len(SHOWN.frames)):
        image = 8 * (render_pattern(SHOWN, k) * 0.7 + 20.0) + rng.normal(
            0, 4, SHOWN.projector_size[::-1]
        )
        cv2.imwrite(str(folder / f"shot{k:02d}.png"), image.round().astype(np.uint16))
    return folder


@pytest.mark.computes
@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({}, ""),
        ({"phase_sign": -1}, "phase_sign"),
        ({"phase_offset_rad": 1.0}, "phase_offset_rad"),
        ({"gray_origin_px": 3.0}, "gray_origin_px"),
        ({"full_scale": 1023}, "1023"),
        ({"frames": (SHOWN.frames[1], SHOWN.frames[0], *SHOWN.frames[2:])}, "shot01"),
        # of three bits it is the same whether their numbers are reversed or two files exchanged
        ({"frames": (*SHOWN.frames[:6], *SHOWN.frames[:5:-1])}, "number them 2, 1, 0"),
        ({"frames": (*SHOWN.frames[:2], *phase_steps("x", 4, 6), *SHOWN.frames[6:])}, "period"),
    ],
    ids=["right", "sign", "offset", "origin", "full scale", "white", "bits", "period"],
)
def test_an_importer_that_misdescribes_frames_is_named_as_an_import_does(rendered, wrong, named):
    def describe(folder, name, projector):
        images, _ = match_images(folder, PATTERN)
        check_complete(images, "shot", len(SHOWN.frames))
        return (
            ImportableRecording(name, replace(SHOWN, **wrong), tuple(images.values()), folder),
            [],
        )

    faults = check_importer(layout(describe), rendered)
    assert len(faults) == bool(wrong) and all(named in fault for fault in faults), faults


def fails(*_):
    raise KeyError("oops")


@pytest.mark.parametrize(
    ("parts", "named"), [({"describe": fails}, "oops"), ({"is_capture": fails}, "oops")]
)
def test_an_importer_that_raises_is_named(capture, parts, named):
    assert any(named in fault for fault in check_importer(layout(**parts), capture))


def test_a_layout_that_fails_hides_no_other(capture, monkeypatch):
    broken = layout(is_capture=fails)
    assert not broken.recognises(capture) and not has_images(capture / "missing", PATTERN)
    monkeypatch.setitem(BUILT_IN, "broken", broken)
    monkeypatch.setitem(BUILT_IN, "shots", layout())
    assert detect_layout(capture) == "shots"
    assert {"p18", "broken", "shots"} <= set(layouts())


def test_a_capture_that_its_layout_cannot_describe_is_skipped_with_the_reason(capture):
    def half(folder, name, projector):
        if folder.name == "two":
            raise KeyError("oops")
        images, _ = match_images(folder, PATTERN)
        frames = tuple(phase_steps("x", 3, 30))
        return (
            ImportableRecording(
                name, PatternSequence(projector, frames), tuple(images.values()), folder
            ),
            [],
        )

    (capture.parent / "two").mkdir()
    (capture.parent / "two" / "shot0.png").write_bytes((capture / "shot0.png").read_bytes())
    imports = layout(half).read(capture.parent)
    assert [recording.name for recording in imports.recordings] == ["one"]
    assert "oops" in str(imports.skipped[0]) and "two" in str(imports.skipped[0])


@pytest.mark.slow
def test_boards_and_exporters():
    for notation in EXAMPLES.values():
        assert check_board(notation) == []
    assert check_exporter(Exporter("pts", "points", lambda shape, scalars, notes: b"1")) == []
    named = check_exporter(Exporter("PTS", "points", lambda shape, scalars, notes: "1"))  # type: ignore[arg-type,return-value]
    assert len(named) == 3
    assert check_exporter(Exporter("pts", "nothing", fails, takes_points=False))
