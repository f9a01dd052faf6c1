"""Calibration files of other programs (YAML, XML, JSON of OpenCV and others, INI, MAT, NPZ), parsed
in a process of its own.

Some malformed ones make a parser use all memory or never end.
"""

import json
import re
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from slviewer.errors import InputError
from slviewer.session.importers.calibration_makers import (
    convert_json,
    read_colmap,
    read_metashape,
    refuse_unread,
)
from slviewer.session.reading import limit_process, read_input, run_isolated

_MAX_BYTES = 1 << 24
_MAX_NUMBERS = 10_000
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?\.?(?i:nan|inf)")


@dataclass(frozen=True)
class Storage:
    """What a file holds at its top level: the ``name`` of the file, and for each key a float64
    matrix, or None where the entry is not a matrix of numbers; ``words``: the texts."""

    name: str
    entries: dict[str, np.ndarray | None]
    words: dict[str, str] = field(default_factory=dict)

    def matrix(self, key: str) -> np.ndarray:
        """The matrix under a key; InputError where it is none, or holds numbers that are not
        finite."""
        matrix = self.entries[key]
        if matrix is None:
            raise InputError(
                f"{self.name}: {key} is not a matrix of numbers", "name the key of one"
            )
        if not np.isfinite(matrix).all():
            raise InputError(
                f"{self.name}: {key} holds numbers that are not finite", "calibrate again"
            )
        return matrix

    def list_unused(self, used: Iterable[str]) -> list[str]:
        """The keys of entries that are not among those ``used``, but texts and mappings."""
        starts = {key.rpartition(".")[0] for key in self.entries}
        left_out = {*used} | starts | self.words.keys()
        return [key for key in self.entries if key not in left_out]


def read_storage(path: Path) -> Storage:
    """The matrices of a calibration file; InputError where it cannot be read."""
    kinds = "YAML, XML, JSON, INI, MAT or NPZ"
    data = read_input(path, _MAX_BYTES, f"give a calibration as {kinds}")
    check_mat(path.name, data)
    refuse_unread(path.name, data)
    status, output = run_isolated(__name__, str(path.absolute()))
    if status != 0:
        reason = "damaged, or none" if status == 1 else "too large, or none"
        raise InputError(
            f"{path.name} is {reason} of the calibration files that are read ({kinds}, as OpenCV,"
            " ROS, Kalibr, MATLAB, NumPy, COLMAP, Metashape and calib.io write them)",
            "export the calibration again",
        )
    entries, words, refusal = json.loads(output)
    if refusal:
        raise InputError(refusal[0], refusal[1], path.name)
    return Storage(
        path.name,
        {key: None if v is None else np.array(v, np.float64) for key, v in entries.items()},
        words,
    )


def check_mat(name: str, data: bytes) -> None:
    """Raise InputError for a file of MATLAB's version 7.3, which is HDF5."""
    if data.startswith(b"MATLAB 7.3"):
        raise InputError(f"{name} is of MATLAB's version 7.3", "save it with the option -v7")


def _parse(path: str) -> tuple[dict[str, Any], dict[str, str]]:
    """Return {key: nested lists of numbers, or None} for the entries of a file, and {key: text}.
    Raises what the parsers raise.

    Entries of a mapping have its key and a dot before their own.
    """
    suffix = Path(path).suffix.lower()
    text = "" if suffix in (".mat", ".npz") else Path(path).read_text(encoding="utf-8-sig")
    if suffix == ".mat":
        tree = {key: v for key, v in _load_mat(path).items() if not key.startswith("__")}
    elif suffix == ".npz":
        tree = _load_npz(path)
    elif text.lstrip().startswith("<"):
        root = ElementTree.fromstring(text)  # noqa: S314 - within limits
        tree = read_metashape(root) or _read_xml(root)
    elif (colmap := read_colmap(text)) is not None:
        tree = colmap
    elif re.match(r"\s*([#;].*\s+)*\[[^\]\n,]+\]\s*\n", text):
        tree = _read_ini(text)
    else:
        # OpenCV writes NaN as YAML does, in JSON too, whose rest is YAML
        text = re.sub(r"\A%YAML.*", "", text).replace(".Nan", ".nan").replace("\t", " ")
        (tree,) = filter(None, yaml.load_all(text, _Loader))
    if not isinstance(tree, dict):
        raise ValueError("no storage")
    numbers: dict[str, Any] = {}
    words: dict[str, str] = {}
    _flatten("", convert_json(tree), numbers, words)
    return numbers, words


def _load_mat(path: str) -> dict[str, Any]:
    """Return the variables of a MAT file; structs as mappings."""
    from scipy.io import loadmat

    found: dict[str, Any] = loadmat(path, simplify_cells=True)
    return found


def _load_npz(path: str) -> dict[str, Any]:
    """Return the arrays of an NPZ file; None for those of Python's objects, or of other kinds."""
    tree: dict[str, Any] = {}
    with np.load(path, allow_pickle=False) as archive:
        for key in archive.files:
            tree[key] = None
            with suppress(ValueError):  # an object, which a pickle holds
                array = archive[key]
                is_plain = array.dtype.kind in "biufU" and array.size <= _MAX_NUMBERS
                tree[key] = array.tolist() if is_plain else None
    return tree


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Reads YAML with the matrices of OpenCV."""


_Loader.add_multi_constructor(
    "tag:yaml.org,2002:opencv-",
    lambda loader, _, node: loader.construct_mapping(node, deep=True),
)


def _read_xml(node: ElementTree.Element) -> Any:
    """Return an element as a mapping, list, text, number or list of numbers."""
    if len(node):
        if all(child.tag == "_" for child in node):
            return [_read_xml(child) for child in node]
        return {child.tag: _read_xml(child) for child in node}
    return _read_words((node.text or "").split())


def _read_words(words: list[str]) -> Any:
    """Return words as a number, a list of numbers, or a text."""
    if not words or not all(map(_NUMBER.fullmatch, words)):
        return " ".join(words).strip('"')
    values = [_to_float(word) for word in words]
    return values if len(values) > 1 else values[0]


def _to_float(word: str) -> float:
    """Return the number in a word."""
    return float(word.lower().replace(".nan", "nan").replace(".inf", "inf"))


def _read_ini(text: str) -> dict[str, Any]:
    """Return the sections of an INI, with names = values, or names above lines of numbers."""
    tree: dict[str, Any] = {}
    section, key = tree, ""
    for line in _list_lines(text):
        name, is_value, value = line.partition("=")
        words = line.split()
        if line.startswith("["):
            section = tree.setdefault(line.strip("[] "), {})
        elif is_value:
            section[name.strip()] = _read_words(value.replace(",", " ").split())
        elif all(map(_NUMBER.fullmatch, words)):
            section[key].append([_to_float(word) for word in words])
        else:
            section[key := line] = []
    return tree


def _list_lines(text: str) -> Iterable[str]:
    """Return the lines of an INI that are neither empty nor comments."""
    return (line for line in map(str.strip, text.splitlines()) if line and line[0] not in "#;")


def _flatten(
    start: str, tree: Mapping[Any, Any], numbers: dict[str, Any], words: dict[str, str]
) -> None:
    """Fill in the ``numbers`` and ``words`` of a mapping, whose keys begin with ``start``."""
    for name, value in tree.items():
        key = f"{start}{name}"
        if isinstance(value, str):
            words[key] = value
            value = _to_float(value) if _NUMBER.fullmatch(value) else None
        if isinstance(value, dict) and not _is_matrix(value):
            numbers[key] = None
            _flatten(f"{key}.", value, numbers, words)
            continue
        try:
            matrix = np.atleast_1d(_to_matrix(value))
            is_matrix = value is not None and matrix.size <= _MAX_NUMBERS and matrix.ndim <= 3
            numbers[key] = matrix.tolist() if is_matrix else None
        except (ValueError, TypeError):
            numbers[key] = None


def _is_matrix(value: dict[Any, Any]) -> bool:
    """Whether a mapping is a matrix of OpenCV or ROS."""
    return "data" in value and ({"rows", "cols"} <= value.keys() or "sizes" in value)


def _to_matrix(value: Any) -> np.ndarray:
    """Return numbers as an array; of rows and cols with data too, whose numbers count where they
    are a row or column of another length than stated, as ROS writes eight under "cols: 5". Raises
    ValueError or TypeError for others."""
    if not isinstance(value, dict):
        return np.array(value, np.float64)
    data = np.array(value["data"], np.float64)
    if "sizes" in value:
        return data.reshape(np.atleast_1d(value["sizes"]).astype(int))
    rows, cols = int(value["rows"]), int(value["cols"])
    if min(rows, cols) == 1 and data.size % (rows * cols):
        return data.reshape(1, -1)
    data = data.reshape(rows, cols, -1)
    return data[..., 0] if data.shape[2] == 1 else data


if __name__ == "__main__":
    limit_process()
    try:
        print(json.dumps([*_parse(sys.argv[1]), None]))
    except InputError as refused:
        print(json.dumps([{}, {}, [refused.observation, refused.remedy]]))
