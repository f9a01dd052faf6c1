import json
from dataclasses import replace

import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.fringe.patterns import profile, render_pattern
from slviewer.fringe.presets import PRESETS, complementary, gray, multifrequency, p18
from slviewer.fringe.sequence import Frame, PatternSequence, PerAxis, parse_size


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_survives_its_description(name):
    sequence = PRESETS[name]((912, 1140))
    assert PatternSequence.from_dict(json.loads(json.dumps(sequence.to_dict()))) == sequence
    assert sequence.axes == ("x", "y")


def test_p18_is_laid_out_as_its_folders_are():
    sequence = p18((912, 1140))
    assert len(sequence.frames) == 2 * 26
    assert [f.kind for f in sequence.frames[:26]] == ["phase"] * 18 + ["gray"] * 7 + ["texture"]
    assert sequence.period_px("x") == 18 and sequence.extent("y") == 1140
    assert sequence.select("y") == list(range(26, 51))
    assert len(p18((3840, 2160)).find("gray", "x")) == 8


def test_gray_is_laid_out_as_procam_calibration():
    sequence = gray((1024, 768))
    assert [(f.kind, f.bit) for f in sequence.frames[:4]] == [
        ("gray", 0),
        ("inverse", 0),
        ("gray", 1),
        ("inverse", 1),
    ]
    assert len(sequence.frames) == 42
    assert [f.kind for f in sequence.frames[-2:]] == ["white", "black"]
    assert sequence.select("x") == [*range(20), 40, 41]
    assert sequence.period_px("x") == 1


def test_rendered_cosine_and_bits():
    sequence = complementary((50, 30), 4, 16.0)
    image = render_pattern(sequence, 1)
    assert image.shape == (30, 50) and image.dtype == np.uint8 and (image == image[0]).all()
    u = np.arange(50)
    assert (
        np.abs(image[0] - (127.5 + 127.5 * np.cos(2 * np.pi * (u / 16 + 1 / 4)))).max()
        <= 0.5 + 1e-9
    )
    bits = sequence.find("gray", "x") + sequence.find("complementary", "x")
    code = np.zeros(50, int)
    for i in bits:
        code = 2 * code + ((code & 1) ^ (profile(sequence, i)[1] > 0))
    np.testing.assert_array_equal(code, u // 8)  # half periods
    y = sequence.find("gray", "y")[-1]
    assert (render_pattern(sequence, y) == render_pattern(sequence, y)[:, :1]).all()
    inverse = gray((50, 30))
    assert (profile(inverse, 0)[1] ^ profile(inverse, 1)[1] == 255).all()
    assert profile(inverse, len(inverse.frames) - 2)[0] is None
    assert render_pattern(inverse, len(inverse.frames) - 1).max() == 0


def _frames(sequence, *without):
    return tuple(f for i, f in enumerate(sequence.frames) if i not in without)


@pytest.mark.parametrize(
    ("frames", "facts"),
    [
        (_frames(p18((912, 1140)), 3), ("phase step 3 of 18", "missing")),
        (_frames(p18((912, 1140)), 24), ("Gray bit 6 of 7", "missing")),
        (_frames(p18((912, 1140)), 18, 20), ("Gray bit 0, 2 of 7", "missing")),
        (_frames(gray((64, 64)), 3), ("inverse", "Gray bit 1 of 6", "missing")),
        ((*p18((912, 1140)).frames, p18((912, 1140)).frames[0]), ("step 0", "more than once")),
        (
            (*_frames(p18((912, 1140)), 0), Frame("phase", "x", step=0, steps=17, period_px=18)),
            ("17, 18 phase steps",),
        ),
    ],
)
def test_an_incomplete_sequence_is_refused(frames, facts):
    with raises(InputError, *facts):
        PatternSequence((912, 1140), frames)


def test_bits_may_or_may_not_count_the_complementary_one():
    frames = complementary((576, 576), 4, 18.0).frames
    for more in (0, 1):
        said = tuple(replace(f, bits=f.bits + more) if f.kind == "gray" else f for f in frames)
        assert len(PatternSequence((576, 576), said).find("gray", "x")) == 5


@pytest.mark.parametrize(
    "data",
    [
        {"kind": "fringes"},
        {"kind": "phase", "axis": "x", "step": 0, "steps": 2, "period_px": 18},
        {"kind": "phase", "axis": "x", "step": 4, "steps": 4, "period_px": 18},
        {"kind": "phase", "axis": "x", "step": 0, "steps": 4},
        {"kind": "phase", "axis": "x", "step": "first", "steps": 4, "period_px": 18},
        {"kind": "gray", "bit": 0, "bits": 3},
        {"kind": "gray", "axis": "u", "bit": 0},
        {"axis": "x"},
        {"kind": "white", "colour": "red"},
    ],
)
def test_a_frame_that_cannot_be_is_refused(data):
    with pytest.raises(InputError):
        Frame.from_dict(data)


def test_sizes():
    assert parse_size("912x1140") == parse_size([912, 1140]) == (912, 1140)
    for bad in ("912", "912x", "0x4", "axb", None):
        with raises(InputError, f"'{bad}'", "width and height"):
            parse_size(bad)


def test_multifrequency_covers_each_axis():
    sequence = multifrequency((912, 1140))
    assert sequence.periods_px("x")[0] >= 912 and sequence.periods_px("y")[0] >= 1140
    assert sequence.period_px("x") == 16


def _through_json(sequence):
    return PatternSequence.from_dict(json.loads(json.dumps(sequence.to_dict())))


def test_conventions_may_differ_by_axis_and_survive_the_description():
    sequence = replace(
        p18((912, 1140)),
        phase_sign=PerAxis(1, -1),
        gray_origin_px=PerAxis(-0.5, -9.5),
        phase_offset_rad=PerAxis(0.0, np.pi / 2),
        gray_cell_px=PerAxis(None, 9.0),
    )
    assert _through_json(sequence) == sequence
    assert (sequence.sign("x"), sequence.sign("y")) == (1, -1)
    assert sequence.offset_rad("y") == pytest.approx(np.pi / 2) and sequence.origin_px("y") == -9.5
    assert (sequence.gray_cell("x"), sequence.gray_cell("y")) == (18.0, 9.0)
    toml = {**p18((912, 1140)).to_dict(), "phase_sign": {"y": -1}, "phase_offset": {"y": np.pi / 2}}
    read = PatternSequence.from_dict({**toml, "gray_origin": {"y": -9.5}, "gray_cell_px": {"y": 9}})
    assert read == sequence
    assert replace(sequence, phase_sign=PerAxis(-1, -1)) == replace(sequence, phase_sign=-1)


def test_descriptions_written_before_read_the_same_and_stay_as_they_are():
    written = {"projector": "912x1140", "phase_sign": 1, "gray_origin": -0.5}
    written["frame"] = [f.to_dict() for f in p18((912, 1140)).frames]
    assert p18((912, 1140)).to_dict() == written
    # what a capture's hash is made of
    assert json.dumps(p18((912, 1140)).to_dict()) == json.dumps(written)
    assert PatternSequence.from_dict(written) == p18((912, 1140))


def test_a_sequence_without_a_projector_size():
    sequence = PatternSequence(None, multifrequency((912, 1140)).frames, relative=True)
    assert _through_json(sequence) == sequence and "projector" not in sequence.to_dict()
    with raises(InputError, "projector"):
        _ = sequence.projector
    with raises(InputError, "projector"):
        render_pattern(sequence, 0)


@pytest.mark.parametrize(
    ("entry", "facts"),
    [
        ({"phase_sign": 2}, ("phase_sign", 2)),
        ({"phase_sign": {"x": 1, "y": 0}}, ("phase_sign", 0)),
        ({"phase_sign": {"x": 1, "z": 1}}, ("phase_sign", "'z'")),
        ({"phase_offset": "quarter"}, ("phase_offset", "number")),
        ({"phase_offset": float("nan")}, ("phase_offset", "nan rad")),
        ({"gray_cell_px": 0}, ("Gray cell", "0.0 px")),
        ({"gray_cell_px": {"x": -2}}, ("axis x", "Gray cell", "-2.0 px")),
        ({"gray_origin": []}, ("gray_origin", "number")),
        ({"relative": 1}, ("relative", 1)),
    ],
)
def test_conventions_that_cannot_be_are_refused(entry, facts):
    with raises(InputError, *facts):
        PatternSequence.from_dict({**p18((912, 1140)).to_dict(), **entry})


def test_a_rendered_cosine_has_the_offset_and_the_sign_of_its_axis():
    sequence = replace(
        complementary((50, 30), 4, 16.0),
        phase_sign=PerAxis(1, -1),
        phase_offset_rad=PerAxis(0.3, np.pi / 2),
    )
    for axis, sign, offset in (("x", 1, 0.3), ("y", -1, np.pi / 2)):
        i = sequence.find("phase", axis)[1]
        u = np.arange(sequence.extent(axis))
        expected = 127.5 + 127.5 * np.cos(2 * np.pi * u / 16 + sign * np.pi / 2 + offset)
        assert np.abs(profile(sequence, i)[1] - expected).max() <= 0.5 + 1e-9


def test_rendered_gray_cells_of_another_width():
    sequence = replace(gray((60, 40)), gray_cell_px=4.0)
    bits = sequence.find("gray", "x")
    code, digit = np.zeros(60, int), np.zeros(60, int)
    for i in bits:
        digit ^= profile(sequence, i)[1] > 0
        code = 2 * code + digit
    np.testing.assert_array_equal(code, np.arange(60) // 4)
