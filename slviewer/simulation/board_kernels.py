"""Rays on bowed boards, and how much of each pixel is dark."""

import math

import numba
import numpy as np

from slviewer.geometry.jit import kernel

# each step gains the factor slope x tan(incidence), about 1e-3 for some tenths of a mm of bow
_FIXED_POINT = 6
_SUBSAMPLES = 8


@kernel(parallel=True)
def intersect(rays, origin, axes, rotation, bounds, shape):
    """Board coordinates (h, w, 2), points and normals (h, w, 3) of the camera rays (h, w, 2); NaN
    behind the camera.

    origin: the camera in the board's frame; axes = R_board_camera; rotation = R_camera_board;
    bounds: the plate's corner and size; shape: bow_x, bow_y, twist.
    """
    h, w = rays.shape[:2]
    xy, points, normals = np.empty((h, w, 2)), np.empty((h, w, 3)), np.empty((h, w, 3))
    half_x, half_y = bounds[2] / 2, bounds[3] / 2
    for i in numba.prange(h):
        for j in range(w):
            r, s = rays[i, j, 0], rays[i, j, 1]
            dx = axes[0, 0] * r + axes[0, 1] * s + axes[0, 2]
            dy = axes[1, 0] * r + axes[1, 1] * s + axes[1, 2]
            dz = axes[2, 0] * r + axes[2, 1] * s + axes[2, 2]
            z = 0.0
            depth, x, y, X, Y = 0.0, 0.0, 0.0, 0.0, 0.0
            for _ in range(_FIXED_POINT):
                depth = (z - origin[2]) / dz if dz != 0 else np.nan
                x, y = origin[0] + depth * dx, origin[1] + depth * dy
                X, Y = (x - bounds[0]) / half_x - 1, (y - bounds[1]) / half_y - 1
                z = shape[0] * (1 - X * X) + shape[1] * (1 - Y * Y) + shape[2] * X * Y
            if not depth > 0:
                x, y, depth = np.nan, np.nan, np.nan
            zx = (-2 * shape[0] * X + shape[2] * Y) / half_x
            zy = (-2 * shape[1] * Y + shape[2] * X) / half_y
            length = math.sqrt(1 + zx * zx + zy * zy)
            xy[i, j, 0], xy[i, j, 1] = x, y
            points[i, j, 0], points[i, j, 1], points[i, j, 2] = depth * r, depth * s, depth
            # (zx, zy, -1) looks back at the camera, because the board's z points away from it
            for k in range(3):
                n = rotation[k, 0] * zx + rotation[k, 1] * zy - rotation[k, 2]
                normals[i, j, k] = n / length if depth > 0 else np.nan
    return xy, points, normals


@kernel()
def _albedo(x, y, bounds, sheet):
    """Albedo at one point of the board, ``white`` or ``dark``; 0 outside the plate."""
    kind, pitch, cells, circles, radius, white, dark = sheet
    px, py = x - bounds[0], y - bounds[1]
    if not (0 <= px <= bounds[2] and 0 <= py <= bounds[3]):
        return 0.0
    if kind == 1:
        row = min(int(4 * py / pitch), cells.shape[0] - 1)
        column = min(int(4 * px / pitch), cells.shape[1] - 1)
        nearest = cells[row, column]
        dx, dy = x - circles[nearest, 0], y - circles[nearest, 1]
        return dark if dx * dx + dy * dy < radius * radius else white
    if kind == 2:
        column, row = math.floor(x / pitch), math.floor(y / pitch)
        inside = -1 <= column < cells[0, 0] and -1 <= row < cells[0, 1]
        return dark if inside and (column + row) % 2 == 0 else white
    return white


@kernel(parallel=True)
def average_albedo(xy, bounds, sheet):
    """Mean albedo (h, w) float32 of each pixel; `xy` (h, w, 2) are the board coordinates of the
    pixels' centres.

    sheet: kind, pitch, cells, circles, radius, white, dark. kind: 0 blank, 1 circles (`cells`
    names the nearest circle for each quarter pitch), 2 chessboard (`cells` holds its inner
    corners). A pixel whose centre and corners agree is taken as uniform; others are sampled 8x8
    times.
    """
    h, w = xy.shape[:2]
    out = np.empty((h, w), np.float32)
    for i in numba.prange(h):
        up, down = max(i - 1, 0), min(i + 1, h - 1)
        for j in range(w):
            left, right = max(j - 1, 0), min(j + 1, w - 1)
            x, y = xy[i, j, 0], xy[i, j, 1]
            ux = (xy[i, right, 0] - xy[i, left, 0]) / (right - left)
            uy = (xy[i, right, 1] - xy[i, left, 1]) / (right - left)
            vx = (xy[down, j, 0] - xy[up, j, 0]) / (down - up)
            vy = (xy[down, j, 1] - xy[up, j, 1]) / (down - up)
            centre = _albedo(x, y, bounds, sheet)
            uniform = True
            for a in (-0.5, 0.5):
                for b in (-0.5, 0.5):
                    corner = _albedo(x + a * ux + b * vx, y + a * uy + b * vy, bounds, sheet)
                    uniform = uniform and corner == centre
            if uniform:
                out[i, j] = centre
                continue
            total = 0.0
            for m in range(_SUBSAMPLES):
                a = (m + 0.5) / _SUBSAMPLES - 0.5
                for n in range(_SUBSAMPLES):
                    b = (n + 0.5) / _SUBSAMPLES - 0.5
                    total += _albedo(x + a * ux + b * vx, y + a * uy + b * vy, bounds, sheet)
            out[i, j] = total / (_SUBSAMPLES * _SUBSAMPLES)
    return out
