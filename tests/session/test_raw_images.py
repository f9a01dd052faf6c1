"""RAW files give levels that grow with the light, or say which package reads them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import raises
from raw_files import write_dng

from slviewer.errors import InputError
from slviewer.fringe.raw_image import develop
from slviewer.session.importers import frames as frames_layout
from slviewer.session.importers.images import read_frames, read_image
from slviewer.session.importers.imported import images_by_name, match_files

BLACK, WHITE = 64, 4095
COLOUR = np.array([500, 1000, 2000])


@pytest.fixture
def rawpy():
    return pytest.importorskip("rawpy", reason="the optional package rawpy is not installed")


def mosaic(level: np.ndarray) -> np.ndarray:
    """RGGB of grey `level` (h, w), seen through a green filter that passes all, and others half."""
    pixels = np.array(level, float)
    pixels[::2, ::2] /= 2
    pixels[1::2, 1::2] /= 2
    return np.minimum(np.round(pixels) + BLACK, WHITE).astype(np.uint16)


def test_levels_are_counts_above_black(rawpy):
    pixels = np.empty((64, 96), np.uint16)
    pixels[:] = BLACK + COLOUR[1]
    pixels[::2, ::2], pixels[1::2, 1::2] = BLACK + COLOUR[0], BLACK + COLOUR[2]
    pixels[20:30, 20:30] = WHITE
    for orientation in (1, 6):  # held upright: the sensor stays as it is
        image = develop(write_dng(pixels, BLACK, WHITE, orientation), "a.dng")
        assert (image.rgb.shape, image.rgb.dtype) == ((64, 96, 3), np.uint16)
        np.testing.assert_array_equal(image.rgb[10, 10], COLOUR)
        assert image.full_scale == WHITE - BLACK == image.rgb.max()
        np.testing.assert_array_equal(image.rgb[25, 25], [WHITE - BLACK] * 3)


def test_frames_of_raw_files_are_proportional_to_light(rawpy, tmp_path: Path):
    light = np.tile(np.linspace(100, 1000, 96), (64, 1))
    paths = []
    for k in (1, 2, 3):
        paths.append(tmp_path / f"IMG_{k}.DNG")
        paths[-1].write_bytes(write_dng(mosaic(k * light), BLACK, WHITE))
    images = read_frames(paths, colour_frame=0)
    assert images.full_scale == WHITE - BLACK and images.in_colour
    inner = images.stack[:, 2:-2, 2:-2].astype(float)
    for k in (1, 2, 3):
        assert np.abs(inner[k - 1] - k * light[2:-2, 2:-2]).max() <= 1.0  # counts are whole numbers
    red = read_frames(paths, channel="red").stack[2, 2:-2, 2:-2]
    assert np.abs(red - 1.5 * light[2:-2, 2:-2]).max() <= 1.0
    assert images.texture is not None
    np.testing.assert_array_equal(images.texture, read_image(paths[0])[..., ::-1])


def test_a_capture_of_raw_files_has_the_phase_of_its_fringes(rawpy, tmp_path: Path):
    toml = tmp_path / "sequence.toml"
    toml.write_text(
        'projector = "96x64"\norder = "name"\nrelative = true\n\n[[frames]]\nkind = "phase"\n'
        'axis = "x"\nsteps = 4\nperiod_px = 48.0\n'
    )
    folder = tmp_path / "part"
    folder.mkdir()
    phase = np.tile(2 * np.pi * np.arange(96) / 48, (64, 1))
    for k in range(4):
        fringes = 1000 + 800 * np.cos(phase + np.pi / 2 * k)
        (folder / f"DSC_{k:04d}.dng").write_bytes(write_dng(mosaic(fringes), BLACK, WHITE))
        cv2.imwrite(str(folder / f"DSC_{k:04d}.jpg"), np.zeros((8, 8), np.uint8))
    (capture,) = frames_layout.LAYOUT.read(folder, toml)
    assert capture.sequence.full_scale == WHITE - BLACK and capture.frames.dtype == np.uint16
    steps = capture.frames.astype(float)
    found = np.arctan2(steps[3] - steps[1], steps[0] - steps[2])
    error = np.angle(np.exp(1j * (found - phase)))[2:-2, 2:-2]
    assert np.abs(error).max() < 0.002  # counts of 800 are rounded by half of one


@pytest.mark.parametrize("kept", [0.0, 0.02, 0.5, 0.99])
def test_raw_files_that_are_cut_short_are_refused(rawpy, tmp_path, kept):
    data = write_dng(mosaic(np.full((64, 96), 900.0)), BLACK, WHITE)
    path = tmp_path / "a.dng"
    path.write_bytes(data[: int(kept * len(data))])
    with raises(InputError, "a.dng"):
        read_image(path)


def test_too_large_raw_files_are_refused(rawpy):
    with raises(InputError, "a.dng", "96x64"):
        develop(write_dng(mosaic(np.full((64, 96), 900.0))), "a.dng", 96 * 64 - 1)


def test_without_rawpy_its_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("slviewer.fringe.raw_image.find_spec", lambda name: None)
    path = tmp_path / "IMG_0001.CR2"
    path.write_bytes(b"II*\0")
    with raises(InputError, "IMG_0001.CR2", "rawpy", "pip install 'slviewer[raw]'"):
        read_frames([path])


def test_of_a_raw_file_and_its_jpeg_the_raw_file_is_taken(tmp_path):
    for name in ("IMG_2.CR2", "IMG_2.JPG", "IMG_10.CR2", "IMG_10.JPG", "dark.png"):
        (tmp_path / name).touch()
    names = [file.name for file in images_by_name(tmp_path)]
    assert names == ["dark.png", "IMG_2.CR2", "IMG_10.CR2"]
    for pattern, suffix in (("IMG_*", "CR2"), ("*.JPG", "JPG")):
        found = [file.name for file in match_files(tmp_path, pattern)]
        assert found == [f"IMG_2.{suffix}", f"IMG_10.{suffix}"]
