"""A stack of frames as a Zarr v3 array: one uncompressed chunk a frame.

Zarr's own library writes the array's description. The chunks are raw little-endian frames, and we move them
ourselves: each is hashed, written and synced by the same thread, and a missing chunk is an error when read, where
Zarr would hand back a black frame.
"""

import hashlib
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from io import RawIOBase
from pathlib import Path

import numpy as np

from slviewer.errors import InputError, SessionError
from slviewer.session.atomic import read_json, write_bytes

_THREADS = 4  # moving and hashing frames releases the interpreter; more threads only queue for the disk
_SEPARATOR = "."
"""Between the parts of a chunk's name: with Zarr's default, "/", every frame has two folders to be synced too."""
_DTYPES = {np.dtype(np.uint8): "uint8", np.dtype(np.uint16): "uint16"}


def write_stack(path: Path, frames: np.ndarray) -> str:
    """Write frames (n, h, w), uint8 or uint16, as a new Zarr v3 array, synced; returns their content hash.

    Raises InputError for any other shape or type.
    """
    check_frames(frames)
    _create_array(path, frames.shape, _DTYPES[frames.dtype])

    def write(index: int) -> bytes:
        """Write one frame as a chunk and return its digest."""
        frame = _to_little_endian(np.ascontiguousarray(frames[index]))
        write_bytes(_chunk_path(path, _SEPARATOR, index), frame.data)
        return hashlib.blake2b(frame.data, digest_size=20).digest()

    with ThreadPoolExecutor(_THREADS) as pool:
        digests = list(pool.map(write, range(len(frames))))
    return _combine_digests(frames.shape, frames.dtype, digests)


def read_stack(path: Path, indices: Sequence[int] | None = None) -> np.ndarray:
    """Frames (n, h, w) in the order of `indices` (all of them where None), C-contiguous; reads only these.

    Raises SessionError where a frame is missing or cut short, InputError for an index outside the stack.
    """
    shape, dtype, separator = _read_description(path)
    wanted = list(range(shape[0])) if indices is None else [int(index) for index in indices]
    if any(not 0 <= index < shape[0] for index in wanted):
        raise InputError(f"frames {wanted} were requested, {path.parent.name} has frames 0 to {shape[0] - 1}")
    stack = np.empty((len(wanted), *shape[1:]), dtype)

    def read(slot: int) -> None:
        """Read one frame into its slot of the stack; SessionError where its file is missing or damaged."""
        chunk = _chunk_path(path, separator, wanted[slot])
        try:
            with open(chunk, "rb", buffering=0) as file:
                whole = os.fstat(file.fileno()).st_size == stack[slot].nbytes
                whole = whole and _read_into(file, stack[slot])
        except FileNotFoundError as error:
            raise SessionError(f"{chunk} is missing: this capture is damaged, import or record it again") from error
        except OSError as error:
            raise SessionError(f"{chunk} cannot be read ({error}): check its permissions and the disk") from error
        if not whole:
            raise SessionError(f"{chunk} is cut short: this capture is damaged, import or record it again")

    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(read, range(len(wanted))))
    return stack if sys.byteorder == "little" else stack.byteswap(inplace=True)


def describe_stack(path: Path) -> tuple[tuple[int, int, int], np.dtype]:
    """Return shape (n, h, w) and type of a stack; SessionError where its layout is not the one written here."""
    return _read_description(path)[:2]


def _read_description(path: Path) -> tuple[tuple[int, int, int], np.dtype, str]:
    """Return shape (n, h, w), dtype and chunk separator of a stack; SessionError for another layout."""
    description = read_json(path / "zarr.json")
    try:
        n, height, width = (int(extent) for extent in description["shape"])
        dtype = np.dtype(description["data_type"])
        chunk = description["chunk_grid"]["configuration"]["chunk_shape"]
        separator = description["chunk_key_encoding"]["configuration"]["separator"]
        codecs = [codec["name"] for codec in description["codecs"]]
    except (KeyError, TypeError, ValueError) as error:
        raise SessionError(f"{path} does not describe a stack of frames ({error}): import the capture again") from error
    if dtype not in _DTYPES or chunk != [1, height, width] or separator not in (".", "/") or codecs != ["bytes"]:
        raise SessionError(f"{path} was not laid out by slviewer (one uncompressed chunk a frame): import it again")
    return (n, height, width), dtype, separator


def check_frames(frames: np.ndarray) -> None:
    """Raise InputError unless `frames` is a stack (n, h, w) of uint8 or uint16 with something in it."""
    if not isinstance(frames, np.ndarray) or frames.ndim != 3 or frames.size == 0:
        raise InputError(f"a stack of frames (n, h, w) is needed, got shape {np.shape(frames)}")
    if frames.dtype not in _DTYPES:
        raise InputError(f"frames of 8 or 16 bits (uint8, uint16) are needed, got {frames.dtype}")


def _create_array(path: Path, shape: tuple[int, ...], dtype: str) -> None:
    """Create the metadata of an uncompressed Zarr v3 array with one chunk a frame."""
    import zarr  # half a second; needed only to write

    zarr.create_array(
        path,
        shape=shape,
        dtype=dtype,
        chunks=(1, *shape[1:]),
        compressors=None,
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


def _read_into(file: RawIOBase, frame: np.ndarray) -> bool:
    """Read a file into a frame's memory; returns whether it held enough bytes."""
    view = frame.data.cast("B")
    done = 0
    while done < len(view):
        count = file.readinto(view[done:])
        if not count:
            return False
        done += count
    return True


def _to_little_endian(frame: np.ndarray) -> np.ndarray:
    """Return the frame with its bytes in little-endian order."""
    return frame if sys.byteorder == "little" else frame.byteswap()


def _combine_digests(shape: tuple[int, ...], dtype: np.dtype, digests: list[bytes]) -> str:
    """Return the content hash of a stack from its shape, dtype and the frames' digests."""
    whole = hashlib.blake2b(f"{shape} {_DTYPES[dtype]}".encode(), digest_size=20)
    for digest in digests:
        whole.update(digest)
    return whole.hexdigest()
