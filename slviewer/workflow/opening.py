"""A session by its folder, or one that is open already."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slviewer.session.store import Session

SessionLike = Path | str | Session


@contextmanager
def opened(session: SessionLike, write: bool = False) -> Iterator[Session]:
    """The session; one that was opened here is closed again, one that was open stays so."""
    if isinstance(session, Session):
        yield session
    else:
        with Session.open(session, write=write) as store:
            yield store
