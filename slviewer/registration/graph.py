"""Many scans as a graph: scans are nodes, registered pairs are edges, and loops say how well these fit together."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from slviewer.registration.refine import Uncertainty

_FLOOR_MM, _FLOOR_DEG = 0.003, 0.002
"""What calibrations and gates leave of an edge, however many points it has."""


@dataclass(frozen=True, eq=False)
class Edge:
    """``T`` (4, 4) maps scan ``scan`` into the frame of scan ``onto``; ``covariance`` (6, 6) of a small rotation (rad)
    about ``centre`` (3,) mm and a shift (mm) there, in that frame."""

    scan: int
    onto: int
    T: np.ndarray
    covariance: np.ndarray
    centre: np.ndarray

    @property
    def variance(self) -> float:
        """Of the shift at the centre, mm squared, with what the rotation adds at 100 mm."""
        total = np.trace(self.covariance[3:, 3:]) + 1e4 * np.trace(self.covariance[:3, :3])
        return float(total + _FLOOR_MM**2 + (100 * np.radians(_FLOOR_DEG)) ** 2)


@dataclass(frozen=True)
class LoopGap:
    """What is left where a loop should close: mm at the middle of the overlap, degrees, and expected mm."""

    shift_mm: float
    turn_deg: float
    expected_mm: float


def spanning_poses(
    nodes: int, edges: Sequence[Edge], root: int, costs: np.ndarray | None = None
) -> tuple[np.ndarray, list[int]]:
    """Each node's pose (nodes, 4, 4) in the root's frame along the surest edges, NaN where none leads; and for each
    node the index of the edge that leads to it, -1 for none. ``costs`` replace the edges' variances."""
    costs = np.array([edge.variance for edge in edges]) if costs is None else costs
    poses = np.full((nodes, 4, 4), np.nan)
    poses[root] = np.eye(4)
    by = [-1] * nodes
    if not edges:
        return poses, by
    best: dict[tuple[int, int], int] = {}
    for k, edge in enumerate(edges):
        key = min(edge.scan, edge.onto), max(edge.scan, edge.onto)
        if key not in best or costs[k] < costs[best[key]]:
            best[key] = k
    chosen = list(best.values())
    ends = np.array([(edges[k].scan, edges[k].onto) for k in chosen])
    graph = coo_matrix((costs[chosen], (ends[:, 0], ends[:, 1])), shape=(nodes, nodes)).tocsr()
    distance, before = dijkstra(graph, directed=False, indices=root, return_predecessors=True)
    for node in np.argsort(distance):
        if node == root or not np.isfinite(distance[node]):
            continue
        one, other = int(node), int(before[node])
        k = best[min(one, other), max(one, other)]
        step = edges[k].T if edges[k].scan == one else np.linalg.inv(edges[k].T)
        poses[one], by[one] = poses[other] @ step, k
    return poses, by


def loop_gap(edge: Edge, poses: np.ndarray, expected_mm: float = float("nan")) -> LoopGap:
    """How far an edge is from where the poses put its scan."""
    residual = residuals([edge], poses)[0]
    return LoopGap(float(np.linalg.norm(residual[3:])), float(np.degrees(np.linalg.norm(residual[:3]))), expected_mm)


def loop_of(edge: Edge, edges: Sequence[Edge], by: Sequence[int]) -> list[int]:
    """The nodes round the loop that an edge closes over the tree, its own ends first and last."""

    def to_root(node: int) -> list[int]:
        way = [node]
        while by[way[-1]] >= 0:
            step = edges[by[way[-1]]]
            way.append(step.onto if step.scan == way[-1] else step.scan)
        return way

    one, other = to_root(edge.scan), to_root(edge.onto)
    while len(one) > 1 and len(other) > 1 and one[-2] == other[-2]:
        one.pop(), other.pop()
    return one + other[-2::-1]


def expected_mm(edge: Edge, edges: Sequence[Edge], by: Sequence[int]) -> float:
    """Expected gap of the loop that an edge closes, mm, from the variances round it."""
    loop = loop_of(edge, edges, by)
    pairs = {frozenset(pair) for pair in pairwise(loop)}
    steps = [edges[k].variance for k in by if k >= 0 and frozenset((edges[k].scan, edges[k].onto)) in pairs]
    return float(np.sqrt(sum(steps) + edge.variance))


_LEVER_MM = 100.0
"""Unknown turns are counted in mm at so many mm, so that all unknowns are alike."""


def optimise_poses(poses: np.ndarray, edges: Sequence[Edge], root: int) -> np.ndarray:
    """The poses (n, 4, 4) in the root's frame that all edges together make most likely, from poses near by."""
    moved, cost, _ = _problem(poses, edges, root)
    return moved(least_squares(cost, np.zeros(6 * (len(poses) - 1)), x_scale="jac").x)


def pose_uncertainties(poses: np.ndarray, edges: Sequence[Edge], root: int) -> list[Uncertainty]:
    """How sure each pose (n, 4, 4) in the root's frame is by all edges together, at the middle of what they share: the
    farther from the root, the less. The root's own is 0."""
    _, cost, middle = _problem(poses, edges, root)
    steps = np.eye(6 * (len(poses) - 1)) * 1e-3
    J = np.stack([(cost(step) - cost(-step)) / 2e-3 for step in steps], axis=1)
    unit = np.repeat([1 / _LEVER_MM, 1.0], 3)
    covariance = np.linalg.inv(J.T @ J)
    blocks = [covariance[k : k + 6, k : k + 6] * np.outer(unit, unit) for k in range(0, len(steps), 6)]
    blocks.insert(root, np.zeros((6, 6)))
    return [Uncertainty(block, middle) for block in blocks]


def _problem(
    poses: np.ndarray, edges: Sequence[Edge], root: int
) -> tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """Of the unknowns x (6 (n - 1),), a turn and a shift about a middle (3,) for every pose but the root's: the poses
    moved so, the edges' residuals then, in standard deviations; and the middle."""
    free = [node for node in range(len(poses)) if node != root]
    roots = []
    for edge in edges:
        whole = edge.covariance + np.diag([np.radians(_FLOOR_DEG) ** 2] * 3 + [_FLOOR_MM**2] * 3)
        roots.append(np.linalg.inv(np.linalg.cholesky(whole)))
    middle = np.mean([(poses[edge.onto] @ np.append(edge.centre, 1.0))[:3] for edge in edges], axis=0)

    def moved(x: np.ndarray) -> np.ndarray:
        turn, shift = x.reshape(-1, 2, 3).transpose(1, 0, 2)
        M = np.tile(np.eye(4), (len(free), 1, 1))
        M[:, :3, :3] = Rotation.from_rotvec(turn / _LEVER_MM).as_matrix()
        M[:, :3, 3] = shift + middle - M[:, :3, :3] @ middle
        out = poses.copy()
        out[free] = M @ poses[free]
        return out

    whiten = np.array(roots)

    def cost(x: np.ndarray) -> np.ndarray:
        return np.asarray(np.einsum("kij,kj->ki", whiten, residuals(edges, moved(x))).ravel())

    return moved, cost, middle


def residuals(edges: Sequence[Edge], poses: np.ndarray) -> np.ndarray:
    """(n, 6): rotation (rad) and shift (mm) at the centre from each edge to where the poses put its scan."""
    scans, ontos = [edge.scan for edge in edges], [edge.onto for edge in edges]
    there = np.linalg.inv(poses[ontos]) @ poses[scans]
    D = there @ np.linalg.inv(np.array([edge.T for edge in edges]))
    centres = np.array([edge.centre for edge in edges])
    shift = np.einsum("kij,kj->ki", D[:, :3, :3], centres) + D[:, :3, 3] - centres
    return np.hstack([Rotation.from_matrix(D[:, :3, :3]).as_rotvec(), shift])
