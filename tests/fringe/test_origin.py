from dataclasses import replace

import cv2
import numpy as np
import pytest
from facts import raises
from fringe_scene import capture, slope, variants

from slviewer.errors import InputError
from slviewer.fringe.decode import decode
from slviewer.fringe.origin import estimate_gray_origin
from slviewer.fringe.presets import complementary, gray, gray_bits, p18, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence

pytestmark = pytest.mark.computes

PROJECTOR = (500, 500)


SEQUENCES = {"p18": p18(PROJECTOR), "complementary": complementary(PROJECTOR, 8, 18.0)}
LIGHTS = [{}, {"gain": 60, "read": 3.0}, {"defocus": 4.0, "psf": 1.5}]


@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("light", variants(LIGHTS, LIGHTS[2]), ids=str)
@pytest.mark.parametrize("origin", variants([-0.5, -4.5, -9.5, -12.5], -12.5))
def test_the_origin_is_found_to_a_fraction_of_a_pixel(name, light, origin):
    sequence = SEQUENCES[name]
    frames = capture(replace(sequence, gray_origin_px=origin), slope(), **light)
    assert estimate_gray_origin(sequence, frames, "x") == pytest.approx(origin, abs=0.15)


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_wide_fringes_in_noise_have_an_origin(seed):
    """Neighbouring pixels differ by less than their noise: single edges tell nothing."""
    rng = np.random.default_rng(seed)
    frames = (*phase_steps("x", 4, 57.0), *gray_bits("x", 4))
    sequence = PatternSequence((912, 100), frames)
    x = 360 + 200 * (np.arange(320) + rng.uniform(-20, 20)) / 320 + np.zeros((240, 1))
    cell = (x / 57).astype(int)
    shown = [0.5 + 0.4 * np.cos(2 * np.pi * x / 57 + k * np.pi / 2) for k in range(4)]
    shown += [((cell ^ (cell >> 1)) >> (3 - bit) & 1).astype(float) for bit in range(4)]
    noisy = [20 + 180 * each + rng.normal(0, 8.0, x.shape) for each in shown]
    stack = np.clip(noisy, 0, 255).round().astype(np.uint8)
    assert estimate_gray_origin(sequence, stack, "x") == pytest.approx(0, abs=0.6)


def test_the_wrong_sign_and_a_bit_too_many_are_named():
    sequence = complementary(PROJECTOR, 8, 18.0)
    frames = capture(sequence, slope())
    with raises(InputError, "phase_sign", "to -1"):
        wrong_way = frames.copy()
        wrong_way[sequence.find("phase", "x")] = frames[[0, 7, 6, 5, 4, 3, 2, 1]]
        estimate_gray_origin(sequence, wrong_way, "x")
    with pytest.raises(InputError):
        frame = replace(sequence.frames[sequence.find("gray", "x")[0]], bit=5, bits=0)
        plain = tuple(
            frame if f.kind == "complementary" and f.axis == "x" else replace(f, bits=0)
            for f in sequence.frames
        )
        estimate_gray_origin(PatternSequence(PROJECTOR, plain), frames, "x")


def test_nothing_to_compare_with_or_to_see():
    sequence = gray(PROJECTOR)
    with pytest.raises(InputError):
        estimate_gray_origin(sequence, np.zeros((len(sequence.frames), 8, 8), np.uint8), "x")
    sequence = p18(PROJECTOR)
    with pytest.raises(InputError):
        estimate_gray_origin(sequence, np.zeros((len(sequence.frames), 8, 8), np.uint8), "x")


@pytest.fixture(scope="module")
def david(real_data):
    """Ten frames of a cluttered scene, every second row: four steps, five Gray bits, the
    complementary bit."""
    files = [real_data / "slmaster_david" / "L" / f"{i}.png" for i in range(10)]
    frames = np.stack([cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files])
    steps = [*phase_steps("x", 4, 18.0), *gray_bits("x", 5), Frame("complementary", "x")]
    return PatternSequence((32 * 18, 32 * 18), tuple(steps)), frames


def test_a_real_scene_of_another_tool(david):
    sequence, frames = david
    origin = estimate_gray_origin(sequence, frames, "x")
    assert origin == pytest.approx(-9.0, abs=0.5)  # its code begins half a period before its phase
    phase = decode(replace(sequence, gray_origin_px=origin), frames, "x")
    assert phase.mask.sum() / phase.illuminated.sum() > 0.97
    assert 0.6 < phase.illuminated.mean() < 0.85
    # Smooth over flat parts: the carton's lid, the wall behind, the front of the case.
    for rows, columns in (
        (np.s_[40:200], np.s_[800:1350]),
        (np.s_[100:250], np.s_[200:550]),
        (np.s_[1000:1080], np.s_[300:700]),
    ):
        patch, valid = phase.phase[rows, columns].astype(np.float64), phase.mask[rows, columns]
        assert valid.mean() > 0.95
        v, u = np.nonzero(valid)
        design = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v], axis=1)
        residue = patch[valid] - design @ np.linalg.lstsq(design, patch[valid], rcond=None)[0]
        assert np.abs(residue).max() < 1.5 and residue.std() < 0.3
    with raises(InputError, "phase_sign", "to 1"):
        estimate_gray_origin(replace(sequence, phase_sign=-1), frames, "x")


@pytest.mark.computes
@pytest.mark.slow
def test_real_gray_code_with_inverses(real_data):
    sequence = gray((1024, 768))
    folder = real_data / "kamino_procam_jpg90" / "capture_0"
    frames = np.stack(
        [cv2.imread(str(folder / f"graycode_{i:02d}.jpg"), cv2.IMREAD_GRAYSCALE) for i in range(42)]
    )
    for axis, low, high in (("x", 62, 826), ("y", 194, 767)):
        phase = decode(sequence, frames, axis)
        board = np.s_[200:750, 220:1050]  # white paper and black squares
        white = frames[40][board] > 80
        assert phase.mask[board][white].mean() > 0.99
        assert phase.mask.sum() / phase.illuminated.sum() > 0.93
        coordinate = phase.coordinate[board]
        assert low - 1 <= np.nanmin(coordinate) and np.nanmax(coordinate) <= high + 1
        across = np.abs(np.diff(coordinate, axis=1))
        assert np.nanpercentile(across, 99.9) < 4  # px: no bit is misread
