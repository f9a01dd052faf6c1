"""The rules of Windows, imposed on every system: no synced folders, no open files replaced, no
names of devices."""

import builtins
import io
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from facts import raises

from slviewer import terminal
from slviewer.errors import InputError, SessionError
from slviewer.session.atomic import replace_file
from slviewer.session.capture import NewCapture
from slviewer.session.layout import new_folder
from slviewer.session.names import folder_name, new_name, safe_name
from slviewer.session.store import Session


@pytest.fixture
def windows(monkeypatch):
    """Refuse what Windows refuses: to open folders, and to move or remove what is open in this
    process."""
    if not Path("/proc/self/fd").is_dir():
        pytest.skip("open files cannot be listed here")
    real_open = os.open

    def open_file(path, flags, *rest, **options):
        # not shutil.rmtree's, of other systems
        if not isinstance(path, int) and os.path.isdir(path) and not options:
            raise PermissionError(13, "Permission denied", str(path))
        return real_open(path, flags, *rest, **options)

    def refusing(real, replaces=False):
        def call(source, target, **options):
            for path in (source, target):
                require_closed(path)
            if os.path.exists(target) and (not replaces or os.path.isdir(target)):
                raise FileExistsError(17, "File exists", str(target))
            return real(source, target, **options)

        return call

    monkeypatch.setattr("slviewer.session.atomic._SYNCS_FOLDERS", False)
    monkeypatch.setattr(os, "open", open_file)
    monkeypatch.setattr(os, "rename", refusing(os.rename))
    monkeypatch.setattr(os, "replace", refusing(os.replace, replaces=True))


def require_closed(path) -> None:
    """Raise PermissionError where a file at or below a path is open or mapped into memory."""
    top = os.path.realpath(path)
    held = {
        os.readlink(link)
        for link in map(str, Path("/proc/self/fd").iterdir())
        if os.path.islink(link)
    }
    maps = Path("/proc/self/maps").read_text().splitlines()
    held |= {line.split(maxsplit=5)[5] for line in maps if "/" in line}
    if any(name == top or name.startswith(top + os.sep) for name in held):
        raise PermissionError(
            13, "The process cannot access the file because it is used", str(path)
        )


def test_the_simulation_refuses_to_move_what_is_open(windows, tmp_path) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    with open(folder / "x", "w"), pytest.raises(PermissionError):
        os.rename(folder, tmp_path / "b")
    os.rename(folder, tmp_path / "b")


def test_a_session_is_saved_and_replaced_by_the_rules_of_windows(
    windows, tmp_path, sequence, frames, noise
) -> None:
    with Session.create(tmp_path / "session") as session:
        session.save_capture("part", "scan", sequence, frames, source="test")
        assert (session.load_capture("part").stack() == frames).all()
        session.save_capture("part", "scan", sequence, noise(2), source="test", force=True)
        assert (session.load_capture("part").stack() == noise(2)).all()
        session.save_rig("mine", "settle_ms = 1")
        session.save_rig("mine", "settle_ms = 2")
        session.exchange({"part": None})
    with Session.open(tmp_path / "session", write=True) as session:
        assert session.capture_names() == []


def test_a_file_that_another_program_has_open_for_a_moment_is_waited_for(
    windows, monkeypatch, tmp_path
) -> None:
    path = tmp_path / "table.csv"
    replace_file(path, b"old")
    with open(path, "rb") as held:
        pauses = []
        monkeypatch.setattr(
            time, "sleep", lambda seconds: pauses.append(seconds) or len(pauses) < 3 or held.close()
        )
        monkeypatch.setattr("slviewer.session.atomic._PATIENCE_S", 60.0)
        replace_file(path, b"new")
    assert path.read_bytes() == b"new" and len(pauses) == 3
    monkeypatch.setattr("slviewer.session.atomic._PATIENCE_S", 0.0)
    with open(path, "rb"), raises(SessionError, "table.csv"):
        replace_file(path, b"never")
    assert path.read_bytes() == b"new" and [each.name for each in tmp_path.iterdir()] == [
        "table.csv"
    ]


@pytest.mark.parametrize("name", ["con", "NUL", "aux.txt", "Com1", "lpt9.a.b"])
def test_names_of_devices_are_refused_for_what_is_new(session, sequence, frames, name) -> None:
    for save in (
        lambda: new_name(name),
        lambda: session.save_capture(name, "scan", sequence, frames, source="test"),
        lambda: session.save_rig(name, ""),
    ):
        with raises(InputError, f"'{name}'", "device"):
            save()
    assert safe_name(name) == name  # what an older version saved can be read
    assert new_name("console") == "console" and new_name("com10") == "com10"


def test_names_that_differ_in_case_alone_are_refused(session, sequence, frames) -> None:
    session.save_capture("Part", "scan", sequence, frames, source="test")
    session.save_rig("bench", "settle_ms = 1")
    both = [NewCapture(name, sequence, frames, None, "test", {}) for name in ("a", "A")]
    for save, *names in (
        (
            lambda: session.save_capture("part", "scan", sequence, frames, source="test"),
            "'part'",
            "'Part'",
        ),
        (
            lambda: session.save_capture("PART", "scan", sequence, frames, source="", force=True),
            "'PART'",
            "'Part'",
        ),
        (lambda: session.save_rig("Bench", ""), "'Bench'", "'bench'"),
        (lambda: session.save_captures(both, "scan"), "'a'", "'A'"),
    ):
        with raises(InputError, *names, "Windows"):
            save()
    assert session.capture_names() == ["Part"]
    session.save_capture("Part", "scan", sequence, frames, source="test", force=True)


def test_a_session_s_path_leaves_room_for_its_files(tmp_path, monkeypatch) -> None:
    long = tmp_path / ("x" * 120)
    with monkeypatch.context() as patch, raises(SessionError, len(str(long)), 259, 120):
        patch.setattr("slviewer.session.layout._IS_WINDOWS", True)
        new_folder(long)
    assert not long.exists()
    Session.create(long).close()


@pytest.mark.process
def test_files_are_opened_with_an_encoding() -> None:
    """By default Windows reads and writes text in a code page of its own."""
    command = [
        sys.executable,
        "-m",
        "ruff",
        "check",
        "--preview",
        "--select",
        "PLW1514",
        "slviewer",
        "docs",
    ]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def test_modules_of_other_systems_are_imported_by_no_module_at_its_top() -> None:
    missing = {"resource", "fcntl", "termios", "pwd", "grp", "pty"}
    for path in Path(terminal.__file__).parent.rglob("*.py"):
        for line in path.read_text("utf-8").splitlines():
            assert not (line.startswith(("import ", "from ")) and line.split()[1] in missing), path


def test_what_a_console_lacks_is_replaced(monkeypatch) -> None:
    streams = [io.TextIOWrapper(io.BytesIO(), "cp1252") for _ in range(2)]
    monkeypatch.setattr(sys, "stdout", streams[0])
    monkeypatch.setattr(sys, "stderr", streams[1])
    terminal.accept_all_characters()
    for stream in streams:
        builtins.print("±0.1 → done", file=stream, flush=True)
        assert b"0.1" in stream.buffer.getvalue() and b"done" in stream.buffer.getvalue()


def test_a_session_may_have_any_printable_name_that_is_one_folder_everywhere() -> None:
    assert folder_name("  Müller  Teil 5 😀 ") == "Müller Teil 5 😀"
    for name in (
        "a / b",
        "..",
        "a\\b",
        "c:",
        "what?",
        "con",
        "end.",
        ".hidden",
        "tab\x00",
        300 * "x",
    ):
        with raises(InputError, *([name] if name in ("a / b", "what?") else [])):
            folder_name(name)
