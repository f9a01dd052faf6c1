"""What the columns of a file of points mean, by their names: places, normals, colours, sigma; all
others are scalars."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from slviewer.errors import InputError
from slviewer.session.names import join_names
from slviewer.session.ply import COLOURS, NORMAL, PLACE

Columns = Mapping[str, np.ndarray]
"""Values (n,) of each point by the name in the file; ``sensor`` (3,) is the place of a scanner."""
_SPELLINGS = {
    PLACE: ("x y z", "cartesianx cartesiany cartesianz", "points0 points1 points2"),
    NORMAL: ("nx ny nz", "normalx normaly normalz", "normals0 normals1 normals2"),
    COLOURS: (
        "red green blue",
        "r g b",
        "rf gf bf",
        "diffusered diffusegreen diffuseblue",
        "colorred colorgreen colorblue",
    ),
    ("sigma",): ("sigma", "sigmanoise"),
}
"""Of each kind of columns its names, in small letters and digits alone."""
SENSOR = "sensor"
_WRITTEN = {*PLACE, *NORMAL, *COLOURS, "sigma", "sigma_noise", "sigma_calibration", "rgb"}
"""Names of what files of points are written with; no scalar is called so."""


def bare_name(name: str) -> str:
    """Return a name in small letters and digits alone."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def find_columns(names: Sequence[str]) -> dict[tuple[str, ...], list[int]]:
    """Return the places of the columns of each kind: `PLACE`, `NORMAL`, `COLOURS`, ("sigma",)."""
    plain = [bare_name(name) for name in names]
    found = dict[tuple[str, ...], list[int]]()
    for kind, spellings in _SPELLINGS.items():
        for words in map(str.split, spellings):
            if kind not in found and set(words) <= set(plain):
                found[kind] = [plain.index(word) for word in words]
    return found


def select_columns(
    name: str, columns: Columns, notes: list[str]
) -> tuple[dict[tuple[str, ...], np.ndarray], dict[str, np.ndarray]]:
    """Return the values (n, k) of the kinds of columns that a file ``name`` has, colours as uint8,
    and of the others the scalars (n,), by names that a property of a PLY can have; those of several
    numbers a point are named in ``notes``. Raises InputError where it has no places."""
    names = [each for each in columns if each != SENSOR and columns[each].ndim == 1]
    found = find_columns(names)
    if PLACE not in found:
        raise InputError(
            f"{name} has no columns x y z: it has {join_names(names, 30) or 'none'}",
            "name them so, or export the cloud again",
        )
    used = {names[i] for places in found.values() for i in places}
    note_unused([each for each in columns if each not in {*names, SENSOR, "_"}], notes)
    values = {
        kind: np.stack([columns[names[i]] for i in places], axis=1)
        for kind, places in found.items()
    }
    if COLOURS in values:
        levels = _to_levels(values.pop(COLOURS), notes)
        values |= {} if levels is None else {COLOURS: levels}
    scalars = dict[str, np.ndarray]()
    for each in names:
        if each not in used | {"_"}:
            scalars[_name_scalar(each, scalars)] = columns[each]
    return values, scalars


def _name_scalar(name: str, others: Mapping[str, np.ndarray]) -> str:
    """Return a name in ASCII letters, digits and _, unlike others and those of points."""
    name = re.sub(r"\W+", "_", name, flags=re.ASCII)
    name = name if name.isidentifier() else f"scalar_{name}"
    while name in _WRITTEN or name in others:
        name += "_"
    return name


def note_unused(names: Sequence[str], notes: list[str]) -> None:
    """Append a note on entries of a file that nothing reads, if any."""
    if names:
        notes.append(f"not used: {', '.join(dict.fromkeys(names))}")


def _to_levels(colours: np.ndarray, notes: list[str]) -> np.ndarray | None:
    """Return colours (n, 3) as uint8: fractions up to 1, or levels of 8 or 16 bits; None, with a
    note, for other numbers."""
    if colours.dtype == np.uint8:
        return colours
    values = np.nan_to_num(colours.astype(np.float64))
    low, high = values.min(initial=0), values.max(initial=0)
    is_fraction = colours.dtype.kind == "f" and high <= 1
    if low < 0 or high > 65535:
        notes.append(f"its colours are not used: they are numbers from {low:.4g} to {high:.4g}")
        return None
    if high > 255:
        notes.append("its colours of 16 bits were scaled to 8 bits")
    scale = 255.0 if is_fraction else 1 / 257 if high > 255 else 1.0
    return np.rint(scale * values).astype(np.uint8)
