"""One writer at a time: an exclusive lock on the session folder, and whose it is."""

import contextlib
import json
import os
import socket
from pathlib import Path

from filelock import FileLock, Timeout

from slviewer.errors import DamagedError, SessionError
from slviewer.session.reading import read_json

_PATIENCE_S = (
    0.3  # outlasts a reader that holds the lock for the moment it needs to clear leftovers
)


class WriterLock:
    """The session's lock, released by the system if its holder dies."""

    def __init__(self, folder: Path):
        self._folder = folder
        # closed by another thread than opened it
        self._lock = FileLock(folder / ".lock", thread_local=False)
        self._holder = folder / ".lock-holder"

    def acquire(self, patience_s: float = _PATIENCE_S) -> None:
        """Take the lock or raise a SessionError that names the process that holds it."""
        try:
            self._lock.acquire(timeout=patience_s, poll_interval=0.02)
        except Timeout as error:
            raise SessionError(
                f"{self._folder} is open for writing in {self._who()}: close it there, or wait"
                " until it has finished"
            ) from error
        except OSError as error:
            raise SessionError(
                f"{self._folder} cannot be written ({error}): check its permissions"
            ) from error
        with contextlib.suppress(OSError):  # it is only for the message to others
            self._holder.write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}))

    def release(self) -> None:
        """Release the lock for the next writer."""
        if self._lock.is_locked:
            with contextlib.suppress(OSError):
                self._holder.unlink(missing_ok=True)
            self._lock.release()

    def release_and_remove(self) -> None:
        """Remove the lock's files and release it: a writer that waits for it then begins with a new
        file.

        Only for a folder that is a session no more.
        """
        with contextlib.suppress(OSError):  # Windows removes no open file: an empty one stays
            self._holder.unlink(missing_ok=True)
            Path(self._lock.lock_file).unlink()
        self._lock.release()

    @property
    def held(self) -> bool:
        """Whether this object holds the lock."""
        return self._lock.is_locked

    def _who(self) -> str:
        """Describe the process that holds the lock."""
        try:
            holder = read_json(self._holder)
            return f"process {holder['pid']} on {holder['host']}"
        except (DamagedError, KeyError):
            return "another process"
