"""Files, and archives of them, offered for download under names that cannot be guessed; no other
file can be read."""

import contextlib
import os
import secrets
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

from websockets.datastructures import Headers

from slviewer.errors import InputError
from slviewer.server.text import safe_file_name
from slviewer.server.zip_stream import open_zip

PREFIX = "download/"
"""Of addresses, which are relative to the page: the path of the role that may fetch the file stands
before it."""


@dataclass(frozen=True)
class Offer:
    """One file: its path, the folder that it must not leave, and the name under which it is saved;
    or the zip of ``parts`` of a folder, files and folders in it."""

    path: Path
    within: Path
    name: str
    parts: tuple[str, ...] = ()


class Downloads:
    """The files that can be downloaded at present."""

    def __init__(self) -> None:
        self._offers: dict[str, Offer] = {}
        self._addresses: dict[Path, str] = {}

    def offer(self, path: Path, *, within: Path) -> str:
        """The address, relative to the wizard's page, at which this file is fetched until `clear`:
        always the same.

        `within` is the folder that it belongs to (the session's); InputError where the file is
        missing or, through links or "..", is elsewhere. It is read when it is fetched, so that the
        newest content arrives.
        """
        if path not in self._addresses:
            offer = Offer(path, within.resolve(), safe_file_name(path.name, "download"))
            _open_offer(offer).close()
            address = self._addresses[path] = PREFIX + secrets.token_urlsafe(16)
            self._offers[address] = offer
        return self._addresses[path]

    def offer_zip(self, folder: Path, parts: Sequence[str]) -> str:
        """The address, as of `offer`, of a zip of files and folders in a folder: those that exist
        when it is fetched, without links and hidden ones. It is named after the folder."""
        key = folder / "*"
        if key not in self._addresses:
            name = safe_file_name(f"{folder.name}.zip", "download.zip")
            address = self._addresses[key] = PREFIX + secrets.token_urlsafe(16)
            self._offers[address] = Offer(folder, folder.resolve(), name, tuple(parts))
        return self._addresses[key]

    def clear(self) -> None:
        """Withdraw all offered files (another session is opened)."""
        self._offers.clear()
        self._addresses.clear()

    def open(self, address: str) -> tuple[Headers, BinaryIO] | None:
        """The headers and the open file for an address; None if it is not offered or no longer
        exists."""
        try:
            offer = self._offers[address]
            file = open_zip(_open_parts(offer)) if offer.parts else _open_offer(offer)
        except (KeyError, InputError):
            return None
        ascii_name = (
            offer.name.encode("ascii", "replace").decode().replace("?", "_").replace('"', "_")
        )
        headers = Headers(
            {
                "Content-Type": "application/octet-stream",
                "Content-Disposition": (
                    f"attachment; filename=\"{ascii_name}\"; filename*=UTF-8''{quote(offer.name)}"
                ),
            }
        )
        if not offer.parts:  # the size of a zip is known at its end, where the connection closes
            headers["Content-Length"] = str(os.fstat(file.fileno()).st_size)
        return headers, file


def _open_parts(offer: Offer) -> Iterator[tuple[str, BinaryIO]]:
    """Open the files of an archive, one after the other, with their names in it; one that has gone
    meanwhile is skipped."""
    for part in offer.parts:
        top = offer.path / part
        paths = [top] if top.is_file() else sorted(top.rglob("*"))
        for path in paths:
            inside = path.relative_to(offer.path)
            hidden = any(each.startswith(".") for each in inside.parts)
            if path.is_file() and not path.is_symlink() and not hidden:
                with contextlib.suppress(InputError):
                    file = _open_offer(Offer(path, offer.within, path.name))
                    yield f"{offer.path.name}/{inside.as_posix()}", file


def _open_offer(offer: Offer) -> BinaryIO:
    """The opened file, checked after opening to be a regular one inside its folder, so that no link
    can change it."""
    with contextlib.suppress(OSError, ValueError):
        real = offer.path.resolve(strict=True)
        if real.is_relative_to(offer.within):
            flags = (
                os.O_RDONLY
                | getattr(os, "O_NOFOLLOW", 0)
                | getattr(os, "O_NONBLOCK", 0)
                | getattr(os, "O_BINARY", 0)
            )
            file = os.fdopen(os.open(real, flags), "rb")
            if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                return file
            file.close()
    raise InputError(
        f"{offer.path.name} can't be offered for download: it is not a file inside"
        f" {offer.within.name}."
    )
