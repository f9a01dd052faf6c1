"""The list of recent sessions: what exists, the last first; deleted and brought back."""

from pathlib import Path

import pytest

from slviewer.errors import InputError, SessionError
from slviewer.session.recent import TRASH, RecentSessions, new_session_folder, unused_folder
from slviewer.session.store import Session


@pytest.fixture
def folders(tmp_path: Path) -> list[Path]:
    """Three sessions."""
    made = [tmp_path / "work" / name for name in ("one", "two", "three")]
    for folder in made:
        Session.create(folder).close()
    return made


def test_recent_sessions_exist_and_the_last_is_first(tmp_path: Path, folders: list[Path]) -> None:
    one, two, three = folders
    file = tmp_path / "state" / "recent.json"
    recent = RecentSessions(file)
    assert recent.read()[0] == [] and recent.fault == ""
    for folder in (one, two, tmp_path / "never made", one, three):
        recent.add(folder)
    assert RecentSessions(file).read()[0] == [three, one, two]
    two.rename(two.with_name("moved"))
    assert recent.read()[0] == [three, one]


def test_damaged_list_is_ignored_and_reported(tmp_path: Path, folders: list[Path]) -> None:
    file = tmp_path / "recent.json"
    for content in ("{", '{"sessions": 3}', '["x"]'):
        file.write_text(content)
        recent = RecentSessions(file)
        assert recent.read()[0] == [] and str(file) in recent.fault
        recent.add(folders[0])
        assert recent.read()[0] == folders[:1] and recent.fault == ""


def test_unwritable_list_is_reported(tmp_path: Path, folders: list[Path]) -> None:
    (tmp_path / "a file").write_text("")
    recent = RecentSessions(tmp_path / "a file" / "recent.json")
    recent.add(folders[0])
    assert "not saved" in recent.fault


def test_deleted_session_moves_to_trash_and_comes_back(tmp_path: Path, folders: list[Path]) -> None:
    one, two, _ = folders
    recent = RecentSessions(tmp_path / "recent.json")
    with pytest.raises(InputError):
        recent.restore()
    for folder in folders:
        recent.add(folder)
    with Session.open(one, write=True), pytest.raises(SessionError, match="open for writing"):
        recent.trash(one)
    assert one.is_dir() and recent.read()[1] is None
    place = recent.trash(one)
    recent.trash(two)
    assert place.parent == one.parent / TRASH and not one.exists()
    assert one not in recent.read()[0] and recent.read()[1] == two
    assert recent.restore() == two and recent.read()[1] == one
    Session.create(one).close()
    with pytest.raises(SessionError, match="exists again"):
        recent.restore()
    assert recent.read()[0][0] == two


def test_new_session_folder_is_unused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platformdirs.user_documents_path", lambda: tmp_path)
    first = new_session_folder()
    assert first.parent == tmp_path / "slviewer" and not first.exists()
    first.mkdir(parents=True)
    assert new_session_folder() == first.with_name(f"{first.name}-2")
    assert unused_folder(first.with_name("free")).name == "free"
