"""An image is read whole or refused by name."""

import errno
import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import raises
from PIL import Image

from slviewer.errors import InputError
from slviewer.session.importers.images import (
    INTERPRETATION_TAG,
    ORIENTATION_TAG,
    REDUCED,
    SUBFILE_TAG,
    read_frames,
    read_image,
    warn_of_unread,
)
from slviewer.session.importers.imported import explain_stacks, images_by_name

PIXELS = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
FORMATS = [".png", ".jpg", ".bmp", ".tif", ".pgm"]


def encoded(suffix: str, pixels: np.ndarray = PIXELS) -> bytes:
    return cv2.imencode(suffix, pixels)[1].tobytes()


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("colour", [False, True])
def test_whole_images_are_read(tmp_path, suffix, colour):
    pixels = np.dstack([PIXELS, PIXELS[::-1], PIXELS.T.reshape(PIXELS.shape)]) if colour else PIXELS
    suffix = ".ppm" if colour and suffix == ".pgm" else suffix
    path = tmp_path / f"a{suffix}"
    path.write_bytes(encoded(suffix, pixels))
    image = read_image(path)
    assert image.shape == pixels.shape
    if suffix != ".jpg":
        np.testing.assert_array_equal(image, pixels)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_cut_short_images_are_refused(tmp_path, suffix, kept):
    data = encoded(suffix)
    path = tmp_path / "pose_1" / "V" / f"P18_F07{suffix}"
    path.parent.mkdir(parents=True)
    path.write_bytes(data[: int(kept * len(data))])
    with raises(InputError, f"pose_1/V/P18_F07{suffix}"):
        read_image(path)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
@pytest.mark.parametrize("colours", [1, 3])
def test_an_image_has_the_sensors_rows_however_the_camera_was_turned(
    tmp_path: Path, suffix: str, colours: int
) -> None:
    pixels = np.kron(np.arange(6, dtype=np.uint8).reshape(2, 3) * 40, np.ones((32, 32), np.uint8))
    shown = Image.fromarray(pixels if colours == 1 else np.stack([pixels] * 3, axis=-1))
    for orientation in range(1, 9):
        exif = Image.Exif()
        exif[ORIENTATION_TAG] = orientation
        path = tmp_path / f"{orientation}{suffix}"
        shown.save(path, exif=exif)
        read = read_image(path).reshape(*pixels.shape, -1)[..., 0]
        assert np.abs(read.astype(int) - pixels).max() <= 12, orientation


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_an_alpha_channel_is_left_aside_and_named(tmp_path, suffix):
    path, plain = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    path.write_bytes(encoded(suffix, np.dstack([PIXELS, PIXELS[::-1], PIXELS, PIXELS // 2])))
    plain.write_bytes(encoded(suffix))
    np.testing.assert_array_equal(read_image(path)[..., 1], PIXELS[::-1])
    (warning,) = warn_of_unread([plain, path, tmp_path / "absent.png"])
    assert path.name in warning and "alpha" in warning and plain.name not in warning


def write_tiff(path, pages, further):
    """Write the images of a TIFF, each with further tags."""
    data, link = bytearray(b"II*\0\0\0\0\0"), 4
    for pixels, own in zip(pages, further, strict=True):
        height, width = pixels.shape
        tags = {256: width, 257: height, 258: 8 * pixels.itemsize, 259: 1, INTERPRETATION_TAG: 1}
        tags |= {273: len(data), 277: 1, 278: height, 279: pixels.nbytes, **own}
        data += pixels.tobytes()
        data[link : link + 4] = struct.pack("<I", len(data))
        data += struct.pack("<H", len(tags))
        data += b"".join(struct.pack("<HHII", tag, 4, 1, tags[tag]) for tag in sorted(tags))
        link = len(data)
        data += bytes(4)
    path.write_bytes(data)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("interpretation", [0, 1])
def test_a_tiff_whose_zero_is_white_is_read_as_it_is_shown(tmp_path, bits, interpretation):
    pixels = (257 * PIXELS.astype(int) >> (16 - bits)).astype(f"uint{bits}")
    write_tiff(tmp_path / "a.tif", [pixels], [{INTERPRETATION_TAG: interpretation}])
    shown = pixels if interpretation else np.invert(pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), shown)


def test_pages_are_read_in_order_without_thumbnails(tmp_path):
    """TIFF of five pages of 16 bits, of which the second is a thumbnail and one is turned."""
    pages = [(PIXELS.astype(np.uint16) << 4) + k for k in range(5)]
    stack = tmp_path / "stack.tif"
    tags = [{}, {SUBFILE_TAG: REDUCED}, {}, {ORIENTATION_TAG: 3}, {}]
    write_tiff(stack, pages, tags)
    names = [f"stack_{n:03d}.tif" for n in range(1, 5)]
    assert [path.name for path in images_by_name(tmp_path)] == names
    read = read_frames(images_by_name(tmp_path)).stack
    np.testing.assert_array_equal(read, [pages[k] for k in (0, 2, 3, 4)])
    np.testing.assert_array_equal(read_image(stack / names[2]), pages[3])
    assert warn_of_unread(images_by_name(tmp_path)) == []
    for absent in (stack, stack / "stack_005.tif"):
        with raises(InputError, absent.name):
            read_image(absent)


@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_files_of_several_images_are_refused(tmp_path, suffix):
    path, pages = tmp_path / f"a{suffix}", [Image.fromarray(PIXELS), Image.fromarray(PIXELS[::-1])]
    pages[0].save(path, save_all=True, append_images=pages[1:])
    with raises(InputError, path.name, "2"):
        read_image(path)
    (tmp_path / "b.tif").write_bytes(encoded(".tif"))  # beside which the pages are not the frames
    assert [each.name for each in images_by_name(tmp_path)] == [path.name, "b.tif"]
    assert f"{path.name} holds 2" in explain_stacks([tmp_path])


def test_a_damaged_png_is_refused(tmp_path):
    data = bytearray(encoded(".png"))
    data[len(data) // 2] ^= 1
    path = tmp_path / "a.png"
    path.write_bytes(data)
    with pytest.raises(InputError):
        read_image(path)


def test_a_thumbnail_does_not_end_a_jpeg(tmp_path):
    whole = encoded(".jpg")
    thumbnail = b"\xff\xe1" + struct.pack(">H", 2 + len(whole)) + whole
    path = tmp_path / "a.jpg"
    path.write_bytes(whole[:2] + thumbnail + whole[2:] + b"\0\0 padding")
    assert read_image(path).shape == PIXELS.shape
    path.write_bytes(whole[:2] + thumbnail + whole[2 : len(whole) // 2])
    with pytest.raises(InputError):
        read_image(path)


@pytest.mark.parametrize(
    ("pixels", "facts"),
    [
        (PIXELS[:, :60], ("60x48", "a.png", "64x48")),
        (PIXELS.astype(np.uint16) * 257, ("16 bits", "a.png", 8)),
    ],
)
def test_frames_that_differ_are_refused(tmp_path, pixels, facts):
    for name, image in (("a.png", PIXELS), ("b.png", pixels)):
        (tmp_path / name).write_bytes(encoded(".png", image))
    with raises(InputError, "b.png", *facts):
        read_frames([tmp_path / "a.png", tmp_path / "b.png"])


def test_what_is_no_frame_is_refused(tmp_path):
    (tmp_path / "a.png").write_text("no image at all")
    (tmp_path / "b.tif").write_bytes(encoded(".tif", PIXELS.astype(np.float32)))
    for name, *facts in (("a.png",), ("b.tif", "float32"), ("c.png", os.strerror(errno.ENOENT))):
        with raises(InputError, name, *facts):
            read_frames([tmp_path / name])


def test_grey_stored_as_colour_has_no_colours(tmp_path):
    (tmp_path / "a.png").write_bytes(encoded(".png", np.dstack([PIXELS] * 3)))
    images = read_frames([tmp_path / "a.png"], 0)
    np.testing.assert_array_equal(images.stack[0], PIXELS)
    assert images.texture is None and not images.in_colour


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_one_channel_of_colour_frames_is_taken(tmp_path, dtype):
    blue, green, red = (
        np.random.default_rng(seed).integers(0, 200, (3, 4)).astype(dtype) for seed in range(3)
    )
    red[0, 0] = white = 255 if dtype == np.uint8 else 1023
    bgr = np.dstack([blue, green, red])
    (tmp_path / "a.png").write_bytes(encoded(".png", bgr))
    for channel, plane in (("blue", blue), ("green", green), ("red", red), ("max", bgr.max(2))):
        images = read_frames([tmp_path / "a.png"], 0, channel)
        np.testing.assert_array_equal(images.stack[0], plane)
        np.testing.assert_array_equal(images.texture, bgr[..., ::-1])
        assert images.in_colour and images.stack.dtype == dtype
    luma = read_frames([tmp_path / "a.png"], None, "luma").stack[0].astype(float)
    np.testing.assert_allclose(
        luma.flat[1:], (0.114 * blue + 0.587 * green + 0.299 * red).flat[1:], atol=1
    )
    assert luma[0, 0] == white  # one channel is saturated
