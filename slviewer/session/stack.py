"""A stack of frames as a Zarr v3 array: one uncompressed chunk a frame, with a checksum.

Zarr's own library writes the array's description. The chunks are raw little-endian frames, each
followed by its CRC-32C (Zarr's codec `crc32c`), and we move them ourselves: each is hashed, written
and synced by the same thread, and a missing chunk is an error when read, where Zarr would hand back
a black frame. Stacks without checksums, of older sessions, are read too: only `hash_stack` tells
whether they are damaged.
"""

import hashlib
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from io import RawIOBase
from pathlib import Path
from typing import Annotated, Literal

import google_crc32c
import msgspec
import numpy as np

from slviewer.errors import DamagedError, InputError, SessionError
from slviewer.records.plain import from_plain
from slviewer.session.atomic import write_bytes
from slviewer.session.reading import decoding, read_json

_THREADS = (
    4  # moving and hashing frames releases the interpreter; more threads only queue for the disk
)
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
    check_stack_array(frames)
    _create_array(path, frames.shape, _DTYPES[frames.dtype])

    def write(index: int) -> bytes:
        """Write one frame as a chunk and return its digest."""
        frame = _to_little_endian(np.ascontiguousarray(frames[index]))
        write_bytes(_chunk_path(path, _SEPARATOR, index), frame.data, _checksum(frame))
        return _digest(frame)

    with ThreadPoolExecutor(_THREADS) as pool:
        digests = list(pool.map(write, range(len(frames))))
    return _combine_digests(frames.shape, frames.dtype, digests)


def read_stack(path: Path, indices: Sequence[int] | None = None) -> np.ndarray:
    """Frames (n, h, w) in the order of `indices` (all of them where None), C-contiguous; reads only
    these.

    Raises DamagedError where a frame is missing, cut short or differs from its checksum, InputError
    for an index outside the stack.
    """
    stack = _StoredStack.open(path)
    n = stack.shape[0]
    wanted = list(range(n)) if indices is None else [int(index) for index in indices]
    if any(not 0 <= index < n for index in wanted):
        raise InputError(
            f"frames {wanted} were requested, {path.parent.name} has {n} frames: count from 0"
        )
    for index in wanted:  # before memory is allocated for what the description announces
        stack.check_size(index)
    frames = np.empty((len(wanted), *stack.shape[1:]), stack.dtype)
    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(stack.read, wanted, frames))
    return frames if sys.byteorder == "little" else frames.byteswap(inplace=True)


def hash_stack(path: Path) -> tuple[str, list[str]]:
    """Read a whole stack; returns its content hash, as `write_stack` does, and the hash of each
    frame, BLAKE2b of 160 bits. Raises DamagedError as `read_stack`."""
    stack = _StoredStack.open(path)

    def digest(index: int) -> bytes:
        """Read one frame and return its digest."""
        stack.check_size(index)
        frame = np.empty(stack.shape[1:], stack.dtype)
        stack.read(index, frame)
        return _digest(frame)

    with ThreadPoolExecutor(_THREADS) as pool:
        digests = list(pool.map(digest, range(stack.shape[0])))
    return _combine_digests(stack.shape, stack.dtype, digests), [each.hex() for each in digests]


def hash_frames(frames: np.ndarray) -> str:
    """Return the content hash that frames (n, h, w), uint8 or uint16, have once they are
    written."""
    with ThreadPoolExecutor(_THREADS) as pool:
        digests = list(
            pool.map(lambda frame: _digest(_to_little_endian(np.ascontiguousarray(frame))), frames)
        )
    return _combine_digests(frames.shape, frames.dtype, digests)


def identify_stack(path: Path) -> tuple[tuple[int, ...], ...] | None:
    """Return what changes whenever a frame's file does (number, size, time), or None where every
    frame has a checksum.

    Raises DamagedError where a file is missing.
    """
    stack = _StoredStack.open(path)
    return (
        None
        if stack.has_checksums
        else tuple(stack.identify(index) for index in range(stack.shape[0]))
    )


def describe_stack(path: Path) -> tuple[tuple[int, int, int], np.dtype]:
    """Return shape (n, h, w) and type of a stack; SessionError where its layout is not the one
    written here."""
    stack = _StoredStack.open(path)
    return stack.shape, stack.dtype


_Extent = Annotated[int, msgspec.Meta(ge=1, le=1 << 16)]


class _ChunkGrid(msgspec.Struct):
    """The entry `chunk_grid` of `zarr.json`."""

    class Configuration(msgspec.Struct):
        """Its size of a chunk, frames x rows x columns."""

        chunk_shape: tuple[int, int, int]

    configuration: Configuration


class _ChunkKeys(msgspec.Struct):
    """The entry `chunk_key_encoding` of `zarr.json`."""

    class Configuration(msgspec.Struct):
        """What stands between the parts of a chunk's name."""

        separator: Literal[".", "/"]

    configuration: Configuration


class _Codec(msgspec.Struct):
    """One of the entry `codecs` of `zarr.json`."""

    name: str


class _Description(msgspec.Struct):
    """The entries of `zarr.json` that are read, with their types and ranges."""

    shape: tuple[_Extent, _Extent, _Extent]
    data_type: Literal["uint8", "uint16"]
    chunk_grid: _ChunkGrid
    chunk_key_encoding: _ChunkKeys
    codecs: list[_Codec]


@dataclass(frozen=True)
class _StoredStack:
    """The description of a stack on disk, and access to its chunks."""

    path: Path
    shape: tuple[int, int, int]
    dtype: np.dtype
    separator: str
    has_checksums: bool

    @classmethod
    def open(cls, path: Path) -> "_StoredStack":
        """Read the description of a stack; SessionError for another layout."""
        with decoding(path / "zarr.json"):
            described = from_plain(read_json(path / "zarr.json"), _Description)
        n, height, width = described.shape
        codecs = [codec.name for codec in described.codecs]
        known = codecs in (["bytes"], ["bytes", "crc32c"])
        if described.chunk_grid.configuration.chunk_shape != (1, height, width) or not known:
            raise SessionError(
                f"{path} was not laid out by slviewer (one uncompressed chunk a frame): import it"
                " again"
            )
        separator = described.chunk_key_encoding.configuration.separator
        return cls(
            path, (n, height, width), np.dtype(described.data_type), separator, "crc32c" in codecs
        )

    def read(self, index: int, frame: np.ndarray) -> None:
        """Read one frame, little-endian, into `frame` (h, w). Raises DamagedError where it is not
        what was saved."""
        chunk, checksum = self._chunk_path(index), bytearray(_CHECKSUM_BYTES * self.has_checksums)
        try:
            with open(chunk, "rb", buffering=0) as file:  # regular, as its size was right
                whole = _read_into(file, frame.data.cast("B")) and _read_into(
                    file, memoryview(checksum)
                )
        except OSError as error:
            raise self._error(index, error) from error
        if not whole:
            raise self._damage(index, "is cut short")
        if checksum and checksum != _checksum(frame):
            raise self._damage(index, "differs from its checksum")

    def check_size(self, index: int) -> None:
        """Raise DamagedError unless a frame's file has the size that the description announces."""
        frame_bytes = self.shape[1] * self.shape[2] * self.dtype.itemsize
        if self.identify(index)[1] != frame_bytes + _CHECKSUM_BYTES * self.has_checksums:
            raise self._damage(index, "is cut short, or longer than it was")

    def identify(self, index: int) -> tuple[int, ...]:
        """Return number, size and time of a frame's file. Raises DamagedError where it is
        missing."""
        try:
            status = self._chunk_path(index).stat()
        except OSError as error:
            raise self._error(index, error) from error
        return status.st_ino, status.st_size, status.st_mtime_ns

    def _chunk_path(self, index: int) -> Path:
        """Return the file of one frame's chunk."""
        return _chunk_path(self.path, self.separator, index)

    def _error(self, index: int, error: OSError) -> SessionError:
        """Return the error for a chunk that cannot be read: damage, unless it is for want of
        permission."""
        if isinstance(error, PermissionError):
            return SessionError(
                f"{self._chunk_path(index)} cannot be read ({error}): check its permissions"
            )
        missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        return self._damage(
            index, "is missing" if missing else f"cannot be read ({error.strerror or error})"
        )

    def _damage(self, index: int, fault: str) -> DamagedError:
        """Return the error for a damaged frame, with the capture's name and the remedy."""
        capture, file = self.path.parent.name, self._chunk_path(index)
        return DamagedError(
            f"{capture}: frame {index + 1} of {self.shape[0]} is damaged ({file} {fault}): "
            "restore this file from a copy, or import or record the capture again"
        )


def check_stack_array(frames: np.ndarray) -> None:
    """Raise InputError unless `frames` is a stack (n, h, w) of uint8 or uint16 with something in
    it."""
    if not isinstance(frames, np.ndarray) or frames.ndim != 3 or frames.size == 0:
        raise InputError(f"a stack of frames (n, h, w) is needed, got shape {np.shape(frames)}")
    if frames.dtype not in _DTYPES:
        raise InputError(f"frames of 8 or 16 bits (uint8, uint16) are needed, got {frames.dtype}")


def _create_array(path: Path, shape: tuple[int, ...], dtype: str) -> None:
    """Create the metadata of an uncompressed Zarr v3 array with one chunk, and its checksum, a
    frame."""
    import zarr  # half a second; needed only to write
    from zarr.codecs import Crc32cCodec

    zarr.create_array(
        path,
        shape=shape,
        dtype=dtype,
        chunks=(1, *shape[1:]),
        compressors=[Crc32cCodec()],
        filters=None,
        fill_value=0,
        zarr_format=3,
        dimension_names=["frame", "v", "u"],
        chunk_key_encoding={"name": "default", "separator": _SEPARATOR},
    )
    description = path / "zarr.json"
    with open(description, "rb") as file:
        os.fsync(file.fileno())


def _chunk_path(path: Path, separator: str, index: int) -> Path:
    """Return the file of one frame's chunk."""
    return path / separator.join(("c", str(index), "0", "0"))


def _read_into(file: RawIOBase, view: memoryview) -> bool:
    """Read a file into memory; returns whether it held enough bytes."""
    done = 0
    while done < len(view):
        count = file.readinto(view[done:])
        if not count:
            return False
        done += count
    return True


def _checksum(frame: np.ndarray) -> bytes:
    """Return the CRC-32C of a frame's bytes, as Zarr appends it to a chunk."""
    return google_crc32c.value(frame).to_bytes(_CHECKSUM_BYTES, "little")


def _digest(frame: np.ndarray) -> bytes:
    """Return the digest of a frame's bytes, of which the content hash is made."""
    return hashlib.blake2b(frame.data, digest_size=20).digest()


def _to_little_endian(frame: np.ndarray) -> np.ndarray:
    """Return the frame with its bytes in little-endian order."""
    return frame if sys.byteorder == "little" else frame.byteswap()


def _combine_digests(shape: tuple[int, ...], dtype: np.dtype, digests: list[bytes]) -> str:
    """Return the content hash of a stack from its shape, dtype and the frames' digests."""
    whole = hashlib.blake2b(f"{shape} {_DTYPES[dtype]}".encode(), digest_size=20)
    for digest in digests:
        whole.update(digest)
    return whole.hexdigest()
