"""Poses of a robot, a CMM or a stage from a file: CSV, or JSON, of 4x4 matrices, or of places with
quaternions or Euler angles in the conventions of the makers."""

import csv
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, rigid_transform
from slviewer.geometry.vectors import rms
from slviewer.session.reading import MAX_JSON_BYTES, expand_user, read_input

Convention = Literal["matrix", "quaternion-wxyz", "quaternion-xyzw", "abb", "kuka", "fanuc", "ur"]
LengthUnit = Literal["mm", "m"]
AngleUnit = Literal["deg", "rad"]
EULER: Mapping[str, str] = {"abb": "xyz", "kuka": "ZYX", "fanuc": "xyz"}
"""Axes of the three angles as SciPy has them, in the order of the columns: small letters turn about
fixed axes (ABB rx, ry, rz; Fanuc W, P, R), capitals about those turned before (KUKA A, B, C)."""
MOST_POSES = 100_000
_FARTHEST, _QUATERNION = 1e6, 0.01
_WHOLE_TURN = 2 * np.pi
_LEAST_SPREAD_MM = 10.0
"""RMS of positions from their middle below which their unit must be stated."""
_NAMES = ("capture", "name", "scan", "pose", "image", "file")
_PLACES = [("x", "y", "z"), ("tx", "ty", "tz")]
_TURNS: Mapping[tuple[str, ...], tuple[Convention, ...]] = {
    ("qw", "qx", "qy", "qz"): ("quaternion-wxyz",),
    ("q1", "q2", "q3", "q4"): ("quaternion-wxyz",),
    ("qa", "qb", "qc", "qd"): ("quaternion-wxyz", "quaternion-xyzw", "abb"),
    ("a", "b", "c"): ("kuka",),
    ("w", "p", "r"): ("fanuc",),
    ("rx", "ry", "rz"): ("abb", "ur", "fanuc"),
    ("roll", "pitch", "yaw"): ("abb", "fanuc"),
}
_COLUMN = re.compile(r"\W*([a-z]+\d*)[\W_]*(mm|m|deg|degrees|rad|°)?\W*", re.IGNORECASE)
_COUNTS: Mapping[int, tuple[Convention, ...]] = {
    16: ("matrix",),
    12: ("matrix",),
    7: ("quaternion-wxyz", "quaternion-xyzw", "abb"),
    6: ("abb", "kuka", "fanuc", "ur"),
}
"""What rows of so many numbers may be."""
PoseRow = tuple[str, Mapping[str, float] | Sequence[float]]


@dataclass(frozen=True, eq=False)
class PoseFile:
    """The numbers of a file: ``names`` of the captures, empty where it names none; ``places``
    (n, 3) in ``unit``; ``turns`` (n, 3, 3), (n, 4) or (n, 3) by ``convention``, in ``angles``."""

    names: tuple[str, ...]
    places: Floats
    turns: Floats
    convention: Convention
    unit: LengthUnit
    angles: AngleUnit

    def poses(self) -> Floats:
        """(n, 4, 4): the poses, mm. Raises InputError for turns that are not rotations."""
        scale = 1000.0 if self.unit == "m" else 1.0
        return rigid_transform(self._rotations().as_matrix(), scale * self.places)

    def _rotations(self) -> Rotation:
        """Return the rotations."""
        if self.turns.ndim == 3:
            return Rotation.from_matrix(self.turns)
        if self.turns.shape[1] == 4:
            is_last = self.convention == "quaternion-xyzw"
            return Rotation.from_quat(self.turns if is_last else np.roll(self.turns, -1, axis=1))
        degrees = self.angles == "deg"
        if self.convention == "ur":
            return Rotation.from_rotvec(self.turns, degrees=degrees)
        return Rotation.from_euler(EULER[self.convention], self.turns, degrees=degrees)

    def readings(self) -> list[tuple[str, Floats]]:
        """Return the poses by the other conventions and units of angles, in words."""
        if self.turns.ndim == 3:
            return []
        names: tuple[Convention, ...] = ("kuka", "fanuc", "ur")
        if self.turns.shape[1] == 4:
            names = ("quaternion-wxyz", "quaternion-xyzw")
        units: tuple[AngleUnit, ...] = ("deg", "rad") if self.turns.shape[1] == 3 else ("deg",)
        own = "fanuc" if self.convention == "abb" else self.convention
        found = []
        for name, angles in product(names, units):
            other = replace(self, convention=name, angles=angles)
            what = "ABB's or Fanuc's" if name == "fanuc" else name.upper() if name != own else ""
            stated = [f"their convention is {what}"] if name != own else []
            if angles != self.angles and self.turns.shape[1] == 3:
                stated.append(f"their angles are in {angles}")
            if stated:
                found.append((" and ".join(stated), other.poses()))
        return found


def read_pose_file(
    file: Path | str,
    convention: Convention | None = None,
    unit: LengthUnit | None = None,
    angles: AngleUnit | None = None,
) -> PoseFile:
    """Read the poses in a file; what is not given is taken from its header, or the convention.

    Raises InputError where it can be read in several ways, or is not a list of poses.
    """
    path = expand_user(file)
    content = read_input(path, MAX_JSON_BYTES, "choose a CSV or JSON of poses")
    try:
        text = content.decode("utf-8-sig")
        is_json = path.suffix.lower() == ".json" or text.lstrip()[:1] in ("[", "{")
        rows, stated = _read_json(text) if is_json else _read_csv(text)
        return _convert_rows(
            rows, stated, {"convention": convention, "unit": unit, "angles": angles}
        )
    except InputError as error:
        raise error.within(path.name) from None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, csv.Error) as error:
        raise InputError(
            f"{path.name} is not a list of poses ({error})",
            "give a CSV with a line, or a JSON with an entry for each pose",
        ) from error


def _convert_rows(rows: list[PoseRow], stated: dict[str, Any], given: dict[str, Any]) -> PoseFile:
    """Return the poses of the rows of a file, by what is ``given``, else what it has ``stated``.
    Raises InputError."""
    if not 0 < len(rows) <= MOST_POSES:
        raise InputError(f"it holds {len(rows)} poses", f"give 1 to {MOST_POSES}")
    names = tuple(name for name, _ in rows if name)
    if len(names) not in (0, len(rows)) or len(set(names)) < len(names):
        raise InputError(
            "some poses have no name of a capture, or one that others have",
            "name a capture for each, or for none",
        )
    allowed = {"convention": Convention, "unit": LengthUnit, "angles": AngleUnit}
    known: dict[str, Any] = {
        key: given[key] or _check(stated.get(key), kind) for key, kind in allowed.items()
    }
    places, turns, convention = _split_columns([values for _, values in rows], known["convention"])
    usual: Any = ("m", "rad") if convention == "ur" else ("mm", "deg")
    unit, angles = (known[key] or own for key, own in zip(("unit", "angles"), usual, strict=True))
    made = PoseFile(names, places, turns, convention, unit, angles)
    _check_numbers(made)
    if not known["unit"]:
        _check_unit(made)
    _check_angles(made, bool(known["angles"]))
    return made


def match_captures(
    names: Sequence[str], captures: Sequence[str], file: str
) -> tuple[dict[str, int], list[str]]:
    """Return {capture: index of its pose}, and names of the file that no capture has. Poses without
    names are those of all ``captures``, in their order. Raises InputError where none match."""
    if not names:
        return {capture: k for k, capture in enumerate(captures)}, []
    there = {Path(name).stem if name not in captures else name: k for k, name in enumerate(names)}
    matched = {capture: there[capture] for capture in captures if capture in there}
    if not matched:
        raise InputError(
            f"no capture is called {', '.join(list(there)[:3])}, as the poses in {file} are",
            f"name them as the captures are: {', '.join(captures[:3]) or 'there are none'}, ...",
        )
    return matched, [name for name in there if name not in matched]


def _read_json(text: str) -> tuple[list[PoseRow], dict[str, Any]]:
    """Return the rows of a JSON, and what it states of all."""
    data = json.loads(text)
    stated = data if isinstance(data, dict) else {}
    entries = stated.get("poses", data)
    if isinstance(entries, dict):
        named = {k: v for k, v in entries.items() if isinstance(v, dict | list)}
        return [(name, _flatten(each)[1]) for name, each in named.items()], stated
    return [_flatten(each) for each in entries], stated


def _flatten(entry: Any) -> PoseRow:
    """Return the name and the numbers of a pose: a matrix, numbers, or an object of columns that
    may hold objects or lists."""
    if isinstance(entry, list):
        return "", np.array(entry, float).ravel().tolist()
    texts = {key.lower(): value for key, value in entry.items() if isinstance(value, str)}
    name = next((texts[key] for key in _NAMES if key in texts), "")
    numbers = dict[str, float]()
    for key, value in entry.items():
        if isinstance(value, list) and np.size(value) in (12, 16):
            return name, np.array(value, float).ravel().tolist()
        numbers |= _list_columns(key, value, "x" in numbers)
    return name, numbers


def _list_columns(key: str, value: Any, has_place: bool) -> dict[str, float]:
    """Return the columns of one entry of a pose: a number, an object (of ROS: orientation x, y, z,
    w), or a list of the place or the rotation, the place first."""
    if isinstance(value, dict):
        start = "q" if "w" in value else ""
        return {f"{start}{k}": float(each) for k, each in value.items()}
    if isinstance(value, list):
        three = ("rx", "ry", "rz") if has_place else ("x", "y", "z")
        columns = {3: three, 4: ("qa", "qb", "qc", "qd")}[len(value)]
        return {column: float(each) for column, each in zip(columns, value, strict=True)}
    return {key: float(value)} if isinstance(value, int | float) else {}


def _read_csv(text: str) -> tuple[list[PoseRow], dict[str, Any]]:
    """Return the rows of a CSV, with or without header, and the units that its header states."""
    cells, columns, stated = _split_cells(text), list[str](), dict[str, Any]()
    if cells and sum(map(_is_number, cells[0])) < len(cells[0]) - 1:
        for title in cells.pop(0):
            match = _COLUMN.fullmatch(title)
            columns.append(match[1].lower() if match else title.lower())
            if match and match[2]:
                word = match[2].lower()
                key = "unit" if word in ("mm", "m") else "angles"
                stated[key] = {"degrees": "deg", "°": "deg"}.get(word, word)
    rows = [_read_row(row, columns, k) for k, row in enumerate(cells, 2 if columns else 1)]
    return rows, stated


def _split_cells(text: str) -> list[list[str]]:
    """Return the cells of a CSV's lines; commas are decimal ones where others separate."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = next((each for each in ";\t," if any(each in line for line in lines)), " ")
    rows = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    cells = [[cell.strip() for cell in row] for row in rows]
    if separator in ";\t":
        cells = [[re.sub(r"(?<=\d),(?=\d)", ".", cell) for cell in row] for row in cells]
    return cells


def _read_row(row: list[str], columns: list[str], number: int) -> PoseRow:
    """Return the name and the numbers of a line. Raises InputError with its ``number``."""
    if columns and len(row) != len(columns):
        raise InputError(f"row {number} has {len(row)} cells, and the header {len(columns)}")
    is_name = [c in _NAMES for c in columns] or [
        k == 0 and not _is_number(row[0]) for k in range(len(row))
    ]
    try:
        numbers = [float(c) for c, own in zip(row, is_name, strict=True) if not own]
    except ValueError as error:
        raise InputError(f"row {number} holds a cell that is not a number ({error})") from None
    name = next((cell for cell, own in zip(row, is_name, strict=True) if own), "")
    titles = [c for c in columns if c not in _NAMES]
    return name, dict(zip(titles, numbers, strict=True)) if columns else numbers


def _is_number(cell: str) -> bool:
    """Whether a cell is a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _split_columns(
    rows: Sequence[Mapping[str, float] | Sequence[float]], wanted: Any
) -> tuple[Floats, Floats, Convention]:
    """Return places (n, 3), turns and their convention, from the columns' names or numbers."""
    convention = _check(wanted, Convention)
    named = [each for each in rows if isinstance(each, Mapping)]
    if len(named) == len(rows):
        first = named[0]
        place = next((each for each in _PLACES if {*each} <= first.keys()), None)
        turn = next((each for each in _TURNS if {*each} <= first.keys()), None)
        if place is None or turn is None:
            if len(first) not in (12, 16):
                raise InputError(
                    f"its columns are {', '.join(first)}",
                    "give x, y, z with qw, qx, qy, qz, or a, b, c (KUKA), w, p, r (Fanuc), or rx,"
                    " ry, rz (ABB, UR); or the 16 numbers of a matrix by rows",
                )
            return _split_columns([[*each.values()] for each in named], convention)
        values = np.array([[each[k] for k in (*place, *turn)] for each in named], np.float64)
        chosen = _choose(convention, _TURNS[turn], f"columns {', '.join(turn)}")
    else:
        counts = {len(each) for each in rows}
        if len(counts) > 1 or not counts <= _COUNTS.keys():
            raise InputError(
                f"its poses have {' or '.join(map(str, sorted(counts)))} numbers",
                "give 16 or 12 (a matrix by rows), 7 (x, y, z, quaternion) or 6 (x, y, z, angles)",
            )
        values = np.array([[*each] for each in rows], np.float64)
        chosen = _choose(convention, _COUNTS[counts.pop()], f"{values.shape[1]} numbers a pose")
    if chosen == "matrix":
        return _split_matrices(values)
    return values[:, :3], values[:, 3:], chosen


def _split_matrices(values: Floats) -> tuple[Floats, Floats, Convention]:
    """Return places and rotations of matrices by rows (n, 12 or 16). Raises InputError for others,
    also for those by columns."""
    T = values.reshape(len(values), -1, 4)
    if T.shape[1] == 4 and not np.allclose(T[:, 3], [0, 0, 0, 1], atol=1e-6):
        by_columns = np.allclose(T[:, :, 3], [0, 0, 0, 1], atol=1e-6)
        raise InputError(
            "the last row of its matrices is not 0 0 0 1",
            "they are written by columns: transpose them" if by_columns else "give them by rows",
        )
    R = T[:, :3, :3]
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max((1, 2))
    if not (off < 2e-3).all() or (np.linalg.det(R) < 0).any():
        k = int(np.argmax(np.where(np.linalg.det(R) < 0, np.inf, np.nan_to_num(off, nan=np.inf))))
        raise InputError(
            f"pose {k + 1} holds a matrix that is not a rotation", "give its first three columns"
            " with at least 4 decimals, as a right-handed frame",
        )  # fmt: skip
    return T[:, :3, 3], R, "matrix"


def _choose(wanted: Convention | None, allowed: Sequence[Convention], what: str) -> Convention:
    """Return the convention of a file. Raises InputError where it is not known, or another is
    wanted."""
    if wanted is not None and wanted in allowed:
        return wanted
    if wanted is None and len(allowed) == 1:
        return allowed[0]
    names = " or ".join(allowed)
    if wanted is None:
        raise InputError(f"{what} can be {names}", "give --convention")
    raise InputError(f"{what} are not of the convention {wanted}", f"they can be {names}")


def _check(value: Any, allowed: Any) -> Any:
    """Return what a file states, if it is one of a literal's values. Raises InputError."""
    choices = allowed.__args__
    if value is not None and value not in choices:
        raise InputError(f"it states {str(value)[:20]!r}", f"use {' or '.join(choices)}")
    return value


def _check_numbers(read: PoseFile) -> None:
    """Raise InputError for numbers that are not poses."""
    finite = np.isfinite(read.places).all() and np.isfinite(read.turns).all()
    if not finite or np.abs(read.places).max() > _FARTHEST:
        raise InputError("it holds numbers that are not places", "give finite numbers")
    if read.turns.ndim == 2 and read.turns.shape[1] == 4:
        norm = np.linalg.norm(read.turns, axis=1)
        k = int(np.argmax(np.abs(norm - 1)))
        if abs(norm[k] - 1) > _QUATERNION:
            raise InputError(
                f"the quaternion of pose {k + 1} has the length {norm[k]:.3g}", "it must be 1"
            )


def _check_unit(read: PoseFile) -> None:
    """Raise InputError where places without a stated unit may be in mm or in m."""
    apart = np.linalg.norm(read.places - read.places.mean(0), axis=1)
    if read.unit == "mm" and len(apart) > 1 and rms(apart) < _LEAST_SPREAD_MM:
        raise InputError(
            f"its positions are within {rms(apart):.3g} of their middle RMS: that may be mm or m",
            "give --unit m or --unit mm",
        )


def _check_angles(read: PoseFile, is_stated: bool) -> None:
    """Raise InputError where angles may be in degrees or in rad, or cannot be in their unit."""
    if read.turns.ndim != 2 or read.turns.shape[1] != 3 or not read.turns.any():
        return
    largest = float(np.abs(read.turns).max())
    if not is_stated and read.angles == "deg" and largest <= _WHOLE_TURN:
        raise InputError(
            f"its angles are up to {largest:.3g}: that may be degrees or rad",
            "give --angles rad or --angles deg",
        )
    if read.angles == "rad" and largest > 2 * _WHOLE_TURN:
        raise InputError(
            f"its angles are up to {largest:.3g}, which is more than a turn in rad",
            "give --angles deg",
        )
