"""Two cameras: where the second one sees what a pixel of the first one sees.

The projector is only a source of light here. Its phases number the points of the surface, whatever
lens it has and however it moved: a pixel of the second camera with the same phases as one of the
first sees the same point. From then on the second camera takes the projector's place: its pixel
coordinates are the phase map of the first one, as if it had been decoded, and calibration,
triangulation and models are those of a camera and a projector.

Patterns along one axis give one phase. The other number is then the epipolar line, as the row of
both rectified images (Hartley and Zisserman, Multiple View Geometry, 11.12), which only a
calibrated pair has; on a board that both see, the board's own coordinate.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap, PhaseMaps, Reason
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel, run_rows
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.vectors import finite_rows

STEPS = 12
"""Of the search from the table's pixel to the one that has the numbers; smooth surfaces need two or
three."""
MIN_NEIGHBOURS = 6
"""Of the nine pixels around a match, those that must be measured to interpolate between them."""
SAME_SURFACE = 4.0
"""RMS, in standard deviations, by which these may miss a plane: more is an edge between two
surfaces."""
SAME_SURFACE_PX = 0.1
"""The same in pixels, of a surface that is bent or whose noise is small."""
MIN_SINE = 0.02
"""Of the angle between the directions in which the two numbers grow: with less, they are one."""
REACH_PX = 0.6
"""From a pixel's middle to a match; a little more than half, where two pixels would send the search
to each other."""
FARTHEST_PX = 16.0
"""Of one step."""
NOWHERE = (math.nan,) * 4


class PairCalibration(Protocol):
    """A calibration of two cameras, the second in the projector's place. ``pinholes``: their lenses
    and arrangement."""

    @property
    def pinholes(self) -> StereoRig:
        """Both lenses by their best pinhole and Brown models, and their arrangement."""

    @property
    def device_rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Undistorted normalised coordinates (h, w, 2) of each pixel of both cameras."""


@dataclass(frozen=True, eq=False)
class Lines:
    """What numbers points besides a single phase: maps (h, w) of the ``first`` and the ``second``
    camera, NaN where unknown, whose standard deviations are ``sigmas``; and the ``axes`` of the
    second camera that are known then."""

    first: np.ndarray
    second: np.ndarray
    sigmas: tuple[float, float]
    axes: tuple[Axis, ...]


def match_cameras(
    first: PhaseMaps,
    second: PhaseMaps,
    lines: Lines | None = None,
) -> PhaseMaps:
    """Return, by axis, the pixel coordinates of the second camera that see what the pixels of the
    first see, as phase maps (h, w) of the first: along x its columns, along y its rows.

    ``first``, ``second``: the absolute phases that each camera decoded. ``lines``: needed where the
    patterns have one axis. Sigma is that of both cameras' phases. Masked as `Reason.UNSEEN` where
    the second camera sees no such point, or an edge. Their ``light`` is ``first``.

    Raises InputError for one axis without lines.
    """
    axes: tuple[Axis, ...] = tuple(axis for axis in first if axis in second)
    known = [first[axis].correct_edges() for axis in axes]
    seen = [second[axis].correct_edges() for axis in axes]
    numbers = [[phase.coordinate for phase, _ in each] for each in (known, seen)]
    sigmas = [[np.hypot(phase.sigma_px, error) for phase, error in each] for each in (known, seen)]
    if len(axes) == 1:
        if lines is None:
            raise InputError(
                "Cannot match the two cameras",
                "their patterns have one axis, and no calibration of the cameras gives the other."
                " Calibrate from target poses, or import a calibration.",
            )
        axes = lines.axes
        for k, rows in enumerate((lines.first, lines.second)):
            numbers[k].append(rows)
            sigmas[k].append(np.full_like(rows, lines.sigmas[k]))
    found = _find(*(np.stack(maps, axis=-1, dtype=np.float64) for maps in (*numbers, *sigmas)))
    own = [phase for phase, _ in known]
    return {axis: replace(_as_phase(axis, own, found), light=dict(first)) for axis in axes}


def _as_phase(axis: Axis, own: Sequence[PhaseMap], found: np.ndarray) -> PhaseMap:
    """Return what `_find` found along one axis as a phase map of the first camera, whose ``own``
    phases say what is masked besides."""
    reason = own[0].reason
    for phase in own[1:]:
        reason = np.where(reason == Reason.VALID, phase.reason, reason)
    unseen = (reason == Reason.VALID) & np.isnan(found[..., 0])
    reason = np.where(unseen, np.uint8(Reason.UNSEEN), reason)
    k = 0 if axis == "x" else 1
    coordinate, sigma = (
        np.where(reason == Reason.VALID, found[..., i], np.nan).astype(np.float32)
        for i in (k, 2 + k)
    )
    return replace(
        own[0], axis=axis, period_px=2 * np.pi, phase=coordinate, reason=reason, steps=0,
        unambiguous_px=np.inf, model_error_rad=0.0, sigma_scale=1.0, sigma_known=sigma,
    )  # fmt: skip


def epipolar_lines(calibration: PairCalibration) -> Lines:
    """Return the row, px, of each pixel of both cameras in the rectified pair: equal where both can
    see the same point. They add the axis along which the cameras are apart."""
    rig = calibration.pinholes
    across = -rig.R.T @ rig.t  # from the first camera's centre to the second's
    across /= np.linalg.norm(across)
    along = np.array([0.0, 0.0, 1.0]) + rig.R.T @ [0.0, 0.0, 1.0]  # between both optical axes
    down = np.cross(along, across)
    down /= np.linalg.norm(down)
    frame = np.stack([down, np.cross(across, down)])
    focal = (rig.camera.K[0, 0] + rig.projector.K[0, 0]) / 2

    def rows(rays: np.ndarray, to_frame: np.ndarray) -> np.ndarray:
        """Return the rectified rows of rays (h, w, 2)."""
        x, z = (rays @ each[:2] + each[2] for each in to_frame)
        return np.ascontiguousarray(focal * x / z)

    first, second = calibration.device_rays
    apart: Axis = "x" if abs(rig.t[0]) >= abs(rig.t[1]) else "y"
    return Lines(rows(first, frame), rows(second, frame @ rig.R.T), (0.0, 0.0), (apart,))


def _find(
    first: np.ndarray, second: np.ndarray, sigma_1: np.ndarray, sigma_2: np.ndarray
) -> np.ndarray:
    """Return (h, w, 4): the second camera's column and row px where its numbers are those of each
    pixel of the first, and their standard deviations; NaN where there is no such place.

    ``first``, ``second`` (h, w, 2) float64: the numbers of each camera's pixels, NaN where unknown;
    ``sigma_1``, ``sigma_2``: their standard deviations.
    """
    out = np.full((*first.shape[:2], 4), np.nan)
    known = second[finite_rows(second)]
    if not len(known):
        return out
    low = known.min(axis=0)
    # cells of four pixels: finer ones stay empty, coarser ones start farther away
    side = int(len(known) ** 0.5 / 2) + 1
    cell = np.maximum((known.max(axis=0) - low) / side, 1e-9)
    table = np.full((side, side), -1, np.int32)
    _fill_table(second, low, cell, table)
    numbers = first, second, sigma_1, sigma_2
    run_rows(_search, len(first), *numbers, low, cell, table, out)
    return out


@kernel()
def _fill_table(numbers, low, cell, table):
    """Fill ``table`` (n, n) with the index of a pixel whose ``numbers`` (h, w, 2) lie in each cell
    from ``low`` (2,) on, -1 where none do."""
    last = table.shape[0] - 1
    for j in range(numbers.shape[0]):
        for i in range(numbers.shape[1]):
            x, y = (numbers[j, i, 0] - low[0]) / cell[0], (numbers[j, i, 1] - low[1]) / cell[1]
            if x == x and y == y:
                table[min(int(y), last), min(int(x), last)] = j * numbers.shape[1] + i


@kernel()
def _search(start, stop, first, second, sigma_1, sigma_2, low, cell, table, out):
    """Fill rows ``start`` to ``stop`` of ``out`` as `_find` returns it: from the pixels of the
    nearest cells of the table."""
    side, width = table.shape[0], second.shape[1]
    for v in range(start, stop):
        for u in range(first.shape[1]):
            a, b = first[v, u, 0], first[v, u, 1]
            x, y = (a - low[0]) / cell[0], (b - low[1]) / cell[1]
            if not (-1.0 < x < side + 1.0 and -1.0 < y < side + 1.0):  # False for NaN
                continue
            for near in range(9):
                # the cell itself, then those around it
                place = (near + 4) % 9
                row, column = int(y) + place // 3 - 1, int(x) + place % 3 - 1
                if not (0 <= row < side and 0 <= column < side) or table[row, column] < 0:
                    continue
                index = table[row, column]
                place_found = _walk(
                    second, sigma_1[v, u], sigma_2, a, b, index // width, index % width
                )
                if place_found[0] == place_found[0]:
                    for k in range(4):
                        out[v, u, k] = place_found[k]
                    break


@kernel()
def _walk(numbers, sigma_1, sigma_2, a, b, j, i):
    """Return (column, row, their sigmas) where ``numbers`` (h, w, 2) are ``a`` and ``b``, from
    pixel (j, i) on along the planes through each pixel's neighbours; NaN where that ends at an edge
    or nowhere."""
    height, width = numbers.shape[0], numbers.shape[1]
    for _ in range(STEPS):
        if not (1 <= j < height - 1 and 1 <= i < width - 1):
            return NOWHERE
        n = x = y = xx = xy = yy = 0.0
        p = q = pp = qq = xp = yp = xq = yq = 0.0
        p0, q0 = numbers[j, i, 0], numbers[j, i, 1]
        if not (p0 == p0 and q0 == q0):
            return NOWHERE
        for dj in range(-1, 2):
            for di in range(-1, 2):
                dp, dq = numbers[j + dj, i + di, 0] - p0, numbers[j + dj, i + di, 1] - q0
                if dp == dp and dq == dq:
                    n, x, y = n + 1.0, x + di, y + dj
                    xx, xy, yy = xx + di * di, xy + di * dj, yy + dj * dj
                    p, q, pp, qq = p + dp, q + dq, pp + dp * dp, qq + dq * dq
                    xp, yp, xq, yq = xp + di * dp, yp + dj * dp, xq + di * dq, yq + dj * dq
        if n < MIN_NEIGHBOURS:
            return NOWHERE
        # about the means
        xx, xy, yy = xx - x * x / n, xy - x * y / n, yy - y * y / n
        xp, yp, pp = xp - x * p / n, yp - y * p / n, pp - p * p / n
        xq, yq, qq = xq - x * q / n, yq - y * q / n, qq - q * q / n
        area = xx * yy - xy * xy
        px, py = (yy * xp - xy * yp) / area, (xx * yp - xy * xp) / area
        qx, qy = (yy * xq - xy * yq) / area, (xx * yq - xy * xq) / area
        turn = px * qy - py * qx
        steep_p, steep_q = math.hypot(px, py), math.hypot(qx, qy)
        if not abs(turn) > MIN_SINE * steep_p * steep_q:  # False for NaN too
            return NOWHERE
        wanted_p = a - p0 - (p - px * x - py * y) / n
        wanted_q = b - q0 - (q - qx * x - qy * y) / n
        du = (qy * wanted_p - py * wanted_q) / turn
        dv = (px * wanted_q - qx * wanted_p) / turn
        if abs(du) <= REACH_PX and abs(dv) <= REACH_PX:
            s0, s1 = sigma_2[j, i, 0], sigma_2[j, i, 1]
            limit_p = (SAME_SURFACE * s0 + SAME_SURFACE_PX * steep_p) ** 2
            limit_q = (SAME_SURFACE * s1 + SAME_SURFACE_PX * steep_q) ** 2
            if pp - px * xp - py * yp > n * limit_p or qq - qx * xq - qy * yq > n * limit_q:
                return NOWHERE
            cx, cy = du - x / n, dv - y / n
            share = 1.0 / n + (yy * cx * cx - 2.0 * xy * cx * cy + xx * cy * cy) / area
            vp, vq = sigma_1[0] ** 2 + share * s0 * s0, sigma_1[1] ** 2 + share * s1 * s1
            su = math.sqrt(qy * qy * vp + py * py * vq) / abs(turn)
            sv = math.sqrt(px * px * vq + qx * qx * vp) / abs(turn)
            return i + du, j + dv, su, sv
        j += round(min(max(dv, -FARTHEST_PX), FARTHEST_PX))
        i += round(min(max(du, -FARTHEST_PX), FARTHEST_PX))
    return NOWHERE
