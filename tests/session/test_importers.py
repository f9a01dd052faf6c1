"""Other tools' folders, written here as those tools write them, whole and broken."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts, raises

from slviewer.errors import InputError
from slviewer.fringe import presets
from slviewer.fringe.sequence import Frame
from slviewer.session.importers import frames as frames_layout
from slviewer.session.importers.imported import check_complete
from slviewer.session.importers.layouts import P18, PROCAM_CALIBRATION


def image(seed: int, dtype=np.uint8) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, (12, 16), dtype)


def write(path: Path, pixels: np.ndarray) -> np.ndarray:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return pixels


def write_p18(
    pose: Path, folders="VH", numbers=range(26), name="P18_F{:02d}.PNG", dtype=np.uint8
) -> list[np.ndarray]:
    return [
        write(pose / d / name.format(n), image(100 * i + n, dtype))
        for i, d in enumerate(folders)
        for n in numbers
    ]


def write_procam(capture: Path, count=42) -> list[np.ndarray]:
    return [write(capture / f"graycode_{n:02d}.png", image(n)) for n in range(count)]


# p18


def test_p18_takes_v_then_h_with_the_texture_once(tmp_path):
    written = {name: write_p18(tmp_path / name) for name in ("pose_10", "pose_2")}
    found = P18.read(tmp_path, prefix="planes")
    captures = list(found)
    assert [capture.name for capture in captures] == [
        "planes_pose_2",
        "planes_pose_10",
    ] and not found.warnings
    assert len(found) == 2
    for capture in captures:
        sequence, whole = capture.sequence, written[capture.name.removeprefix("planes_")]
        assert sequence.projector == (912, 1140) and sequence.axes == ("x", "y")
        assert (sequence.phase_sign, sequence.gray_origin_px) == (1, -0.5)
        preset = presets.p18((912, 1140))
        assert sequence.frames == preset.frames[:-1]  # the preset shows its white once an axis
        np.testing.assert_array_equal(capture.frames, np.stack([*whole[:26], *whole[26:51]]))
        assert capture.texture is None and capture.source.endswith(
            capture.name.removeprefix("planes_")
        )


def test_p18_of_one_pose_one_axis_other_capitals_and_depth(tmp_path):
    write_p18(tmp_path / "scan", "h", name="p18_f{:02d}.tif", dtype=np.uint16)
    (capture,) = P18.read(tmp_path / "scan", projector=(800, 600))
    assert (
        capture.name == "scan"
        and capture.sequence.axes == ("y",)
        and capture.sequence.projector == (800, 600)
    )
    assert capture.frames.shape == (26, 12, 16) and capture.frames.dtype == np.uint16


def test_p18_texture_at_f26_or_nowhere_or_twice(tmp_path):
    whole = write_p18(tmp_path / "pose_1", numbers=[*range(25), 26])
    (capture,) = P18.read(tmp_path)
    np.testing.assert_array_equal(capture.frames[25], whole[25])
    write_p18(tmp_path / "pose_2", numbers=range(25))
    write_p18(tmp_path / "pose_3", numbers=range(25))
    write(tmp_path / "pose_3/V/P18_F25.PNG", np.zeros((12, 16), np.uint8))
    write(tmp_path / "pose_3/V/P18_F26.PNG", np.full((12, 16), 9, np.uint8))
    found = P18.read(tmp_path)
    _, bare, double = found
    assert [frame.kind for frame in bare.sequence.frames].count("texture") == 0 and len(
        bare.frames
    ) == 50
    assert (double.frames[25] == 9).all()
    assert missing_facts(found.warnings[0], "pose_2", "texture") == [] and len(found.warnings) == 2
    assert missing_facts(found.warnings[1], "pose_3/V", "F25", "F26") == []


def test_p18_in_colour_keeps_the_texture(tmp_path):
    write_p18(tmp_path / "pose_1", "V", name="P18_F{:02d}.png")
    blue, green, red = (image(seed) for seed in (1, 2, 3))
    write(tmp_path / "pose_1/V/P18_F25.png", np.dstack([blue, green, red]))
    write(tmp_path / "pose_1/V/P18_F03.png", np.dstack([blue, red, green]))
    (capture,) = P18.read(tmp_path)
    np.testing.assert_array_equal(capture.texture, np.dstack([red, green, blue]))
    np.testing.assert_array_equal(capture.frames[25], green)
    np.testing.assert_array_equal(capture.frames[3], red)


def test_p18_says_what_is_missing_before_it_reads(tmp_path):
    write_p18(tmp_path / "pose_01")
    write_p18(tmp_path / "pose_03", numbers=[*range(7), *range(9, 26)])
    (tmp_path / "pose_01/V/P18_F00.PNG").write_bytes(b"no image: not looked at yet")
    found = P18.read(tmp_path)
    assert [recording.name for recording in found.recordings] == ["pose_01"]
    (skipped,) = found.skipped
    assert skipped.name == "pose_03" and missing_facts(skipped.reason, "V", "P18_F07, 08") == []
    with raises(InputError, "pose_03", "V", "P18_F07, 08"):
        P18.read(tmp_path / "pose_03")


def test_p18_refuses_extra_and_double_frames_and_warns_of_strangers(tmp_path):
    write_p18(tmp_path / "pose_1")
    (tmp_path / "pose_1/V/Thumbs.db").touch()
    (tmp_path / "notes").mkdir()
    found = P18.read(tmp_path)
    assert missing_facts(found.warnings[0], "notes") == [] and len(found.warnings) == 2
    assert missing_facts(found.warnings[1], "pose_1/V", "Thumbs.db") == []
    write(tmp_path / "pose_1/H/P18_F31.PNG", image(0))
    with raises(InputError, "pose_1", "H", "P18_F31.PNG"):
        P18.read(tmp_path)
    (tmp_path / "pose_1/H/P18_F31.PNG").unlink()
    write(tmp_path / "pose_1/H/P18_F03.bmp", image(0))
    with raises(InputError, "P18_F03.PNG", "P18_F03.bmp"):
        P18.read(tmp_path)


def test_p18_folders_without_poses(tmp_path):
    with pytest.raises(InputError):
        P18.read(tmp_path)
    with pytest.raises(InputError):
        P18.read(tmp_path / "absent")
    write_p18(tmp_path / "pose_1")
    (tmp_path / "pose_2" / "V").mkdir(parents=True)
    write_p18(tmp_path / "my pose")
    found = P18.read(tmp_path)
    assert [recording.name for recording in found.recordings] == ["my_pose", "pose_1"]
    assert [each.name for each in found.skipped] == ["pose_2"]
    write_p18(tmp_path / "pose 1")
    with raises(InputError, "pose_1"):
        P18.read(tmp_path)


def test_an_error_states_each_reason_once(tmp_path):
    for n in range(5):
        write_procam(tmp_path / f"capture_{n}", count=40 if n < 3 else 39)
    with pytest.raises(InputError) as refused:
        PROCAM_CALIBRATION.read(tmp_path)
    message = str(refused.value)
    assert message.count("40 images") == message.count("39 images") == 1
    assert missing_facts(message, "5 captures", "capture_0, capture_1, capture_2") == []


def test_p18_seven_bits_cannot_number_every_projector(tmp_path):
    write_p18(tmp_path / "pose_1", "V")
    assert len(P18.read(tmp_path, projector=(2304, 4000))) == 1  # only x is there
    with raises(InputError, 2304, 2305, "x"):
        P18.read(tmp_path, projector=(2305, 100))


# procam-calibration


def test_procam_calibration(tmp_path):
    written = [write_procam(tmp_path / f"capture_{n}") for n in range(2)]
    captures = list(PROCAM_CALIBRATION.read(tmp_path))
    assert [capture.name for capture in captures] == ["capture_0", "capture_1"]
    np.testing.assert_array_equal(captures[1].frames, np.stack(written[1]))
    sequence = captures[0].sequence
    assert sequence.frames[0] == Frame("gray", "x", bit=0, bits=10)
    assert sequence.frames[3] == Frame("inverse", "x", bit=1, bits=10)
    assert sequence.frames[20] == Frame("gray", "y", bit=0, bits=10)
    assert sequence.frames[40:] == (Frame("white"), Frame("black"))


def test_procam_calibration_counts(tmp_path):
    write_procam(tmp_path / "capture_0")
    assert len(PROCAM_CALIBRATION.read(tmp_path, projector=(800, 600))) == 1
    with raises(InputError, "42 images", "1920x1080", 46):
        PROCAM_CALIBRATION.read(tmp_path, projector=(1920, 1080))
    with raises(InputError, "42 images", "512x512", 38):
        PROCAM_CALIBRATION.read(tmp_path, projector=(512, 512))
    (tmp_path / "capture_0/graycode_17.png").unlink()
    with raises(InputError, "capture_0", "graycode_17"):
        PROCAM_CALIBRATION.read(tmp_path)


@pytest.mark.parametrize(
    ("form", "first", "missing", "named"),
    [
        ("{:04d}", 1, 3, "shot_0003"),
        ("{:04d}", 1, 6, "shot_0006"),
        ("{}", 0, 2, "shot_2"),
        ("{:02d}", 0, 0, "shot_00"),
    ],
)
def test_missing_images_are_named_as_the_others(form, first, missing, named):
    numbers = [number for number in range(first, first + 6)]
    images = {(n,): Path(f"shot_{form.format(n)}.png") for n in numbers}
    check_complete(images, "shot_", 6, first=first)
    check_complete(images, "shot_", first=first)
    del images[(missing,)]
    with raises(InputError, named):
        check_complete(images, "shot_", 6, first=first)


def test_procam_calibration_of_a_real_rig(real_data):
    found = PROCAM_CALIBRATION.read(real_data / "kamino_procam_jpg90")
    assert len(found) == 5
    capture = next(iter(found))
    assert capture.frames.shape == (42, 1024, 1280) and capture.frames.dtype == np.uint8
    white, black = capture.frames[40].mean(), capture.frames[41].mean()
    pattern, inverse = capture.frames[2].astype(int), capture.frames[3].astype(int)
    assert white > black + 10
    # what the pattern lights its inverse leaves dark: together they are white and black together
    illuminated = capture.frames[40].astype(int) - capture.frames[41] > 40
    together = (pattern + inverse - capture.frames[40] - capture.frames[41])[illuminated]
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
    found = frames_layout.LAYOUT.read(tmp_path, toml, prefix="p")
    (capture,) = found
    assert capture.name == "p_capture" and "more.png" in found.warnings[0]
    assert (capture.sequence.phase_sign, capture.sequence.gray_origin_px) == (-1, 0.0)
    assert capture.settings == {"gray_origin_given": True}
    np.testing.assert_array_equal(capture.frames, [image(seed) for seed in range(4)])
    (alone,) = frames_layout.LAYOUT.read(tmp_path / "capture", write_frames(tmp_path))
    assert alone.name == "capture" and alone.settings == {"gray_origin_given": False}


@pytest.mark.parametrize(
    ("edit", "facts"),
    [
        (lambda t: t.replace("96x64", "96"), ("'96'", "912x1140")),
        (lambda t: 'channel = "grey"\n' + t, ("channel", "'grey'", "luma")),
        (lambda t: 'order = "time"\n' + t, ("order", "'time'", '"name"')),
        (lambda t: 'order = "name"\n' + t, ("[[frame]] 1", 'order = "name"')),
        (lambda t: t.replace("step = 1", "step = 1\nexposure_ms = 4"), ("3 of 4", "exposure_ms")),
        (
            lambda t: t + '\n[[frames]]\nkind = "white"\nfiles = "w.png"',
            ("[[frame]]", "[[frames]]"),
        ),
        (lambda t: t.replace('"c.png"', '"../c.png"'), ("[[frame]] 3", '"../c.png"')),
        (lambda t: t.replace("projector =", "projectr ="), ("'projectr'", "projector")),
        (
            lambda t: t.replace('kind = "white"', 'kind = "blue"'),
            ("[[frame]] 4", "white.png", "'blue'"),
        ),
        (
            lambda t: t.replace('kind = "white"', 'kind = ["white"]'),
            ("[[frame]] 4", "white.png", "kind", "['white']"),
        ),
        (lambda t: t.replace("step = 1", "stp = 1"), ("[[frame]] 2", "sub/b.png", "'stp'")),
        (
            lambda t: t.replace("step = 1", 'step = "one"'),
            ("[[frame]] 2", "sub/b.png", "phase", "number"),
        ),
        (lambda t: t.replace("step = 1", "step = 0"), ("phase step 1 of 3",)),
        (lambda t: t.replace('file = "c.png"', ""), ("[[frame]] 3", "file")),
        (lambda t: t.replace("c.png", "d.png"), ("capture", "d.png")),
        (lambda t: t.replace("[[frame]]", "[frame]", 1), ("TOML", "line")),
        (lambda t: t.replace('"a.png"', '"a.png'), ("TOML", "line 5")),
        (lambda t: 'projector = "96x64"', ("[[frame]]", "[[frames]]")),
        (lambda t: 'projector = "96x64"\nframe = 3', ("[[frame]]", "[[frames]]")),
        (lambda t: 'projector = "96x64"\nframe = [3]', ("[[frame]] 1", "table")),
    ],
)
def test_frames_toml_faults_are_named(tmp_path, edit, facts):
    toml = write_frames(tmp_path, edit=edit)
    with raises(InputError, *facts):
        frames_layout.LAYOUT.read(tmp_path, toml)


def test_frames_projector_given_beside_the_toml(tmp_path):
    toml = write_frames(tmp_path, edit=lambda text: text.replace('projector = "96x64"', ""))
    assert frames_layout.LAYOUT.read(tmp_path, toml, projector=(96, 64)).recordings[
        0
    ].sequence.projector == (96, 64)
    assert frames_layout.LAYOUT.read(tmp_path, toml).recordings[0].sequence.projector_size is None
    toml = write_frames(tmp_path)
    frames_layout.LAYOUT.read(tmp_path, toml, projector=(96, 64))
    with raises(InputError, "96x64", "912x1140"):
        frames_layout.LAYOUT.read(tmp_path, toml, projector=(912, 1140))
    with pytest.raises(InputError):
        frames_layout.LAYOUT.read(tmp_path, tmp_path / "absent.toml")


GROUPS = """
projector = "96x64"
{top}
[[frames]]
kind = "phase"
axis = "x"
steps = 3
period_px = [96.0, 16.0]
files = "fringe_*.png"
[[frames]]
kind = "gray"
axis = "y"
bits = 2
inverse = true
files = "t*_[0?_*].png"
[[frames]]
kind = "white"
files = ["white.png"]
"""
GROUP_FILES = [f"fringe_{n}.png" for n in range(6, 12)] + [
    f"t{9 + n}.{n}_[0{n % 2}_{n}].png" for n in range(4)
]


def write_groups(folder: Path, names: list[str], toml: str) -> Path:
    for seed, name in enumerate(names):
        write(folder / "capture" / name, image(seed))
    (folder / "sequence.toml").write_text(toml)
    return folder / "sequence.toml"


def test_groups_take_their_files_by_pattern_in_natural_order(tmp_path):
    toml = write_groups(tmp_path, [*GROUP_FILES, "white.png"], GROUPS.format(top=""))
    write(tmp_path / "capture" / "t1_0001.png", image(99))  # no bracket: the pattern's are literal
    found = frames_layout.LAYOUT.read(tmp_path, toml)
    (capture,) = found
    np.testing.assert_array_equal(capture.frames, [image(seed) for seed in range(11)])
    assert "t1_0001.png" in found.warnings[0]
    frames = capture.sequence.frames
    assert [(f.kind, f.step, f.period_px) for f in frames[2:5]] == [
        ("phase", 2, 96),
        ("phase", 0, 16),
        ("phase", 1, 16),
    ]
    assert [(f.kind, f.bit) for f in frames[6:]] == [
        ("gray", 0), ("inverse", 0), ("gray", 1), ("inverse", 1), ("white", 0)
    ]  # fmt: skip
    (tmp_path / "capture" / "fringe_8.png").unlink()
    with raises(InputError, "5 files", '"fringe_*.png"', "[[frames]] 1", "phase x", "6 images"):
        frames_layout.LAYOUT.read(tmp_path, toml)


def test_groups_in_order_of_the_names(tmp_path):
    ordered = "\n".join(
        line
        for line in GROUPS.format(top='order = "name"').splitlines()
        if not line.startswith("files")
    )
    toml = write_groups(tmp_path, [f"{n}.bmp" for n in range(11)], ordered)
    (capture,) = frames_layout.LAYOUT.read(tmp_path, toml)
    np.testing.assert_array_equal(capture.frames, [image(seed) for seed in range(11)])
    write(tmp_path / "capture" / "preview.png", image(0))
    with raises(InputError, "12 images", 11):
        frames_layout.LAYOUT.read(tmp_path, toml)


@pytest.mark.parametrize(
    ("text", "kinds"),
    [
        ("bits = 3", ["gray 0", "gray 1", "gray 2"]),
        ("bits = 2\ncomplementary = true", ["gray 0", "gray 1", "complementary 0"]),
        (
            "bits = 2\nmsb_first = false\ncomplementary = true",
            ["complementary 0", "gray 1", "gray 0"],
        ),
        (
            "bits = 2\nmsb_first = false\ninverse = true",
            ["gray 1", "inverse 1", "gray 0", "inverse 0"],
        ),
    ],
)
def test_gray_groups(tmp_path, text, kinds):
    toml = (
        'order = "name"\n[[frames]]\nkind = "phase"\naxis = "x"\nsteps = 3\nperiod_px ='
        " 16\n[[frames]]\n"
    )
    path = write_groups(tmp_path, [], f'{toml}kind = "gray"\naxis = "x"\n{text}')
    frames = frames_layout.read_description(path).sequence.frames
    assert [f"{frame.kind} {frame.bit}" for frame in frames[3:]] == kinds


@pytest.mark.parametrize(
    ("old", "new", "facts"),
    [
        ("bits = 2", "bits = 0", ("[[frames]] 2", "gray y", "bits")),
        ("bits = 2", "bit = 2", ("[[frames]] 2", "gray y", "bit")),
        ("steps = 3", "steps = 2", ("[[frames]] 1", "phase x", "steps")),
        ("16.0]", '"16"]', ("[[frames]] 1", "str", "period_px")),
        ("inverse = true", "inverse = 1", ("[[frames]] 2", "bool", "inverse")),
        (
            'files = ["white.png"]',
            'files = ["a.png", "b.png"]',
            ("[[frames]] 3", "2 files", "1 images"),
        ),
        ('kind = "white"', 'kind = "flat"', ("[[frames]] 3", "'flat'", "kind")),
        ('files = "fringe_*.png"', "", ("[[frames]] 1", "phase x", "file")),
        ('files = ["white.png"]', 'files = "fringe_6.*"', ("fringe_6.png", "two patterns")),
    ],
)
def test_faults_in_groups_are_named(tmp_path, old, new, facts):
    toml = write_groups(
        tmp_path, [*GROUP_FILES, "white.png"], GROUPS.format(top="").replace(old, new)
    )
    with raises(InputError, *facts):
        frames_layout.LAYOUT.read(tmp_path, toml)


def test_brackets_of_exposures_become_one_capture(tmp_path):
    text = 'projector = "96x64"\n' + "".join(
        '[[frames]]\nkind = "phase"\naxis = "x"\nsteps = 3\nperiod_px = 96\n'
        f'exposure_ms = {exposure}\nfiles = "{exposure}ms/*.png"\n'
        for exposure in (20, 5)
    )
    names = [f"{exposure}ms/{n}.png" for exposure in (20, 5) for n in range(3)]
    (capture,) = frames_layout.LAYOUT.read(tmp_path, write_groups(tmp_path, names, text))
    assert capture.exposures_ms == (20.0, 5.0) and len(capture.sequence.frames) == 3
    np.testing.assert_array_equal(capture.frames, [image(seed) for seed in range(6)])
    longest = capture.frames[:3].max(0) < 255
    np.testing.assert_array_equal(
        capture.merged_frames(), np.where(longest, capture.frames[:3], capture.frames[3:])
    )
    (tmp_path / "sequence.toml").write_text(text.replace("steps = 3", "steps = 4", 1))
    with raises(InputError, 20, "5 ms"):
        frames_layout.LAYOUT.read(tmp_path, tmp_path / "sequence.toml")
    (tmp_path / "sequence.toml").write_text(text[: text.rindex("[[")])
    (capture,) = frames_layout.LAYOUT.read(tmp_path, tmp_path / "sequence.toml")
    assert capture.exposures_ms == () and capture.settings["exposure_ms"] == 20.0


DAVID = """
# 32 fringes of 60 px on a projector whose size is not stated
[[frames]]
kind = "phase"
axis = "x"
steps = 4
period_px = 60.0
files = ["0.png", "1.png", "2.png", "3.png"]
[[frames]]
kind = "gray"
axis = "x"
bits = 5
complementary = true
files = ["4.png", "5.png", "6.png", "7.png", "8.png", "9.png"]
"""


def test_frames_of_a_real_scene(real_data, tmp_path):
    toml = tmp_path / "david.toml"
    toml.write_text(DAVID)
    (capture,) = frames_layout.LAYOUT.read(real_data / "slmaster_david" / "L", toml)
    assert capture.name == "L" and capture.frames.shape == (10, 1536, 2048)
    assert capture.sequence.projector_size is None and capture.sequence.frames[9] == Frame(
        "complementary", "x"
    )
    a, b, c, d = capture.frames[:4, ::8, ::8].astype(float)
    modulation = np.hypot(a - c, b - d) / 2
    assert 0.6 < (modulation > 6).mean() < 0.8  # INFO.md: 70 % of the pixels
    assert np.abs(a + c - b - d)[modulation > 20].mean() < 4  # four quarter periods
