"""A session by its folder, or one that is open already, and names in it."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from fnmatch import fnmatchcase
from pathlib import Path

from slviewer.errors import SessionError, SlviewerError, UsageError
from slviewer.pipeline.feedback import Warn
from slviewer.session.names import natural_key
from slviewer.session.store import Session

SessionLike = Path | str | Session


def opened(session: SessionLike, write: bool = False) -> AbstractContextManager[Session]:
    """Return a context manager of the session; one that was opened here is closed at the end, one
    that was open stays so."""
    if isinstance(session, Session):
        return nullcontext(session)
    return Session.open(session, write=write)


def opened_to_save(session: SessionLike, warn: Warn) -> AbstractContextManager[Session]:
    """Return a context manager of the session, to store results in where ``is_writable``.

    One that another process is writing to, or that cannot be written, is opened for reading, with a
    warning.
    """
    try:
        return opened(session, write=True)
    except SessionError as error:
        store = opened(session)
        warn(f"the result is not stored in the session: {error}")
        return store


@contextmanager
def placed_file(store: Session, out: Path | str | None, name: str) -> Iterator[tuple[Path, Path]]:
    """Context manager: the file ``out``, or one of this name in the session's exports, and the path
    to write it to.

    In the exports it appears at the end of the block, unless that fails.
    """
    if out is not None:
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        yield Path(out), Path(out)
        return
    with store.staged_export(name) as staged:
        yield store.exports / name, staged


@contextmanager
def opened_or_made(session: SessionLike) -> Iterator[Session]:
    """Context manager: the session, open for writing; one created for the block is removed again if
    nothing was saved in it."""
    if isinstance(session, Session):
        yield session
        return
    with Session.open_or_create(session) as store:
        try:
            yield store
        except BaseException:
            store.remove_if_new()
            raise


def match_names(
    names: Sequence[str],
    patterns: Sequence[str],
    kind: str,
    error: type[SlviewerError] = UsageError,
) -> list[str]:
    """Return those of ``names`` that match a pattern such as ``pose_0*``, in their order.

    Raises ``error`` for a pattern that matches none; ``kind``: what they are names of.
    """
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise error(f"no {kind} is called {pattern!r}: there are {', '.join(names) or 'none'}")
    return [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]


def numbered_names(store: Session, kind: str) -> list[str]:
    """Names of the session's results of a kind, ``merge/1``, ``merge/2``, ..., without it, in the
    order of their numbers."""
    names = (name for name in store.result_names() if name.startswith(f"{kind}/"))
    return sorted((name.removeprefix(f"{kind}/") for name in names), key=natural_key)
