"""Coded markers: squares that carry a number, detected in an image, and drawn on sheets to
print."""

import re
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import lengths
from slviewer.target.sheet import Drawing

DICTIONARIES = ("DICT_APRILTAG_36h11", "DICT_5X5_250", "DICT_6X6_250")
"""Those that are searched for, in this order, until one is seen; the sheets have the first."""
MOST_MARKERS = 587
"""Numbers of AprilTag 36h11."""
SMALLEST_PX = 16.0
"""Side of a marker below which its corners are too uncertain to be used."""
_CONTRAST = 12.0
"""Grey levels between a marker's border and the white around it, below which its sides are not
measured."""
_SEEN = 0.6
"""Share of a side's profiles that must cross it once."""
_QUIET = 0.2
"""Width of the white around a marker over its side."""
_PAGE_MM = (190.0, 277.0)
"""What fits on A4 with margins of 10 mm."""


@dataclass(frozen=True, eq=False)
class CodedMarkers:
    """Markers in an image: numbers ``ids`` (n,) int, each seen once, and ``corners`` (n, 4, 2)
    float64 px, in the order of OpenCV. ``repeated``: numbers that were seen more than once, and are
    not among them."""

    ids: NDArray[np.int_]
    corners: Floats
    repeated: tuple[int, ...] = ()


def detect_markers(grey: NDArray[np.uint8]) -> CodedMarkers:
    """Detect the markers of the first of `DICTIONARIES` that is seen in an image (h, w), with
    subpixel corners."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    for name in DICTIONARIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        found, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(grey)
        if ids is not None and len(ids):
            break
    corners = np.reshape(found, (-1, 4, 2)).astype(np.float64)
    is_large = lengths(corners - np.roll(corners, 1, axis=1)).min(axis=1) >= SMALLEST_PX
    corners, ids = corners[is_large], np.reshape([] if ids is None else ids, -1)[is_large]
    numbers, first, counts = np.unique(ids, return_index=True, return_counts=True)
    refined = {
        int(number): quad
        for number, rough in zip(numbers[counts == 1], corners[first[counts == 1]], strict=True)
        if (quad := _refine_corners(grey, rough, dictionary.markerSize + 2)) is not None
    }
    quads = np.reshape([*refined.values()], (-1, 4, 2)).astype(float)
    return CodedMarkers(np.array([*refined], int), quads, tuple(numbers[counts > 1].tolist()))


def _refine_corners(grey: np.ndarray, quad: Floats, modules: int) -> Floats | None:
    """Return the corners (4, 2) px where the marker's four sides meet, each a parabola through the
    places where the brightness is half way from the black border to the white around it; None where
    a side is not seen.

    The border alone decides: the windows of general corner detectors would reach into the modules
    inside of it.
    """
    quad = quad.copy()
    for _ in range(2):
        sides = []
        for start, end in zip(quad, np.roll(quad, -1, axis=0), strict=True):
            side = _fit_side(grey, start, end, modules)
            if side is None:
                return None
            sides.append(side)
        for k in range(4):
            # places and directions of the sides at their common corner
            (p, d), (q, e) = sides[k - 1][1], sides[k][0]
            along = np.linalg.lstsq(np.stack([d, -e], axis=1), q - p, rcond=None)[0]
            quad[k] = p + along[0] * d
    return quad


def _fit_side(
    grey: np.ndarray, start: Floats, end: Floats, modules: int
) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]] | None:
    """Return place (2,) px and direction (2,) of a marker's side at its start and end; None if it
    is not seen."""
    length = float(lengths(end - start))
    way = (end - start) / length
    outward = np.array([way[1], -way[0]])  # corners run clockwise in the image
    reach = min(0.7 * length / modules, 6.0)
    t = np.linspace(0.06, 0.94, max(12, int(length)))
    offsets = np.linspace(-reach, reach, 4 * int(np.ceil(reach)) + 1)
    places = start + t[:, None, None] * (end - start) + offsets[:, None] * outward
    u, v = np.moveaxis(places.astype(np.float32), -1, 0)
    profile = cv2.remap(grey, u, v, cv2.INTER_CUBIC).astype(float)
    dark, bright = np.median(profile[:, 0]), np.median(profile[:, -1])
    if not bright - dark > _CONTRAST:
        return None
    over = profile - (dark + bright) / 2
    crosses = (over[:, :-1] < 0) & (over[:, 1:] >= 0)
    clear = crosses.sum(axis=1) == 1
    if np.count_nonzero(clear) < _SEEN * len(t):
        return None
    at, t = np.argmax(crosses[clear], axis=1)[:, None], t[clear]
    a, b = (np.take_along_axis(over[clear], k, axis=1)[:, 0] for k in (at, at + 1))
    place = offsets[at[:, 0]] - a / (b - a) * (offsets[1] - offsets[0])
    left = np.abs(place - np.polyval(np.polyfit(t, place, 2), t))
    good = left <= max(4 * float(np.median(left)), 0.02)
    curve = np.polyfit(t[good], place[good], 2)
    slope = np.polyder(curve)
    first, last = (
        (
            start + k * (end - start) + np.polyval(curve, k) * outward,
            way * length + np.polyval(slope, k) * outward,
        )
        for k in (0.0, 1.0)
    )
    return first, last


def marker_modules(number: int) -> NDArray[np.uint8]:
    """The modules (m, m) of a marker of the first dictionary with its black border: 0 black, 255
    white."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARIES[0]))
    cells = dictionary.markerSize + 2
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, number, cells, borderBits=1))


def draw_marker_sheet(notation: str) -> Drawing:
    """Draw the sheet ``markers:FIRST-LAST:SIDE`` (numbers to cut out, mm) or ``mat:SIDE`` (a mat
    for a turntable: rings of markers about a cross). Raises InputError for other notations, and for
    sheets that do not fit on A4.
    """
    if match := re.fullmatch(r"markers:(\d{1,3})-(\d{1,3}):(\d{1,3}(?:\.\d{1,2})?)", notation):
        return _draw_numbers(int(match[1]), int(match[2]), float(match[3]))
    if match := re.fullmatch(r"mat:(\d{1,3}(?:\.\d{1,2})?)", notation):
        return _draw_mat(float(match[1]))
    raise InputError(
        f"{notation!r} is not a sheet of markers",
        "write markers:0-23:20 (numbers, mm) or mat:16 (mm)",
    )


def _draw_numbers(first: int, last: int, side: float) -> Drawing:
    """Draw a sheet of markers with cutting marks and numbers."""
    if not (5 <= side <= 150 and first <= last < MOST_MARKERS):
        raise InputError(
            f"markers {first} to {last} of {side:g} mm are not possible",
            f"give numbers from 0 to {MOST_MARKERS - 1} in ascending order, and a side of 5 to 150"
            " mm",
        )
    pitch = side * (1 + 2 * _QUIET) + 4.0
    columns, rows = (int((length + 1e-9) // pitch) for length in _PAGE_MM)
    count = last - first + 1
    if count > columns * rows:
        raise InputError(
            f"{count} markers of {side:g} mm do not fit on A4, {columns * rows} do",
            "make several sheets",
        )
    drawing = Drawing(210.0, 297.0)
    for i in range(count):
        left, top = 10.0 + pitch * (i % columns), 10.0 + pitch * (i // columns)
        quiet = side * _QUIET
        drawing.add_cells(marker_modules(first + i) == 0, left + quiet, top + quiet, side)
        edge = side * (1 + 2 * _QUIET)
        for x, y in ((0, 0), (edge, 0), (0, edge), (edge, edge)):
            drawing.circles.append((left + x, top + y, 0.15))
        drawing.texts.append((left + quiet, top + edge + 2.6, 2.2, str(first + i)))
    return drawing


def _draw_mat(side: float) -> Drawing:
    """Draw a ring of markers on A4 about a cross that marks the turntable's axis."""
    if not 8 <= side <= 40:
        raise InputError(f"a mat with markers of {side:g} mm is not possible", "give 8 to 40 mm")
    pitch = side * (1 + 2 * _QUIET)
    drawing = Drawing(210.0, 297.0)
    centre, outer = np.array([105.0, 148.5]), 95.0 - side
    number = 0
    for radius in np.arange(outer, outer - 2.5 * pitch, -1.25 * pitch):
        around = int(2 * np.pi * radius / (1.5 * pitch))
        for angle in 2 * np.pi * np.arange(around) / max(around, 1):
            x, y = centre + radius * np.array([np.cos(angle), np.sin(angle)]) - side / 2
            drawing.add_cells(marker_modules(number) == 0, float(x), float(y), side)
            number += 1
    u, v = centre
    drawing.rectangles += [(u - 5, v - 0.1, 10, 0.2), (u - 0.1, v - 5, 0.2, 10)]
    drawing.circles += [
        (u + 95 * np.cos(a), v + 95 * np.sin(a), 0.2) for a in np.arange(0, 6.28, 0.05)
    ]
    drawing.texts.append(
        (10.0, 10.0, 3.0, f"slviewer mat, markers of {side:g} mm: put the cross on the axis")
    )
    return drawing
