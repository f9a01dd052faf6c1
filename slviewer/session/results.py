"""A result: what was computed, from which inputs, with which settings. `meta.json` and one `.npy` an array."""

import hashlib
import io
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import InputError, SessionError
from slviewer.session.atomic import read_json, to_json, write_bytes, write_json
from slviewer.session.layout import inner_folders
from slviewer.session.names import safe_path

_ARRAY_FOLDER = "arrays"
_RESERVED = {"hash", "arrays"}


def list_results(root: Path) -> list[str]:
    """Names of the results under `root`, parts joined by `/`, in no order."""

    def under(folder: Path) -> list[str]:
        """Return the names of the results in a folder and below."""
        if (folder / "meta.json").is_file():
            return [folder.relative_to(root).as_posix()]
        return [name for inner in inner_folders(folder) for name in under(folder / inner)]

    return under(root)


def check_place(root: Path, name: str) -> None:
    """Raise InputError where a result called `name` would be inside another, or hold others."""
    for other in list_results(root):
        if name.startswith(f"{other}/") or other.startswith(f"{name}/"):
            raise InputError(f"result {name!r} and result {other!r} would lie inside each other: choose another name")


def check_result(meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays as plain NumPy arrays; InputError for names that cannot be files or values that are no arrays."""
    if reserved := _RESERVED & set(meta):
        raise InputError(f"meta holds {sorted(reserved)}, which the session writes itself: use other keys")
    checked = {safe_path(name): np.asarray(array) for name, array in arrays.items()}
    for name, array in checked.items():
        if array.dtype.hasobject:
            raise InputError(f"array {name!r} holds Python objects: give numbers, or put it into meta")
    return checked


def write_result(folder: Path, meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write a checked result into an empty folder, every file synced. Its hash covers meta and arrays."""

    def write(name: str) -> bytes:
        """Write one array as .npy, synced, and return its digest."""
        array = np.asarray(arrays[name], order="C")
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(array))
        path = folder / _ARRAY_FOLDER / f"{name}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        body = array.reshape(-1).view(np.uint8).data if array.size else b""
        write_bytes(path, header.getvalue(), body)
        whole = hashlib.blake2b(header.getvalue(), digest_size=20)
        whole.update(body)
        return whole.digest()

    names = sorted(arrays)
    with ThreadPoolExecutor(4) as pool:
        digests = list(pool.map(write, names))
    whole = hashlib.blake2b(to_json(dict(meta)), digest_size=20)
    for name, digest in zip(names, digests, strict=True):
        whole.update(name.encode() + digest)
    write_json(folder / "meta.json", {**meta, "hash": whole.hexdigest(), "arrays": names})


def read_meta(folder: Path) -> dict[str, Any]:
    """`meta` as it was saved, with its content `hash` and the names of its `arrays`."""
    return read_json(folder / "meta.json")


def read_arrays(folder: Path, only: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of a result (those named in `only`); SessionError where one is missing or damaged."""
    names = read_meta(folder).get("arrays", [])
    if only is not None and (unknown := set(only) - set(names)):
        raise InputError(f"{folder.name} holds no array {sorted(unknown)}: it holds {names}")
    arrays = {}
    for name in names:
        if only is not None and name not in only:
            continue
        path = folder / _ARRAY_FOLDER / f"{name}.npy"
        try:
            arrays[name] = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise SessionError(f"{path} is missing or damaged ({error}): compute the result again") from error
    return arrays
