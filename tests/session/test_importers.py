"""Other tools' folders, written here as those tools write them, whole and broken."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from slviewer.errors import InputError
from slviewer.fringe import presets
from slviewer.fringe.sequence import Frame
from slviewer.session.importers import frames as frames_layout
from slviewer.session.importers import p18, procam_calibration


def image(seed: int, dtype=np.uint8) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, (12, 16), dtype)


def write(path: Path, pixels: np.ndarray) -> np.ndarray:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return pixels


def write_p18(pose: Path, folders="VH", numbers=range(26), name="P18_F{:02d}.PNG", dtype=np.uint8) -> list[np.ndarray]:
    return [write(pose / d / name.format(n), image(100 * i + n, dtype)) for i, d in enumerate(folders) for n in numbers]


def write_procam(capture: Path, count=42) -> list[np.ndarray]:
    return [write(capture / f"graycode_{n:02d}.png", image(n)) for n in range(count)]


# p18


def test_p18_takes_v_then_h_with_the_texture_once(tmp_path):
    written = {name: write_p18(tmp_path / name) for name in ("pose_10", "pose_2")}
    found = p18.read(tmp_path, prefix="planes")
    captures = list(found)
    assert [capture.name for capture in captures] == ["planes_pose_2", "planes_pose_10"] and not found.warnings
    assert len(found) == 2
    for capture in captures:
        sequence, whole = capture.sequence, written[capture.name.removeprefix("planes_")]
        assert sequence.projector == (912, 1140) and sequence.axes == ("x", "y")
        assert (sequence.phase_sign, sequence.gray_origin_px) == (1, -0.5)
        preset = presets.p18((912, 1140))
        assert sequence.frames == preset.frames[:-1]  # the preset shows its white once an axis
        np.testing.assert_array_equal(capture.frames, np.stack([*whole[:26], *whole[26:51]]))
        assert capture.texture is None and capture.source.endswith(capture.name.removeprefix("planes_"))


def test_p18_of_one_pose_one_axis_other_capitals_and_depth(tmp_path):
    write_p18(tmp_path / "scan", "h", name="p18_f{:02d}.tif", dtype=np.uint16)
    (capture,) = p18.read(tmp_path / "scan", projector=(800, 600))
    assert capture.name == "scan" and capture.sequence.axes == ("y",) and capture.sequence.projector == (800, 600)
    assert capture.frames.shape == (26, 12, 16) and capture.frames.dtype == np.uint16


def test_p18_texture_at_f26_or_nowhere_or_twice(tmp_path):
    whole = write_p18(tmp_path / "pose_1", numbers=[*range(25), 26])
    (capture,) = p18.read(tmp_path)
    np.testing.assert_array_equal(capture.frames[25], whole[25])
    write_p18(tmp_path / "pose_2", numbers=range(25))
    write_p18(tmp_path / "pose_3", numbers=range(25))
    write(tmp_path / "pose_3/V/P18_F25.PNG", np.zeros((12, 16), np.uint8))
    write(tmp_path / "pose_3/V/P18_F26.PNG", np.full((12, 16), 9, np.uint8))
    found = p18.read(tmp_path)
    _, bare, double = found
    assert [frame.kind for frame in bare.sequence.frames].count("texture") == 0 and len(bare.frames) == 50
    assert (double.frames[25] == 9).all()
    assert "no texture" in found.warnings[0] and "brighter" in found.warnings[1] and len(found.warnings) == 2


def test_p18_in_colour_keeps_the_texture(tmp_path):
    write_p18(tmp_path / "pose_1", "V", name="P18_F{:02d}.png")
    blue, green, red = (image(seed) for seed in (1, 2, 3))
    write(tmp_path / "pose_1/V/P18_F25.png", np.dstack([blue, green, red]))
    write(tmp_path / "pose_1/V/P18_F03.png", np.dstack([blue, red, green]))
    (capture,) = p18.read(tmp_path)
    np.testing.assert_array_equal(capture.texture, np.dstack([red, green, blue]))
    np.testing.assert_array_equal(capture.frames[25], green)
    np.testing.assert_array_equal(capture.frames[3], red)


def test_p18_says_what_is_missing_before_it_reads(tmp_path):
    write_p18(tmp_path / "pose_01")
    write_p18(tmp_path / "pose_03", numbers=[*range(7), *range(9, 26)])
    (tmp_path / "pose_01/V/P18_F00.PNG").write_bytes(b"no image: not looked at yet")
    found = p18.read(tmp_path)
    assert [recording.name for recording in found.recordings] == ["pose_01"]
    (skipped,) = found.skipped
    assert skipped.name == "pose_03" and "V lacks P18_F07, 08" in skipped.reason
    with pytest.raises(InputError, match="pose_03: folder V lacks P18_F07, 08"):
        p18.read(tmp_path / "pose_03")


def test_p18_refuses_extra_and_double_frames_and_warns_of_strangers(tmp_path):
    write_p18(tmp_path / "pose_1")
    (tmp_path / "pose_1/V/Thumbs.db").touch()
    (tmp_path / "notes").mkdir()
    found = p18.read(tmp_path)
    assert "notes" in found.warnings[0] and "pose_1/V: Thumbs.db" in found.warnings[1] and len(found.warnings) == 2
    write(tmp_path / "pose_1/H/P18_F31.PNG", image(0))
    with pytest.raises(InputError, match=r"pose_1: folder H holds P18_F31.PNG, beyond"):
        p18.read(tmp_path)
    (tmp_path / "pose_1/H/P18_F31.PNG").unlink()
    write(tmp_path / "pose_1/H/P18_F03.bmp", image(0))
    with pytest.raises(InputError, match=r"P18_F03.PNG and P18_F03.bmp"):
        p18.read(tmp_path)


def test_p18_folders_without_poses(tmp_path):
    with pytest.raises(InputError, match="holds no captures"):
        p18.read(tmp_path)
    with pytest.raises(InputError, match="is no folder"):
        p18.read(tmp_path / "absent")
    write_p18(tmp_path / "pose_1")
    (tmp_path / "pose_2" / "V").mkdir(parents=True)
    write_p18(tmp_path / "my pose")
    found = p18.read(tmp_path)
    assert [recording.name for recording in found.recordings] == ["pose_1"]
    assert [each.name for each in found.skipped] == ["pose_2", "my pose"]
    assert "holds no frames" in found.skipped[0].reason and "'my pose' cannot be a name" in found.skipped[1].reason


def test_an_error_states_each_reason_once(tmp_path):
    for n in range(5):
        write_procam(tmp_path / f"capture_{n}", count=40 if n < 3 else 39)
    with pytest.raises(InputError) as refused:
        procam_calibration.read(tmp_path)
    message = str(refused.value)
    assert "none of the 5 captures" in message and message.count("holds 40 images") == 1
    assert message.count("holds 39 images") == 1 and "capture_0, capture_1, capture_2" in message


def test_p18_seven_bits_cannot_number_every_projector(tmp_path):
    write_p18(tmp_path / "pose_1", "V")
    assert len(p18.read(tmp_path, projector=(2304, 4000))) == 1  # only x is there
    with pytest.raises(InputError, match="2304 px, and the projector has 2305 along x"):
        p18.read(tmp_path, projector=(2305, 100))


# procam-calibration


def test_procam_calibration(tmp_path):
    written = [write_procam(tmp_path / f"capture_{n}") for n in range(2)]
    captures = list(procam_calibration.read(tmp_path))
    assert [capture.name for capture in captures] == ["capture_0", "capture_1"]
    np.testing.assert_array_equal(captures[1].frames, np.stack(written[1]))
    sequence = captures[0].sequence
    assert sequence.frames[0] == Frame("gray", "x", bit=0, bits=10)
    assert sequence.frames[3] == Frame("inverse", "x", bit=1, bits=10)
    assert sequence.frames[20] == Frame("gray", "y", bit=0, bits=10)
    assert sequence.frames[40:] == (Frame("white"), Frame("black"))


def test_procam_calibration_counts(tmp_path):
    write_procam(tmp_path / "capture_0")
    assert len(procam_calibration.read(tmp_path, projector=(800, 600))) == 1
    with pytest.raises(InputError, match=r"holds 42 images, .* 1920x1080 projector takes 46: images are missing"):
        procam_calibration.read(tmp_path, projector=(1920, 1080))
    with pytest.raises(InputError, match="takes 38: there are images too many"):
        procam_calibration.read(tmp_path, projector=(512, 512))
    (tmp_path / "capture_0/graycode_17.png").unlink()
    with pytest.raises(InputError, match="capture_0: it lacks graycode_17"):
        procam_calibration.read(tmp_path)


def test_procam_calibration_of_a_real_rig(real_data):
    found = procam_calibration.read(real_data / "kamino_procam_jpg90")
    assert len(found) == 5
    capture = next(iter(found))
    assert capture.frames.shape == (42, 1024, 1280) and capture.frames.dtype == np.uint8
    white, black = capture.frames[40].mean(), capture.frames[41].mean()
    pattern, inverse = capture.frames[2].astype(int), capture.frames[3].astype(int)
    assert white > black + 10
    # what the pattern lights its inverse leaves dark: together they are white and black together
    lit = capture.frames[40].astype(int) - capture.frames[41] > 40
    together = (pattern + inverse - capture.frames[40] - capture.frames[41])[lit]
    assert abs(np.median(together)) < 6


# frames


TOML = """
projector = "96x64"
{top}
[[frame]]
file = "a.png"
kind = "phase"
axis = "x"
step = 0
steps = 3
period_px = 16.0
[[frame]]
file = "sub/b.png"
kind = "phase"
axis = "x"
step = 1
steps = 3
period_px = 16.0
[[frame]]
file = "c.png"
kind = "phase"
axis = "x"
step = 2
steps = 3
period_px = 16
[[frame]]
file = "white.png"
kind = "white"
{bottom}
"""


def write_frames(folder: Path, top="", bottom="", edit=lambda text: text) -> Path:
    for seed, name in enumerate(("a.png", "sub/b.png", "c.png", "white.png")):
        write(folder / "capture" / name, image(seed))
    toml = folder / "sequence.toml"
    toml.write_text(edit(TOML.format(top=top, bottom=bottom)))
    return toml


def test_frames_are_what_the_toml_says(tmp_path):
    toml = write_frames(tmp_path, "phase_sign = -1\ngray_origin = 0.0")
    write(tmp_path / "capture/more.png", image(9))
    found = frames_layout.read(tmp_path, toml, prefix="p")
    (capture,) = found
    assert capture.name == "p_capture" and "more.png" in found.warnings[0]
    assert (capture.sequence.phase_sign, capture.sequence.gray_origin_px) == (-1, 0.0)
    assert capture.settings == {"gray_origin_given": True}
    np.testing.assert_array_equal(capture.frames, [image(seed) for seed in range(4)])
    (alone,) = frames_layout.read(tmp_path / "capture", write_frames(tmp_path))
    assert alone.name == "capture" and alone.settings == {"gray_origin_given": False}


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda t: t.replace("96x64", "96"), "projector size"),
        (lambda t: t.replace('projector = "96x64"', ""), "does not say the projector's size"),
        (lambda t: t.replace("projector =", "projectr ="), "unknown entry 'projectr'"),
        (lambda t: t.replace('kind = "white"', 'kind = "blue"'), r"\[\[frame\]\] 4 \(white.png\): .*'blue'"),
        (lambda t: t.replace('kind = "white"', 'kind = ["white"]'), "kind must be a word"),
        (lambda t: t.replace("step = 1", "stp = 1"), r"\[\[frame\]\] 2 \(sub/b.png\): .*'stp'"),
        (lambda t: t.replace("step = 1", 'step = "one"'), "no number"),
        (lambda t: t.replace("step = 1", "step = 0"), "phase step 1 of 3 is missing"),
        (lambda t: t.replace('file = "c.png"', ""), r"\[\[frame\]\] 3 names no file"),
        (lambda t: t.replace("c.png", "d.png"), "capture: it lacks d.png"),
        (lambda t: t.replace("[[frame]]", "[frame]", 1), "is not TOML .*line"),
        (lambda t: t.replace('"a.png"', '"a.png'), "is not TOML .*line 5"),
        (lambda t: 'projector = "96x64"', "names no frames"),
        (lambda t: 'projector = "96x64"\nframe = 3', "names no frames"),
        (lambda t: 'projector = "96x64"\nframe = [3]', r"\[\[frame\]\] 1 is no table"),
    ],
)
def test_frames_toml_faults_are_named(tmp_path, edit, message):
    toml = write_frames(tmp_path, edit=edit)
    with pytest.raises(InputError, match=message):
        frames_layout.read(tmp_path, toml)


def test_frames_projector_given_beside_the_toml(tmp_path):
    toml = write_frames(tmp_path, edit=lambda text: text.replace('projector = "96x64"', ""))
    assert frames_layout.read(tmp_path, toml, projector=(96, 64)).recordings[0].sequence.projector == (96, 64)
    toml = write_frames(tmp_path)
    frames_layout.read(tmp_path, toml, projector=(96, 64))
    with pytest.raises(InputError, match="96x64, and 912x1140 was given"):
        frames_layout.read(tmp_path, toml, projector=(912, 1140))
    with pytest.raises(InputError, match="cannot be read"):
        frames_layout.read(tmp_path, tmp_path / "absent.toml")


def test_frames_of_a_real_scene(real_data, tmp_path):
    lines = ['projector = "1920x1080"']
    for n in range(10):
        what = (
            f'kind = "phase"\nstep = {n}\nsteps = 4\nperiod_px = 60'
            if n < 4
            else 'kind = "complementary"'
            if n == 9
            else f'kind = "gray"\nbit = {n - 4}\nbits = 5'
        )
        lines.append(f'[[frame]]\nfile = "{n}.png"\naxis = "x"\n{what}')
    toml = tmp_path / "david.toml"
    toml.write_text("\n".join(lines))
    (capture,) = frames_layout.read(real_data / "slmaster_david" / "L", toml)
    assert capture.name == "L" and capture.frames.shape == (10, 1536, 2048)
    a, b, c, d = capture.frames[:4, ::8, ::8].astype(float)
    modulation = np.hypot(a - c, b - d) / 2
    assert 0.6 < (modulation > 6).mean() < 0.8  # INFO.md: 70 % of the pixels
    assert np.abs(a + c - b - d)[modulation > 20].mean() < 4  # four quarter periods
