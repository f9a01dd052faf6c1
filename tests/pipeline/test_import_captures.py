"""Folders that other tools made, through the command line: what is kept, what is skipped, and what
is said of it."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts

from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import gray, gray_bits, phase_steps
from slviewer.fringe.sequence import PatternSequence, PerAxis
from slviewer.pipeline.capture_phases import decode_capture
from slviewer.pipeline.import_captures import (
    _describe_unneeded_bits,
    find_captures,
    import_captures,
)
from slviewer.session.importers.imported import (
    FolderLayout,
    ImportableRecording,
    define_layout,
    has_images,
    match_images,
)
from slviewer.session.importers.layouts import BUILT_IN
from slviewer.session.store import Session

pytestmark = pytest.mark.computes

Run = Callable[..., tuple[int, str, str]]
PROJECTOR = (120, 90)


def photographed(sequence: PatternSequence, seed: int) -> list[np.ndarray]:
    """What a camera with the projector's own pixels records: 8 bits, noise of one grey level,
    ambient light."""
    rng = np.random.default_rng(seed)
    return [
        np.clip(render_pattern(sequence, i) * 0.5 + 40 + rng.normal(0, 1, PROJECTOR[::-1]), 0, 255)
        .round()
        .astype(np.uint8)
        for i in range(len(sequence.frames))
    ]


def write_captures(source: Path, count: int) -> list[Path]:
    """Folders of the procam-calibration layout."""
    sequence = gray(PROJECTOR)
    folders = [source / f"capture_{n}" for n in range(count)]
    for seed, folder in enumerate(folders):
        folder.mkdir(parents=True)
        for number, frame in enumerate(photographed(sequence, seed)):
            assert cv2.imwrite(str(folder / f"graycode_{number:02d}.png"), frame)
    return folders


def unchanged(err: str) -> set[str]:
    """Return the captures that an import reports as not imported again."""
    (warning,) = [line for line in err.splitlines() if not missing_facts(line, "again")]
    return set(re.findall(r"capture_\d", warning))


@pytest.mark.slow
def test_an_import_that_is_repeated_adds_what_is_missing(run: Run, tmp_path: Path) -> None:
    write_captures(tmp_path / "source", 3)
    session, options = tmp_path / "session", ("--projector", "120x90")
    assert (
        run("import", "procam-calibration", tmp_path / "source" / "capture_1", session, *options)[0]
        == 0
    )
    chunk = session / "captures/capture_1/frames.zarr/c.2.0.0"
    sound = chunk.read_bytes()
    status, out, err = run("import", "procam-calibration", tmp_path / "source", session, *options)
    assert status == 0 and not missing_facts(out, "3 captures") and unchanged(err) == {"capture_1"}
    assert not (session / "trash").exists()
    # the remedy for damage is to import again
    chunk.write_bytes(sound[:100] + bytes(len(sound) - 100))
    status, _, err = run("import", "procam-calibration", tmp_path / "source", session, *options)
    assert status == 0 and unchanged(err) == {"capture_0", "capture_2"}
    assert any(not missing_facts(line, "capture_1", "damaged") for line in err.splitlines())
    assert chunk.read_bytes() == sound and len(list((session / "trash").iterdir())) == 1
    image = tmp_path / "source" / "capture_2" / "graycode_04.png"
    assert cv2.imwrite(str(image), cv2.imread(str(image), cv2.IMREAD_UNCHANGED) // 2 * 2)
    status, _, err = run("import", "procam-calibration", tmp_path / "source", session, *options)
    assert status == 1 and not missing_facts(err, "'capture_2'")


GRAY = (
    'projector = "120x90"\norder = "name"\n'
    + "".join(
        f'[[frames]]\nkind = "gray"\naxis = "{axis}"\nbits = 7\ninverse = true\n' for axis in "xy"
    )
    + '[[frames]]\nkind = "white"\n[[frames]]\nkind = "black"\n'
)


@pytest.mark.parametrize("layout", ["procam-calibration", "auto"])
def test_a_scan_takes_size_and_description_of_the_session(
    run: Run, tmp_path: Path, layout: str
) -> None:
    pose, scan = write_captures(tmp_path, 2)
    session = tmp_path / "session"
    if layout == "auto":
        for folder in (pose, scan):
            for file in folder.iterdir():
                file.rename(folder / file.name[-6:])
        (tmp_path / "gray.toml").write_text(GRAY)
        given: tuple = ("frames", pose, session, "--sequence", tmp_path / "gray.toml")
        assert run("import", "auto", scan, session, "--role", "scan")[0] != 0
    else:
        given = (layout, pose, session, "--projector", "120x90")
    assert run("import", *given)[0] == 0
    status, _, err = run("import", layout, scan, session, "--role", "scan")
    assert status == 0 and not missing_facts(err, "--sequence" if layout == "auto" else "120x90")
    with Session.open(session) as store:
        first, second = (store.load_capture(folder.name) for folder in (pose, scan))
        assert first.sequence == second.sequence and second.role == "scan"


@pytest.mark.parametrize("stacks", [(28,), (14, 14), (14, 14, 0)])
def test_images_of_a_tiff_are_frames_in_order(
    run: Run, tmp_path: Path, stacks: tuple[int, ...]
) -> None:
    """One TIFF of a folder, one for each axis by a pattern; two without a pattern are refused."""
    frames = photographed(gray(PROJECTOR), 0)[:28]
    folder, toml = tmp_path / "scan", GRAY.partition('[[frames]]\nkind = "white"')[0]
    folder.mkdir()
    first = 0
    for name, count in zip("xy", filter(None, stacks), strict=False):
        assert cv2.imwritemulti(str(folder / f"{name}.tif"), frames[first : first + count])
        first += count
        if len(stacks) == 2:
            toml = toml.replace(f'axis = "{name}"', f'axis = "{name}"\nfiles = "{name}*.tif"')
    if len(stacks) == 2:
        toml = toml.replace('order = "name"\n', "")
    (folder / "gray.toml").write_text(toml)
    status, _, err = run("import", "frames", folder, tmp_path / "session")
    if len(stacks) == 3:
        assert status == 1 and not missing_facts(err, "x.tif", "14 images")
        return
    assert status == 0, err
    with Session.open(tmp_path / "session") as store:
        capture = store.load_capture("scan")
        assert np.array_equal(capture.stack(), frames)
        assert capture.files[-1] == ("x.tif/x_028.tif" if len(stacks) == 1 else "y.tif/y_014.tif")


def test_a_code_that_is_centred_on_the_projector(run: Run, tmp_path: Path) -> None:
    """128 codes for 90 rows: code 0 begins 19 px before the first one."""
    sequence = replace(gray(PROJECTOR), gray_origin_px=PerAxis(-4.5, -19.5))
    for number, frame in enumerate(photographed(sequence, 0)):
        (tmp_path / "scan").mkdir(exist_ok=True)
        assert cv2.imwrite(str(tmp_path / "scan" / f"{number:02d}.png"), frame)
    (tmp_path / "scan" / "gray.toml").write_text(GRAY)
    status, _, err = run("import", "auto", tmp_path / "scan", tmp_path / "session")
    assert status == 0 and not missing_facts(err, "-19.5 px", "-4.5 px", "gray_origin")
    with Session.open(tmp_path / "session") as store:
        capture = store.load_capture("scan")
        assert capture.sequence.gray_origin_px == PerAxis(-4.5, -19.5)


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_fringes_that_begin_late_do_not_shift_the_coordinates(
    run: Run, tmp_path: Path, quarters: int
) -> None:
    """Sines, and complementary codes whose edges lie at -pi, begin quarters of a period late."""
    frames = [*phase_steps("x", 4, 15.0), *gray_bits("x", 3)]
    sequence = PatternSequence(PROJECTOR, tuple(frames), phase_offset_rad=np.pi / 2 * quarters)
    for number, frame in enumerate(photographed(sequence, 0)):
        (tmp_path / "scan").mkdir(exist_ok=True)
        assert cv2.imwrite(str(tmp_path / "scan" / f"{number:02d}.png"), frame)
    (tmp_path / "scan" / "late.toml").write_text(
        'projector = "120x90"\norder = "name"\n[[frames]]\nkind = "phase"\naxis = "x"\nsteps = 4\n'
        'period_px = 15.0\n[[frames]]\nkind = "gray"\naxis = "x"\nbits = 3\n'
    )
    status, _, err = run("import", "auto", tmp_path / "scan", tmp_path / "session")
    assert status == 0 and ("phase_offset" in err) == (quarters > 0)
    with Session.open(tmp_path / "session") as store:
        capture = store.load_capture("scan")
        decoded = decode_capture(capture)["x"].coordinate
    off = decoded - np.arange(PROJECTOR[0])
    assert abs(np.nanmedian(off)) < 0.2 and np.nanmax(np.abs(off)) < 1


@pytest.fixture
def faulty(tmp_path: Path) -> Path:
    """Five captures: one with a file cut short, one with a missing file, one in the dark, two
    sound."""
    folders = write_captures(tmp_path / "source", 5)
    cut = folders[1] / "graycode_03.png"
    cut.write_bytes(cut.read_bytes()[:200])
    (folders[2] / "graycode_07.png").unlink()
    dark = np.full(PROJECTOR[::-1], 3, np.uint8)
    for file in folders[3].iterdir():
        cv2.imwrite(str(file), dark)
    return tmp_path / "source"


def test_readable_captures_are_imported_and_the_others_named(
    faulty: Path, run: Run, tmp_path: Path
) -> None:
    session = tmp_path / "session"
    status, out, err = run("import", "procam-calibration", faulty, session, "--projector", "120x90")
    assert status == 0 and not missing_facts(
        out, "2 captures", "target poses", "capture_0", "capture_4"
    )
    warnings = [line for line in err.splitlines() if line.startswith("warning: ")]
    assert len(warnings) == 3
    for name, fact in (
        ("capture_1", "graycode_03.png"),
        ("capture_2", "graycode_07"),
        ("capture_3", "0.0 % of the pixels"),
    ):
        assert any(name in line and fact in line for line in warnings), (name, warnings)
    with Session.open(session) as store:
        assert store.capture_names() == ["capture_0", "capture_4"]


def test_strict_refuses_the_folder(faulty: Path, run: Run, tmp_path: Path) -> None:
    status, _, err = run(
        "import", "procam-calibration", faulty, tmp_path / "s", "--projector", "120x90", "--strict"
    )
    assert status == 1 and not missing_facts(err, "capture_2") and "graycode_07" in err
    (faulty / "capture_2" / "graycode_07.png").write_bytes(
        (faulty / "capture_0" / "graycode_07.png").read_bytes()
    )
    status, _, err = run(
        "import", "procam-calibration", faulty, tmp_path / "s", "--projector", "120x90", "--strict"
    )
    assert status == 1 and not missing_facts(err, "capture_1", "graycode_03.png")
    assert not (tmp_path / "s").exists()


def test_a_folder_without_a_readable_capture_is_an_error(
    faulty: Path, run: Run, tmp_path: Path
) -> None:
    for name in ("capture_0", "capture_4"):
        for file in (faulty / name).iterdir():
            file.unlink()
        (faulty / name).rmdir()
    status, _, err = run(
        "import", "procam-calibration", faulty, tmp_path / "s", "--projector", "120x90"
    )
    assert status == 1 and not missing_facts(err, "3 captures")
    assert not missing_facts(err, "graycode_03.png", "0.0 %") and "graycode_07" in err
    assert not (tmp_path / "s").exists()


def write_colour(source: Path, exposures: tuple[float, ...] = ()) -> Path:
    """Four steps of a fringe along both axes, in red light on a colour camera, described by a TOML
    in the folder."""
    lines = ['order = "name"'] if not exposures else []
    sequence = PatternSequence(PROJECTOR, (*phase_steps("x", 4, 132.0), *phase_steps("y", 4, 99.0)))
    for exposure in exposures or (1.0,):
        for axis, period in (("x", 132.0), ("y", 99.0)):
            lines += [
                "[[frames]]",
                'kind = "phase"',
                f'axis = "{axis}"',
                "steps = 4",
                f"period_px = {period}",
            ]
            if exposures:
                lines += [f"exposure_ms = {exposure}", f'files = "{exposure:g}ms/{axis}*.png"']
        for i, frame in enumerate(photographed(sequence, 7)):
            light = np.clip(frame * exposure, 0, 255)
            image = np.dstack([0.1 * light, 0.3 * light, light]).round().astype(np.uint8)
            folder = source / "scan" / (f"{exposure:g}ms" if exposures else "")
            folder.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(folder / f"{sequence.frames[i].axis}{i}.png"), image)
    (source / "frames.toml").write_text("\n".join(lines) + "\n")
    return source


@pytest.mark.slow
def test_the_default_channel_of_colour_frames_is_stated_once(run: Run, tmp_path: Path) -> None:
    source, session = write_colour(tmp_path / "source"), tmp_path / "session"
    shutil.copytree(source / "scan", source / "scan_2")
    status, out, err = run(
        "import", "auto", source, session, "--projector", "120x90", "--role", "scan"
    )
    assert (
        status == 0 and not missing_facts(out, "layout frames") and err.count("green channel") == 1
    )
    status, _, err = run(
        "import",
        "frames",
        source,
        session,
        "--projector",
        "120x90",
        "--channel",
        "red",
        "--prefix",
        "red",
    )
    assert status == 0 and "channel" not in err
    with Session.open(session) as store:
        green, red = store.load_capture("scan"), store.load_capture("red_scan")
        assert red.frames.max() > 2 * green.frames.max()
        assert (
            green.meta["settings"]["channel"] == "green"
            and red.meta["settings"]["channel"] == "red"
        )


def test_exposures_of_a_toml_become_those_of_the_session(run: Run, tmp_path: Path) -> None:
    source, session = write_colour(tmp_path / "source", (4.0, 1.0)), tmp_path / "session"
    status, _, err = run(
        "import",
        "auto",
        source,
        session,
        "--projector",
        "120x90",
        "--channel",
        "red",
        "--role",
        "scan",
    )
    assert status == 0, err
    with Session.open(session) as store:
        capture = store.load_capture("scan")
        assert capture.exposures_ms == (4.0, 1.0) and len(capture.frames) == 8
        phase = decode_capture(capture)["x"]
    error = (phase.coordinate - np.arange(120.0))[phase.mask]
    assert phase.mask.mean() > 0.95 and np.sqrt(np.mean(error**2)) < 2.0


def test_a_projector_size_that_is_not_stated_is_said(run: Run, tmp_path: Path) -> None:
    source, session = write_colour(tmp_path / "source"), tmp_path / "session"
    status, out, err = run("import", "auto", source, session, "--role", "scan")
    assert not missing_facts(out, "1 capture", "scan")
    assert status == 0 and not missing_facts(err, "projector", "not stated")
    status, out, _ = run("inspect", session)
    assert status == 0 and not missing_facts(out, "unknown size")


def test_the_size_of_the_session_is_named_only_where_it_was_used(
    run: Run, tmp_path: Path, monkeypatch
) -> None:
    write_captures(tmp_path / "source", 1)
    session, warnings = tmp_path / "session", []
    assert (
        run("import", "procam-calibration", tmp_path / "source", session, "--projector", "120x90")[
            0
        ]
        == 0
    )
    images = re.compile(r"graycode_(\d+)")

    def make_layout(stated: tuple[int, int] | None) -> FolderLayout:
        def describe(
            folder: Path, name: str, projector: tuple[int, int]
        ) -> tuple[ImportableRecording, list[str]]:
            files = match_images(folder, images)[0]
            return (
                ImportableRecording(name, gray(stated or projector), tuple(files.values()), folder),
                [],
            )

        return define_layout("own", "images", describe, lambda folder: has_images(folder, images))

    for stated, expected in (((160, 100), 0), (None, 1)):
        monkeypatch.setitem(BUILT_IN, "own", make_layout(stated))
        find_captures(tmp_path / "source", "own", session=session, warn=warnings.append)
        assert len(warnings) == expected and all("120x90" in warning for warning in warnings)


@pytest.mark.parametrize(("gain", "word"), [(0.2, "exposure"), (1.9, "saturated"), (1.0, "")])
def test_a_wrong_exposure_is_reported(tmp_path: Path, run: Run, gain: float, word: str) -> None:
    steps = phase_steps("x", 4, float(PROJECTOR[0]))
    sequence = PatternSequence(PROJECTOR, tuple(steps))
    (folder := tmp_path / "source").mkdir()
    for number, frame in enumerate(photographed(sequence, 0)):
        bright = np.clip(np.rint(frame * gain), 0, 255).astype(np.uint8)
        assert cv2.imwrite(str(folder / f"{number}.png"), bright)
    lines = [
        f'[[frame]]\nfile = "{k}.png"\n' + _toml(frame.to_dict()) for k, frame in enumerate(steps)
    ]
    (tmp_path / "frames.toml").write_text('projector = "120x90"\n' + "\n".join(lines))
    status, _, err = run(
        "import", "frames", folder, tmp_path / "session", "--sequence", tmp_path / "frames.toml"
    )
    assert status == (gain > 1) and (word in err if word else "warning" not in err), err


def _toml(values: dict) -> str:
    return "\n".join(
        f'{k} = "{v}"' if isinstance(v, str) else f"{k} = {v}" for k, v in values.items()
    )


@pytest.mark.parametrize("is_exchanged", [False, True])
def test_exchanged_inverses_of_a_binary_code_are_mentioned(
    tmp_path: Path, is_exchanged: bool
) -> None:
    """The negative of a binary code numbers the columns from the other end."""
    column = np.clip(np.linspace(5, 250, 400), 0, 255).astype(int)
    for bit in range(8):
        image = np.repeat(40 + 180 * ((column[None] >> (7 - bit)) & 1), 60, axis=0)
        noise = np.random.default_rng(bit).normal(0, 1, image.shape)
        for kind, levels in (("a", image), ("b", 260 - image)):
            cv2.imwrite(str(tmp_path / f"{kind}{bit}.png"), np.rint(levels + noise))
    toml = 'projector = "256x200"\ncode = "binary"\ngray_origin = -0.5\n'
    kinds = ("inverse", "gray") if is_exchanged else ("gray", "inverse")
    for files, kind in zip("ab", kinds, strict=True):
        toml += f'[[frames]]\nkind = "{kind}"\naxis = "x"\nbits = 8\nfiles = "{files}*.png"\n'
    (tmp_path / "frames.toml").write_text(toml)
    warnings = list[str]()
    import_captures(tmp_path, tmp_path / "session", "frames", role="scan", warn=warnings.append)
    assert ("inverses are exchanged" in " ".join(warnings)) == is_exchanged


def test_bits_that_no_cell_needs_are_mentioned() -> None:
    sequence = gray((684, 512))
    assert not any(_describe_unneeded_bits(sequence, axis) for axis in ("x", "y"))
    wide = replace(sequence, gray_cell_px=2.0)
    assert not missing_facts(_describe_unneeded_bits(wide, "x"), "342 cells of 2 px", "10 bits")
