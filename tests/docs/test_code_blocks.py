"""The code blocks of README and docs work: commands and Python are run, TOML is read, or the reason
why not is stated.

A block that cannot be run follows a comment: <!-- not run: reason -->. The quick start is run with
the built wheel, in tests/test_release.py. Most pages work on one simulated session and share the
names in it; only -m slow runs them.
"""

import inspect
import re
import shlex
import shutil
import tomllib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from slviewer.cli import main
from slviewer.devices.drivers import builtin_drivers
from slviewer.pipeline import simulate as simulation
from slviewer.pipeline.rig_choice import check_choice, driver_factory
from slviewer.session.store import Session
from slviewer.simulation.plans import spheres
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.turning import turning

ROOT = Path(__file__).parents[2]
GENERATED = {"cli.md", *(path.name for path in (ROOT / "docs" / "reference").glob("python*.md"))}
WRITTEN = [p for p in (ROOT / "docs").rglob("*.md") if not {"_build", "gallery"} & set(p.parts)]
PAGES = [ROOT / "README.md", *sorted(WRITTEN)]
BLOCK = re.compile(
    r"(?:^ *<!-- not run: (?P<reason>[^\n]+) -->\n)?^ *```(?P<language>\w*)[^\n]*\n(?P<code>.*?)^"
    r" *```",
    re.MULTILINE | re.DOTALL,
)
BOARD = "circles:21x16:9"
WITHOUT_SESSION = {"choosing.md", "boards.md", "markers.md", "first-scan.md"}
"""Pages whose commands need no session."""
RIG = 'driver = "simulated"\nscale = 0.15\nthing = "stone"\n\n[turntable]\ndriver = "simulated"\n'


@dataclass(frozen=True)
class Block:
    page: Path
    language: str
    code: str
    reason: str


def blocks(page: Path, language: str = "") -> list[Block]:
    """The code blocks of a page, all or those of a language."""
    found = [
        Block(page, m["language"], m["code"], m["reason"] or "")
        for m in BLOCK.finditer(page.read_text(encoding="utf-8"))
    ]
    return [block for block in found if not language or block.language == language]


def pages_with(language: str) -> list[Path]:
    return [
        page
        for page in PAGES
        if page.name not in {*GENERATED, "quickstart.md"}
        and any(not b.reason for b in blocks(page, language))
    ]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name not in GENERATED], ids=name_of
)
def test_every_block_states_its_language(page: Path) -> None:
    known = {"bash", "python", "toml", "text", "nginx", "math"}
    unknown = [
        block.code
        for block in blocks(page)
        if not (block.language in known or page.name == "index.md")
    ]
    assert not unknown


@pytest.mark.parametrize("page", pages_with("toml"), ids=name_of)
def test_toml_is_valid(page: Path) -> None:
    for block in blocks(page, "toml"):
        values = tomllib.loads(block.code)
        values.pop("what", None)
        if not block.reason and ({"camera", "driver"} & values.keys()) and "frame" not in values:
            check_choice(values, name_of(page))


def run(line: str) -> None:
    """Run one command of slviewer in this process; its comment may state that its exit status may
    be 1."""
    words: list[str] = []
    for word in shlex.split(line, comments=True)[1:]:
        if span := re.fullmatch(r"(.*)\{(\d+)\.\.(\d+)\}", word):  # as a shell does
            words += [
                f"{span[1]}{k:0{len(span[2])}d}" for k in range(int(span[2]), int(span[3]) + 1)
            ]
        else:
            words.append(word)
    assert main(words) in ((0, 1) if "# status 1" in line else (0,)), line


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, few_cells: None) -> Path:
    """A folder with the sessions and files that the pages name."""
    folder = tmp_path_factory.mktemp("workspace")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("my-rig.toml").write_text(RIG)
        with pytest.MonkeyPatch.context() as fewer:
            # those that the pages name
            fewer.setattr(simulation, "turning", lambda: dict(list(turning().items())[:3]))
            run("slviewer simulate my-session --preset turn --poses 8 --scale 0.15")
        with Session.open("my-session", write=True) as session:
            sequence = session.load_capture("object_r1").sequence
            ball = Renderer(letter(0.15), spheres()["sphere_3"]).capture(sequence)
            session.save_capture("ball", "scan", sequence, ball, source="simulated")
            session.save_rig("my-rig", RIG)
            for number, mark in enumerate("abc", 1):
                capture = session.load_capture(f"object_r{number}")
                for name in (f"part_{number}", f"part_{mark}"):
                    session.save_capture(name, "scan", sequence, capture.frames, source="simulated")
        run(f"slviewer calibrate my-session --target {BOARD}")
        run("slviewer merge my-session part_a part_b part_c --reference part_c")
        run("slviewer reconstruct my-session part_a --grid part_a.npy")
        cloud = np.load("part_a.npy")
        valid = cloud[np.isfinite(cloud[..., 2])]
        for shape, radius, wanted in (("plane", 5.0, 1), ("sphere", 15.0, 2)):  # m1, m2, m3
            places = valid[:: len(valid) // 50]
            if shape == "sphere":  # of what is curved like one most lies at the rim
                places = places[
                    np.argsort(-np.linalg.norm(places - np.median(valid, axis=0), axis=1))
                ]
            for place in places:
                ball = [f"{x:.1f}" for x in (*place, radius)]
                wanted -= main(["measure", "my-session", "part_a", shape, "--ball", *ball]) == 0
                if not wanted:
                    break
        run("slviewer report my-session --out report.html")
        run("slviewer mesh my-session part_a --out nominal.stl")
        shutil.copy("nominal.stl", "part.stl")
        for other in ("other-session", "monday", "tuesday"):
            shutil.copytree("my-session", other)
    return folder


@pytest.mark.computes
@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in pages_with("bash") if p.name not in WITHOUT_SESSION], ids=name_of
)
def test_the_commands_of_a_page_run(
    page: Path, workspace: Path, tmp_path: Path, monkeypatch
) -> None:
    shutil.copytree(workspace, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    run_blocks(page)


@pytest.mark.computes
@pytest.mark.parametrize(
    "page", [p for p in pages_with("bash") if p.name in WITHOUT_SESSION], ids=name_of
)
def test_the_commands_of_a_page_without_a_session_run(
    page: Path, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_blocks(page)


def run_blocks(page: Path) -> None:
    """Run the commands of a page in the current folder, where its named TOML files are written
    first."""
    for block in blocks(page):
        if named := re.match(r"# (\S+\.toml)\n", block.code):
            Path(named[1]).write_text(block.code)
        if block.reason or block.language != "bash":
            continue
        for line in re.sub(r"\\\n", " ", block.code).splitlines():
            if line.strip():
                assert line.split()[0] == "slviewer", f"{line}: state why it is not run"
                run(line)


@pytest.mark.computes
@pytest.mark.parametrize("page", pages_with("python"), ids=name_of)
def test_the_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    capture = tmp_path / "captures" / "part_1"  # of the layout that docs/howto/plugins.md describes
    capture.mkdir(parents=True)
    columns, noise = 480 + np.arange(320), np.random.default_rng(0)
    for k in range(12):
        phase = 2 * np.pi * (columns / (1280, 180, 30)[k // 4] + k % 4 / 4)
        frame = 120 + 80 * np.cos(phase) + noise.normal(0, 1, (240, 320))
        cv2.imwrite(str(capture / f"shot{k:02d}.png"), frame.astype(np.uint8))
    names: dict[str, object] = {"__name__": "page"}
    for block in blocks(page, "python"):
        if not block.reason:
            exec(compile(block.code, name_of(page), "exec"), names)


def test_the_page_of_rig_files_names_every_option() -> None:
    page = (ROOT / "docs" / "reference" / "rig-files.md").read_text(encoding="utf-8")
    provided = {"board", "world", "page", "timing"}  # by the program
    for name, found in builtin_drivers().items():
        for part in ("camera", "projector", "turntable", "rig"):
            make = driver_factory(found, part)
            row = " ".join(line for line in page.splitlines() if line.startswith(f"| `{name}` |"))
            if make is not None:
                missing = [
                    p
                    for p in inspect.signature(make).parameters
                    if p not in provided and f"`{p}`" not in row
                ]
                assert not missing, (name, part)
