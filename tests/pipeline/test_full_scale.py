"""What a camera or a file states as its full scale is stored with the capture, and judges it
everywhere."""

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from decode_reference import decode_reference
from facts import missing_facts, raises

from slviewer.devices.protocols import Rig, stated_full_scale
from slviewer.devices.replay import replay
from slviewer.devices.simulated import SimulatedCamera, simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import InputError
from slviewer.fringe.decode import decode
from slviewer.fringe.layout import to_eight_bits
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.phase import Reason
from slviewer.fringe.presets import gray, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.pipeline.capture import capture
from slviewer.pipeline.capture_phases import capture_texture, loss_warnings
from slviewer.pipeline.examination import check_capture_exposure
from slviewer.pipeline.import_captures import import_captures
from slviewer.pipeline.rig_choice import RigSetup
from slviewer.preflight.check_rig import check_recorded_rig, preflight
from slviewer.session.importers.images import read_frames
from slviewer.session.store import Session
from slviewer.simulation.rig import letter
from slviewer.wizard.preview_watcher import brightness, reduced
from slviewer.wizard.result_views import make_thumbnail
from slviewer.wizard.snapshot import DIM

DARK, BRIGHT = 0.04, 3.0


class DeepCamera(SimulatedCamera):
    """The simulated camera with a higher full scale in a uint16; ``share`` of it is what 8 bits
    would be."""

    dtype = np.dtype(np.uint16)

    def __init__(self, world: SimulatedWorld, share: float, full_scale: int) -> None:
        super().__init__(world)
        self.share, self.full_scale = share, full_scale

    def grab(self, out: np.ndarray) -> None:
        """Fill `out` with scaled grey levels, clipped at the full scale."""
        self.dtype = np.dtype(np.uint8)
        eight = np.empty(out.shape, np.uint8)
        super().grab(eight)
        self.dtype = out.dtype
        out[:] = np.minimum(np.rint(eight * (self.share * self.full_scale / 255)), self.full_scale)


def deep_rig(share: float, full_scale: int = 4095) -> Rig:
    world = SimulatedWorld(letter(0.15, 0))
    world.place("object")
    rig = simulated_rig(world)
    return replace(rig, camera=DeepCamera(world, share, full_scale))


def captured(folder: Path, share: float, full_scale: int = 4095) -> list[str]:
    warnings: list[str] = []
    bench = RigSetup(deep_rig(share, full_scale))
    capture(
        folder, "a", {"driver": "test"}, role="scan", set_up=lambda *_: bench, warn=warnings.append
    )
    return warnings


@pytest.mark.computes
def test_a_dark_capture_is_dark_everywhere(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    warnings = captured(folder, DARK)
    assert any("3 % of the camera's range" in message for message in warnings), warnings
    with Session.open(folder) as store:
        shot = store.load_capture("a")
        shot.verify()
        assert shot.sequence.full_scale == 4095 and shot.meta["sequence"]["full_scale"] == 4095
        frames = shot.frames
        assert frames.dtype == np.uint16 and 100 < frames.max() < 200
        shown = capture_texture(shot, frames, stretch=False)
        assert 5 < shown.max() < 15 and capture_texture(shot, frames).max() == 255
        assert cv2.imdecode(np.frombuffer(make_thumbnail(shot), np.uint8), 0).max() < 20
        assert stated_full_scale(replay(frames, shot.sequence).camera) == 4095
    exposure = check_recorded_rig(folder, "a").check("exposure")
    assert (
        exposure.verdict == "bad" and 0.03 < exposure.figures["bright_share_of_full_scale"] < 0.05
    )
    lit = frames[np.argmax(frames.mean(axis=(1, 2)))]
    assert brightness(lit, 4095)[1] < 0.05 < DIM < brightness(lit)[1]
    assert reduced(lit, full_scale=4095)[0].max() < 15

    # a capture of before, which does not state it, is judged by its brightest pixel
    phases = {"x": decode(shot.sequence, frames, "x")}
    old = replace(shot.sequence, full_scale=None)
    with Session.create(tmp_path / "old") as store:
        saved = store.save_capture("a", "scan", old, frames, source="")
        assert saved.hash != shot.hash and "full_scale" not in saved.meta["sequence"]
        assert capture_texture(saved, frames, stretch=False).max() == 255
    assert check_capture_exposure(old, frames, phases).figures["bright_share_of_full_scale"] > 0.5


@pytest.mark.computes
def test_the_rig_is_judged_by_its_full_scale() -> None:
    rig = deep_rig(DARK)
    with rig.opened():
        exposure = preflight(rig).check("exposure")
    assert (
        exposure.verdict == "bad" and 0.03 < exposure.figures["bright_share_of_full_scale"] < 0.05
    )


@pytest.mark.computes
@pytest.mark.parametrize("full_scale", [4000, 4095])
def test_pixels_at_the_full_scale_are_saturated(tmp_path: Path, full_scale: int) -> None:
    folder = tmp_path / "session"
    warnings = captured(folder, BRIGHT, full_scale)
    assert any("saturated" in message for message in warnings), warnings
    with Session.open(folder) as store:
        shot = store.load_capture("a")
    frames, sequence = shot.frames, shot.sequence
    phase = decode(sequence, frames, "x")
    clipped = (phase.reason == Reason.SATURATED).mean()
    assert 0.05 < clipped < 0.9
    np.testing.assert_array_equal(
        decode_reference(sequence, frames, "x").reason == Reason.SATURATED, phase.reason == 2
    )
    assert any("saturated" in message for message in loss_warnings(sequence, frames, {"x": phase}))
    assert check_recorded_rig(folder, "a").check("exposure").figures["saturated_share"] > 0.05
    unstated = (
        decode(replace(sequence, full_scale=None), frames, "x").reason == Reason.SATURATED
    ).mean()
    assert unstated == clipped


def test_a_full_scale_that_the_frames_contradict_is_refused() -> None:
    sequence = PatternSequence(
        (64, 48), tuple(phase_steps("x", 4, 64.0)), relative=True, full_scale=1023
    )
    frames = np.stack([np.uint16(16) * render_pattern(sequence, k) for k in range(4)])
    with raises(InputError, "full_scale", 1023, 4080):
        decode(sequence, frames, "x")
    with raises(InputError, "full_scale", 1023, "uint8"):
        decode(sequence, (frames // 16).astype(np.uint8), "x")
    for wrong in (0, 70000):
        with raises(InputError, wrong):
            replace(sequence, full_scale=wrong)
    with raises(InputError, "full_scale"):
        PatternSequence.from_dict({**sequence.to_dict(), "full_scale": "twelve bits"})
    assert PatternSequence.from_dict(sequence.to_dict()) == sequence


def test_an_image_is_shown_by_its_full_scale() -> None:
    image = np.array([[0, 2000, 4000, 4095]], np.uint16)
    assert to_eight_bits(image, 4095).tolist() == [[0, 125, 250, 255]]
    assert to_eight_bits(image, 4000).tolist() == [[0, 128, 255, 255]]
    assert (
        to_eight_bits(image[:, :2], 4095).tolist() == [[0, 125]]
        and to_eight_bits(image // 16).max() == 255
    )


def png(image: np.ndarray, bits: int) -> bytes:
    """A PNG that states its significant bits."""
    data, chunk = cv2.imencode(".png", image)[1].tobytes(), b"sBIT" + bytes([bits])
    return (
        data[:33] + struct.pack(">I", 1) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
    )


def pgm(image: np.ndarray, largest: int) -> bytes:
    """A PGM that states its largest grey level."""
    return (
        f"P5\n{image.shape[1]} {image.shape[0]}\n{largest}\n".encode()
        + image.astype(">u2").tobytes()
    )


@pytest.mark.parametrize(
    ("name", "encode", "stated", "scale", "expected"),
    [
        ("a.png", png, 12, 1, 4095),
        ("a.png", png, 12, 128, 65520),
        ("a.png", png, 16, 1, None),
        ("a.pgm", pgm, 4095, 1, 4095),
        ("a.pgm", pgm, 65535, 1, None),
        ("a.pgm", pgm, 1000, 1, None),
    ],
)
def test_files_that_state_their_bits(tmp_path: Path, name, encode, stated, scale, expected) -> None:
    image = (np.arange(48, dtype=np.uint16) * 10 * scale).reshape(6, 8)
    (tmp_path / name).write_bytes(encode(image, stated))
    read = read_frames([tmp_path / name])
    np.testing.assert_array_equal(read.stack[0], image)
    assert (
        read.full_scale == expected
        and read_frames([tmp_path / name], full_scale=600).full_scale == 600
    )


def write_frames(folder: Path, order: list[int] | None = None, head: str = "") -> Path:
    """Fringes and a Gray code as dark PNGs of 12 bits, named from 00, with their TOML; the files in
    another order."""
    sequence = gray((120, 90))
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number, index in enumerate(order or range(len(sequence.frames))):
        image = render_pattern(sequence, index) * 0.5 + 40 + rng.normal(0, 1, (90, 120))
        assert cv2.imwrite(str(folder / f"{number:02d}.png"), image.round().astype(np.uint16))
    groups = "".join(f"[[frame]]\n{_toml(frame)}" for frame in sequence.frames)
    (folder / "frames.toml").write_text(f'projector = "120x90"\norder = "name"\n{head}{groups}')
    return folder


def _toml(frame: Frame) -> str:
    return "".join(f"{key} = {value!r}\n" for key, value in frame.to_dict().items())


@pytest.mark.computes
def test_a_description_states_the_full_scale(tmp_path: Path) -> None:
    warnings: list[str] = []
    source = write_frames(tmp_path / "a", head="full_scale = 4095\n")
    import_captures(source, tmp_path / "s", warn=warnings.append)
    assert any(not missing_facts(message, "camera's range") for message in warnings), warnings
    with Session.open(tmp_path / "s") as store:
        shot = store.load_capture("a")
    assert shot.sequence.full_scale == 4095 and shot.files[:2] == ("00.png", "01.png")
    source = write_frames(tmp_path / "b", head="full_scale = 100\n")
    with raises(InputError, "full_scale", 100):
        import_captures(source, tmp_path / "s")


@pytest.mark.computes
def test_messages_name_the_files_of_frames(tmp_path: Path) -> None:
    count = len(gray((120, 90)).frames)
    order = [*range(3), 4, 3, *range(5, count)]
    with raises(InputError, "4 (03.png)", "5 (04.png)"):
        import_captures(write_frames(tmp_path / "a", order), tmp_path / "s")
