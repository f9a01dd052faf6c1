"""Nothing is half there and nothing is lost: killed writers, full disks."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
from facts import raises

from slviewer.errors import SessionError
from slviewer.session import atomic
from slviewer.session.layout import WriterLock
from slviewer.session.store import Session

WRITER = """
import os, signal, sys
import numpy as np
from faults import Disk, watching
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.store import Session

class Mortal(Disk):
    def die(self):
        os.kill(os.getpid(), signal.SIGKILL)

folder = sys.argv[1]
sequence = PatternSequence((96, 64), tuple(phase_steps("x", 24, 16.0)))

def save_until_killed(height, at):
    with Session.open(folder, write=True) as session, watching(Mortal(at)):
        frames = np.full((24, height, 640), 7, np.uint8)
        for i in range(10000):
            frames[:] = i % 251
            session.save_capture(
                f"new_{i % 20}", "scan", sequence, frames, source=str(i), force=True
            )
            session.save_result("calibration/stereo", {"i": i}, {"z": np.full((height, 640), i)})

for line in sys.stdin:
    child = os.fork()
    if child == 0:
        save_until_killed(*map(int, line.split()))
    print(os.WTERMSIG(os.waitpid(child, 0)[1]), flush=True)
"""
"""Starts one writer a line of its input, height of the frames and number of the change to the disk
in which it dies."""


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize(
    ("seed", "kills"),
    [pytest.param(0, 2, id="few"), pytest.param(1, 10, id="many", marks=pytest.mark.slow)],
)
def test_a_writer_killed_at_any_moment_leaves_whole_captures(
    tmp_path, sequence, frames, seed, kills
):
    folder = tmp_path / "session"
    with Session.create(folder) as session:
        session.save_capture("before", "scan", sequence, frames, source="")
    rng = np.random.default_rng(seed)
    caught_in_the_act = 0
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path]),
    }
    command = [sys.executable, "-c", WRITER, str(folder)]
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
        env=environment,
    ) as writers:
        for height in (8, 480, 1600):
            for _ in range(kills):
                print(height, rng.integers(20, 200), file=writers.stdin)
                assert writers.stdout.readline() == f"{signal.SIGKILL:d}\n"
                caught_in_the_act += bool(atomic.list_leftovers(folder))
                with Session.open(folder, write=True) as session:
                    assert not atomic.list_leftovers(folder)
                    np.testing.assert_array_equal(session.load_capture("before").frames, frames)
                    for capture in session.captures():
                        if capture.name != "before":
                            stack = capture.frames
                            assert (stack == int(capture.meta["source"]) % 251).all()
                    if session.state_of("calibration/stereo") != "absent":
                        meta, arrays = session.load_result("calibration/stereo")
                        assert (arrays["z"] == meta["i"]).all()
        writers.stdin.close()
    assert caught_in_the_act >= 3, "the writer was never killed in the middle of a save"


class Killed(BaseException):
    """Stands for `kill -9`: no clean-up that a program does itself may help."""


@pytest.mark.parametrize("renames", range(6))
def test_a_replacement_cut_short_anywhere_leaves_the_old_or_the_new(
    session, sequence, frames, monkeypatch, renames
):
    new = frames[::-1].copy()
    session.save_capture("a", "scan", sequence, frames, source="old")
    done = 0

    def dying(rename):
        def wrapped(*args):
            nonlocal done
            if done == renames:
                raise Killed
            done += 1
            return rename(*args)

        return wrapped

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", dying(os.rename))
        patch.setattr(atomic, "sync_folder", dying(atomic.sync_folder))
        patch.setattr(atomic, "discard", lambda path: None)
        with pytest.raises(Killed):
            session.save_capture("a", "scan", sequence, new, source="new", force=True)
    session.close()
    for write in (False, True):  # a reader recovers too, where nobody writes
        with Session.open(session.folder, write=write) as reopened:
            capture = reopened.load_capture("a")
            np.testing.assert_array_equal(
                capture.frames, frames if capture.meta["source"] == "old" else new
            )
            assert not atomic.list_leftovers(session.folder)
    if capture.meta["source"] == "new":
        assert len(list((session.folder / "trash").iterdir())) == 1


def test_a_reader_leaves_a_working_writer_alone(session, sequence, frames, monkeypatch):
    waits = []
    acquire = WriterLock.acquire
    monkeypatch.setattr(
        WriterLock, "acquire", lambda lock, patience_s: waits.append(patience_s) or acquire(lock, 0)
    )
    with atomic.staged_folder(session.folder / "captures" / "a", 1) as staged:
        assert Session.open(session.folder).capture_names() == []
        assert staged.is_dir()
    assert waits == [0]
    atomic.discard(staged)


def test_a_save_that_the_disk_has_no_room_for_is_refused(session, sequence, frames, monkeypatch):
    session.save_capture("a", "scan", sequence, frames, source="")
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 0, 12 * 10**6))
    big = np.zeros((4, 4000, 6000), np.uint8)
    with raises(SessionError, "96.0 MB", "1.0 MB", "12.0 MB", session.folder):
        session.save_capture("b", "scan", sequence, big, source="")
    with raises(SessionError, "12.0 MB", "12.0 MB are free", session.folder):
        session.save_result("calibration/stereo", {}, {"a": np.zeros(1_500_000)})
    _check_unharmed(session, frames)


@pytest.mark.parametrize("written", [0, 2, 4, 5])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_a_disk_that_fills_up_in_the_middle(
    session, sequence, frames, noise, monkeypatch, written, code
):
    session.save_capture("a", "scan", sequence, frames, source="")
    whole = atomic.write_bytes
    count = 0

    def failing(path, *parts):
        nonlocal count
        count += 1
        if count > written:
            path.write_bytes(b"half")
            raise OSError(code, os.strerror(code))
        whole(path, *parts)

    for module in ("atomic", "stack", "capture"):
        monkeypatch.setattr(f"slviewer.session.{module}.write_bytes", failing)
    saves = [lambda: session.save_capture("a", "scan", sequence, noise(9), source="", force=True)]
    if written == 0:
        saves.append(lambda: session.exclude("a", "why"))
    for save in saves:
        if written == 5:  # four frames and capture.json: all of a capture
            save()
            return
        with pytest.raises(SessionError):
            save()
        _check_unharmed(session, frames)
    assert session.excluded() == {}


def _check_unharmed(session, frames):
    with_lock = Session.open(session.folder)
    assert with_lock.capture_names() == ["a"] and with_lock.result_names() == []
    np.testing.assert_array_equal(with_lock.load_capture("a").frames, frames)
    assert not atomic.list_leftovers(session.folder)
