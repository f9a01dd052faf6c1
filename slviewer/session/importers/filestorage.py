"""OpenCV FileStorage files (YAML, XML, JSON), parsed in a process of its own.

Some malformed ones crash OpenCV's parser, and others make it use all memory or never end.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.session.reading import limit_process, read_input, run_isolated

_MAX_BYTES = 1 << 24
_MAX_NUMBERS = 10_000


@dataclass(frozen=True)
class Storage:
    """What a file holds at its top level: the ``name`` of the file, and for each key a float64
    matrix, or None where the entry is not a matrix of numbers."""

    name: str
    entries: dict[str, np.ndarray | None]

    def matrix(self, key: str) -> np.ndarray:
        """The matrix under a key; InputError where it is none, or holds numbers that are not
        finite."""
        matrix = self.entries[key]
        if matrix is None:
            raise InputError(f"{self.name}: {key} is not a matrix of numbers: name the key of one")
        if not np.isfinite(matrix).all():
            raise InputError(
                f"{self.name}: {key} holds numbers that are not finite: calibrate again"
            )
        return matrix


def read_storage(path: Path) -> Storage:
    """The matrices of an OpenCV FileStorage file; InputError where it cannot be read."""
    read_input(path, _MAX_BYTES, "give an OpenCV FileStorage file (.yml, .xml or .json)")
    status, output = run_isolated(__name__, str(path.absolute()))
    if status != 0:
        reason = "is no" if status == 1 else "makes OpenCV's parser fail, as it is too large or no"
        raise InputError(
            f"{path.name} {reason} OpenCV FileStorage file (.yml, .xml or .json): export the"
            " calibration again"
        )
    entries = json.loads(output)
    return Storage(
        path.name,
        {key: None if v is None else np.array(v, np.float64) for key, v in entries.items()},
    )


def _parse(path: str) -> dict[str, Any]:
    """Return {key: nested lists of numbers, or None} for the entries of a file. Raises what OpenCV
    raises."""
    storage = cv2.FileStorage(path, cv2.FILE_STORAGE_READ)
    if not storage.isOpened():
        raise ValueError("no storage")
    entries: dict[str, Any] = {}
    for key in storage.root().keys():  # noqa: SIM118 (a FileNode is not a dict)
        try:
            entries[key] = _numbers(storage.getNode(key))
        except (ValueError, cv2.error):
            entries[key] = None
    return entries


def _numbers(node: Any) -> list[Any]:
    """A FileStorage matrix, or numbers in (nested) sequences, as nested lists; ValueError for
    anything else."""

    def plain(node: Any, depth: int) -> Any:
        """Return a node of numbers or nested sequences as a float or nested lists."""
        if node.isInt() or node.isReal():
            return node.real()
        if not node.isSeq() or depth == 3 or node.size() > _MAX_NUMBERS:
            raise ValueError("no numbers")
        return [plain(node.at(i), depth + 1) for i in range(node.size())]

    matrix = node.mat() if node.isMap() else np.atleast_1d(np.array(plain(node, 0), np.float64))
    if matrix is None or matrix.size > _MAX_NUMBERS:
        raise ValueError("no matrix")
    numbers: list[Any] = np.asarray(matrix, np.float64).tolist()
    return numbers


if __name__ == "__main__":
    limit_process()
    print(json.dumps(_parse(sys.argv[1])))
