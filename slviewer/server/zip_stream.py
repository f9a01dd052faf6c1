"""A zip that is made while it is read, so that one of any size takes one piece of memory."""

import io
import os
import time
import zipfile
from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO

_PIECE = 2**20
_EARLIEST = (1980, 1, 1, 0, 0, 0)
"""Time that a zip can hold."""


def open_zip(members: Iterable[tuple[str, BinaryIO]]) -> BinaryIO:
    """Return a file to read the zip of members (name in it, open file) from; each is closed once it
    was read.

    They are stored as they are: frames and clouds hardly shrink.
    """
    return io.BufferedReader(_ZipReader(_write(members)))  # type: ignore[return-value]


class _Pieces(io.RawIOBase):
    """Takes what is written, until it is fetched; it cannot be rewound."""

    def __init__(self) -> None:
        self._written = bytearray()

    def writable(self) -> bool:
        """Whether it can be written: yes."""
        return True

    def write(self, data: Any) -> int:
        """Take data."""
        self._written += data
        return len(data)

    def fetch(self) -> bytes:
        """Return what was written since the last time."""
        piece, self._written = bytes(self._written), bytearray()
        return piece


def _write(members: Iterable[tuple[str, BinaryIO]]) -> Iterator[bytes]:
    """Yield the bytes of a zip, piece by piece."""
    pieces = _Pieces()
    with zipfile.ZipFile(pieces, "w") as archive:
        for name, file in members:
            with file:
                status = os.fstat(file.fileno())
                changed = time.localtime(status.st_mtime)[:6]
                info = zipfile.ZipInfo(name, max(changed, _EARLIEST))
                info.file_size = status.st_size  # from which it chooses the large format
                with archive.open(info, "w") as out:
                    while piece := file.read(_PIECE):
                        out.write(piece)
                        yield pieces.fetch()
    yield pieces.fetch()


class _ZipReader(io.RawIOBase):
    """Reads what an iterator yields."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces, self._rest = pieces, memoryview(b"")

    def readable(self) -> bool:
        """Whether it can be read: yes."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer with the next bytes; returns their number, 0 at the end."""
        while not self._rest:
            piece = next(self._pieces, None)
            if piece is None:
                return 0
            self._rest = memoryview(piece)
        count = min(len(buffer), len(self._rest))
        buffer[:count], self._rest = self._rest[:count], self._rest[count:]
        return count
