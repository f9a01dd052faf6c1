"""Results that belong together are replaced together, whatever happens on the way."""

import errno
import json
import os
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from slviewer.errors import InputError, SessionError
from slviewer.session import atomic
from slviewer.session.store import Session

NAMES = ("calibration/stereo", "calibration/pixelwise", "verdict/last")


class Killed(BaseException):
    """Stands for `kill -9`: no clean-up that a program does itself may help."""


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Iterator[str]:
    """A session whose results say "old"; the new calibration has three of the four. The disk syncs
    at once."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    folder = tmp_path / "session"
    with Session.create(folder) as session:
        for name in (*NAMES, "calibration/splined"):
            session.save_result(name, {"age": "old", "inputs": {}}, {"z": np.zeros(3)})
    yield folder


def save_new(session: Session) -> None:
    """Replace the three results by new ones, of which one depends on another, and move the fourth
    to the trash."""
    with session.together():
        session.trash_result("calibration/splined")
        for name in NAMES:
            inputs = {} if name == NAMES[0] else session.input_hashes(NAMES[0])
            session.save_result(name, {"age": "new", "inputs": inputs}, {"z": np.ones(3)})
        assert session.load_result(NAMES[0])[0]["age"] == "new"
        assert not session.has_result("calibration/splined")


def age(folder) -> str:
    """The age of all results, which must be one, and of which none may be missing, half there or
    stale."""
    with Session.open(folder, write=True) as session:
        assert not atomic.list_leftovers(folder)
        (age,) = {session.load_result(name)[0]["age"] for name in NAMES}
        assert {session.state_of(name) for name in NAMES} == {"fresh"}
        assert session.has_result("calibration/splined") == (age == "old")
        return age


def inject(monkeypatch, at: int, fault: BaseException) -> Callable[[], int]:
    """Let the ``at``-th call that changes or syncs the disk raise a fault; returns the count of the
    calls."""
    calls = 0
    for name in ("rename", "replace", "fsync", "unlink", "mkdir"):
        real = getattr(os, name)

        def wrapped(*args, real=real, **options):
            nonlocal calls
            calls += 1
            # nothing runs after a kill
            if calls == at or (isinstance(fault, Killed) and calls > at):
                raise fault
            return real(*args, **options)

        monkeypatch.setattr(os, name, wrapped)
    return lambda: calls


@pytest.mark.parametrize("kind", ["killed", "ENOSPC", "EIO"])
def test_a_fault_at_any_boundary_leaves_the_whole_old_or_the_whole_new(folder, monkeypatch, kind):
    ages, at = [], 0
    while not ages or ages[-1] != "complete":
        at += 1
        fault = Killed() if kind == "killed" else OSError(getattr(errno, kind), "injected")
        session = Session.open(folder, write=True)
        with monkeypatch.context() as patch:
            count = inject(patch, at, fault)
            try:
                save_new(session)
                ages.append("complete" if count() < at else "saved")
            except (Killed, SessionError):
                ages.append("")
        session.close()
        now = age(folder)
        ages[-1] = ages[-1] or now
        if now == "new":  # back to the start
            with Session.open(folder, write=True) as session, session.together():
                for name in (*NAMES, "calibration/splined"):
                    session.save_result(name, {"age": "old", "inputs": {}}, {"z": np.zeros(3)})
    assert {"old", "new", "complete"} <= set(ages) and at > 15


def test_nothing_changes_where_the_work_raises(folder):
    with Session.open(folder, write=True) as session:
        with pytest.raises(InputError), session.together():
            session.trash_result(NAMES[1])
            session.save_result(NAMES[0], {"age": "new", "inputs": {}}, {})
            raise InputError("the next model cannot be made")
        assert session.load_result(NAMES[0])[0]["age"] == "old" and session.deleted_results() == []
    assert age(folder) == "old"


def test_a_result_that_is_trashed_and_saved_again_is_in_the_trash_once(folder):
    with Session.open(folder, write=True) as session:
        with session.together():
            session.trash_result(NAMES[0])
            for _ in range(2):
                session.save_result(NAMES[0], {"age": "new", "inputs": {}}, {"z": np.ones(3)})
        assert session.load_result(NAMES[0])[0]["age"] == "new"
        assert session.deleted_results() == ["calibration/stereo"]
        session.trash_result(NAMES[0])
        session.restore_last(NAMES[0])
        assert session.load_result(NAMES[0])[0]["age"] == "new"


def test_what_was_replaced_is_exchanged_back_and_forth(folder):
    added = "verdict/other"
    with Session.open(folder, write=True) as session:

        def ages() -> dict[str, str]:
            return {name: session.load_result(name)[0]["age"] for name in session.result_names()}

        before = ages()
        with session.keep_replaced("calibration", "verdict") as replaced:
            save_new(session)
            session.save_result(added, {"age": "new", "inputs": {}}, {})
            session.save_result(added, {"age": "newer", "inputs": {}}, {})
        after = ages()
        assert replaced.keys() == {*before, added} and replaced[added] is None
        assert after == dict.fromkeys(NAMES, "new") | {added: "newer"}
        with (
            session.keep_replaced("verdict") as given_up,
            pytest.raises(InputError),
            session.together(),
        ):
            session.save_result(added, {"age": "none", "inputs": {}}, {})
            raise InputError("it cannot be made")
        assert given_up == {} and ages() == after
        with session.keep_replaced("merge") as of_others:
            session.save_result(added, {"age": "newer", "inputs": {}}, {})
        assert of_others == {}
        for expected in (before, after, before):
            replaced = session.exchange(replaced)
            assert ages() == expected
        (folder / "trash").rename(folder / "lost")
        with pytest.raises(InputError, match=added):
            session.exchange({NAMES[0]: None, added: None})
        with pytest.raises(InputError, match=NAMES[0]):
            session.exchange(replaced)
        assert ages() == before  # all or nothing


@pytest.mark.parametrize(
    "listed",
    [
        '{"changes": [["../x", null, "trash/x"]]}',
        '{"changes": [["/tmp/x", null, null]]}',
        '{"changes": [["results/a", [], null]]}',
        "{",
    ],
)
def test_a_listing_that_names_other_folders_is_ignored(folder, listed):
    (folder.parent / "x").mkdir()
    (folder / ".together.new-1-ab").write_text(listed)
    assert age(folder) == "old"
    assert (folder.parent / "x").is_dir() and not list(folder.glob(".together*"))


@pytest.mark.parametrize(
    "change", [["captures/x", "captures/y", None], ["captures/x", None, "trash/x"]]
)
def test_a_listing_that_leads_outside_by_a_link_is_ignored(folder, change):
    """A session from somebody else may come with both."""
    for name in ("x", "y"):
        (folder.parent / "home" / name / "inside").mkdir(parents=True)
    (folder / "captures").rmdir()
    (folder / "captures").symlink_to(folder.parent / "home")
    (folder / ".together.new-1-ab").write_text(json.dumps({"changes": [change]}))
    assert age(folder) == "old"
    assert sorted(path.name for path in (folder.parent / "home").rglob("*")) == [
        "inside",
        "inside",
        "x",
        "y",
    ]
