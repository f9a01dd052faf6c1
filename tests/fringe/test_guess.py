"""What the images of a capture show is guessed from the images alone, or left open."""

import tomllib
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts
from fringe_scene import variants

from slviewer.cli import main
from slviewer.devices.capture import capture_frames
from slviewer.devices.protocols import Rig
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.fringe.presets import (
    AXES,
    bits_for,
    complementary,
    gray,
    gray_bits,
    multifrequency,
    p18,
    phase_steps,
    short,
)
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.session.importers.frames import read_description
from slviewer.session.importers.guess import guess_sequence
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

PROJECTOR = (912, 1140)


def three_steps() -> PatternSequence:
    frames: list[Frame] = []
    for axis, extent in zip(AXES, PROJECTOR, strict=True):
        frames += [*phase_steps(axis, 3, 18.0), *gray_bits(axis, bits_for(extent / 18))]
    return PatternSequence(PROJECTOR, (*frames, Frame("texture")))


def with_white_and_black() -> PatternSequence:
    frames = [*gray_bits("x", 10), *gray_bits("y", 11), Frame("white"), Frame("black")]
    return PatternSequence(PROJECTOR, tuple(frames))


SEQUENCES = {
    "p18": lambda: p18(PROJECTOR),
    "gray": lambda: gray(PROJECTOR),
    "complementary 8": lambda: complementary(PROJECTOR),
    "complementary 4": lambda: complementary(PROJECTOR, 4, 24.0),
    "multifrequency": lambda: multifrequency(PROJECTOR, 6),
    "two periods": lambda: multifrequency(PROJECTOR, 4, [1300.0, 40.0]),
    "short": lambda: short(PROJECTOR, "x"),
    "three": three_steps,
    "white": with_white_and_black,
}


@cache
def rig_before_board() -> Rig:
    """A simulated rig that sees a board: its rays are traced for the first capture alone."""
    world = SimulatedWorld(letter(0.25, 0))
    world.place("board")
    return simulated_rig(world)


@cache
def taken(name: str) -> tuple[PatternSequence, np.ndarray]:
    rig, sequence = rig_before_board(), SEQUENCES[name]()
    with rig.opened():
        frames = np.array(capture_frames(rig, sequence))
    frames.setflags(write=False)
    return sequence, frames


@pytest.mark.parametrize("name", variants(SEQUENCES, "short", "white", "three"))
def test_presets_are_recognised(name: str) -> None:
    sequence, frames = taken(name)
    guess = guess_sequence(frames)
    assert guess.doubts == () and guess.sequence is not None
    for true, guessed in zip(sequence.frames, guess.sequence.frames, strict=True):
        assert (guessed.kind, guessed.axis, guessed.step, guessed.steps) == (
            true.kind,
            true.axis,
            true.step,
            true.steps,
        )
        assert (guessed.bit, guessed.bits) == (true.bit, true.bits)
    assert guess.sequence.phase_sign == 1 and guess.sequence.phase_offset_rad == 0
    for axis in sequence.axes:
        true_periods, periods = (np.array(s.periods_px(axis)) for s in (sequence, guess.sequence))
        np.testing.assert_allclose(
            periods, true_periods * (periods[-1:] / true_periods[-1:]), rtol=2e-3
        )
    is_scale_unknown = any(not missing_facts(note, "unknown") for note in guess.notes)
    assert is_scale_unknown == bool(sequence.periods_px(sequence.axes[0]))


def test_a_period_that_the_view_leaves_open_is_a_doubt() -> None:
    _, frames = taken("three")
    guess = guess_sequence(frames, PROJECTOR)
    assert [images[0] for images, _ in guess.doubts] == [0, 9]
    assert guess.sequence is not None and guess.sequence.projector_size == PROJECTOR


def test_gray_code_of_pixels_agrees_with_its_projector_alone() -> None:
    _, frames = taken("white")
    assert guess_sequence(frames, PROJECTOR).doubts == ()
    assert guess_sequence(frames, (4096, 1140)).doubts


@pytest.mark.parametrize(
    "name", variants(["gray", "complementary 4", "two periods"], "complementary 4")
)
def test_shuffled_and_dark_captures_are_unsure(name: str) -> None:
    _, frames = taken(name)
    rng = np.random.default_rng(1)
    assert guess_sequence(frames[rng.permutation(len(frames))]).doubts
    dark = rng.normal(3 + 0.004 * frames, 1.0).clip(0, 255).astype(np.uint8)
    assert guess_sequence(dark).doubts


def test_photographs_are_unsure() -> None:
    rng = np.random.default_rng(2)
    blur = [
        cv2.GaussianBlur(rng.random((240, 320)), (0, 0), s) for s in (2, 3, 5, 8, 9, 12, 15, 20)
    ]
    photographs = [255 * (b - b.min()) / np.ptp(b) for b in blur]
    assert guess_sequence(np.array(photographs, np.uint8)).doubts


def test_the_command_writes_a_description_that_is_read_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence, frames = taken("complementary 4")
    folder = tmp_path / "capture"
    folder.mkdir()
    for k, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"[{k}]_img.png"), frame)
    toml = tmp_path / "sequence.toml"
    assert main(["import", "frames", "--guess", str(folder), "--out", str(toml)]) == 0
    described = read_description(toml, PROJECTOR).sequence
    assert [f.kind for f in described.frames] == [f.kind for f in sequence.frames]
    assert missing_facts(toml.read_text(), "UNSURE", "fringes per cell") == ["UNSURE"]
    capsys.readouterr()
    # a doubt about an entry is a warning: the description is whole, and can be imported
    assert main(["import", "frames", "--guess", str(folder), "--projector", "912x1140"]) == 0
    out, err = capsys.readouterr()
    assert not missing_facts(out, "# UNSURE") and not missing_facts(err, "unsure")
    assert len(tomllib.loads(out)["frame"]) == len(frames)
    assert main(["import", "frames", str(folder)]) == 2
    assert main(["import", "frames", "--guess", str(folder), str(tmp_path / "session")]) == 2


def test_import_of_an_unknown_layout_says_what_the_images_suggest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, frames = taken("complementary 4")
    folder, session = tmp_path / "my images" / "part 1", tmp_path / "session"
    folder.mkdir(parents=True)
    for k, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"[{k}]_img.png"), frame)
    assert main(["import", "auto", str(tmp_path), str(session)]) == 1
    assert not missing_facts(capsys.readouterr().err, f"'{folder.parent}'")
    assert main(["import", "auto", str(folder.parent), str(session)]) == 1
    err = capsys.readouterr().err
    assert not missing_facts(err, "[0]_img.png to [3]_img.png: 4 phase steps along x", "--guess")
    assert not session.exists()
    toml = folder.parent / "sequence.toml"
    guess = ["--guess", str(folder.parent), "--projector", "912x1140", "--out", str(toml)]
    assert main(["import", "frames", *guess]) == 0
    assert main(["import", "auto", str(folder.parent), str(session)]) == 0
    assert not missing_facts(capsys.readouterr().out, "part_1")


@pytest.mark.slow
def test_images_whose_light_is_red_are_read_in_red(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, frames = taken("complementary 4")
    dark = np.full_like(frames[0], 3)
    for k, frame in enumerate(frames):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.dstack([dark, dark, frame]))
    assert main(["import", "frames", "--guess", str(tmp_path)]) == 1
    assert not missing_facts(capsys.readouterr().err, "--channel red")
    assert main(["import", "frames", "--guess", str(tmp_path), "--channel", "red"]) == 0
    assert len(tomllib.loads(capsys.readouterr().out)["frame"]) == len(frames)


@pytest.mark.parametrize(
    ("folder", "kinds"),
    [
        ("slmaster_david/L", "p" * 4 + "g" * 5 + "c"),
        pytest.param("kamino_procam_jpg90", "gi" * 20 + "wb", marks=pytest.mark.slow),
        pytest.param("sltk_shells/scan_0020", "gi" * 22, marks=pytest.mark.slow),
    ],
)
def test_real_captures_are_recognised(
    real_data: Path, tmp_path: Path, folder: str, kinds: str
) -> None:
    toml = tmp_path / "sequence.toml"
    assert main(["import", "frames", "--guess", str(real_data / folder), "--out", str(toml)]) == 0
    sequence = read_description(toml).sequence
    assert "".join(frame.kind[0] for frame in sequence.frames) == kinds
    half = kinds.count("g") // 2
    if "i" in kinds:
        assert [f.bit for f in sequence.frames if f.kind == "gray"] == [*range(half)] * 2
        assert [f.axis for f in sequence.frames if f.kind == "gray"] == ["x"] * half + ["y"] * half
    else:
        assert abs(sequence.offset_rad("x")) == pytest.approx(np.pi, abs=0.01)
