"""The release: what sdist and wheel hold, and whether an installed wheel works outside of the
checkout."""

import os
import re
import shlex
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
import trimesh

import slviewer

ROOT = Path(__file__).parents[1]


def run(*command: str | Path, cwd: Path) -> str:
    """Return the standard output of a command that must succeed; it sees no checkout and no
    settings of ours."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "PYTHONHOME")
    }
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{command}: {done.stderr[-2000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path]:
    """An sdist, and a wheel that was built from it; needs no network."""
    for needed in ("build", "hatchling", "hatch_vcs"):
        pytest.importorskip(needed)
    folder = tmp_path_factory.mktemp("dist")
    version_file = ROOT / "slviewer" / "_version.py"
    before = version_file.read_bytes() if version_file.exists() else None
    try:
        run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    finally:  # the build writes the version into the checkout
        if before is not None:
            version_file.write_bytes(before)
        else:
            version_file.unlink(missing_ok=True)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return sdist, wheel


def test_the_version_without_git_is_the_same_in_the_build_and_in_the_package() -> None:
    fallback = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"][
        "version"
    ]
    source = (ROOT / "slviewer" / "__init__.py").read_text("utf-8")
    assert re.findall(r'__version__ = "(.+)"', source) == [fallback["fallback-version"]]
    assert re.fullmatch(r"\d+\.\d+\.\d+[\w.+]*", slviewer.__version__)


@pytest.mark.slow
@pytest.mark.process
def test_an_sdist_holds_sources_docs_tests_and_assets_and_no_caches(built) -> None:
    with tarfile.open(built[0]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted = (
        "README.md LICENSE SECURITY.md CHANGELOG.md CITATION.cff pyproject.toml"
        " docs/architecture.md"
    )
    assert {
        *wanted.split(),
        "tests/test_release.py",
        "assets/rigs/webcam.toml",
        "slviewer/py.typed",
    } <= names
    assert not [
        name
        for name in names
        if re.search(r"__pycache__|\.venv|\.git/|\.\w+_cache/|^dist/|\.zarr", name)
    ]


@pytest.mark.slow
@pytest.mark.process
def test_a_wheel_works_without_the_checkout(built, tmp_path) -> None:
    with zipfile.ZipFile(built[1]) as archive:
        names = set(archive.namelist())
    pages = {
        f"server/{name}"
        for name in ("login.html", "projector.html", "camera.html", "device_page.js")
    }
    data = {
        "report/page.html.j2",
        "report/page.css",
        "py.typed",
        "assets/rigs/webcam.toml",
        "_version.py",
        *pages,
    }
    assert {f"slviewer/{name}" for name in data} <= names
    assert not [name for name in names if not name.startswith(("slviewer/", "slviewer-"))]

    # The wheel in an environment of its own; its dependencies are those of this environment, which
    # need no network.
    venv.create(tmp_path / "venv", with_pip=False)
    site = run(
        _python(tmp_path),
        "-c",
        "import sysconfig; print(sysconfig.get_path('purelib'))",
        cwd=tmp_path,
    ).strip()
    with zipfile.ZipFile(built[1]) as archive:
        archive.extractall(site)
    Path(site, "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", "utf-8")
    version = built[1].name.split("-")[1]
    show = (
        "import slviewer as s, importlib.metadata as m; print(s.__file__, s.__version__,"
        " m.version('slviewer'))"
    )
    where, *versions = run(_python(tmp_path), "-c", show, cwd=tmp_path).split()
    assert Path(where).is_relative_to(site) and versions == [version, version]

    assert run(_python(tmp_path), "-m", "slviewer.cli", "--version", cwd=tmp_path).split() == [
        "slviewer",
        version,
    ]
    for line in _quick_start():
        run(_python(tmp_path), "-m", "slviewer.cli", *shlex.split(line)[1:], cwd=tmp_path)
    ply, mesh = tmp_path / "object.ply", trimesh.load(tmp_path / "object.stl")
    assert ply.read_bytes()[:3] == b"ply"
    assert len(mesh.faces) > 20_000 and 100 < mesh.extents.max() < 200  # the object is 150 mm wide


def _quick_start() -> list[str]:
    """Return the commands of the quick start, as they are written."""
    page = (ROOT / "docs" / "quickstart.md").read_text("utf-8")
    blocks = re.findall(r"(?<! -->\n)^```bash\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines() if line]
    assert len(lines) > 8 and all(line.startswith("slviewer ") for line in lines)
    return lines


def _python(folder: Path) -> Path:
    """Return the interpreter of the environment in ``folder``."""
    return folder / "venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
