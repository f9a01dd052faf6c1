"""OpenCV FileStorage files (YAML, XML, JSON) and other YAML, parsed in a process of its own.

Some malformed ones crash OpenCV's parser, and others make it use all memory or never end.
"""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from slviewer.errors import InputError
from slviewer.session.reading import limit_process, read_input, run_isolated

_MAX_BYTES = 1 << 24
_MAX_NUMBERS = 10_000


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


def read_storage(path: Path) -> Storage:
    """The matrices of an OpenCV FileStorage file; InputError where it cannot be read."""
    read_input(path, _MAX_BYTES, "give an OpenCV FileStorage file (.yml, .xml or .json)")
    status, output = run_isolated(__name__, str(path.absolute()))
    if status != 0:
        reason = "is no" if status == 1 else "makes OpenCV's parser fail, as it is too large or no"
        raise InputError(
            f"{path.name} {reason} OpenCV FileStorage file (.yml, .xml or .json)",
            "export the calibration again",
        )
    entries, words = json.loads(output)
    return Storage(
        path.name,
        {key: None if v is None else np.array(v, np.float64) for key, v in entries.items()},
        words,
    )


def _parse(path: str) -> tuple[dict[str, Any], dict[str, str]]:
    """Return {key: nested lists of numbers, or None} for the entries of a file, and {key: text}.
    Raises what OpenCV and the YAML parser raise.

    Entries of a mapping have its key and a dot before their own.
    """
    try:
        storage = cv2.FileStorage(path, cv2.FILE_STORAGE_READ)
        is_storage = storage.isOpened()
    except (cv2.error, SystemError):
        is_storage = False
    if is_storage:
        tree = _plain(storage.root())
    else:  # YAML of other programs lacks OpenCV's first line
        tree = yaml.safe_load(Path(path).read_text(encoding="utf-8-sig"))
    if not isinstance(tree, dict):
        raise ValueError("no storage")
    numbers: dict[str, Any] = {}
    words: dict[str, str] = {}
    _flatten("", tree, numbers, words)
    return numbers, words


def _plain(node: Any) -> Any:
    """Return a FileStorage node as a number, text, list or mapping; a matrix as nested lists, and
    None for what holds too much."""
    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isMap():
        try:
            return _limited(node.mat())
        except (cv2.error, ValueError):
            return {key: _plain(node.getNode(key)) for key in node.keys()}  # noqa: SIM118
    if not node.isSeq() or node.size() > _MAX_NUMBERS:
        return None
    return [_plain(node.at(i)) for i in range(node.size())]


def _limited(matrix: np.ndarray | None) -> list[Any] | None:
    """Return a matrix as nested lists; None for one that is too large. Raises ValueError for
    none."""
    if matrix is None:
        raise ValueError("no matrix")
    return None if matrix.size > _MAX_NUMBERS else np.asarray(matrix, np.float64).tolist()


def _flatten(
    start: str, tree: dict[Any, Any], numbers: dict[str, Any], words: dict[str, str]
) -> None:
    """Fill in the ``numbers`` and ``words`` of a mapping, whose keys begin with ``start``."""
    for name, value in tree.items():
        key = f"{start}{name}"
        if isinstance(value, str):
            words[key], value = value, None
        if isinstance(value, dict) and not {"rows", "cols", "data"} <= value.keys():
            numbers[key] = None
            _flatten(f"{key}.", value, numbers, words)
            continue
        try:
            if isinstance(value, dict):
                value = np.reshape(value["data"], (value["rows"], value["cols"])).tolist()
            matrix = np.atleast_1d(np.array(value, np.float64))
            is_matrix = value is not None and matrix.size <= _MAX_NUMBERS and matrix.ndim <= 3
            numbers[key] = matrix.tolist() if is_matrix else None
        except (ValueError, TypeError):
            numbers[key] = None


if __name__ == "__main__":
    limit_process()
    print(json.dumps(_parse(sys.argv[1])))
