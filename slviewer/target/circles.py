"""Detect a grid of circles, dark on bright or bright on dark, in a cluttered image, and refine
their centres: centroids of their ink, relative to the brightness of the paper around them."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Self

import cv2
import numpy as np

from slviewer.errors import BoardError, DetectionError
from slviewer.geometry.jit import kernel, read_only, run_rows
from slviewer.geometry.rigid import Floats, Floats32, Mask
from slviewer.geometry.robust import select
from slviewer.geometry.vectors import finite_rows, lengths
from slviewer.target.blobs import Blobs, detect_blobs
from slviewer.target.board import Board, Detection
from slviewer.target.images import MIRRORED, SEARCH_PX, BoardImage, light_advice, resize_image
from slviewer.target.lattice import (
    AREA_RATIO,
    CLUTTER_FREE_SHARE,
    NODE_RADIUS,
    BoardPart,
    Lattice,
    complete_lattice,
    describe_sides,
    grow_lattices,
    match_part,
    match_pattern,
    neighbouring_rows,
    select_part,
)
from slviewer.target.mark import is_mark_mirrored, select_numbering_by_mark
from slviewer.target.planar import (
    MAX_GRID_OFFSET,
    MAX_GRID_OFFSET_SIGMAS,
    GridMap,
    check_grid,
    fit_grid_map,
    fit_homography,
    is_on_grid,
    jacobians,
    select_upright,
)

SQUARE_LIMIT_ROUNDNESS = 0.97
"""Limit between the roundness of squares, 0.955, and of well-resolved circles, 0.985 and more on
real photographs."""
WHOLE_CIRCLE_ROUNDNESS = 0.96
"""Roundness below which a circle is partly covered."""
MIN_SHAPE_AREA_PX = 60.0
"""Smallest area of a circle whose roundness can be judged."""
RESOLVED_AREA_PX = 80.0
"""Area of a circle beyond which more pixels do not improve detection."""
CONTINUATION_SHARE = 1 / 3
"""Share of a further row or column of circles above which the board is larger than stated."""
DOMINANT_AREA_RATIO = 2.0
"""Smallest ratio of the areas of two boards of the same kind at which the larger one is
selected."""
EDGE_WIDTH_PX = 2.5
"""Distance in px by which the camera's PSF blurs a circle's edge outwards."""
RING_PX = 5.0
"""Width of the ring beyond the soft edge from which the paper's brightness is read."""
CORE_RADIUS = 0.6
"""Share of a circle's radius that its blurred edge does not reach."""
INITIAL_GATE = 0.35
"""Largest variation of the background around a circle, over its contrast: light that halves across
one circle."""
GATE_SIGMAS = 4.0
FLATNESS = 0.04
"""Pixels of the ring are background within so many standard deviations of its plane, or this share
of the contrast."""
SAME_PAPER = 0.78
"""Least brightness of paper over that beside it, and its inverse the largest."""
NEAR_EDGE = (0.15, 0.3, 0.5)
"""Where beside a board's border there is paper, from the next row of circles on, in steps."""
MIN_RING_PIXELS = 8
"""Smallest number of pixels for a plane fit."""


@dataclass(frozen=True)
class _Binarisation:
    """The blobs of one binarisation, in pixels of the full image, and the lattices among them."""

    blobs: Blobs
    lattices: list[Lattice]

    @property
    def largest(self) -> Lattice:
        """The lattice of most nodes; an empty one if there is none."""
        empty = Lattice(np.empty((0, 2), int), np.empty(0, int))
        return max(self.lattices, key=len, default=empty)


@dataclass(frozen=True)
class _Grid:
    """A detected board: its blobs and the equally valid ``numberings``, (n,) indices into them, -1
    where a circle is hidden; ``others``: those of other places of the board, of which the image
    shows the same circles."""

    blobs: Blobs
    numberings: list[np.ndarray]
    others: list[np.ndarray] = field(default_factory=list)

    @property
    def centres(self) -> Floats:
        """(m, 2) px: centres of the circles that are seen."""
        order = self.numberings[0]
        return self.blobs.centres[order[order >= 0]]

    @property
    def area_px(self) -> float:
        """Area of the grid's convex hull in the image."""
        return cv2.contourArea(cv2.convexHull(self.centres.astype(np.float32)))


def detect_circles(board: Board, image: BoardImage) -> Detection:
    """Detect every circle of a board that is not beyond the image's border or the light.

    Raises DetectionError, whose message gives the number of circles detected.
    """
    tried: list[_Binarisation] = []
    for attempt in _binarise_all(board, image.grey):
        tried.append(attempt)
        grids = [
            grid
            for lattice in attempt.lattices
            if (grid := _match_board(board, lattice, attempt.blobs, image))
        ]
        if grids:
            return _measure(board, image, _select_board(board, grids))
    most = max(tried, key=lambda attempt: len(attempt.largest), default=None)
    if most is not None and len(most.largest) > CLUTTER_FREE_SHARE * len(board.points):
        # what one binarisation lacks, another may have: reflections and shadows cover parts of the
        # board
        inverted = most.blobs.inverted
        pool = _pool_blobs(
            most.blobs, [attempt.blobs for attempt in tried if attempt.blobs.inverted == inverted]
        )
        lattice = complete_lattice(most.largest, pool)
        grid = _match_board(board, lattice, pool, image) or _match_part(board, lattice, pool, image)
        if grid:
            return _measure(board, image, grid)
    raise _describe_failure(board, image, most)


def list_grids(image: BoardImage) -> Iterator[tuple[int, int]]:
    """Yield columns and rows, the longer first, of the whole rectangular grids of circles that an
    image shows."""
    smallest = Board("circles", 7, 6, 1.0)
    for attempt in _binarise_all(smallest, image.grey):
        for lattice in attempt.lattices:
            columns, rows = lattice.extent
            if rows >= 3 and len(lattice) == columns * rows:
                yield columns, rows


def _binarise_all(board: Board, grey: np.ndarray) -> Iterator[_Binarisation]:
    """Yield binarisations at the search resolution, at half of it, at the full and at twice the
    full resolution.

    Once a third of the board is detected, the circles' polarity is fixed, and resolutions that
    cannot improve the detection are skipped.
    """
    first = min(1.0, SEARCH_PX / max(grey.shape))
    colours = [False, True]
    resolved = False
    for factor in dict.fromkeys((first, first / 2, 1.0, 2.0)):
        if (resolved and factor > first) or (len(colours) > 1 and factor > 1):
            return
        small = resize_image(grey, factor)
        scale = np.array(grey.shape[::-1]) / np.array(small.shape[::-1])
        pitch = max(small.shape) / (min(board.columns, board.rows) - 1)
        for inverted in colours:
            for blobs in detect_blobs(small, pitch, inverted):
                lattices = list(grow_lattices(blobs))
                for lattice in lattices:
                    if len(lattice) > CLUTTER_FREE_SHARE * len(board.points):
                        colours = [inverted]
                        resolved |= float(np.median(blobs.areas[lattice.blobs])) > RESOLVED_AREA_PX
                yield _Binarisation(blobs.rescale(scale), lattices)
            if colours == [inverted]:
                break


def _match_board(board: Board, lattice: Lattice, blobs: Blobs, image: BoardImage) -> _Grid | None:
    """Match a lattice with the board; None unless all circles are there.

    Raises DetectionError where the grid of circles is larger than the board.
    """
    if len(lattice) <= CLUTTER_FREE_SHARE * len(board.points):
        return None
    for candidate in (lattice, complete_lattice(lattice, blobs)):
        places: dict[bytes, list[np.ndarray]] = {}
        for numbering in match_pattern(board, candidate):
            places.setdefault(np.sort(numbering).tobytes(), []).append(numbering)
        fitting = [
            (numberings, grid_map)
            for numberings in places.values()
            if (grid_map := _fit_map(board, blobs.select(numberings[0]))) is not None
        ]
        if fitting:
            numberings, grid_map = fitting[0]
            if len(fitting) > 1 or _grid_continues(board, grid_map, blobs, numberings[0]):
                raise DetectionError(
                    f"{len(candidate)} circles in one grid detected where {board} has"
                    f" {len(board.points)}",
                    "check the board's columns and rows",
                )
            return _Grid(blobs, numberings)
    return None


def _match_part(board: Board, lattice: Lattice, blobs: Blobs, image: BoardImage) -> _Grid | None:
    """Match a lattice with a board of which the rest is beyond the image's border, or without
    light; None unless its borders or its mark tell which circles these are, or leave few places."""
    if blobs.inverted or len(lattice) <= CLUTTER_FREE_SHARE * len(board.points):
        return None
    try:
        whole, grid_map = _select_whole(lattice, blobs, image)
    except DetectionError:
        return None
    if len(whole) <= CLUTTER_FREE_SHARE * len(board.points):
        return None
    steps = jacobians(grid_map.H, whole.nodes.mean(0, keepdims=True))[0]
    around = _Surroundings.of(image.grey, grid_map, whole, blobs)
    places = match_part(board, whole, steps, around)
    every = [order for place in places for order in place.numberings]
    marked = select_numbering_by_mark(board, image.deep, blobs.centres, every) if every else None
    part = select_part(board, blobs.centres, places, image.grey.shape, marked)
    return _Grid(blobs, [part.numbering], part.others) if part else None


def _select_whole(lattice: Lattice, blobs: Blobs, image: BoardImage) -> tuple[Lattice, GridMap]:
    """Return the part of a lattice whose circles are, with their blurred edges, inside an image and
    uncovered, and its map. Raises DetectionError where they do not determine one."""
    seen = blobs.select(lattice.blobs)
    reach = 2 * np.sqrt(np.diagonal(seen.covariances, axis1=1, axis2=2))
    is_whole = _is_inside(seen.centres, reach + 2 * EDGE_WIDTH_PX, image.grey.shape)
    is_whole &= (seen.areas <= MIN_SHAPE_AREA_PX) | (seen.roundness >= WHOLE_CIRCLE_ROUNDNESS)
    pixels = refine_centres(image.deep, seen)
    is_whole &= finite_rows(pixels)
    for _ in range(2):
        nodes = lattice.nodes[is_whole].astype(float)
        grid_map = fit_grid_map(nodes, pixels[is_whole], robust=True)
        is_whole[is_whole] = is_on_grid(grid_map, grid_map.pitch_px(nodes))
    return Lattice(lattice.nodes[is_whole], lattice.blobs[is_whole]), grid_map


def _is_inside(pixels: Floats, reach: Floats | float, shape: tuple[int, ...]) -> Mask:
    """Return whether pixels (n, 2) are inside an image (h, w) by a ``reach`` px, for all or for
    each, along u and v."""
    last = np.array(shape[::-1]) - 1 - reach
    return np.asarray(((pixels >= reach) & (pixels <= last)).all(axis=1))


@dataclass(frozen=True, eq=False)
class _Surroundings:
    """What an image ``grey`` (h, w) uint8 shows at the nodes of a lattice, by the lattice's map.

    ``radius``: of the circles, in pitches; ``seen`` (m, 2): the lattice's nodes, and ``paper``
    (m,): grey level of the paper around their circles.
    """

    grey: np.ndarray
    grid_map: GridMap
    radius: float
    seen: Floats
    paper: Floats

    @classmethod
    def of(cls, grey: np.ndarray, grid_map: GridMap, lattice: Lattice, blobs: Blobs) -> Self:
        """Return the surroundings of a lattice."""
        pitch = grid_map.pitch_px(lattice.nodes.astype(float))
        radius = float(np.median(np.sqrt(blobs.areas[lattice.blobs] / np.pi) / pitch))
        smooth = cv2.medianBlur(grey, 3)
        across = 2 * int(radius * np.median(pitch) + EDGE_WIDTH_PX) + 1
        u, v = np.rint(blobs.centres[lattice.blobs]).astype(int).T
        brightest = cv2.dilate(smooth, np.ones((across, across), np.uint8))[v, u]
        return cls(smooth, grid_map, radius, lattice.nodes.astype(float), brightest.astype(float))

    def is_outside(self, nodes: Floats) -> Mask:
        """See ``lattice.Surroundings``."""
        places, pitch = self.grid_map.extrapolate(nodes), self.grid_map.pitch_px(nodes)
        reach = (self.radius + NODE_RADIUS) * pitch + 2 * EDGE_WIDTH_PX
        return ~(_is_inside(places, reach[:, None], self.grey.shape) & (pitch > 0))

    def shows_end(self, nodes: Floats, nearest: np.ndarray) -> Mask:
        """See ``lattice.Surroundings``."""
        paper, seen = self.paper[nearest], self.seen[nearest]
        levels = [self._level(nodes + share * (seen - nodes)) / paper for share in NEAR_EDGE]
        return np.all([(each > SAME_PAPER) & (each < 1 / SAME_PAPER) for each in levels], axis=0)

    def _level(self, nodes: Floats) -> Floats:
        """Return the grey levels (k,) at nodes (k, 2); NaN outside the image."""
        places = self.grid_map.extrapolate(nodes)
        inside = _is_inside(places, 0.0, self.grey.shape)
        u, v = np.rint(np.where(inside[:, None], places, 0.0)).astype(int).T
        return np.where(inside, self.grey[v, u], np.nan)


def _fit_map(board: Board, blobs: Blobs) -> GridMap | None:
    """Fit the map from board to image; None unless the blobs, in the board's order, form a grid of
    equal circles."""
    points = board.nodes
    try:
        grid_map = fit_grid_map(points, blobs.centres, robust=True)
    except DetectionError:
        return None
    pitch = grid_map.pitch_px(points)
    size = np.sqrt(blobs.areas) / np.maximum(pitch, 1e-9)
    alike = np.abs(np.log(size / np.median(size))) < np.log(AREA_RATIO) / 2
    is_grid = (alike & (lengths(grid_map.residuals) < NODE_RADIUS * pitch)).all()
    return grid_map if is_grid else None


def _grid_continues(board: Board, grid_map: GridMap, blobs: Blobs, numbering: np.ndarray) -> bool:
    """Return whether circles of the grid's size continue it by one more row or column.

    A blob counts only if it is as close to its extrapolated position as the grid's own circles are;
    most clutter next to a board is not.
    """
    points = board.nodes
    pitch = np.maximum(grid_map.pitch_px(points), 1e-9)
    size = np.median(np.sqrt(blobs.areas[numbering]) / pitch)
    others = blobs.select(np.delete(np.arange(len(blobs.centres)), numbering))
    if not len(others.centres):
        return False
    for side in neighbouring_rows(board):
        pitch = grid_map.pitch_px(side)
        apart = lengths(grid_map.to_image(side)[:, None] - others.centres)
        gate = np.maximum(MAX_GRID_OFFSET * pitch, 2 * MAX_GRID_OFFSET_SIGMAS * grid_map.sigma_px)
        ratio = np.sqrt(others.areas[apart.argmin(1)]) / np.maximum(size * pitch, 1e-9)
        is_alike = np.abs(np.log(np.maximum(ratio, 1e-9))) < np.log(1.25)
        on = (pitch > 0) & (apart.min(1) < gate) & is_alike
        if np.count_nonzero(on) >= max(2.0, CONTINUATION_SHARE * len(side)):
            return True
    return False


def _select_board(board: Board, grids: list[_Grid]) -> _Grid:
    """Select the grid with the largest area in the image; raises DetectionError where two are of
    similar area."""
    grids = sorted(grids, key=lambda grid: -grid.area_px)
    if len(grids) > 1 and grids[0].area_px < DOMINANT_AREA_RATIO * grids[1].area_px:
        (a, b), (c, d) = (grid.centres.mean(0) for grid in grids[:2])
        raise DetectionError(
            f"{len(grids)} boards {board} detected, around pixels {a:.0f}, {b:.0f} and {c:.0f},"
            f" {d:.0f}",
            "take one out of view; a mirror image counts as well",
        )
    return grids[0]


def _measure(board: Board, image: BoardImage, grid: _Grid) -> Detection:
    """Number the grid and refine its centres.

    Raises DetectionError where blobs are squares or partly covered circles, and where a centre
    cannot be measured or fits no grid.
    """
    marked = select_numbering_by_mark(board, image.deep, grid.blobs.centres, grid.numberings)
    if marked is None and is_mark_mirrored(board, image.deep, grid.blobs.centres, grid.numberings):
        raise BoardError(*MIRRORED, cause="axis-reversed")
    order = select_upright(board, grid.blobs.centres, grid.numberings) if marked is None else marked
    ids, seen, others = BoardPart(order, grid.others).list_features()
    blobs = grid.blobs.select(seen)
    large = blobs.areas > MIN_SHAPE_AREA_PX
    if large.all() and np.median(blobs.roundness) < SQUARE_LIMIT_ROUNDNESS:
        raise DetectionError(
            f"a grid of squares, or of blurred or small circles, detected where {board} has"
            " circles",
            "check the board's kind, focus the camera, and move the board closer",
        )
    covered = np.count_nonzero(large & (blobs.roundness < WHOLE_CIRCLE_ROUNDNESS))
    if covered:
        raise DetectionError(
            f"{covered} of {len(blobs.areas)} circles are partly covered, or reflect",
            "uncover the board, and turn it away from the lights",
        )
    pixels = refine_centres(image.deep, blobs)
    unmeasured = np.count_nonzero(~finite_rows(pixels))
    if unmeasured:
        raise DetectionError(
            f"{unmeasured} of {len(pixels)} circles are too close to their neighbours or too faint"
            " to measure",
            "move the board closer, or focus the camera",
        )
    check_grid(board, pixels, ids, "circles")
    points = board.points[ids, :2]
    scale = np.linalg.det(jacobians(fit_homography(points, blobs.centres), points))
    radius_mm = float(np.sqrt(np.median(blobs.areas / scale) / np.pi))
    return Detection(pixels, ids, radius_mm, marked is not None, others)


def _pool_blobs(first: Blobs, others: list[Blobs]) -> Blobs:
    """Merge the blobs of several binarisations; of duplicates the one from the earlier binarisation
    remains."""
    pool = first
    for blobs in others:
        apart = lengths(blobs.centres[:, None] - pool.centres).min(1)
        new = blobs.select(apart > 0.5 * np.sqrt(blobs.areas))
        pool = Blobs(
            np.concatenate([pool.centres, new.centres]),
            np.concatenate([pool.areas, new.areas]),
            np.concatenate([pool.covariances, new.covariances]),
            pool.inverted,
        )
    return pool


def _describe_failure(
    board: Board, image: BoardImage, most: _Binarisation | None
) -> DetectionError:
    """Return the error: number of detected circles, other blobs, and what to do."""
    total, detected = len(board.points), len(most.largest) if most else 0
    if most is None or detected < 6:
        return DetectionError(
            f"no grid of circles detected where {board} has {total}", light_advice(image.grey)
        )
    longer, shorter = most.largest.extent
    others = len(most.blobs.centres) - detected
    if detected >= total:
        return DetectionError(
            f"{detected} circles detected in a grid of {longer}x{shorter} that does not hold all of"
            f" {board}",
            "check the board's columns and rows, and that nothing covers it",
        )
    facts = [f"{detected} of {total} circles of {board} detected"]
    if others:
        facts.append(f"among {others} other round blobs")
    facts += describe_sides(most.blobs.centres[most.largest.blobs], image.grey.shape)
    return DetectionError(", ".join(facts), light_advice(image.grey))


def refine_centres(image: Floats32, blobs: Blobs) -> Floats:
    """Return the centroids (n, 2) float64 px of the circles' ink, relative to the brightness around
    each circle.

    ``image`` (h, w) float32; ``blobs`` describe the circles' ellipses to some tenths of a pixel.
    Ink is ``1 - I / W`` with W the plane through the paper's brightness next to the circle, so that
    uneven light does not move the centroid; for bright circles, ink is the excess over the
    background, divided by the plane of their own brightness. NaN where too little paper is visible
    around a circle, or where the result is too far from the initial centre.
    """
    centres, covariances = blobs.centres, blobs.covariances
    refined = np.full(centres.shape, np.nan)
    arrays = [
        read_only(np.ascontiguousarray(each, np.float64))
        for each in (centres, covariances, _ring_widths(centres, covariances))
    ]
    image = read_only(np.ascontiguousarray(image))
    run_rows(_measure_centroids, len(centres), image, *arrays, blobs.inverted, refined)
    off = lengths(refined - centres)
    refined[~(off < np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1]))] = np.nan
    return refined


def _ring_widths(centres: Floats, covariances: Floats) -> Floats:
    """Return the width (n,) px of the paper between each circle's edge and its nearest
    neighbour's."""
    apart = lengths(centres[:, None] - centres)
    np.fill_diagonal(apart, np.inf)
    nearest = apart.argmin(1)
    towards = (centres[nearest] - centres) / apart.min(1)[:, None]
    # half the width of an ellipse along a direction e: 2 sqrt(e C e), C being a quarter of the
    # squared half axes
    own, other = (
        2 * np.sqrt(np.einsum("ni,nij,nj->n", towards, c, towards))
        for c in (covariances, covariances[nearest])
    )
    return apart.min(1) - own - other


@kernel()
def _measure_centroids(first, last, image, centres, covariances, gaps, inverted, out):
    """Fill ``out`` (n, 2) with the centroids px of circles ``first`` to ``last``; others stay as
    they are.

    ``gaps`` (n,): width px of the paper around each circle. Loops over pixels, as whole-array
    expressions take four times as long to compile.
    """
    height, width = image.shape
    for k in range(first, last):
        u, v = centres[k, 0], centres[k, 1]
        xx, xy, yy = covariances[k, 0, 0], covariances[k, 0, 1], covariances[k, 1, 1]
        soft = min(EDGE_WIDTH_PX, 0.3 * gaps[k])
        end = min(EDGE_WIDTH_PX + RING_PX, gaps[k] - soft)
        far_u, far_v = 2 * np.sqrt(xx) + end + 1, 2 * np.sqrt(yy) + end + 1
        determinant = xx * yy - xy * xy
        if not (np.isfinite(u + v + far_u + far_v) and determinant > 0.0):
            continue
        u0, v0 = max(int(np.floor(u - far_u)), 0), max(int(np.floor(v - far_v)), 0)
        u1, v1 = min(int(np.ceil(u + far_u)) + 1, width), min(int(np.ceil(v + far_v)) + 1, height)
        size = max(u1 - u0, 0) * max(v1 - v0, 0)
        place, level = np.empty((2, size)), np.empty(size)
        within, ring = np.zeros(size, np.bool_), np.zeros(size, np.bool_)
        core = np.zeros(size, np.bool_)
        i, in_ring, in_core = 0, 0, 0
        for row in range(v0, v1):
            for column in range(u0, u1):
                du, dv = column - u, row - v
                square = (yy * du * du - 2 * xy * du * dv + xx * dv * dv) / (4 * determinant)
                radius = np.sqrt(max(square, 0.0))  # 1 on the edge
                # px from the edge, outwards
                beyond = np.sqrt(du * du + dv * dv) * (1 - 1 / max(radius, 1e-6))
                place[0, i], place[1, i], level[i] = du, dv, image[row, column]
                within[i], ring[i] = beyond < soft, soft < beyond < end
                core[i] = radius < CORE_RADIUS
                in_ring += ring[i]
                in_core += core[i]
                i += 1
        if in_ring < MIN_RING_PIXELS or in_core == 0:
            continue
        ground = _fit_paper_level(place, level, ring, _quantile(level, core, 0.5))
        light = _fit_plane(place, level, core) if inverted else ground
        total, along_u, along_v = 0.0, 0.0, 0.0
        for i in range(size):
            if within[i]:
                own = max(_plane_at(light, place, i), 1.0)
                paper = _plane_at(ground, place, i)
                ink = (level[i] - paper) / own if inverted else 1 - level[i] / own
                total += ink
                along_u += ink * place[0, i]
                along_v += ink * place[1, i]
        if total > 0.0:
            out[k, 0], out[k, 1] = u + along_u / total, v + along_v / total


@kernel()
def _fit_paper_level(place, level, ring, ink):
    """Fit a plane to the brightness ``level`` (n,) of the ``ring`` (n,) around a circle, without
    edges or other blobs.

    Where the ring does not fit one plane, the fit starts with the quarter that differs most from
    the circle's own level ``ink`` and continues with the pixels within the noise of the plane.
    ``place`` (2, n) px from the circle's centre.
    """
    share = 0.75 if ink < _quantile(level, ring, 0.5) else 0.25
    ground = _quantile(level, ring, share)
    contrast = abs(ground - ink)
    plane = _fit_plane(place, level, ring)
    off, near = np.empty_like(level), np.empty_like(ring)
    if _measure_off(plane, place, level, ring, off) < FLATNESS * contrast:
        return plane
    for i in range(len(level)):
        off[i] = abs(level[i] - ground)
    gate = INITIAL_GATE * contrast
    for _ in range(3):
        count = 0
        for i in range(len(level)):
            near[i] = ring[i] and off[i] < gate
            count += near[i]
        if count < MIN_RING_PIXELS:
            break
        plane = _fit_plane(place, level, near)
        _measure_off(plane, place, level, ring, off)
        gate = max(GATE_SIGMAS * 1.4826 * _quantile(off, near, 0.5), FLATNESS * contrast)
    return plane


@kernel()
def _measure_off(plane, place, level, ring, off):
    """Fill ``off`` (n,) with how far the ``level`` (n,) is from a plane; return the largest in the
    ``ring`` (n,)."""
    worst = 0.0
    for i in range(len(level)):
        off[i] = abs(level[i] - _plane_at(plane, place, i))
        if ring[i]:
            worst = max(worst, off[i])
    return worst


@kernel()
def _quantile(values, where, share):
    """Return a quantile of the ``values`` (n,) at the places ``where`` (n,), without
    interpolation."""
    chosen, count = np.empty_like(values), 0
    for i in range(len(values)):
        if where[i]:
            chosen[count] = values[i]
            count += 1
    return select(chosen, count, int(share * (count - 1)))


@kernel()
def _fit_plane(place, level, where):
    """Return the plane (mean level, slope along u, along v, mean u, mean v) of least squares
    through pixels ``where``.

    Its slopes are 0 where the pixels are on one line.
    """
    count, mean_u, mean_v, mean = 0, 0.0, 0.0, 0.0
    for i in range(len(level)):
        if where[i]:
            count += 1
            mean_u += place[0, i]
            mean_v += place[1, i]
            mean += level[i]
    mean_u, mean_v, mean = mean_u / count, mean_v / count, mean / count
    uu, uv, vv, ul, vl = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(level)):
        if where[i]:
            du, dv, dl = place[0, i] - mean_u, place[1, i] - mean_v, level[i] - mean
            uu += du * du
            uv += du * dv
            vv += dv * dv
            ul += du * dl
            vl += dv * dl
    determinant = uu * vv - uv * uv
    if not determinant > 1e-9 * uu * vv:
        return mean, 0.0, 0.0, mean_u, mean_v
    along_u, along_v = (vv * ul - uv * vl) / determinant, (uu * vl - uv * ul) / determinant
    return mean, along_u, along_v, mean_u, mean_v


@kernel()
def _plane_at(plane, place, i):
    """Return the level of a plane at pixel ``i`` of ``place`` (2, n)."""
    return plane[0] + plane[1] * (place[0, i] - plane[3]) + plane[2] * (place[1, i] - plane[4])
