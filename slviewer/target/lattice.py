"""Grouping of scattered blobs into lattices, from neighbour to neighbour, and matching of a board's
pattern to them.

A board is accepted only if all of its circles that can be seen match at exactly one position of the
lattice: a grid that could be shifted by a row is refused.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Protocol

import numpy as np
import scipy

from slviewer.errors import DetectionError
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import lengths, unit_vectors
from slviewer.target.blobs import Blobs
from slviewer.target.board import Board
from slviewer.target.planar import fit_grid_map, select_upright

CLUTTER_FREE_SHARE = 1 / 3
"""Share of the board's features in one lattice that clutter never reaches."""
PREDICTION_RADIUS = 0.27
"""Largest distance, in steps, of a neighbour from its predicted position."""
AREA_RATIO = 2.2
"""Largest ratio of the areas of neighbouring blobs."""
NODE_RADIUS = 0.15
"""Largest distance, in pitches, of a blob from the node predicted by the map of the whole
lattice."""
COMPLETIONS = 4
"""Largest number of rows added at each side of a grown lattice."""
MAX_SIDE_NODES = 200
"""Largest number of nodes along one side of a lattice."""
SEEDS = 60
"""Largest number of lattices grown in one attempt."""
NEIGHBOURS = 25
"""Number of nearest blobs among which neighbours of similar size are searched."""
SHEARS = np.array(
    [[[1, 0], [0, 1]], [[1, 0], [1, 1]], [[1, 1], [0, 1]], [[1, 0], [-1, 1]], [[1, -1], [0, 1]]]
)
"""Changes of basis, for a strong slant where a diagonal of the grid looks shorter than its
sides."""
LEAST_ENDS, LEAST_SHARE = 3, 0.6
"""Features beside which a board must end to show its border, and their share of those in view."""
MOST_PLACES = 6
"""Places of a board of which an image shows the same features: with more, hardly any of its border
is seen."""
MAX_SKEW = 0.6
"""Largest cosine of the angle between columns and rows in the image, where a board is tilted by 60
degrees."""
TURNS = np.array([[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]])
DIAGONAL = np.array([[1, 1], [-1, 1]])
"""From nearest neighbours of an asymmetric grid, which lie on its diagonals, to its columns and
rows."""


@dataclass(frozen=True)
class Lattice:
    """Blobs at the nodes of a lattice.

    ``nodes`` (m, 2) int: coordinates along two directions that are right-handed in the image (u
    right, v down); ``blobs`` (m,) int: index of the blob at each node.
    """

    nodes: np.ndarray
    blobs: np.ndarray

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def extent(self) -> tuple[int, int]:
        """Number of nodes along the longer and the shorter direction."""
        spans = self.nodes.max(0) - self.nodes.min(0) + 1
        return int(spans.max()), int(spans.min())


def grow_lattices(blobs: Blobs) -> Iterator[Lattice]:
    """Yield lattices of similar blobs, grown from the most regular neighbourhoods; each blob is in
    one at most."""
    if len(blobs.centres) < 6:
        return
    tree = scipy.spatial.cKDTree(blobs.centres)
    free = np.ones(len(blobs.centres), bool)
    seeds = (seed for seed in _list_seeds(tree, blobs) if free[seed[0]])
    for seed in islice(seeds, SEEDS):
        yield _grow(tree, blobs, free, *seed)


def complete_lattice(lattice: Lattice, blobs: Blobs) -> Lattice:
    """Add the blobs at nodes that the lattice's map predicts, and remove those that are not at a
    node.

    Growing from neighbour to neighbour ends at a gap and may follow clutter next to a grid; the map
    of all nodes does neither.
    """
    for _ in range(COMPLETIONS):
        try:
            grid_map = fit_grid_map(
                lattice.nodes.astype(float), blobs.centres[lattice.blobs], robust=True
            )
        except DetectionError:
            return lattice
        low, high = lattice.nodes.min(0) - 1, lattice.nodes.max(0) + 1
        if (high - low).max() > MAX_SIDE_NODES:
            return lattice
        nodes = grid_points(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True)))
        pitch = grid_map.pitch_px(nodes.astype(float))
        own_pitch = np.maximum(grid_map.pitch_px(lattice.nodes * 1.0), 1e-9)
        typical = np.median(np.sqrt(blobs.areas[lattice.blobs]) / own_pitch)
        apart, nearest = scipy.spatial.cKDTree(blobs.centres).query(
            grid_map.to_image(nodes.astype(float))
        )
        ratio = np.sqrt(blobs.areas[nearest]) / np.maximum(typical * pitch, 1e-9)
        is_alike = np.abs(np.log(np.maximum(ratio, 1e-9))) < np.log(AREA_RATIO) / 2
        on = (pitch > 0) & (apart < NODE_RADIUS * pitch) & is_alike
        _, first = np.unique(np.where(on, nearest, -1 - np.arange(len(nodes))), return_index=True)
        chosen = np.sort(first[on[first]])
        if len(chosen) < 6:
            return lattice
        same = len(chosen) == len(lattice.blobs) and set(nearest[chosen]) == set(lattice.blobs)
        lattice = Lattice(nodes[chosen], nearest[chosen])
        if same:
            break
    return lattice


def match_pattern(board: Board, lattice: Lattice) -> list[np.ndarray]:
    """Return every numbering of the board's features, (n,) indices of blobs each; empty if blobs
    are missing.

    Numberings of the same blobs are the board's rotational symmetries; different sets of blobs mean
    that the lattice is larger than the board.
    """
    pattern = np.rint(board.nodes).astype(int)
    for shear in SHEARS:
        numberings = []
        for change in _board_directions(board, shear):
            nodes = lattice.nodes @ change.T
            first = nodes.min(0)
            excess = nodes.max(0) - first - pattern.max(0)
            if (excess < 0).any():
                continue
            blobs = _arrange(lattice.blobs, nodes - first)
            for shift in np.ndindex(*(np.minimum(excess, 12) + 1)):
                chosen = blobs[tuple((pattern + shift).T)]
                if (chosen >= 0).all():
                    numberings.append(chosen)
        if numberings:
            return numberings
    return []


def _board_directions(board: Board, shear: np.ndarray) -> list[np.ndarray]:
    """Return the (2, 2) int from a sheared lattice's coordinates to a board's, in each turn."""
    to_board = DIAGONAL if board.kind == "acircles" else np.eye(2, dtype=int)
    return [turn @ to_board @ shear for turn in TURNS]


def _arrange(blobs: np.ndarray, nodes: np.ndarray, margin: np.ndarray | int = 0) -> np.ndarray:
    """Return the index of the blob at each node from (0, 0) on, -1 where there is none, with a
    ``margin`` behind the last."""
    arranged = np.full(nodes.max(0) + 1 + margin, -1)
    arranged[tuple(nodes.T)] = blobs
    return arranged


class Surroundings(Protocol):
    """What an image shows at the nodes (k, 2) of a lattice, which may be fractions."""

    def is_outside(self, nodes: Floats) -> Mask:
        """(k,) bool: whether a feature there is not wholly in the image."""

    def shows_end(self, nodes: Floats, nearest: np.ndarray) -> Mask:
        """(k,) bool: whether the board's pattern ends between the features ``nearest`` (k,), by
        their index in the lattice, and the nodes next to these."""


@dataclass(frozen=True)
class BoardPlace:
    """A place of a board of which a lattice shows a part.

    ``numberings``: those that the board's rotational symmetry leaves, (n,) indices of blobs, -1
    where hidden. ``open_axes`` of the board, 0 along its rows and 1 along its columns: along these
    no end of the board is seen.
    """

    numberings: list[np.ndarray]
    open_axes: tuple[int, ...]


@dataclass(frozen=True)
class BoardPart:
    """Features of a part of a board: their ``numbering`` (n,), -1 where hidden, and the ``others``
    that are as good."""

    numbering: np.ndarray
    others: list[np.ndarray]

    def list_features(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the numbers (k,) of the features that are seen, the blob (k,) of each, and what
        the others number these (n, k)."""
        ids = np.flatnonzero(self.numbering >= 0)
        order = self.numbering[ids]
        features = np.full((len(self.others), order.max() + 1), -1)
        for own, other in zip(features, self.others, strict=True):
            own[other[other >= 0]] = np.flatnonzero(other >= 0)
        return ids, order, features[:, order]


def match_part(
    board: Board,
    lattice: Lattice,
    steps: Floats,
    around: Surroundings,
    is_dark: np.ndarray | None = None,
) -> list[BoardPlace]:
    """Return every place of the board at which all of the lattice's blobs are its features, and
    that no end of the board between these and others of its features contradicts, unless these
    reach all four borders.

    ``steps`` (2, 2) px: in the image, along the lattice's first direction in the first column.
    ``is_dark`` (m,) bool, of a chessboard: the square towards the negative directions of a node.
    """
    pattern = np.rint(board.nodes).astype(int)
    reach = pattern.max(0)
    places: dict[bytes, BoardPlace] = {}
    for shear in SHEARS if is_dark is None else SHEARS[:1]:
        along, down = unit_vectors((steps @ np.linalg.inv(shear)).T)
        if abs(along @ down) > MAX_SKEW:
            continue
        for turn, change in enumerate(_board_directions(board, shear)):
            nodes, back = lattice.nodes @ change.T, np.linalg.inv(change).T
            first, last = nodes.max(0) - reach, nodes.min(0)
            if (first > last).any():
                continue
            blobs = _arrange(lattice.blobs, nodes - first, last + reach - nodes.max(0))
            for shift in np.ndindex(*(last - first + 1)):
                at = tuple((pattern + shift).T)
                chosen, origin = blobs[at], first + shift
                is_seen = chosen >= 0
                if np.count_nonzero(is_seen) < len(lattice):
                    continue
                if is_dark is not None and not _fits_colours(board, nodes - origin, is_dark, turn):
                    continue
                lacking = (pattern + origin)[~is_seen] @ back
                spans = _list_spans(pattern[is_seen], reach)
                if _ends_between(around, lacking, lattice.nodes, spans):
                    continue
                covered = np.rint((pattern + origin) @ back).astype(int)
                place = covered[np.lexsort(covered.T)].tobytes()
                sides = [(side + origin) @ back for side in neighbouring_rows(board)]
                ends = [_shows_end(around, side, lattice.nodes) for side in sides]
                is_open = [
                    not (ends[2 - 2 * axis] or ends[3 - 2 * axis]) and not spans[axis]
                    for axis in (0, 1)
                ]
                open_axes = tuple(np.flatnonzero(is_open).tolist())
                places.setdefault(place, BoardPlace([], open_axes)).numberings.append(chosen)
    return list(places.values())


def _fits_colours(board: Board, nodes: np.ndarray, is_dark: np.ndarray, turn: int) -> bool:
    """Return whether a chessboard's squares are dark where they are seen to be, at ``nodes`` (m, 2)
    of the board after so many quarter turns; always where prints of such a board differ."""
    columns, rows = board.features
    if (columns + rows) % 2 == 0 and not (columns == rows and columns % 2):
        return True
    agree = (nodes.sum(1) + turn) % 2 == ~is_dark
    return bool(2 * np.count_nonzero(agree) > len(agree))


def _list_spans(seen: np.ndarray, last: np.ndarray) -> list[bool]:
    """Return for each axis whether features ``seen`` (k, 2) reach from its first line to its
    ``last``."""
    return [
        all(np.count_nonzero(along == end) >= LEAST_ENDS for end in (0, most))
        for along, most in zip(seen.T, last.tolist(), strict=True)
    ]


def _list_ends(around: Surroundings, nodes: Floats, seen: np.ndarray) -> Mask:
    """Return whether the image shows that the board ends beside the ``seen`` nodes (m, 2), for each
    of the ``nodes`` (k, 2) that are next to one of these and in the image."""
    # a map that is extrapolated by more than a node decides nothing
    apart, nearest = scipy.spatial.cKDTree(seen).query(nodes)
    is_beside = (apart < 1.01) & ~around.is_outside(nodes)
    return around.shows_end(nodes[is_beside], nearest[is_beside])


def _ends_between(
    around: Surroundings, lacking: Floats, seen: np.ndarray, spans: Sequence[bool]
) -> bool:
    """Return whether the board ends between the ``seen`` features (m, 2) and ``lacking`` ones (k,
    2). Where it ``spans`` both axes, what looks like paper there covers it."""
    count = np.count_nonzero(_list_ends(around, lacking, seen))
    return not all(spans) and bool(count >= LEAST_ENDS)


def _shows_end(around: Surroundings, side: Floats, seen: np.ndarray) -> bool:
    """Return whether the image shows the board's border where one more row of features would be at
    ``side`` (k, 2)."""
    ends = _list_ends(around, side, seen)
    return bool(np.count_nonzero(ends) >= LEAST_ENDS and ends.mean() > LEAST_SHARE)


def _describe_open_ends(
    board: Board, pixels: Floats, places: list[BoardPlace], shape: tuple[int, ...]
) -> DetectionError:
    """Return the error of an image (h, w) that does not show which part of the board it is: how
    many of its features it shows, at ``pixels`` (m, 2), and which end is missing."""
    open_axes = {axis for place in places for axis in place.open_axes}
    which = " or ".join(("rows", "columns")[axis] for axis in sorted(open_axes)) or "rows"
    order = places[0].numberings[0]
    seen = order[order >= 0]
    is_chessboard = board.kind == "chessboard"
    facts = [
        f"{len(seen)} of {len(board.points)} {'corners' if is_chessboard else 'circles'} of {board}"
        " detected",
        *describe_sides(pixels[seen], shape),
        f"without an end of its {which} that shows which these are",
    ]
    return DetectionError(
        ", ".join(facts),
        f"bring an end of its {which}{'' if is_chessboard else ', or its mark,'} into view and into"
        " the light",
    )


def describe_sides(pixels: Floats, shape: tuple[int, ...]) -> list[str]:
    """Return up to which borders of an image (h, w) a part of a board reaches whose features are at
    ``pixels`` (m, 2), as one phrase or none."""
    spacing = np.median(scipy.spatial.cKDTree(pixels).query(pixels, k=2)[0][:, 1])
    (left, upper), (right, lower) = pixels.min(0), np.array(shape[::-1]) - 1 - pixels.max(0)
    gaps = {"left": left, "right": right, "upper": upper, "lower": lower}
    # a feature that the border cuts is not detected
    sides = [side for side, gap in gaps.items() if gap < 1.5 * spacing]
    return [f"up to the {' and the '.join(sides)} border of the image"] if sides else []


def select_part(
    board: Board,
    pixels: Floats,
    places: list[BoardPlace],
    shape: tuple[int, ...],
    mark: np.ndarray | None = None,
) -> BoardPart | None:
    """Select the numbering of a part of a board from its ``places``, with the others that are as
    good, by features at ``pixels`` (m, 2) of an image (h, w); ``mark``: that of its mark, if any.
    None where there is no place.

    Raises DetectionError where the image does not show which part it is.
    """
    if mark is not None:
        return BoardPart(mark, [])
    if not places:
        return None
    if len(places) > MOST_PLACES or all(place.open_axes for place in places):
        raise _describe_open_ends(board, pixels, places, shape)
    if len(places) == 1:
        return BoardPart(select_upright(board, pixels, places[0].numberings), [])
    every = [order for place in places for order in place.numberings]
    upright = [select_upright(board, pixels, place.numberings) for place in places]
    best = select_upright(board, pixels, upright)
    return BoardPart(best, [order for order in every if order is not best])


def neighbouring_rows(board: Board) -> list[Floats]:
    """Return the positions (k, 2), in pitches, of one more row or column of features at each of the
    four sides."""
    columns, rows = board.features
    across, down = np.arange(columns), np.arange(rows)
    sides = []
    for j, i in ((across, -1), (across, rows), (-1, down), (columns, down)):
        x = 2 * j + i % 2 if board.kind == "acircles" else j
        sides.append(np.stack(np.broadcast_arrays(x, i), axis=1).astype(float))
    return sides


def _list_seeds(tree: "scipy.spatial.cKDTree", blobs: Blobs) -> list[tuple[int, Floats, Floats]]:
    """Return (blob, step, step) of blobs with similar neighbours opposite each other in two
    directions, best first."""
    centres, areas = blobs.centres, blobs.areas
    _, near = tree.query(centres, k=min(NEIGHBOURS, len(centres)))
    near = near[:, 1:]
    alike = np.abs(np.log(areas[near] / areas[:, None])) < np.log(AREA_RATIO)
    # the nearest eight of its size, ignoring others between
    first = np.argsort(~alike, axis=1, kind="stable")[:, :8]
    near, alike = np.take_along_axis(near, first, axis=1), np.take_along_axis(alike, first, axis=1)
    step = centres[near] - centres[:, None]
    length = lengths(step)
    gap = lengths(step[:, :, None] + step[:, None])
    shorter = np.minimum(length[:, :, None], length[:, None])
    regular = np.where(alike[:, :, None] & alike[:, None], gap / np.maximum(shorter, 1e-9), np.inf)
    seeds = []
    for blob in np.nonzero((regular < 0.3).sum((1, 2)) >= 4)[0]:
        a, b = np.nonzero(np.triu(regular[blob] < 0.3))
        order = np.argsort(length[blob, a] + length[blob, b])
        a, b = a[order], b[order]
        axes = (step[blob, a] - step[blob, b]) / 2
        sides = lengths(axes)
        cross = axes[0, 0] * axes[:, 1] - axes[0, 1] * axes[:, 0]
        across = np.nonzero(np.abs(cross) > 0.35 * sides[0] * sides)[0]
        if len(across):
            k = across[0]
            score = regular[blob, a[0], b[0]] + regular[blob, a[k], b[k]]
            seeds.append((score, (int(blob), axes[0], axes[k] * np.sign(cross[k]))))
    return [seed for _, seed in sorted(seeds, key=lambda scored: scored[0])]


def _grow(
    tree: "scipy.spatial.cKDTree",
    blobs: Blobs,
    free: Mask,
    seed: int,
    first: Floats,
    second: Floats,
) -> Lattice:
    """Grow the lattice around a ``seed`` blob with steps ``first`` and ``second`` (2,) px along its
    two directions.

    Each node's four neighbours are searched among the ``free`` (n,) bool blobs where the known
    nodes predict them; those of the lattice are not free any more.
    """
    centres, areas = blobs.centres, blobs.areas
    at = {(0, 0): seed}
    steps = {(0, 0): (first, second)}
    free[seed] = False
    queue = [(0, 0)]
    for node in queue:
        i, j = node
        here = centres[at[node]]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            di, dj = (sign, 0) if axis == 0 else (0, sign)
            ahead = (i + di, j + dj)
            if ahead in at:
                continue
            step = sign * steps[node][axis]
            behind = at.get((i - di, j - dj))
            if behind is not None:
                step = here - centres[behind]
            else:
                for side in (1, -1):
                    lateral = at.get((i + side * dj, j + side * di))
                    diagonal = at.get((i + di + side * dj, j + dj + side * di))
                    if lateral is not None and diagonal is not None:
                        step = centres[diagonal] - centres[lateral]
            reach = PREDICTION_RADIUS * float(np.hypot(*step))
            near = tree.query(here + step, k=3, distance_upper_bound=reach)[1]
            near = near[near < len(areas)]
            ratios = areas[near] / areas[at[node]]
            near = near[free[near] & (ratios > 1 / AREA_RATIO) & (ratios < AREA_RATIO)]
            if not len(near):
                continue
            neighbour = at[ahead] = int(near[0])
            free[neighbour] = False
            measured = sign * (centres[neighbour] - here)
            steps[ahead] = (measured, steps[node][1]) if axis == 0 else (steps[node][0], measured)
            queue.append(ahead)
    return Lattice(np.array(list(at)), np.array(list(at.values())))
