"""Pixel formats by law: what is packed bit by bit, as the standards draw it, comes back."""

import numpy as np
import pytest

from slviewer.devices.pixel_formats import best_format, pixel_format
from slviewer.errors import InputError
from slviewer.fringe.layout import clip_level


def bit_stream(levels: np.ndarray, bits: int) -> bytes:
    """A "p" format: one little-endian number of all pixels, the first in its lowest bits."""
    number = sum(int(level) << (k * bits) for k, level in enumerate(levels.ravel()))
    return number.to_bytes((levels.size * bits + 7) // 8, "little")


def gige_packed(levels: np.ndarray, bits: int) -> bytes:
    """GigE Vision: the upper eight bits of a pixel, the lower ones of it and of the next, the upper
    of that."""
    low, flat = bits - 8, [int(level) for level in levels.ravel()]
    data = bytearray()
    for first, second in zip(flat[::2], [*flat[1::2], 0], strict=False):
        data += bytes(
            [first >> low, (first & (1 << low) - 1) | (second & (1 << low) - 1) << 4, second >> low]
        )
    return bytes(data[:-1] if len(flat) % 2 else data)


PACKERS = {"p": bit_stream, "Packed": gige_packed}


@pytest.mark.parametrize("kind", ["Mono", "BayerGR"])
@pytest.mark.parametrize("bits", [10, 12])
@pytest.mark.parametrize("packing", ["p", "Packed"])
@pytest.mark.parametrize("shape", [(4, 8), (3, 5), (1, 1), (2, 7), (5, 6)])
@pytest.mark.parametrize("padding", [0, 3])
def test_what_is_packed_comes_back(kind, bits, packing, shape, padding):
    levels = np.random.default_rng(bits).integers(0, 1 << bits, shape).astype(np.uint16)
    levels.flat[0] = (1 << bits) - 1
    pack = PACKERS[packing]
    data = (
        pack(levels, bits)
        if padding == 0
        else b"".join(pack(row, bits) + b"\xaa" * padding for row in levels)
    )
    found = pixel_format(f"{kind}{bits}{packing}")
    out = np.zeros(shape, found.dtype)
    assert found.nbytes(shape[::-1], padding) == len(data)
    found.unpack(np.frombuffer(data + b"\x55" * 9, np.uint8), out, padding)
    np.testing.assert_array_equal(out, levels)


@pytest.mark.parametrize(
    ("name", "dtype"), [("Mono8", "u1"), ("Mono10", "<u2"), ("Mono12", "<u2"), ("Mono16", "<u2")]
)
@pytest.mark.parametrize("padding", [0, 2, 3])
def test_unpacked_levels_and_padded_rows(name, dtype, padding):
    found = pixel_format(name)
    levels = np.random.default_rng(0).integers(0, 1 << found.bits, (5, 7)).astype(dtype)
    data = b"".join(row.tobytes() + b"\xff" * padding for row in levels)
    out = np.zeros((5, 7), found.dtype)
    found.unpack(np.frombuffer(data, np.uint8), out, padding)
    np.testing.assert_array_equal(out, levels)


@pytest.mark.parametrize("name", ["RGB8", "RGBa8", "BGR8", "BGRa8", "RGB8Packed", "BGR8Packed"])
def test_colours_in_any_order_are_rgb(name):
    found = pixel_format(name)
    seen = np.random.default_rng(1).integers(0, 256, (4, 6, 3), np.uint8)
    stored = seen if name.startswith("RGB") else seen[..., ::-1]
    if found.samples == 4:
        stored = np.concatenate([stored, np.full((4, 6, 1), 9, np.uint8)], axis=2)
    for padding in (0, 5):
        data = np.frombuffer(b"".join(row.tobytes() + b"x" * padding for row in stored), np.uint8)
        rgb = found.rgb(found.view_samples(data, (6, 4), padding))
        np.testing.assert_array_equal(rgb, seen)
        assert np.shares_memory(rgb, data) == (padding == 0)


@pytest.mark.parametrize("name", ["BayerRG8", "BayerGR8", "BayerGB12", "BayerBG10"])
def test_a_mosaic_of_one_colour_is_that_colour(name):
    found = pixel_format(name)
    colour = {"R": 10, "G": 90, "B": 200}
    tile = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}[found.kind[-2:]]
    mosaic = np.tile(
        np.array([colour[letter] for letter in tile], found.dtype).reshape(2, 2), (6, 5)
    )
    rgb = found.rgb(mosaic)
    assert rgb.shape == (12, 10, 3) and rgb.dtype == found.dtype
    assert (rgb == [10, 90, 200]).all()


def test_grey_levels_keep_the_full_scale_that_decoding_expects():
    for bits in (10, 12):
        white = np.full((2, 4), (1 << bits) - 1)
        out = np.zeros((2, 4), np.uint16)
        pixel_format(f"Mono{bits}p").unpack(np.frombuffer(bit_stream(white, bits), np.uint8), out)
        assert out.max() == clip_level(out.dtype, int(out.max())) == (1 << bits) - 1


@pytest.mark.parametrize(
    ("offered", "best"),
    [
        (["Mono8", "Mono10", "Mono12", "Mono16", "Mono12p"], "Mono12"),
        (["Mono8", "Mono12Packed", "Mono16"], "Mono8"),
        (["Mono12p"], "Mono12p"),
        (["RGBa8", "Mono8", "Coord3D_ABC32f_Planar"], "RGBa8"),
        (["Mono8", "RGB8", "BayerRG8", "BayerRG12", "BayerRG12p", "YUV422_8"], "BayerRG12"),
        (["BGRa8", "BGR8", "Mono8"], "BGR8"),
    ],
)
def test_the_format_that_is_chosen(offered, best):
    assert best_format(offered).name == best


def test_formats_that_are_not_read_are_none_here():
    for name in (
        "YUV422_8",
        "Mono1p",
        "Mono14p",
        "RGB12",
        "Mono10pmsb",
        "Coord3D_ABC32f",
        "",
        "Mono8s",
    ):
        assert pixel_format(name) is None
    assert best_format(["YUV422_8"]) is None
    with pytest.raises(InputError):
        pixel_format("Mono8").rgb(np.zeros((2, 2), np.uint8))
