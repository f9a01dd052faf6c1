"""MAT: arrays of MATLAB, up to its version 7, in mm; read alone."""

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.session.columns import Columns, bare_name, note_unused
from slviewer.session.importers.filestorage import check_mat
from slviewer.session.ply import COLOURS, NORMAL, PLACE
from slviewer.session.shape_format import ShapeFormat

_NAMES = {
    NORMAL: ("normal", "normals"),
    COLOURS: ("color", "colors", "colour", "colours", "rgb"),
    PLACE: ("location", "points", "xyz", "xyzpoints", "vertices", "pts", "cloud"),
}
"""Of each kind of array, of three numbers a point, the names of its last part."""


def _read(path: Path, data: bytes, notes: list[str]) -> list[Columns]:
    """Return the columns of the arrays that have a row of three numbers, or a number, for each
    point."""
    from scipy.io import loadmat

    check_mat(path.name, data)
    arrays = dict(_list_arrays("", loadmat(io.BytesIO(data), simplify_cells=True)))
    last = {name: name.rpartition(".")[2] for name in arrays}
    triples = {
        name: each.reshape(-1, 3) for name, each in arrays.items() if each.shape[-1:] == (3,)
    }
    axes = [arrays[name].size for name in arrays if last[name] in PLACE]
    kinds = _find_triples(path.name, list(triples), has_axes=len(axes) == 3)
    columns = {
        axis: column
        for kind, name in kinds.items()
        for axis, column in zip(kind, triples[name].T, strict=True)
    }
    count = len(triples[kinds[PLACE]]) if PLACE in kinds else max(axes, default=0)
    singles = [name for name, each in arrays.items() if each.size == count]
    columns |= {last[name]: arrays[name].ravel() for name in singles}
    note_unused([name for name in arrays if name not in (*kinds.values(), *singles)], notes)
    return [columns]


def _find_triples(name: str, triples: Sequence[str], has_axes: bool) -> dict[tuple[str, ...], str]:
    """Return the name of the array of each kind among ``triples``; of places the only one left
    where none has a name of theirs, unless ``has_axes`` that are arrays of their own. Raises
    InputError for several."""
    kinds = dict[tuple[str, ...], str]()
    for kind, spellings in _NAMES.items():
        left = [each for each in triples if each not in kinds.values()]
        chosen = [each for each in left if bare_name(each.rpartition(".")[2]) in spellings]
        chosen = chosen or (left if kind == PLACE and not has_axes else [])
        if len(chosen) > 1:
            raise InputError(
                f"{name} holds {' and '.join(chosen)}", "save the points of one cloud alone"
            )
        kinds |= dict.fromkeys([kind], *chosen) if chosen else {}
    return kinds


def _list_arrays(start: str, tree: Mapping[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the arrays of numbers in nested structs, with their names behind ``start``."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _list_arrays(f"{start}{name}.", value)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "iuf":
            yield f"{start}{name}", value


FORMAT = ShapeFormat("mat", "mm", read=_read)
