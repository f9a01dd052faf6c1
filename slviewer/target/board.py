"""Boards and their notation: what features a board has, and their coordinates.

=============================  =====================================================================
``circles:21x16:9``            columns x rows of circles : pitch mm
``acircles:4x11:20``           OpenCV's asymmetric grid: circle j of row i at ((2 j + i % 2) pitch,
                               i pitch)
``chessboard:9x7:75``          columns x rows of *inner corners* : side of a square in mm
``charuco:8x6:30``             columns x rows of *squares* : side of a square in mm; then, if they
                               differ from the defaults, ``:marker mm`` (0.75 of the square),
                               ``:dictionary`` (DICT_5X5_1000) and ``:first id`` of the markers
                               (0). The layout is OpenCV's since 4.6: the top-left square is dark
``charuco-legacy:8x6:30``      the layout before OpenCV 4.6: with an even number of rows, the
                               top-left square is bright
=============================  =====================================================================

Where the print's pitch differs along x and y, both are given, as in ``circles:21x16:9.05x9``.
Plugins add others (`BoardType`).
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slviewer.entry_points import PluginGroup
from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats

Kind = Literal["circles", "acircles", "chessboard", "charuco"]

EXAMPLES = {
    "circles": "circles:21x16:9",
    "acircles": "acircles:4x11:20",
    "chessboard": "chessboard:9x7:75",
    "charuco": "charuco:8x6:30",
    "charuco-legacy": "charuco-legacy:8x6:30",
}
_OUTLINE_SQUARES = {"circles": 0.5, "acircles": 0.5, "chessboard": 0.95, "charuco": 1.0}
DEFAULT_DICTIONARY = "DICT_5X5_1000"
DEFAULT_MARKER = 0.75
"""Side of a ChArUco marker in squares."""
LEGACY = "charuco-legacy"
MAX_STRETCH = 1.5
"""Largest ratio of the pitches along x and y."""
DICTIONARIES = {f"DICT_{n}X{n}_{m}": m for n in (4, 5, 6, 7) for m in (50, 100, 250, 1000)} | {
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
    "DICT_ARUCO_MIP_36h12": 250,
    "DICT_ARUCO_ORIGINAL": 1024,
}
"""Numbers of markers of OpenCV's dictionaries."""
_DICTIONARY_NAMES = {name.upper(): name for name in DICTIONARIES}


@dataclass(frozen=True)
class Detection:
    """Detected features: ``pixels`` (n, 2) float64 px, and ``ids`` (n,) int, their indices into
    ``board.points``.

    A circle's pixel is the centroid of its image, which perspective and distortion move away from
    the image of its centre (some hundredths of a pixel; it grows with the square of the radius):
    ``radius_mm``, 0 for corners, is there to correct that. ``marked``: the mark beside the first
    circle was detected, so that the numbering is the board's own at any turn. ``others`` (k, n)
    int: further ``ids`` that the image allows, where it does not show which of the board's features
    these are. ``note``: what else is in view and not used.
    """

    pixels: Floats
    ids: np.ndarray
    radius_mm: float = 0.0
    marked: bool = False
    others: np.ndarray = field(default_factory=lambda: np.empty((0, 0), int))
    note: str = ""


@dataclass(frozen=True)
class BoardType:
    """A kind of board, written ``NAME:COLUMNSxROWS:PITCH`` as in ``example``.

    ``features(board)``: (columns, rows) of its features. ``points(board)``: their coordinates (n,
    3) float64 mm, row by row, z = 0, x along a row and y along a column, as in `Board`.
    ``detect(board, image)``: of an image (h, w) uint8 the detected features as ``pixels`` (m, 2)
    float64 px and ``ids`` (m,) int, their indices into the points; it raises DetectionError rather
    than return a wrong number. ``margin_pitches``: what of the board surely lies beyond the
    outermost features, in pitches. ``what``: its name in the wizard; ``counts``: what columns, rows
    and pitch mean.
    """

    name: str
    what: str
    counts: str
    example: str
    features: Callable[["Board"], tuple[int, int]]
    points: Callable[["Board"], Floats]
    detect: Callable[["Board", NDArray[np.uint8]], tuple[Floats, np.ndarray]]
    margin_pitches: float = 0.0


_APRILGRID = (
    "; AprilGrids are read by a plugin, such as the one in docs/examples/slviewer-example-plugin"
)
BOARD_PLUGINS = PluginGroup("slviewer.boards", BoardType, lambda: EXAMPLES)


def plugin_boards() -> dict[str, BoardType]:
    """Return the board types that plugins add, by name."""
    return BOARD_PLUGINS.usable()


def board_examples() -> dict[str, str]:
    """Return a notation of each kind of board, those of plugins last."""
    return EXAMPLES | {name: added.example for name, added in plugin_boards().items()}


def _find_example(kind: str) -> str:
    """Return a notation of a kind of board, empty for an unknown one; no plugin is imported for
    those built in."""
    return EXAMPLES.get(kind) or board_examples().get(kind, "")


@dataclass(frozen=True)
class Board:
    """A flat calibration target.

    ``points``: the features, row by row: x along a row, y along a column, so that the normal (x
    cross y) points away from a camera that sees the printed side; the first feature is the origin.
    ``marker_mm``, ``dictionary``, ``legacy``, the layout before OpenCV 4.6, and ``first_id``, the
    number of the first marker, belong to ChArUco boards only. ``kind``: a `Kind`, or the name of a
    plugin's `BoardType`. ``pitch_mm``: along x; ``pitch_y_mm``: along y, by default the same.
    """

    kind: str
    columns: int
    rows: int
    pitch_mm: float
    marker_mm: float = 0.0
    dictionary: str = ""
    pitch_y_mm: float = 0.0
    legacy: bool = False
    first_id: int = 0

    def __post_init__(self) -> None:
        example = _find_example(self.kind)
        if not example:
            raise InputError(
                f"there is no board of kind '{self.kind}'",
                f"use one of {', '.join(board_examples())}"
                + BOARD_PLUGINS.explain_missing(self.kind),
            )
        if self.kind == LEGACY:
            object.__setattr__(self, "kind", "charuco")
            object.__setattr__(self, "legacy", True)
        fewest = {"acircles": (2, 3)}.get(self.kind, (3, 3) if self.kind in EXAMPLES else (1, 1))
        if not (fewest[0] <= self.columns <= 200 and fewest[1] <= self.rows <= 200):
            raise InputError(
                f"a {self.kind} board of {self.columns}x{self.rows} cannot be used",
                f"give {fewest[0]} to 200 columns and {fewest[1]} to 200 rows, as in '{example}'",
            )
        self._check_pitches(example)
        if self.kind == "charuco":
            self._check_markers()
            # the layouts differ with an even number of rows only
            object.__setattr__(self, "legacy", self.legacy and self.rows % 2 == 0)
        elif self.marker_mm or self.dictionary or self.legacy or self.first_id:
            raise InputError(f"a {self.kind} board has no markers", "omit marker and dictionary")

    def _check_pitches(self, example: str) -> None:
        """Set the default of the pitch along y, and raise InputError for pitches that no board
        has."""
        if not self.pitch_y_mm:
            object.__setattr__(self, "pitch_y_mm", self.pitch_mm)
        for pitch in self.pitches.tolist():
            if not (math.isfinite(pitch) and 0.01 <= pitch <= 10_000):
                raise InputError(
                    f"a pitch of {pitch:g} mm cannot be used",
                    f"give 0.01 to 10000 mm, as in '{example}'",
                )
        if self.pitch_y_mm != self.pitch_mm and self.plugin_type:
            raise InputError(
                f"a {self.kind} board comes from a plugin and has one pitch", "give one"
            )
        if not 1 / MAX_STRETCH <= self.pitch_y_mm / self.pitch_mm <= MAX_STRETCH:
            raise InputError(
                f"pitches of {self.pitch_mm:g} mm along x and {self.pitch_y_mm:g} mm along y cannot"
                " be used",
                f"their ratio is at most {MAX_STRETCH:g}, and a board drawn with square cells is"
                " needed",
            )

    def _check_markers(self) -> None:
        """Set the defaults of marker and dictionary, and raise InputError where they do not fit the
        board."""
        if not self.marker_mm:
            object.__setattr__(self, "marker_mm", DEFAULT_MARKER * self.pitch_mm)
        if not self.dictionary:
            object.__setattr__(self, "dictionary", DEFAULT_DICTIONARY)
        if not 0.2 * self.pitch_mm <= self.marker_mm <= 0.95 * self.pitch_mm:
            raise InputError(
                f"markers of {self.marker_mm:g} mm do not fit squares of {self.pitch_mm:g} mm",
                "give 0.2 to 0.95 of the square, as in 'charuco:8x6:30:22.5'",
            )
        if self.dictionary not in DICTIONARIES:
            raise InputError(
                f"'{self.dictionary}' is not a marker dictionary of OpenCV",
                f"write it as in 'charuco:8x6:30:22.5:DICT_5X5_1000', one of"
                f" {', '.join(DICTIONARIES)}",
            )
        available = DICTIONARIES[self.dictionary]
        needed = self.marker_ids.stop
        if not 0 <= self.first_id <= needed <= available:
            raise InputError(
                f"a ChArUco board of {self.columns}x{self.rows} squares, from marker"
                f" {self.first_id}, needs {needed} markers, and {self.dictionary} has {available}",
                "choose a larger dictionary",
            )

    @classmethod
    def parse(cls, notation: str) -> "Board":
        """Parse a notation such as ``circles:21x16:9``; raises InputError for others."""
        kind, *fields = notation.strip().split(":")
        kind = kind.strip().lower()
        example = _find_example(kind)
        if not example:
            raise InputError(
                f"board '{notation}' is not understood",
                f"start it with one of {', '.join(board_examples())}, for example"
                f" '{EXAMPLES['circles']}'"
                + (_APRILGRID if kind == "aprilgrid" else BOARD_PLUGINS.explain_missing(kind)),
            )
        is_charuco = kind in ("charuco", LEGACY)
        most = 5 if is_charuco else 2
        if not 2 <= len(fields) <= most:
            raise InputError(
                f"board '{notation}' has {len(fields)} fields after the kind",
                "give columns x rows and the"
                f" {'side of a square' if is_charuco or kind == 'chessboard' else 'pitch'} in mm,"
                f" as in '{example}'",
            )
        size = re.fullmatch(r"\s*(\d{1,6})\s*[xX×]\s*(\d{1,6})\s*", fields[0])
        if not size:
            raise InputError(
                f"board '{notation}': '{fields[0]}' is not columns x rows, as in '{example}'"
            )
        pitch, *along_y = (
            _parse_millimetres(notation, text, example)
            for text in re.split("[xX×]", fields[1], maxsplit=1)
        )
        marker = _parse_millimetres(notation, fields[2], example) if len(fields) > 2 else 0.0
        dictionary = fields[3].strip() if len(fields) > 3 else ""
        dictionary = _DICTIONARY_NAMES.get(dictionary.upper(), dictionary)
        first_id = fields[4].strip() if len(fields) > 4 else "0"
        if not re.fullmatch(r"\d{1,4}", first_id):
            raise InputError(
                f"board '{notation}': '{first_id}' is not the first id of the markers, as in"
                " 'charuco:8x6:30:22.5:DICT_5X5_1000:24'"
            )
        columns, rows, pitch_y = int(size[1]), int(size[2]), along_y[0] if along_y else 0.0
        board = cls(kind, columns, rows, pitch, marker, dictionary, pitch_y)
        return replace(board, first_id=int(first_id))

    def __str__(self) -> str:
        pitch = _format_number(self.pitch_mm)
        if self.pitch_y_mm != self.pitch_mm:
            pitch += f"x{_format_number(self.pitch_y_mm)}"
        kind = LEGACY if self.legacy else self.kind
        fields = [kind, f"{self.columns}x{self.rows}", pitch]
        if self.kind == "charuco":
            plain = self.dictionary == DEFAULT_DICTIONARY and not self.first_id
            if not plain or self.marker_mm != DEFAULT_MARKER * self.pitch_mm:
                fields.append(_format_number(self.marker_mm))
            if not plain:
                fields.append(self.dictionary)
            if self.first_id:
                fields.append(str(self.first_id))
        return ":".join(fields)

    @property
    def features(self) -> tuple[int, int]:
        """(columns, rows) of features: a ChArUco board of c x r squares has (c - 1) x (r - 1) inner
        corners."""
        if added := self.plugin_type:
            return added.features(self)
        lost = 1 if self.kind == "charuco" else 0
        return self.columns - lost, self.rows - lost

    @property
    def marker_ids(self) -> range:
        """Numbers of a ChArUco board's markers."""
        return range(self.first_id, self.first_id + self.columns * self.rows // 2)

    @property
    def plugin_type(self) -> BoardType | None:
        """The type of a plugin's board; None for the kinds that are built in."""
        return None if self.kind in EXAMPLES else plugin_boards()[self.kind]

    @cached_property
    def points(self) -> Floats:
        """(n, 3) float64 mm, z = 0, row by row; read-only."""
        columns, rows = self.features
        i, j = np.divmod(np.arange(columns * rows), columns)
        x = 2 * j + i % 2 if self.kind == "acircles" else j
        points = np.stack([x, i, np.zeros(len(i))], axis=1) * [*self.pitches, 0.0]
        if added := self.plugin_type:
            points = np.array(added.points(self), np.float64)
            is_flat = points.shape == (columns * rows, 3) and not points[:, 2].any()
            if not (is_flat and np.isfinite(points).all()):
                raise InputError(
                    f"the plugin of {self.kind} boards gives points of shape {points.shape} for"
                    f" {columns}x{rows} features",
                    "it must give (n, 3) mm with z = 0, row by row",
                )
        points.flags.writeable = False
        return points

    @property
    def pitches(self) -> Floats:
        """(2,) float64 mm: the pitch along x and along y."""
        return np.array([self.pitch_mm, self.pitch_y_mm])

    @cached_property
    def nodes(self) -> Floats:
        """(n, 2) float64: the points' x and y in pitches."""
        return self.points[:, :2] / self.pitches

    def outline(self, margin_mm: float | None = None) -> Floats:
        """Return a rectangle (4, 3) float64 mm around the features, from top left over top right to
        bottom left.

        ``margin_mm`` beyond the outermost features; by default what is part of the board for
        certain: half a pitch for circles, 0.95 of a square for a chessboard's inner corners, the
        whole sheet of squares for ChArUco.
        """
        if margin_mm is None:
            added = self.plugin_type
            squares = added.margin_pitches if added else _OUTLINE_SQUARES[self.kind]
            margin_mm = squares * self.pitch_mm
        x0, y0 = self.points[:, :2].min(0) - margin_mm
        x1, y1 = self.points[:, :2].max(0) + margin_mm
        return np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])


def _format_number(value: float) -> str:
    """Format a number for the notation, without a trailing ".0"."""
    return repr(float(value)).removesuffix(".0")


def _parse_millimetres(notation: str, text: str, example: str) -> float:
    """Parse a positive length in mm; raises InputError with an example otherwise."""
    try:
        length = float(text)
    except ValueError:
        length = math.nan
    if not length > 0:
        raise InputError(f"board '{notation}': '{text}' is not a length in mm, as in '{example}'")
    return length
