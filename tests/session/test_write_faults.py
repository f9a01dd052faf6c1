"""Wherever the program is killed while it writes, or the disk refuses: nothing saved is lost, and
work goes on."""

import shutil
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts
from faults import FAULTS, KILL, Disk, Killed, watching

from slviewer.errors import SessionError
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import gray
from slviewer.pipeline.import_captures import import_captures
from slviewer.pipeline.operation import opened_or_made
from slviewer.pipeline.report import inspect
from slviewer.session import atomic, store
from slviewer.session.capture import NewCapture
from slviewer.session.layout import WriterLock
from slviewer.session.store import Session


@contextmanager
def faulty(disk: Disk) -> Iterator[None]:
    """Context manager: everything that changes files is counted by the disk; locks of the dead are
    released after."""
    locks: list[WriterLock] = []

    class Lock(WriterLock):
        def __init__(self, folder: Path) -> None:
            super().__init__(folder)
            locks.append(self)

    with watching(disk) as patch:
        patch.setattr(store, "WriterLock", Lock)
        try:
            yield
        finally:
            for lock in locks:  # the system does so when a process ends
                lock._lock.release(force=True)


def points(calls: list[str], most: int) -> list[int]:
    """Numbers of the calls to fail at: all that rename, remove or make, and some that write and
    sync."""
    moves = [
        i
        for i, name in enumerate(calls)
        if name in ("rename", "replace", "mkdir", "unlink", "rmdir")
    ]
    others = np.linspace(0, len(calls) - 1, most).astype(int).tolist()
    return sorted({*moves[:: max(1, len(moves) // most)], *moves[-3:], *others})


def whole_captures(folder: Path) -> dict[str, str]:
    """{name: source} of the session's captures, all of which must be what was saved; nothing else
    may be there."""
    with Session.open(folder, write=True) as session:
        assert not atomic.list_leftovers(folder)
        captures, faults = session.read_captures()
        assert not faults
        for capture in captures:
            capture.verify()
        for name in session.result_names():
            session.load_result(name)
        return {capture.name: capture.meta["source"] for capture in captures}


@pytest.fixture
def new(sequence, noise):
    """Makes captures to save, by their seeds."""
    return lambda *seeds, source="": [
        NewCapture(f"pose_{i}", sequence, noise(i), None, source) for i in seeds
    ]


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(name, marks=[] if name in ("kill", "disk full") else pytest.mark.slow)
        for name in FAULTS
    ],
)
def test_several_captures_are_saved_whatever_happens(tmp_path, new, fault):
    def attempt(folder: Path, disk: Disk) -> None:
        with faulty(disk), opened_or_made(folder) as session:
            session.save_captures(
                new(*(i for i in (1, 2, 3) if f"pose_{i}" not in session.capture_names())), "scan"
            )
            session.save_result("clouds/pose_1", {}, {"a": np.arange(5)})
            session.exclude("pose_1", "why")

    attempt(tmp_path / "dry", counted := Disk(None))
    counts = set()
    for at in points(counted.calls, 12):
        folder = tmp_path / f"session_{at}"
        disk = Disk(at, FAULTS[fault])
        with pytest.raises((Killed, SessionError) if FAULTS[fault] else Killed):
            attempt(folder, disk)
            if FAULTS[fault]:  # what only tidies up may fail unnoticed
                raise SessionError("nothing failed")
        if (folder / "session.json").exists():
            there = whole_captures(folder)
            counts.add(len(there))
            complete = [name for name in disk.calls[:at] if name == "rename"]
            assert FAULTS[fault] != KILL or len(there) >= min(3, len(complete)), (
                "a complete capture was removed"
            )
        attempt(folder, Disk(None))
        assert set(whole_captures(folder)) == {"pose_1", "pose_2", "pose_3"}
        with Session.open(folder) as session:
            assert session.excluded() and session.state_of("clouds/pose_1") == "fresh"
    assert {0, 3} <= counts if fault != "kill" else counts == {0, 1, 2, 3}


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(name, marks=[] if name in ("kill", "disk full") else pytest.mark.slow)
        for name in FAULTS
    ],
)
def test_a_replacement_is_the_old_or_the_new(tmp_path, sequence, new, fault):
    def attempt(folder: Path, disk: Disk) -> None:
        with faulty(disk), Session.open(folder, write=True) as session:
            session.save_captures(new(1, source="new"), "scan", force=True)
            session.save_result("clouds/pose_1", {"made": "new"}, {"a": np.arange(9)})

    def prepare(folder: Path) -> Path:
        with Session.create(folder) as session:
            session.save_captures(new(1, 2, source="old"), "scan")
            session.save_result("clouds/pose_1", {"made": "old"}, {"a": np.arange(5)})
        return folder

    old = prepare(tmp_path / "old")
    attempt(shutil.copytree(old, tmp_path / "dry"), counted := Disk(None))
    for at in points(counted.calls, 12):
        folder = shutil.copytree(old, tmp_path / f"session_{at}")
        with suppress(Killed, SessionError):
            attempt(folder, Disk(at, FAULTS[fault]))
        there = whole_captures(folder)
        assert (
            set(there) == {"pose_1", "pose_2"}
            and there["pose_2"] == "old"
            and there["pose_1"] in ("old", "new")
        )
        with Session.open(folder) as session:
            meta, arrays = session.load_result("clouds/pose_1")
            assert len(arrays["a"]) == {"old": 5, "new": 9}[meta["made"]]
        attempt(folder, Disk(None))
        assert whole_captures(folder) == {"pose_1": "new", "pose_2": "old"}


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize("fault", ["kill", "disk full"])
def test_an_import_that_was_interrupted_continues(tmp_path, fault):
    sequence, source = gray((60, 40)), tmp_path / "source"
    rng = np.random.default_rng(0)
    for number in range(3):
        (folder := source / f"capture_{number}").mkdir(parents=True)
        for i in range(len(sequence.frames)):
            image = np.clip(
                render_pattern(sequence, i) * 0.5 + 40 + rng.normal(0, 1, (40, 60)), 0, 255
            ).round()
            cv2.imwrite(str(folder / f"graycode_{i:02d}.png"), image.astype(np.uint8))

    def attempt(folder: Path, disk: Disk) -> list[str]:
        warnings: list[str] = []
        with faulty(disk):
            import_captures(source, folder, projector="60x40", warn=warnings.append)
        return [warning for warning in warnings if missing_facts(warning, "already") == []]

    attempt(tmp_path / "dry", counted := Disk(None))
    repeated = set()
    for at in points(counted.calls, 4 if fault == "kill" else 1):
        folder = tmp_path / f"session_{at}"
        with pytest.raises((Killed, SessionError)):
            attempt(folder, Disk(at, FAULTS[fault]))
            raise SessionError("nothing failed")
        there = whole_captures(folder) if (folder / "session.json").exists() else {}
        skipped = attempt(folder, Disk(None))
        assert len(skipped) == bool(there) and all(
            missing_facts(each, *there) == [] for each in skipped
        )
        repeated.add(len(there))
        assert len(whole_captures(folder)) == 3 and not (folder / "trash").exists()
        assert missing_facts(inspect(folder, check=True), "3 captures") == []
    assert fault != "kill" or len(repeated) >= 3


def test_a_session_that_another_writer_works_in_is_never_removed(tmp_path, sequence, frames):
    folder = tmp_path / "session"
    with pytest.raises(SessionError), opened_or_made(folder):
        raise SessionError("a failure before anything is saved")
    assert not folder.exists()
    with pytest.raises(SessionError), opened_or_made(folder) as session:
        (session.folder / "notes.txt").write_text("of the operator")
        raise SessionError("a failure")
    assert (folder / "notes.txt").exists() and Session.open(folder).capture_names() == []
    (tmp_path / "made").mkdir()
    with pytest.raises(SessionError), opened_or_made(tmp_path / "made"):
        raise SessionError("a failure")
    assert list((tmp_path / "made").iterdir()) == []
    # made by another: never removed
    with (
        pytest.raises(SessionError),
        opened_or_made(folder) as session,
    ):
        raise SessionError("a failure")
    assert (folder / "session.json").exists()


def test_a_failed_creation_never_costs_a_second_writer_its_work(
    tmp_path, sequence, frames, monkeypatch
):
    """The second writer begins at every change to the disk that the first one makes."""

    class PatientLock(WriterLock):
        def acquire(self, patience_s: float = 60.0) -> None:
            super().acquire(patience_s)

    class Watch(Disk):
        """Counts the first writer's changes, and lets the second one begin at one of them."""

        def __init__(self, begin: int | None) -> None:
            super().__init__(None)
            self.started, self._begin, self._thread = (
                threading.Event(),
                begin,
                threading.get_ident(),
            )

        def call(self, name: str, *paths: object) -> None:
            if threading.get_ident() == self._thread:
                if len(self.calls) == self._begin:
                    self.started.set()
                super().call(name, *paths)

    def fail(folder: Path) -> None:
        with suppress(SessionError), opened_or_made(folder):
            raise SessionError("a failure before anything is saved")

    def save(folder: Path, started: threading.Event) -> None:
        assert started.wait(60)
        with opened_or_made(folder) as session:
            session.save_capture("a", "scan", sequence, frames, source="")

    monkeypatch.setattr(store, "WriterLock", PatientLock)
    with watching(dry := Watch(None)):
        fail(tmp_path / "dry")
    assert len(dry.calls) > 5
    for begin in range(len(dry.calls) + 1):
        folder = tmp_path / str(begin)
        with ThreadPoolExecutor(1) as pool, watching(watch := Watch(begin)):
            saving = pool.submit(save, folder, watch.started)
            fail(folder)
            watch.started.set()
            saving.result()
        assert whole_captures(folder) == {"a": ""}
