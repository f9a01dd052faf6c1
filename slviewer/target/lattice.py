"""Grouping of scattered blobs into lattices, from neighbour to neighbour, and matching of a board's
pattern to them.

A board is accepted only if all of its circles match at exactly one position of the lattice: a grid
that could be shifted by a row is refused.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
import scipy

from slviewer.errors import DetectionError
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import lengths
from slviewer.target.blobs import Blobs
from slviewer.target.board import Board
from slviewer.target.planar import fit_grid_map

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
    spans = pattern.max(0) + 1
    to_board = DIAGONAL if board.kind == "acircles" else np.eye(2, dtype=int)
    for shear in SHEARS:
        numberings = []
        for turn in TURNS:
            nodes = lattice.nodes @ (turn @ to_board @ shear).T
            nodes = nodes - nodes.min(0)
            excess = nodes.max(0) + 1 - spans
            if (excess < 0).any():
                continue
            occupied = np.full(nodes.max(0) + 1, -1)
            occupied[nodes[:, 0], nodes[:, 1]] = lattice.blobs
            for dx, dy in np.ndindex(*(np.minimum(excess, 12) + 1)):
                chosen = occupied[pattern[:, 0] + dx, pattern[:, 1] + dy]
                if (chosen >= 0).all():
                    numberings.append(chosen)
        if numberings:
            return numberings
    return []


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
