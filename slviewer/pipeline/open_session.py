"""A session by its folder, or one that is open already."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slviewer.session.store import Session, is_session

SessionLike = Path | str | Session


@contextmanager
def opened(session: SessionLike, write: bool = False) -> Iterator[Session]:
    """The session; one that was opened here is closed again, one that was open stays so."""
    if isinstance(session, Session):
        yield session
    else:
        with Session.open(session, write=write) as store:
            yield store


@contextmanager
def opened_or_made(session: SessionLike) -> Iterator[Session]:
    """The session, open for writing, or one that is; one that had to be made goes again if nothing was saved in it."""
    if isinstance(session, Session):
        yield session
        return
    folder = Path(session).expanduser().absolute()
    fresh, parent_fresh = not is_session(folder), not folder.exists()
    store = Session.open_or_create(folder)
    try:
        with store:
            yield store
    except BaseException:
        if fresh and not store.capture_names():
            for entry in folder.iterdir():
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
            if parent_fresh:
                folder.rmdir()
        raise
