"""The patterns of other tools, made here by their own formulae: a camera that sees them decodes its
own pixels."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.fringe.decode import decode
from slviewer.session.capture import NewCapture
from slviewer.session.importers import layouts

COLUMNS, ROWS = 640, 120
SIZE = (COLUMNS, ROWS)
U, V = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))


def write(path: Path, pattern: np.ndarray) -> None:
    """What a camera of the projector's size records of a pattern in 0 ... 1."""
    path.parent.mkdir(parents=True, exist_ok=True)
    seed = [int(byte) for byte in path.name.encode()]
    noise = np.random.default_rng(seed).normal(0, 0.7, U.shape)
    assert cv2.imwrite(str(path), np.rint(30 + 190 * pattern + noise).astype(np.uint8))


def cosines(steps: int, pitch: float, at: np.ndarray) -> list[np.ndarray]:
    """SLStudio's pstools::computePhaseVector."""
    return [
        0.5 * (1 + np.cos(2 * np.pi * at / pitch - 2 * np.pi * k / steps)) for k in range(steps)
    ]


def bit_of(at: np.ndarray, place: int) -> np.ndarray:
    """Bit of that place value, 0 the finest, of the Gray code of an integer coordinate."""
    return ((at ^ (at >> 1)) >> place) & 1


def decoded_error(capture: NewCapture, axis: str) -> np.ndarray:
    """px, where decoded; most of the frame must be."""
    phase = decode(capture.sequence, capture.merged_frames(), axis)
    assert phase.mask.mean() > 0.9
    return (phase.coordinate - (U if axis == "x" else V))[phase.mask]


def slstudio_frames(codec: str) -> list[np.ndarray]:
    """Both axes, or the columns alone for the codecs of one axis."""
    if codec == "gray":
        # of 10 and of 7
        bits = [bit_of(U, 9 - p) for p in range(10)] + [bit_of(V, 6 - p) for p in range(6)]
        return [np.ones(U.shape), np.zeros(U.shape), *bits]
    frames: list[np.ndarray] = []
    for at, extent in ((U, COLUMNS), (V, ROWS)):
        if codec == "2x3":
            frames += cosines(3, extent / 16, at) + cosines(3, extent, at)
        elif codec == "nstep":
            frames += cosines(9, extent / 8, at) + cosines(3, extent, at)
    return frames or cosines(int(codec), COLUMNS, U)


@pytest.mark.computes
@pytest.mark.parametrize(
    ("codec", "least", "most"),
    [("2x3", 0.0, 0.3), ("nstep", 0.0, 0.3), ("3", 0.1, 3.0), ("4", 0.1, 3.0), ("gray", 0.0, 0.6)],
)
def test_slstudio_codecs_give_the_projectors_pixels(tmp_path, codec, least, most):
    for number, pattern in enumerate(slstudio_frames(codec)):
        write(tmp_path / "scan" / f"frameSeq_{number}.bmp", pattern)
    assert layouts.detect_layout(tmp_path) == "slstudio"
    (capture,) = layouts.SLSTUDIO.read(tmp_path, projector=SIZE, codec=codec)
    assert capture.sequence.axes == (("x",) if codec in "34" else ("x", "y"))
    assert capture.sequence.sign("x") == -1
    error = decoded_error(capture, "x")
    assert least <= np.sqrt(np.mean(error**2)) < most and abs(np.median(error)) < 0.1
    if codec == "gray":
        assert capture.sequence.gray_cell("x") == 1 and capture.sequence.gray_cell("y") == 2


def test_slstudio_frames_that_fit_several_codecs_need_its_name(tmp_path):
    for number, pattern in enumerate(slstudio_frames("2x3")):
        write(tmp_path / f"frameSeq_{number:02d}.bmp", pattern)
    with raises(InputError, "12 frames", "2x3", "nstep", "gray", "--codec"):
        layouts.SLSTUDIO.read(tmp_path, projector=SIZE)
    with raises(InputError, "--projector"):
        layouts.SLSTUDIO.read(tmp_path, codec="2x3")
    for number in range(3):
        write(tmp_path / "three" / f"frameSeq_{number}.bmp", cosines(3, COLUMNS, U)[number])
    with raises(InputError, "3 frames", "2p1", "--codec"):
        layouts.SLSTUDIO.read(tmp_path / "three", projector=SIZE)
    (tmp_path / "frameSeq_07.bmp").unlink()
    with raises(InputError, "frameSeq_07"):
        layouts.SLSTUDIO.read(tmp_path, projector=SIZE)
    for number in (8, 9, 10, 11):
        (tmp_path / f"frameSeq_{number:02d}.bmp").unlink()
    with raises(InputError, "7 frames", "--codec"):
        layouts.SLSTUDIO.read(tmp_path, projector=SIZE)


@pytest.mark.computes
@pytest.mark.parametrize("shadow", [True, False])
def test_opencv_generates_columns_then_rows_each_with_its_inverse(tmp_path, shadow):
    patterns = [
        pattern
        for at, bits in ((U, 10), (V, 7))
        for place in reversed(range(bits))
        for pattern in (bit_of(at, place), 1 - bit_of(at, place))
    ]
    patterns += [np.ones(U.shape), np.zeros(U.shape)] if shadow else []
    for number, pattern in enumerate(patterns, 1):
        write(tmp_path / "scan" / f"pattern_cam1_im{number}.png", pattern)
    assert layouts.detect_layout(tmp_path) == "opencv-graycode"
    (capture,) = layouts.OPENCV_GRAYCODE.read(tmp_path, projector=SIZE)
    for axis in ("x", "y"):
        assert np.abs(decoded_error(capture, axis)).max() < 0.5
    if shadow:
        for number, pattern in enumerate([*patterns[:-2], *patterns[:-3:-1]], 1):
            write(tmp_path / "black_first" / f"pattern_cam1_im{number}.png", pattern)
        (other,) = layouts.OPENCV_GRAYCODE.read(tmp_path / "black_first", projector=SIZE)
        assert other.frames[-2].mean() > 2 * other.frames[-1].mean()
        for number, pattern in enumerate([*patterns[:-2:2], *patterns[1:-2:2], *patterns[-2:]], 1):
            write(tmp_path / "block" / f"pattern_cam1_im{number}.png", pattern)
        with raises(InputError, *(f"pattern_cam1_im{n}.png" for n in (1, 2, 18)), "--guess"):
            layouts.OPENCV_GRAYCODE.read(tmp_path / "block", projector=SIZE)
        shutil.rmtree(tmp_path / "black_first")
        shutil.rmtree(tmp_path / "block")
    write(tmp_path / "scan" / "pattern_cam2_im1.png", U / COLUMNS)
    with raises(InputError, "pattern_cam1_imN", "pattern_cam2_imN", '--files "pattern_cam1_im'):
        layouts.OPENCV_GRAYCODE.read(tmp_path, projector=SIZE)
    found = layouts.OPENCV_GRAYCODE.read(tmp_path, projector=SIZE, files="pattern_cam1_*")
    assert len(found) == 1 and "pattern_cam2_im1.png" in found.warnings[0]
    # as many images as another projector without, or with them
    other = (2000, ROWS) if shadow else (COLUMNS, 60)
    with pytest.raises(InputError):
        layouts.OPENCV_GRAYCODE.read(tmp_path, projector=other, files="pattern_cam1_*")
    with raises(InputError, f"{len(patterns)} images", "4000x120", 40):
        layouts.OPENCV_GRAYCODE.read(tmp_path, projector=(4000, ROWS), files="pattern_cam1_*")


@pytest.mark.computes
def test_sltk_names_say_axis_bit_and_negative(tmp_path):
    number = 0
    for axis, (at, bits) in enumerate(((U, 10), (V, 7))):
        for place in reversed(range(bits)):
            for negative in (0, 1):
                pattern = bit_of(at, place)
                place_and_number = f"{axis:02d}-{place:02d}-{negative:02d}_{number:02d}"
                name = f"1481{50 + number}.5_[{place_and_number}]_img.png"
                write(tmp_path / "scan" / name, 1 - pattern if negative else pattern)
                number += 1
    write(tmp_path / "scan" / "preview.png", U / COLUMNS)
    assert layouts.detect_layout(tmp_path) == "sltk"
    found = layouts.SLTK.read(tmp_path, projector=SIZE)
    (capture,) = found
    assert "preview.png" in found.warnings[0]
    for axis in ("x", "y"):
        assert np.abs(decoded_error(capture, axis)).max() < 0.5
    next((tmp_path / "scan").glob("*[[]00-05-01*")).unlink()
    with raises(InputError, "4 of 10"):
        layouts.SLTK.read(tmp_path, projector=SIZE)


def test_a_layout_is_detected_or_the_known_ones_are_listed(tmp_path):
    with raises(InputError, "sltk"):
        layouts.detect_layout(tmp_path)
    write(tmp_path / "a" / "graycode_00.png", U / COLUMNS)
    assert layouts.detect_layout(tmp_path) == "procam-calibration"
    write(tmp_path / "b" / "frameSeq_0.bmp", U / COLUMNS)
    with raises(InputError, "procam-calibration", "slstudio"):
        layouts.detect_layout(tmp_path)
    above = tmp_path / "above"
    for inner in ("a b/1", "c/d/2"):
        write(above / inner / "graycode_00.png", U / COLUMNS)
    with raises(InputError, f"'{above / 'a b'}'", above / "c" / "d"):
        layouts.detect_layout(above)
    (tmp_path / "frames.toml").touch()
    assert layouts.detect_layout(tmp_path) == "frames"
    (tmp_path / "more.toml").touch()
    with raises(InputError, "frames.toml", "more.toml"):
        layouts.detect_layout(tmp_path)


def test_sltk_captures_of_a_real_rig(real_data):
    source = real_data / "sltk_shells"
    assert layouts.detect_layout(source) == "sltk"
    found = layouts.SLTK.read(source, projector=(1280, 800))
    assert [recording.name for recording in found.recordings] == ["scan_0020", "scan_0021"]
    sequence, files = found.recordings[0].sequence, found.recordings[0].files
    assert len(files) == 44 and [frame.axis for frame in sequence.frames] == ["x"] * 22 + ["y"] * 22
    assert [frame.bit for frame in sequence.frames[:4]] == [0, 0, 1, 1] and sequence.frames[
        43
    ].kind == "inverse"
    assert layouts.detect_layout(real_data / "kamino_procam_jpg90") == "procam-calibration"
