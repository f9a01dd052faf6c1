"""Detect the inner corners of chessboards that are in view, and refine corners to a fraction of a
pixel.

A corner is where two blurred edges cross, fitted to the grey levels around it. The model is
``I = P (1 + kappa E_1 E_2)``: P the plane of the light, kappa the contrast, E_k the blurred step
across edge k. A corner is the point that it is symmetric about, so that neither blur nor uneven
light moves it; gradient-based refinement (OpenCV's ``cornerSubPix``) is off by 0.03 to 0.07 px on
the same images.
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import scipy

from slviewer.errors import DetectionError, InputError
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rigid import Floats, Floats32, Mask
from slviewer.geometry.vectors import lengths
from slviewer.target.blobs import Blobs
from slviewer.target.board import Board, Detection
from slviewer.target.images import (
    SEARCH_PX,
    BoardImage,
    flatten_light,
    light_advice,
    resize_image,
    to_full_image,
)
from slviewer.target.lattice import (
    CLUTTER_FREE_SHARE,
    COMPLETIONS,
    MAX_SIDE_NODES,
    NODE_RADIUS,
    SHEARS,
    Lattice,
    grow_lattices,
    match_part,
    select_part,
)
from slviewer.target.planar import (
    GridMap,
    check_grid,
    fit_grid_map,
    fit_homography,
    is_on_grid,
    jacobians,
)

MIN_CORNERS = 8
"""Smallest number of corners of a pose."""
SUFFICIENT_SHARE = 0.8
"""Share of the corners at which the search ends; below it continues at another resolution."""
MIN_CONTRAST = 1.12
"""Bright over dark squares around a corner."""
MAX_HALF_WIDTH_PX = 11
"""Largest half width of a window; farther pixels measure the lens rather than the corner."""
EDGE_SHARE = 0.4
"""Half length, in squares, of a corner's window along the edges."""
MAX_MISFIT = 0.15
MAX_RELATIVE_MISFIT = 3.0
"""Largest RMS misfit of a corner's grey levels: over its contrast, and over the median misfit of
all corners."""
SADDLE_PX = 5
"""Radius of the ring on which a corner is detected."""
MIN_RESPONSE = 120.0
"""Smallest response of the ring: a quarter of the contrast of black on white."""
COHERENCE = 0.8
"""Least resultant of the phases of a chessboard's corners, of which every other one is turned."""
QUADRANTS = 0.25 * np.array([(-1, -1), (1, 1), (1, -1), (-1, 1)])
"""Where the four squares at a corner are read, in squares."""
END = 0.2
"""Distance in squares at which the outermost squares' end is seen."""
PAPER_SHARE = 0.3
"""Largest difference of paper from the bright squares, over the contrast."""
ITERATIONS = 15
CONVERGENCE_PX = 1e-3


def detect_chessboard(board: Board, image: BoardImage) -> Detection:
    """Detect the inner corners that are in view, lit and uncovered.

    Raises DetectionError, whose message gives the number of corners detected, also where the image
    does not show which part of the board these are.
    A board that has differently coloured corners is numbered so that its top-left square is dark.
    """
    seen = _detect_largest(image, len(board.points))
    if seen is None:
        raise DetectionError(
            f"no chessboard detected where {board} has {len(board.points)} corners",
            light_advice(image.grey),
        )
    return _number_corners(board, image, seen)


def recognise_chessboard(image: BoardImage) -> tuple[Board, Detection] | None:
    """Return the largest chessboard in view, with squares of 1 mm, the longer side first, and its
    detection; None where there is none, or it cannot be numbered."""
    seen = _detect_largest(image, np.inf)
    if seen is None:
        return None
    with suppress(InputError):
        board = Board("chessboard", *seen.lattice.extent, 1.0)
        return board, _number_corners(board, image, seen)
    return None


def _number_corners(board: Board, image: BoardImage, seen: "_Corners") -> Detection:
    """Return the detection of a board by the corners that are seen. Raises DetectionError where
    they are not the board's, or the image does not show which of its corners these are."""
    lattice = seen.lattice
    longer, shorter = lattice.extent
    if longer > max(board.features) or shorter > min(board.features):
        raise DetectionError(
            f"a chessboard of {longer}x{shorter} inner corners detected, {board} expected",
            "check its columns and rows",
        )
    count = f"{len(lattice)} of {len(board.points)} corners of {board} detected"
    if len(lattice) <= CLUTTER_FREE_SHARE * len(board.points):
        raise DetectionError(f"{count} ({longer}x{shorter})", light_advice(image.grey))
    steps = jacobians(seen.grid_map.H, seen.nodes.mean(0, keepdims=True))[0]
    places = match_part(board, lattice, steps, seen, seen.polarity > 0)
    part = select_part(board, seen.pixels, places, image.grey.shape)
    if part is None:
        raise DetectionError(
            f"{count} ({longer}x{shorter}), and the board ends beside these or is covered",
            "check its columns and rows, and uncover it",
        )
    ids, order, others = part.list_features()
    check_grid(board, seen.pixels[order], ids, "corners")
    return Detection(seen.pixels[order], ids, others=others)


@dataclass(frozen=True, eq=False)
class _Corners:
    """Corners (n, 2) px of a chessboard in an image (h, w), at ``nodes`` (n, 2) int of a lattice,
    with the map between these, and ``polarity`` (n,): see ``corner_polarity``."""

    image: Floats32
    grid_map: GridMap
    nodes: np.ndarray
    pixels: Floats
    polarity: np.ndarray

    @property
    def lattice(self) -> Lattice:
        """The corners as a lattice."""
        return Lattice(self.nodes, np.arange(len(self.nodes)))

    @cached_property
    def levels(self) -> Floats:
        """(2, n): grey levels of the dark and of the bright squares at each corner."""
        quadrants = self._read(self.nodes[None] + QUADRANTS[:, None])
        return np.sort([quadrants[:2].mean(0), quadrants[2:].mean(0)], axis=0)

    def is_outside(self, nodes: Floats) -> Mask:
        """See ``lattice.Surroundings``."""
        return np.asarray(np.isnan(self._read(nodes + 2 * QUADRANTS[:, None])).any(axis=0))

    def shows_end(self, nodes: Floats, nearest: np.ndarray) -> Mask:
        """See ``lattice.Surroundings``: of the two squares between a corner and the next node one
        is dark, up to there, and beyond there is paper."""
        inwards = self.nodes[nearest] - nodes
        beside = 0.5 * inwards[:, ::-1] * (1, -1)
        places = np.array(
            [[nodes + side * beside + END * away * inwards for side in (-1, 1)] for away in (1, -1)]
        )
        inner, outer = self._shares(places, nearest)
        is_end = (inner.min(0) < 1 - PAPER_SHARE) & _is_paper(inner.max(0))
        return np.asarray(is_end & _is_paper(outer).all(axis=0))

    def _shares(self, nodes: Floats, nearest: np.ndarray) -> Floats:
        """Return grey levels (..., k) at nodes (..., k, 2): 0 as the dark squares at the corners
        ``nearest`` (k,), 1 as the bright ones."""
        dark, bright = self.levels[:, nearest]
        return (self._read(nodes) - dark) / np.maximum(bright - dark, 1e-6)

    def _read(self, nodes: Floats) -> Floats:
        """Return the grey levels (...) at nodes (..., 2); NaN outside the image."""
        if not nodes.size:
            return np.empty(nodes.shape[:-1])
        pixels = self.grid_map.extrapolate(nodes.reshape(-1, 2)).astype(np.float32)
        levels = cv2.remap(
            self.image, pixels[:, None, 0], pixels[:, None, 1], cv2.INTER_LINEAR, borderValue=np.nan
        )
        return levels.reshape(nodes.shape[:-1]).astype(np.float64)


def _is_paper(shares: Floats) -> Mask:
    """Return whether grey levels, as shares of the contrast, are those of paper."""
    return np.asarray(np.abs(shares - 1) < PAPER_SHARE)


def _detect_largest(image: BoardImage, wanted: float) -> _Corners | None:
    """Detect the largest grid of corners of any chessboard, of ``wanted`` ones if possible, at the
    search resolution, half of it, the full and twice the full resolution, as far as these can
    improve it; None below 3x3."""
    first = min(1.0, SEARCH_PX / max(image.grey.shape))
    even = flatten_light(image.grey)
    largest: _Corners | None = None
    for factor in dict.fromkeys((first, first / 2, 1.0, 2.0)):
        count = len(largest.nodes) if largest else 0
        if count > SUFFICIENT_SHARE * wanted or (factor > 1 and not count):
            break
        saddles = _detect_saddles(resize_image(even, factor))
        for lattice in grow_lattices(saddles.blobs):
            if len(lattice) > max(MIN_CORNERS, len(largest.nodes) if largest else 0):
                largest = _complete_corners(image, saddles, lattice, factor) or largest
    return largest


@dataclass(frozen=True, eq=False)
class _Saddles:
    """Points (n, 2) px about which dark and bright alternate twice, with the ``phase`` (n,) rad of
    that, which is opposite at neighbouring corners of a chessboard."""

    pixels: Floats
    phase: Floats

    @property
    def blobs(self) -> Blobs:
        """The points as blobs, all alike, of which lattices grow."""
        n = len(self.pixels)
        return Blobs(self.pixels, np.ones(n), np.tile(np.eye(2), (n, 1, 1)), False)


def _detect_saddles(grey: np.ndarray) -> _Saddles:
    """Detect points where two dark and two bright squares meet in an image (h, w) uint8: by the
    ring of ChESS (Bennett and Lasenby, 2014)."""
    image = cv2.GaussianBlur(grey, (3, 3), 0).astype(np.float32)
    angles = np.arange(16) * np.pi / 8
    height, width = image.shape
    padded = cv2.copyMakeBorder(image, *(SADDLE_PX,) * 4, cv2.BORDER_REPLICATE)
    ring = [
        padded[v : v + height, u : u + width]
        for u, v in np.rint(
            SADDLE_PX * (1 + np.stack([np.cos(angles), np.sin(angles)], axis=1))
        ).astype(int).tolist()
    ]  # fmt: skip
    opposite = [ring[k] + ring[k + 8] for k in range(8)]
    response = -np.abs(16 * cv2.blur(image, (3, 3)) - sum(opposite))
    for k in range(4):
        response += np.abs(opposite[k] - opposite[k + 4])
    for k in range(8):
        response -= np.abs(ring[k] - ring[k + 8])
    highest = cv2.dilate(response, np.ones((SADDLE_PX, SADDLE_PX), np.uint8))
    v, u = np.nonzero((response == highest) & (response > MIN_RESPONSE))
    turning = sum(
        opposite[k][v, u] * np.exp(2j * angle) for k, angle in enumerate(angles[:8].tolist())
    )
    return _Saddles(np.stack([u, v], axis=1).astype(float), np.angle(turning))


def _complete_corners(
    image: BoardImage, saddles: _Saddles, lattice: Lattice, factor: float
) -> _Corners | None:
    """Return the refined corners at the nodes of a ``lattice`` of saddles, and at those that its
    map predicts around it, in an image that was resized by ``factor`` for these; None where they
    do not alternate as a chessboard's."""
    phase = saddles.phase[lattice.blobs]
    for shear in SHEARS:
        nodes = lattice.nodes @ shear.T
        if abs(np.exp(1j * phase) @ (1 - 2 * (nodes.sum(1) % 2))) > COHERENCE * len(nodes):
            break
    else:
        return None
    smooth = cv2.GaussianBlur(image.deep, (3, 3), 0).astype(np.float32)
    pixels = to_full_image(saddles.pixels[lattice.blobs], factor)
    found: _Corners | None = None
    for _ in range(COMPLETIONS):
        try:
            grid_map = fit_grid_map(nodes.astype(float), pixels, robust=True)
        except DetectionError:
            return found
        low, high = nodes.min(0) - 1, nodes.max(0) + 1
        if (high - low).max() > MAX_SIDE_NODES:
            return found
        around = grid_points(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True)))
        around = around[grid_map.pitch_px(around * 1.0) > 2]
        predicted = grid_map.extrapolate(around * 1.0)
        across, down = jacobians(grid_map.H, around * 1.0).transpose(2, 0, 1)
        polarity = corner_polarity(image.deep, predicted, across, down)
        parity = 1 - 2 * (around.sum(1) % 2)
        fits = polarity * parity * np.sign((polarity * parity).sum()) > 0
        if np.count_nonzero(fits) < MIN_CORNERS:
            return found
        refined, good = refine_corners(image.deep, predicted[fits], around[fits] * 1.0, np.ones(2))
        off = lengths(refined - predicted[fits])
        good &= off < NODE_RADIUS * grid_map.pitch_px(around[fits] * 1.0)
        if np.count_nonzero(good) < MIN_CORNERS:
            return found
        good[good] = _is_in_grid(around[fits][good], refined[good])
        if np.count_nonzero(good) < MIN_CORNERS:
            return found
        is_same = len(nodes) == np.count_nonzero(good)
        nodes, pixels = around[fits][good], refined[good]
        found = _Corners(smooth, grid_map, nodes, pixels, polarity[fits][good])
        if is_same:
            break
    return found


def _is_in_grid(nodes: np.ndarray, pixels: Floats) -> Mask:
    """Return whether corners at ``nodes`` (n, 2) int and ``pixels`` (n, 2) lie on one smooth map
    and have two neighbours."""
    grid_map = fit_grid_map(nodes * 1.0, pixels, robust=True)
    is_in = is_on_grid(grid_map, grid_map.pitch_px(nodes * 1.0))
    neighbours = scipy.spatial.cKDTree(nodes[is_in]).query_ball_point(
        nodes, 1.01, return_length=True
    )
    return np.asarray(is_in & (neighbours > 2))  # itself is one


def corner_polarity(image: np.ndarray, corners: Floats, across: Floats, down: Floats) -> np.ndarray:
    """Return (...,) int8: 1 where the square towards -x, -y of a corner is dark, -1 if bright, 0
    where no squares meet.

    ``corners``, ``across``, ``down`` (..., 2) px: the corner, and the steps to the next ones along
    x and y. The two squares on one diagonal must both be brighter than the two on the other. 0 also
    where the image's border is too close.
    """
    offsets = [(-1, -1), (1, 1), (1, -1), (-1, 1)]
    places = np.stack([corners + 0.3 * (a * across + b * down) for a, b in offsets])
    height, width = image.shape
    flat = np.ascontiguousarray(places.reshape(-1, 1, 2), np.float32)
    blurred, border = cv2.GaussianBlur(image, (3, 3), 0), cv2.BORDER_REPLICATE
    levels = cv2.remap(blurred, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=border)
    inside = (flat >= 0).all(2) & (flat[..., 0] <= width - 1) & (flat[..., 1] <= height - 1)
    main, other = np.split(np.where(inside, levels, np.nan).reshape(places.shape[:-1]), 2)
    with np.errstate(invalid="ignore"):
        dark = main.max(0) * MIN_CONTRAST < other.min(0)
        bright = other.max(0) * MIN_CONTRAST < main.min(0)
    return dark.astype(np.int8) - bright.astype(np.int8)


def refine_corners(
    image: Floats32,
    pixels: Floats,
    points: Floats,
    pitch: Floats,
    marker: float = 0.0,
) -> tuple[Floats, Mask]:
    """Refine corners; returns sub-pixel positions (n, 2) float64 px and whether each fits the
    model, (n,) bool.

    ``image`` (h, w) float32; ``pixels`` (n, 2) px: initial positions, good to a px or two;
    ``points`` (n, 2) mm: the corners on the board; ``pitch`` (2,) and ``marker``: sides of the
    squares and of the markers in them, mm.
    """
    H = fit_homography(points, pixels)
    to_px = jacobians(H, points) * pitch
    sides = lengths(to_px.transpose(0, 2, 1))
    reach = int(np.clip(round(EDGE_SHARE * float(np.median(sides))), 3, MAX_HALF_WIDTH_PX))
    span = np.arange(-reach, reach + 1)
    middle = np.rint(pixels).astype(int)
    u, v = (middle[:, k, None] + o.ravel() for k, o in enumerate(np.meshgrid(span, span)))
    height, width = image.shape
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    grey = image[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)].astype(np.float64)
    offset = np.stack([u, v], axis=2) - pixels[:, None]
    board = np.abs(np.einsum("nij,nmj->nmi", np.linalg.inv(to_px), offset))
    free = 0.8 * (1 - marker / pitch.min()) / 2 if marker else EDGE_SHARE
    weight = (inside & (board.max(2) < EDGE_SHARE) & (board.min(2) < free)).astype(float)
    shift, misfit = _fit_corners(offset, grey, weight, to_px)
    good = misfit < np.maximum(MAX_MISFIT, MAX_RELATIVE_MISFIT * np.median(misfit))
    good &= lengths(shift) < reach
    return pixels + shift, good


def _fit_corners(
    offset: Floats, grey: np.ndarray, weight: np.ndarray, to_px: Floats
) -> tuple[Floats, Floats]:
    """Fit all corners at once by damped Gauss-Newton; returns shifts (n, 2) px and RMS misfits over
    contrast (n,).

    ``offset`` (n, m, 2) px: pixels of each window from the initial corner; ``grey`` and ``weight``
    (n, m); ``to_px`` (n, 2, 2): px per square along the board's x and y.

    Unknowns of each corner: its position (2), the angles of the edges' normals (2), the blur's
    sigma, the plane of the light (3), kappa.
    """
    n = len(offset)
    q = np.zeros((n, 9))
    # an edge along (a, b) has its normal along (-b, a)
    q[:, 2:4] = np.arctan2(to_px[:, 0], -to_px[:, 1])
    q[:, 4] = 1.0
    q[:, 5] = (weight * grey).sum(1) / np.maximum(weight.sum(1), 1)
    q[:, 8] = 0.1
    model, J = _evaluate_model(q, offset)
    q[:, 8] = 0.6 * np.where((weight * (grey - q[:, 5, None]) * J[..., 8]).sum(1) < 0, -1, 1)
    damping = np.full(n, 1e-3)
    model, J = _evaluate_model(q, offset)
    cost = (weight * (grey - model) ** 2).sum(1)
    for _ in range(ITERATIONS):
        J *= weight[..., None]
        A = J.transpose(0, 2, 1) @ J
        b = J.transpose(0, 2, 1) @ (grey - model)[..., None]
        diagonal = np.einsum("nii->ni", A)
        diagonal += damping[:, None] * diagonal + 1e-6
        trial = q + np.linalg.solve(A, b)[..., 0]
        trial[:, 4] = np.clip(trial[:, 4], 0.25, 8.0)
        trial_model, trial_J = _evaluate_model(trial, offset)
        trial_cost = (weight * (grey - trial_model) ** 2).sum(1)
        better = trial_cost < cost
        settled = (~better | (np.abs(trial - q)[:, :2].max(1) < CONVERGENCE_PX)).all()
        damping = np.where(better, damping * 0.1, np.minimum(damping * 10, 1e6))
        q[better], cost[better] = trial[better], trial_cost[better]
        model[better], J[better] = trial_model[better], trial_J[better]
        if settled:
            break
    misfit = np.sqrt(cost / np.maximum(weight.sum(1), 1))
    return q[:, :2], misfit / np.maximum(np.abs(q[:, 5] * q[:, 8]), 1e-6)


def _evaluate_model(q: Floats, offset: Floats) -> tuple[Floats, Floats]:
    """Return grey levels (n, m) and derivatives (n, m, 9) of corners ``q`` (n, 9) at offsets (n, m,
    2) px."""
    x, y = np.moveaxis(offset - q[:, None, :2], -1, 0)
    sigma = q[:, 4, None]
    light = q[:, 5, None] + q[:, 6, None] * offset[..., 0] + q[:, 7, None] * offset[..., 1]
    kappa = q[:, 8, None]
    # (2, n, m): of both edges
    angles = q[:, 2:4].T[..., None]
    normal_u, normal_v = np.cos(angles), np.sin(angles)
    distance = normal_u * x + normal_v * y
    edge = scipy.special.erf(distance / (np.sqrt(2) * sigma))
    slope = np.sqrt(2 / np.pi) / sigma * np.exp(-0.5 * (distance / sigma) ** 2)
    cross, ahead = edge[0] * edge[1], slope * edge[::-1]
    gain = light * kappa
    J = np.empty((*light.shape, 9))
    J[..., 0] = -gain * (ahead * normal_u).sum(0)
    J[..., 1] = -gain * (ahead * normal_v).sum(0)
    J[..., 2], J[..., 3] = gain * ahead * (normal_u * y - normal_v * x)
    J[..., 4] = -gain * (ahead * distance).sum(0) / sigma
    J[..., 5] = 1 + kappa * cross
    J[..., 6] = offset[..., 0] * J[..., 5]
    J[..., 7] = offset[..., 1] * J[..., 5]
    J[..., 8] = light * cross
    return light * J[..., 5], J
