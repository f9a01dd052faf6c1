"""Where the sessions of a batch are: folders that every worker sees, or addresses that fsspec
understands."""

import contextlib
import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slviewer.errors import InputError, SessionError
from slviewer.session.layout import is_session
from slviewer.session.reading import expand_user


def is_remote(address: str) -> bool:
    """Whether this is an fsspec address, such as ``s3://bucket/session``, and no folder."""
    return "://" in address or "::" in address


def absolute_address(session: Path | str) -> str:
    """The address of a session as every worker understands it: folders become absolute."""
    address = os.fspath(session)
    return address.rstrip("/") if is_remote(address) else str(expand_user(address).absolute())


@contextmanager
def fetch_session(address: str, capture: str = "") -> Iterator[Path]:
    """Yield a folder with the session and the named capture's frames. Raises SessionError where it
    is missing.

    From an fsspec address it is copied, with the calibrations, and removed when the block ends.
    """
    if not is_remote(address):
        if not is_session(address):
            raise SessionError(
                f"{address} is not a session folder where the worker is: give one that all workers"
                " share, or an address"
            )
        yield Path(address)
        return
    fs, root = _file_system(address)
    whole = (f"captures/{capture}/", "results/calibration/", "results/scale/") if capture else ()
    with tempfile.TemporaryDirectory(prefix="slviewer-") as folder:
        try:
            for path in fs.find(root):
                inner = path[len(root) :].lstrip("/")
                wanted = inner.startswith(whole) or inner.endswith(".json")
                if wanted and not any(part.startswith(".") for part in inner.split("/")):
                    target = Path(folder, inner)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    fs.get_file(path, str(target))
        except OSError as error:
            raise SessionError(
                f"{address} cannot be read ({error}): check the address and its permissions"
            ) from error
        if not is_session(folder):
            raise SessionError(
                f"{address} is not a session (it holds no session.json): check the address"
            )
        for inner in ("captures", "results"):
            Path(folder, inner).mkdir(exist_ok=True)
        yield Path(folder)


@contextmanager
def export_folder(address: str, batch: str) -> Iterator[Path]:
    """Yield a folder whose files are moved to the session's exports when the block ends; none if it
    fails.

    They replace files of their names. ``remove_leftovers`` removes what a killed worker leaves
    behind.
    """
    fs, root = _file_system(address)
    with tempfile.TemporaryDirectory(prefix="slviewer-") as folder:
        yield Path(folder)
        try:
            fs.makedirs(f"{root}/exports", exist_ok=True)
            for path in sorted(Path(folder).iterdir()):
                arriving = f"{root}/exports/.batch-{batch}-{secrets.token_hex(4)}-{path.name}"
                fs.put_file(str(path), arriving)
                fs.mv(arriving, f"{root}/exports/{path.name}")
        except FileNotFoundError as error:
            raise SessionError(
                f"a file for {address} disappeared while it was delivered ({error}): the batch was"
                " ended meanwhile, or another program removes files there; run the batch again"
            ) from error
        except OSError as error:
            raise SessionError(
                f"{address} cannot be written ({error}): check its permissions and free space"
            ) from error


def remove_leftovers(address: str, batch: str) -> None:
    """Remove what killed or cancelled workers of a batch did not finish, as far as it can be
    reached from here."""
    with contextlib.suppress(OSError, InputError):
        fs, root = _file_system(address)
        for path in fs.ls(f"{root}/exports", detail=False):
            if path.split("/")[-1].startswith(f".batch-{batch}"):
                fs.rm(path)


def _file_system(address: str) -> tuple[Any, str]:
    """The fsspec file system of an address, and the root in it."""
    try:
        from fsspec.core import url_to_fs

        fs, root = url_to_fs(address)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{address} cannot be reached ({error}): install what it needs where the workers are"
        ) from error
    return fs, root.rstrip("/")
