"""Files offered for download under names that cannot be guessed; no other file can be read."""

import contextlib
import os
import secrets
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

from websockets.datastructures import Headers

from slviewer.errors import InputError
from slviewer.server.text import safe_file_name

PREFIX = "download/"
"""Of addresses, which are relative to the page: the path of the role that may fetch the file stands
before it."""


@dataclass(frozen=True)
class Offer:
    """One file: its path, the folder that it must not leave, and the name under which it is
    saved."""

    path: Path
    within: Path
    name: str


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

    def clear(self) -> None:
        """Withdraw all offered files (another session is opened)."""
        self._offers.clear()
        self._addresses.clear()

    def open(self, address: str) -> tuple[Headers, BinaryIO] | None:
        """The headers and the open file for an address; None if it is not offered or no longer
        exists."""
        try:
            offer = self._offers[address]
            file = _open_offer(offer)
        except (KeyError, InputError):
            return None
        ascii_name = (
            offer.name.encode("ascii", "replace").decode().replace("?", "_").replace('"', "_")
        )
        size = os.fstat(file.fileno()).st_size
        headers = Headers(
            {
                "Content-Type": "application/octet-stream",
                "Content-Length": str(size),
                "Content-Disposition": (
                    f"attachment; filename=\"{ascii_name}\"; filename*=UTF-8''{quote(offer.name)}"
                ),
            }
        )
        return headers, file


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
