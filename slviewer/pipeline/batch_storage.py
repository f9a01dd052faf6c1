"""Where the sessions of a batch are: folders that every worker sees, or addresses that fsspec understands."""

import contextlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slviewer.errors import InputError, SessionError
from slviewer.session.store import is_session


def is_remote(address: str) -> bool:
    """Whether this is an fsspec address, such as ``s3://bucket/session``, and no folder."""
    return "://" in address or "::" in address


def absolute_address(session: Path | str) -> str:
    """The address of a session as every worker understands it: folders become absolute."""
    address = os.fspath(session)
    return address.rstrip("/") if is_remote(address) else str(Path(address).expanduser().absolute())


@contextmanager
def fetch_descriptions(address: str) -> Iterator[Path]:
    """A folder with the session, in which captures may lack their frames; raises SessionError where there is none."""
    with _session_folder(address, lambda path: path.split("/")[-1] in ("session.json", "capture.json")) as folder:
        yield folder


@contextmanager
def fetch_capture(address: str, capture: str) -> Iterator[Path]:
    """A folder with the session, in which one capture is whole; raises SessionError where there is none.

    From an fsspec address it is copied, with the calibrations, and goes when the block ends.
    """

    def wanted(path: str) -> bool:
        whole = (f"captures/{capture}/", "results/calibration/", "results/scale/")
        return path.startswith(whole) or path.endswith(".json")

    with _session_folder(address, wanted) as folder:
        yield folder


@contextmanager
def export_folder(address: str, batch: str) -> Iterator[Path]:
    """A folder for files that appear in the session's exports when the block ends, each whole, and none if it fails.

    They replace files of their names. What a worker that is killed leaves behind goes with ``swept``.
    """
    try:
        if is_remote(address):
            with tempfile.TemporaryDirectory(prefix="slviewer-") as made:
                yield Path(made)
                fs, root = _file_system(address)
                fs.makedirs(f"{root}/exports", exist_ok=True)
                for path in sorted(Path(made).iterdir()):
                    arriving = f"{root}/exports/{_hidden_name(batch)}-{secrets.token_hex(4)}-{path.name}"
                    fs.put_file(str(path), arriving)
                    fs.mv(arriving, f"{root}/exports/{path.name}")
            return
        exports = Path(address, "exports")
        # beside those of other workers, not in one folder for all: whoever removed that one once it was empty would do
        # so right as another makes its own in it
        folder = exports / f"{_hidden_name(batch)}-{secrets.token_hex(4)}"
        folder.mkdir(parents=True)
        yield folder
        for path in sorted(folder.iterdir()):
            os.replace(path, exports / path.name)
        folder.rmdir()
    except OSError as error:
        raise SessionError(f"{address} cannot be written ({error}): check its permissions and free space") from error


def remove_leftovers(address: str, batch: str) -> None:
    """Remove what killed or cancelled workers of a batch left unfinished, as far as it can be reached from here."""
    with contextlib.suppress(OSError, InputError):
        if not is_remote(address):
            for folder in Path(address, "exports").glob(f"{_hidden_name(batch)}-*"):
                shutil.rmtree(folder, ignore_errors=True)
            return
        fs, root = _file_system(address)
        for path in fs.ls(f"{root}/exports", detail=False):
            if path.split("/")[-1].startswith(_hidden_name(batch)):
                fs.rm(path)


@contextmanager
def _session_folder(address: str, wanted: Callable[[str], bool]) -> Iterator[Path]:
    if not is_remote(address):
        if not is_session(address):
            raise SessionError(
                f"{address} is no session folder where the worker is: give one that all workers share, or an address"
            )
        yield Path(address)
        return
    with tempfile.TemporaryDirectory(prefix="slviewer-") as folder:
        _fetch(address, wanted, Path(folder))
        yield Path(folder)


def _fetch(address: str, wanted: Callable[[str], bool], folder: Path) -> None:
    """Copy the wanted files, given by their paths in the session, hidden ones apart, into a folder."""
    fs, root = _file_system(address)
    try:
        for path in fs.find(root):
            inner = path[len(root) :].lstrip("/")
            if wanted(inner) and not any(part.startswith(".") for part in inner.split("/")):
                target = folder / inner
                target.parent.mkdir(parents=True, exist_ok=True)
                fs.get_file(path, str(target))
    except OSError as error:
        raise SessionError(f"{address} cannot be read ({error}): check the address and its permissions") from error
    if not is_session(folder):
        raise SessionError(f"{address} is no session (it holds no session.json): check the address")
    for inner in ("captures", "results"):
        (folder / inner).mkdir(exist_ok=True)


def _file_system(address: str) -> tuple[Any, str]:
    """What fsspec makes of an address: the file system and the root in it."""
    try:
        from fsspec.core import url_to_fs

        fs, root = url_to_fs(address)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{address} cannot be reached ({error}): install what it needs where the workers are"
        ) from error
    return fs, root.rstrip("/")


def _hidden_name(batch: str) -> str:
    return f".batch-{batch}"
