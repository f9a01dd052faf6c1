"""A stack of frames as a Zarr v3 array: one uncompressed chunk a frame, with a checksum.

Zarr's own library writes the array's description. The chunks are raw little-endian frames, each
followed by its CRC-32C (Zarr's codec `crc32c`), and we move them ourselves: each is hashed, written
and synced by the same thread, and a missing chunk is an error when read, where Zarr would hand back
a black frame. Stacks without checksums, of older sessions, are read too: only `FrameStack.hash`
tells whether they are damaged.
"""

import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import google_crc32c
import msgspec
import numpy as np

from slviewer.errors import DamagedError, InputError, SessionError
from slviewer.records.record import from_plain
from slviewer.session.atomic import write_bytes
from slviewer.session.reading import decoding, read_json
from slviewer.session.results import Extent, digest_bytes, in_threads

_SEPARATOR = "."
"""Between the parts of a chunk's name: with Zarr's default, "/", every frame has two folders to be
synced too."""
_CHECKSUM_BYTES = 4
_DTYPES = {np.dtype(np.uint8): "uint8", np.dtype(np.uint16): "uint16"}


def write_stack(path: Path, frames: np.ndarray) -> str:
    """Write frames (n, h, w), uint8 or uint16, as a new Zarr v3 array, synced; returns their
    content hash.

    Raises InputError for any other shape or type.
    """
    import zarr  # half a second; needed only to write
    from zarr.codecs import Crc32cCodec

    check_stack_array(frames)
    zarr.create_array(
        path,
        shape=frames.shape,
        dtype=_DTYPES[frames.dtype],
        chunks=(1, *frames.shape[1:]),
        compressors=[Crc32cCodec()],
        filters=None,
        fill_value=0,
        zarr_format=3,
        dimension_names=["frame", "v", "u"],
        chunk_key_encoding={"name": "default", "separator": _SEPARATOR},
    )
    with open(path / "zarr.json", "rb") as file:
        os.fsync(file.fileno())
    stack = FrameStack(path, frames.shape, frames.dtype, _SEPARATOR, has_checksums=True)

    def write(index: int) -> bytes:
        """Write one frame as a chunk and return its digest."""
        frame = _to_little_endian(np.ascontiguousarray(frames[index]))
        write_bytes(stack.chunk_path(index), frame.data, _checksum(frame))
        return digest_bytes(frame.data)

    digests = in_threads(write, range(len(frames)))
    return _combine_digests(frames.shape, frames.dtype, digests)


def hash_frames(frames: np.ndarray) -> str:
    """Return the content hash that frames (n, h, w), uint8 or uint16, have once they are
    written."""
    digests = in_threads(
        lambda frame: digest_bytes(_to_little_endian(np.ascontiguousarray(frame)).data), frames
    )
    return _combine_digests(frames.shape, frames.dtype, digests)


class _Description(msgspec.Struct):
    """The entries of `zarr.json` that are read, with their types and ranges."""

    shape: tuple[Extent, Extent, Extent]
    data_type: Literal["uint8", "uint16"]
    chunk_grid: dict[str, Any]
    chunk_key_encoding: dict[str, Any]
    codecs: list[dict[str, Any]]


@dataclass(frozen=True)
class FrameStack:
    """The description of a stack on disk, and access to its frames."""

    path: Path
    shape: tuple[int, int, int]
    dtype: np.dtype
    separator: str
    has_checksums: bool

    @classmethod
    def open(cls, path: Path) -> "FrameStack":
        """Read the description of a stack; SessionError where its layout is not the one written
        here."""
        with decoding(path / "zarr.json"):
            described = from_plain(read_json(path / "zarr.json"), _Description)
            codecs = [codec["name"] for codec in described.codecs]
            chunk = described.chunk_grid["configuration"]["chunk_shape"]
            separator = described.chunk_key_encoding["configuration"]["separator"]
        if (
            chunk != [1, *described.shape[1:]]
            or separator not in (".", "/")
            or codecs not in (["bytes"], ["bytes", "crc32c"])
        ):
            raise SessionError(
                f"{path} was not laid out by slviewer (one uncompressed chunk a frame)",
                "import it again",
            )
        dtype = np.dtype(described.data_type)
        return cls(path, described.shape, dtype, separator, "crc32c" in codecs)

    def read(self, indices: Iterable[int] | None = None) -> np.ndarray:
        """Frames (n, h, w) in the order of `indices` (all of them where None), C-contiguous; reads
        only these.

        Raises DamagedError where a frame is missing, cut short or differs from its checksum,
        InputError for an index outside the stack.
        """
        n = self.shape[0]
        wanted = check_indices(self.path.parent.name, indices, n)
        size = self.shape[1] * self.shape[2] * self.dtype.itemsize
        for index in wanted:  # before memory is allocated for what the description announces
            if self._status(index).st_size != size + _CHECKSUM_BYTES * self.has_checksums:
                raise self._damage(index, "is cut short, or longer than it was")
        frames = np.empty((len(wanted), *self.shape[1:]), self.dtype)
        in_threads(self._read_frame, wanted, frames)
        return frames if sys.byteorder == "little" else frames.byteswap(inplace=True)

    def hash(self) -> tuple[str, list[str]]:
        """Read the whole stack; returns its content hash, as `write_stack` does, and the hash of
        each frame, BLAKE2b of 160 bits. Raises DamagedError as `read`."""
        digests = in_threads(
            lambda index: digest_bytes(_to_little_endian(self.read([index])).data),
            range(self.shape[0]),
        )
        return _combine_digests(self.shape, self.dtype, digests), [each.hex() for each in digests]

    def identify(self) -> tuple[tuple[int, ...], ...]:
        """Return what changes whenever a frame's file does: number, size and time of each. Raises
        DamagedError where a file is missing."""
        statuses = map(self._status, range(self.shape[0]))
        return tuple((each.st_ino, each.st_size, each.st_mtime_ns) for each in statuses)

    def _read_frame(self, index: int, frame: np.ndarray) -> None:
        """Read one frame, little-endian, into `frame` (h, w). Raises DamagedError where it is not
        what was saved."""
        checksum = bytearray(_CHECKSUM_BYTES * self.has_checksums)
        try:
            with open(self.chunk_path(index), "rb") as file:  # regular, as its size was right
                whole = file.readinto(frame.data.cast("B")) == frame.nbytes
                whole = whole and file.readinto(checksum) == len(checksum)
        except OSError as error:
            raise self._error(index, error) from error
        if not whole:
            raise self._damage(index, "is cut short")
        if checksum and checksum != _checksum(frame):
            raise self._damage(index, "differs from its checksum")

    def _status(self, index: int) -> os.stat_result:
        """Return the status of a frame's file. Raises DamagedError where it is missing."""
        try:
            return self.chunk_path(index).stat()
        except OSError as error:
            raise self._error(index, error) from error

    def chunk_path(self, index: int) -> Path:
        """Return the file of one frame's chunk."""
        return self.path / self.separator.join(("c", str(index), "0", "0"))

    def _error(self, index: int, error: OSError) -> SessionError:
        """Return the error for a chunk that cannot be read: damage, unless it is for want of
        permission."""
        if isinstance(error, PermissionError):
            return SessionError(
                f"{self.chunk_path(index)} cannot be read ({error})", "check its permissions"
            )
        missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        return self._damage(
            index, "is missing" if missing else f"cannot be read ({error.strerror or error})"
        )

    def _damage(self, index: int, fault: str) -> DamagedError:
        """Return the error for a damaged frame, with the capture's name and the remedy."""
        return DamagedError(
            f"{self.path.parent.name}: frame {index + 1} of {self.shape[0]} is damaged"
            f" ({self.chunk_path(index)} {fault})",
            "restore this file from a copy, or import or record the capture again",
        )


def check_indices(name: str, indices: Iterable[int] | None, count: int) -> list[int]:
    """Return the indices of frames of the capture ``name``, all of them where None; InputError for
    one outside of its ``count``."""
    wanted = list(range(count) if indices is None else map(int, indices))
    if any(not 0 <= index < count for index in wanted):
        raise InputError(
            f"frames {wanted} were requested, {name} has {count} frames", "count from 0"
        )
    return wanted


def check_stack_array(frames: np.ndarray) -> None:
    """Raise InputError unless `frames` is a stack (n, h, w) of uint8 or uint16 with something in
    it."""
    if not isinstance(frames, np.ndarray) or frames.ndim != 3 or frames.size == 0:
        raise InputError(f"a stack of frames (n, h, w) is needed, got shape {np.shape(frames)}")
    if frames.dtype not in _DTYPES:
        raise InputError(f"frames of 8 or 16 bits (uint8, uint16) are needed, got {frames.dtype}")


def _checksum(frame: np.ndarray) -> bytes:
    """Return the CRC-32C of a frame's bytes, as Zarr appends it to a chunk."""
    return google_crc32c.value(frame).to_bytes(_CHECKSUM_BYTES, "little")


def _to_little_endian(frame: np.ndarray) -> np.ndarray:
    """Return the frame with its bytes in little-endian order."""
    return frame if sys.byteorder == "little" else frame.byteswap()


def _combine_digests(shape: tuple[int, ...], dtype: np.dtype, digests: list[bytes]) -> str:
    """Return the content hash of a stack from its shape, dtype and the frames' digests."""
    return digest_bytes(f"{shape} {_DTYPES[dtype]}".encode(), *digests).hex()
