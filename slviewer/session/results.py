"""A result: what was computed, from which inputs, with which settings. `meta.json` and one `.npy`
an array.

`meta.json` holds the CRC-32C of the file of each array, which is checked when the array is read;
older results have none, and only `verify_result` tells whether they are damaged.
"""

import hashlib
import io
import tokenize
from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict, TypeVar

import google_crc32c
import msgspec
import numpy as np

from slviewer.errors import DamagedError, InputError
from slviewer.records.kinds import all_kinds
from slviewer.records.record import Count, Vector, from_plain
from slviewer.records.verdict import Examination, Verdict
from slviewer.session.atomic import to_json, write_bytes
from slviewer.session.layout import inner_folders
from slviewer.session.names import safe_path
from slviewer.session.reading import (
    MOST_REMEMBERED,
    decoding,
    identify,
    read_file,
    read_json,
)

T = TypeVar("T")
Extent = Annotated[int, msgspec.Meta(ge=1, le=1 << 16)]
StoredSize = tuple[Extent, Extent]
_Matrix3 = tuple[Vector, Vector, Vector]
Exposure = Annotated[float, msgspec.Meta(gt=0, lt=1e9)]


class Meta(dict[str, Any]):
    """The entries of a `meta.json`; DamagedError, with its path, for one that is read and
    missing."""

    def __init__(self, place: Path, entries: Mapping[str, Any]) -> None:
        super().__init__(entries)
        self._place = place

    def __missing__(self, key: str) -> Any:
        raise DamagedError(
            f"{self._place} lacks the entry {key!r}", "restore it from a copy, or compute it again"
        )


class ResultMeta(TypedDict, total=False):
    """The entries of every result."""

    hash: str
    arrays: list[str]
    checksums: dict[str, int]
    inputs: dict[str, str]
    scales: dict[str, float]


class _Imported(TypedDict):
    """The matrices of a calibration made elsewhere."""

    K_camera: _Matrix3
    D_camera: list[float | list[float]]
    K_projector: _Matrix3
    D_projector: list[float | list[float]]
    R: _Matrix3
    T: list[float | list[float]]


class _Stereo(ResultMeta, total=False):
    """What `calibration/stereo` holds where it was imported: the file that it is from, and the
    sizes stated there."""

    imported: _Imported
    source: str
    camera: StoredSize | None
    projector: StoredSize | None


class _Verdict(ResultMeta, total=False):
    """`verdict/1`, on the last attempt to calibrate."""

    verdict: Verdict


_Finite = Annotated[float, msgspec.Meta(gt=-1e9, lt=1e9)]


class _CompiledAxis(TypedDict):
    """The numbers of a compiled axis."""

    axis: Literal["x", "y"]
    centre: _Finite
    step: Extent
    near: _Finite
    far: _Finite


class _Compiled(ResultMeta, total=False):
    """`compiled/splined`."""

    version: int
    compiled: _CompiledAxis


class _Projector(ResultMeta, total=False):
    """`projector/splined`."""

    model: dict[str, Any]


class _Pose(ResultMeta, total=False):
    """`poses/*`."""

    target: str
    smoothing: list[str | int]
    reading: int
    refused: str


class _Evidence(ResultMeta, total=False):
    """`evidence/*`."""

    target: str
    look: int
    evidence: dict[str, Any]


class _Examination(ResultMeta, total=False):
    """`trust/*`."""

    version: int
    examination: Examination


class _Edit(TypedDict):
    """An edit of a scan: its pixels are the array of its number, or it has a plane."""

    kind: Literal["pixels", "plane"]
    what: str
    points: Count
    normal: Vector | None
    offset_mm: float | None
    margin_mm: float | None
    made: NotRequired[str]


class _Edits(ResultMeta, total=False):
    """`edits/*`."""

    capture: str
    size: StoredSize
    applied: Count
    edits: list[_Edit]
    content: str


class _Scale(ResultMeta, total=False):
    """`scale/*`."""

    factor: Annotated[float, msgspec.Meta(gt=0.5, lt=2)]
    U_ppm: Annotated[float, msgspec.Meta(ge=0, lt=1e6)]
    certificate: str


_TYPES: dict[str, Any] = {
    "calibration/stereo": _Stereo,
    "verdict": _Verdict,
    "compiled/splined": _Compiled,
    "projector": _Projector,
    "poses": _Pose,
    "evidence": _Evidence,
    "trust": _Examination,
    "edits": _Edits,
    "scale": _Scale,
}


RENAMED = {"calibration/validation": "validation/1", "calibration/verdict": "verdict/1"}
"""{name of a result in sessions of version 0.2: its name today}."""


def check_meta(name: str, meta: Mapping[str, Any]) -> None:
    """Raise InputError, which names the entry, unless ``meta`` is what a result of this name
    holds."""
    name = RENAMED.get(name, name)
    from_plain(meta, _TYPES.get(name) or _TYPES.get(name.partition("/")[0]) or ResultMeta)
    if (kind := all_kinds().get(name.partition("/")[0])) is not None:
        from_plain(kind.upgrade(meta), kind)


_ARRAY_FOLDER = "arrays"
_RESERVED = {"hash", "arrays", "checksums"}
MAX_ARRAY_BYTES = 1 << 33


def list_results(root: Path) -> set[str]:
    """Names of the results under `root`, parts joined by `/`."""

    def under(folder: Path) -> list[str]:
        """Return the names of the results in a folder and below."""
        if (folder / "meta.json").is_file():
            return [folder.relative_to(root).as_posix()]
        return [name for inner in inner_folders(folder) for name in under(folder / inner)]

    return {RENAMED.get(name, name) for name in under(root)}


def locate_result(root: Path, name: str) -> Path:
    """Return the folder of a result under ``root``, also of one that an older version named
    otherwise.

    Raises InputError for an unsafe name.
    """
    folder = root / safe_path(name)
    former = next((root / old for old, today in RENAMED.items() if today == name), folder)
    return former if former.is_dir() and not folder.is_dir() else folder


def check_place(root: Path, name: str) -> None:
    """Raise InputError where a result called `name` would be inside another, or hold others."""
    for other in list_results(root):
        if name.startswith(f"{other}/") or other.startswith(f"{name}/"):
            raise InputError(
                f"result {name!r} and result {other!r} would lie inside each other",
                "choose another name",
            )


def check_result(
    meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The arrays as plain NumPy arrays; InputError for names that cannot be files or values that
    are not arrays."""
    if reserved := _RESERVED & set(meta):
        raise InputError(
            f"meta holds {sorted(reserved)}, which the session writes itself", "use other keys"
        )
    checked = {safe_path(name): np.asarray(array) for name, array in arrays.items()}
    for name, array in checked.items():
        if array.dtype.hasobject:
            raise InputError(
                f"array {name!r} holds Python objects", "give numbers, or put it into meta"
            )
    return checked


def in_threads(function: Callable[..., T], *arguments: Iterable[Any]) -> list[T]:
    """Return what a function returns for each of the arguments, as `map` does: moving and hashing
    files releases the interpreter, and more than four threads only queue for the disk."""
    with ThreadPoolExecutor(4) as pool:
        return list(pool.map(function, *arguments))


def write_result(folder: Path, meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write a checked result into an empty folder, every file synced. Its hash covers meta and
    arrays."""

    def write(name: str) -> tuple[bytes, int]:
        """Write one array as .npy, synced, and return digest and CRC-32C of the file."""
        content, path = io.BytesIO(), _array_path(folder, name)
        np.lib.format.write_array(content, np.asarray(arrays[name], order="C"), version=(1, 0))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, data := content.getvalue())
        return digest_bytes(data), google_crc32c.value(data)

    names = sorted(arrays)
    digests = dict(zip(names, in_threads(write, names), strict=True))
    content_hash = _combine_digests(meta, {name: digest for name, (digest, _) in digests.items()})
    checksums = {name: checksum for name, (_, checksum) in digests.items()}
    saved = {**meta, "hash": content_hash, "arrays": names, "checksums": checksums}
    write_bytes(folder / "meta.json", to_json(saved))


def read_meta(folder: Path) -> dict[str, Any]:
    """`meta` as it was saved, with its content `hash` and the names and checksums of its `arrays`;
    not to be changed, as it is read once.

    Raises DamagedError where these, or its `inputs`, are not what the session writes.
    """
    return _read_meta(folder, identify(folder / "meta.json"))


@lru_cache(MOST_REMEMBERED)
def _read_meta(folder: Path, identity: object) -> dict[str, Any]:
    """Read `meta`, as `read_meta` does."""
    meta = read_json(folder / "meta.json")
    with decoding(folder / "meta.json"):
        check_meta("/".join(folder.parts[-2:]), meta)
        for name in meta.get("arrays", ()):
            safe_path(name)
    return Meta(folder / "meta.json", meta)


def verify_result(folder: Path) -> None:
    """Read a whole result; raises DamagedError unless it is what was saved."""
    meta = read_meta(folder)
    digests, checksums = {}, meta.get("checksums", {})
    try:
        for name in meta.get("arrays", []):
            data = read_file(_array_path(folder, name), MAX_ARRAY_BYTES)
            digests[name] = digest_bytes(data)
            if checksums.get(name, checksum := google_crc32c.value(data)) != checksum:
                raise _damage(folder, f"array {name}: its checksum differs from the saved one")
    except OSError as error:
        raise _damage(folder, str(error)) from error
    if _combine_digests(
        {key: meta[key] for key in meta if key not in _RESERVED}, digests
    ) != meta.get("hash"):
        raise _damage(folder, "its hash differs from the saved one")


def read_arrays(
    folder: Path, meta: Mapping[str, Any], only: Collection[str] | None
) -> dict[str, np.ndarray]:
    """The arrays of a result with that meta (those named in `only`); DamagedError where one is
    missing or not what was saved."""
    names, checksums = meta.get("arrays", []), meta.get("checksums", {})
    if only is not None and (unknown := set(only) - set(names)):
        raise InputError(f"{folder.name} holds no array {sorted(unknown)}: it holds {names}")
    arrays = {}
    for name in names:
        if only is not None and name not in only:
            continue
        try:
            arrays[name] = _read_array(_array_path(folder, name), checksums.get(name))
        except (
            OSError,
            ValueError,
            EOFError,
            KeyError,
            SyntaxError,
            tokenize.TokenError,
            MemoryError,
        ) as error:
            raise _damage(folder, f"array {name}: {error}") from error
    return arrays


def _read_array(path: Path, checksum: int | None) -> np.ndarray:
    """Read a .npy file. Raises ValueError unless it is what was saved, or where that is not known
    exactly the numbers or texts that its header announces."""
    data = read_file(path, MAX_ARRAY_BYTES)
    if checksum is not None and google_crc32c.value(data) != checksum:
        raise ValueError("it differs from its checksum")
    content = io.BytesIO(data)
    array: np.ndarray = np.lib.format.read_array(content, allow_pickle=False)
    if array.dtype.kind not in "biufU" or content.read(1):
        raise ValueError(f"its {len(data)} bytes are not numbers {array.dtype} {array.shape}")
    return array


def _array_path(folder: Path, name: str) -> Path:
    """Return the file of one array of a result."""
    return folder / _ARRAY_FOLDER / f"{name}.npy"


def digest_bytes(*parts: bytes | memoryview) -> bytes:
    """Return the digest of bytes one after another, of which content hashes are made."""
    whole = hashlib.blake2b(digest_size=20)
    for part in parts:
        whole.update(part)
    return whole.digest()


def _combine_digests(meta: Mapping[str, Any], digests: Mapping[str, bytes]) -> str:
    """Return the content hash of a result from its meta and the digests of its arrays in the order
    of their names."""
    named = (name.encode() + digest for name, digest in digests.items())
    return digest_bytes(to_json(dict(meta)), *named).hex()


def _damage(folder: Path, fault: str) -> DamagedError:
    """Return the error for a damaged result, with its folder and the remedy."""
    return DamagedError(
        f"the result in {folder} is damaged ({fault})",
        "compute it again, or restore it from a copy",
    )
