"""The kernels' machine code: never stale, kept wherever something can be written, done without
where nothing can."""

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import slviewer.geometry

CALLER = """
from slviewer.geometry.jit import kernel
from slviewer.helper import {name}

@kernel()
def answer(x):
    return x * {name}

if __name__ != "__main__":
    print(answer(2), sum(answer.stats.cache_hits.values()), answer.stats.cache_path)
"""


@pytest.fixture
def install(tmp_path: Path) -> Path:
    """A folder to import ``slviewer`` from: the real decorator, one kernel, and a file with a
    constant of its."""
    package = tmp_path / "install" / "slviewer"
    (package / "geometry").mkdir(parents=True)
    for name in ("jit.py", "jit_cache.py", "__init__.py"):
        shutil.copy(Path(slviewer.geometry.__path__[0], name), package / "geometry")
    (package / "__init__.py").touch()
    (package / "caller.py").write_text(CALLER.format(name="FACTOR"))
    (package / "helper.py").write_text("FACTOR = 3\n")
    return package.parent


def run(install: Path, code: str, **environment: str) -> list[str]:
    given = {
        name: value
        for name, value in os.environ.items()
        if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**given, "PYTHONPATH": str(install), "PYTHONDONTWRITEBYTECODE": "1", **environment},
        cwd=install,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def read_only(install: Path) -> None:
    """Nothing can be written beside the sources, by root either: a file stands where the folder
    would be."""
    shutil.rmtree(install / "slviewer" / "__pycache__", ignore_errors=True)
    (install / "slviewer" / "__pycache__").touch()


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.computes
def test_another_files_change_is_seen_and_code_is_compiled_once(
    install: Path, tmp_path: Path
) -> None:
    home = {"HOME": str(tmp_path / "home")}
    value, hits, place = run(install, "import slviewer.caller", **home)
    assert (value, hits) == ("6", "0") and Path(place).is_relative_to(install)
    (install / "slviewer" / "helper.py").write_text("FACTOR = 5\n")
    read_only(install)
    value, hits, place = run(install, "import slviewer.caller", **home)
    assert (value, hits) == ("10", "0") and Path(place).is_relative_to(tmp_path / "home")
    value, hits, place = run(install, "import slviewer.caller", **home)
    assert (value, hits) == ("10", "1")


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.computes
def test_of_two_processes_one_compiles_and_the_other_waits_and_loads(install: Path) -> None:
    with ThreadPoolExecutor(2) as both:
        results = [*both.map(lambda _: run(install, "import slviewer.caller"), range(2))]
    assert sorted((value, hits) for value, hits, _ in results) == [("6", "0"), ("6", "1")]


PLACE = (
    "from slviewer.geometry.jit_cache import cache_folder; print(cache_folder('slviewer.caller'))"
)


@pytest.mark.process
def test_places_are_tried_in_turn_and_old_code_goes(install: Path, tmp_path: Path) -> None:
    given, temp, wall = tmp_path / "given", tmp_path / "temp", tmp_path / "wall"
    temp.mkdir()
    wall.touch()  # no folder can be made under a file
    (first,) = run(install, PLACE, NUMBA_CACHE_DIR=str(given))
    assert Path(first).is_relative_to(given)
    (install / "slviewer" / "helper.py").write_text("FACTOR = 5\n")
    (second,) = run(install, PLACE, NUMBA_CACHE_DIR=str(given))
    assert Path(second).is_dir() and second != first and not Path(first).exists()
    read_only(install)
    (third,) = run(install, PLACE, HOME=str(wall), TMPDIR=str(temp))
    assert Path(third).is_relative_to(temp)
    assert Path(third).parent.stat().st_mode & 0o777 == 0o700


@pytest.mark.process
def test_a_folder_that_others_may_write_to_is_not_read(install: Path, tmp_path: Path) -> None:
    read_only(install)
    temp, wall = tmp_path / "temp", tmp_path / "wall"
    temp.mkdir()
    wall.touch()
    (place,) = run(install, PLACE, HOME=str(wall), TMPDIR=str(temp))
    Path(place).parent.chmod(0o777)
    assert run(install, PLACE, HOME=str(wall), TMPDIR=str(temp)) == ["None"]


@pytest.mark.process
def test_where_no_place_is_left_none_is_named(install: Path, tmp_path: Path) -> None:
    read_only(install)
    (tmp_path / "wall").touch()
    code = f"import tempfile; tempfile.gettempdir = lambda: '{tmp_path / 'wall'}'; {PLACE}"
    assert run(install, code, HOME=str(tmp_path / "wall")) == ["None"]


@pytest.mark.parametrize(
    "line",
    [
        "import slviewer.helper",
        "from slviewer import helper",
        "from slviewer import (\n    caller,\n    helper,\n)",
        "def later():\n    from slviewer.helper import FACTOR",
    ],
)
def test_every_way_to_import_counts(
    line: str, install: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from slviewer.geometry import jit_cache

    monkeypatch.setattr(jit_cache, "PACKAGE", install / "slviewer")
    (install / "slviewer" / "other.py").write_text(f"{line}\n")
    hashes = set()
    for factor in (3, 5, 3):
        (install / "slviewer" / "helper.py").write_text(f"FACTOR = {factor}\n")
        jit_cache._hash_source.cache_clear()
        hashes.add(jit_cache.hash_sources("slviewer.other"))
    jit_cache._hash_source.cache_clear()
    assert len(hashes) == 2
