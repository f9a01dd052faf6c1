"""Pose graph: scans are nodes, registered pairs are edges; initial poses, loop gaps, selection of
the edges that agree with one another, and optimisation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from slviewer.geometry.rigid import Floats, Uncertainty, move_points, rigid_transform
from slviewer.registration.refusal import Refused

_FLOOR, _FLOOR_DEG = 3e-5, 0.002
"""Least standard deviation of an edge, over the scans' size, however many points it has."""
_LEVER = 1.0
"""Over the scans' size: converts angles to mm, so that all unknowns are of one scale."""
_TREES = 200
_RIM = 1 / 2
_GAP_SIGMAS = 8.0
_GAP_GATES = 0.5
"""A loop is inconsistent where its gap exceeds both 8 times the expected gap and half the
registration's gate."""


@dataclass(frozen=True, eq=False)
class Edge:
    """A registered pair: ``T`` (4, 4) mm maps points of node ``scan`` into the frame of node
    ``onto``.

    ``covariance`` (6, 6): of a small rotation (rad) about ``centre`` (3,) mm and a translation
    (mm), in that frame. ``size_mm``: of the scans. ``gate_mm``: of the registration.
    """

    scan: int
    onto: int
    T: Floats
    covariance: Floats
    centre: Floats
    size_mm: float
    gate_mm: float = 0.0

    @property
    def ends(self) -> frozenset[int]:
        """Both nodes."""
        return frozenset((self.scan, self.onto))

    @property
    def lever_mm(self) -> float:
        """Length that converts the rotation to mm."""
        return _LEVER * self.size_mm

    @property
    def floor(self) -> Floats:
        """(6, 6): least covariance."""
        return np.diag(np.repeat([np.radians(_FLOOR_DEG), _FLOOR * self.size_mm], 3) ** 2)

    @property
    def variance(self) -> float:
        """Variance in mm^2 of the translation plus that of the rotation at the lever."""
        total = np.trace(self.covariance[3:, 3:]) + self.lever_mm**2 * np.trace(
            self.covariance[:3, :3]
        )
        floor = (_FLOOR * self.size_mm) ** 2 + (self.lever_mm * np.radians(_FLOOR_DEG)) ** 2
        return float(total + floor)


class LoopGap(NamedTuple):
    """The gap of a loop: translation at the middle of the overlap, and rotation."""

    shift_mm: float
    turn_deg: float


def spanning_poses(
    nodes: int, edges: Sequence[Edge], root: int, costs: Floats | None = None
) -> tuple[Floats, Floats]:
    """Compute poses along the tree of shortest paths from the root, by the edges' variances or the
    given ``costs``.

    Returns T_root_node (nodes, 4, 4) mm, NaN for unconnected nodes, and the node before each in the
    tree (nodes,), negative for the root and unconnected ones.
    """
    costs = np.array([edge.variance for edge in edges]) if costs is None else costs
    poses = np.full((nodes, 4, 4), np.nan)
    poses[root] = np.eye(4)
    ends = np.array([(edge.scan, edge.onto) for edge in edges], int).reshape(-1, 2)
    between = {edge.ends: edge for edge in edges}
    graph = coo_matrix((costs, tuple(ends.T)), shape=(nodes, nodes)).tocsr()
    distance, before = dijkstra(graph, directed=False, indices=root, return_predecessors=True)
    for node in np.argsort(distance).tolist():
        parent = int(before[node])
        if parent >= 0:
            edge = between[frozenset((node, parent))]
            poses[node] = poses[parent] @ (edge.T if edge.scan == node else np.linalg.inv(edge.T))
    return poses, before


def closes_loop(edge: Edge, before: np.ndarray) -> bool:
    """Whether an edge is none of the tree's of ``spanning_poses``."""
    return bool(before[edge.scan] != edge.onto and before[edge.onto] != edge.scan)


def loop_gap(edge: Edge, poses: Floats) -> LoopGap:
    """Return the gap between an edge and the relative pose of its nodes by ``poses`` (n, 4, 4)."""
    turn, shift = np.linalg.norm(edge_residuals([edge], poses).reshape(2, 3), axis=1)
    return LoopGap(float(shift), float(np.degrees(turn)))


def loop_nodes(edge: Edge, before: np.ndarray) -> list[int]:
    """Return the nodes of the loop that an edge closes with the tree ``before`` (nodes,) of
    ``spanning_poses``, from end to end."""

    def path_to_root(node: int) -> list[int]:
        """Return the nodes from a node to the root, both included."""
        path = [node]
        while before[path[-1]] >= 0:
            path.append(int(before[path[-1]]))
        return path

    first, second = path_to_root(edge.scan), path_to_root(edge.onto)
    while len(first) > 1 and len(second) > 1 and first[-2] == second[-2]:
        first.pop(), second.pop()
    return first + second[-2::-1]


def select_consistent_edges(
    nodes: int, edges: Sequence[Edge], root: int, is_good_fit: Callable[[Edge, Floats], bool]
) -> tuple[list[int], dict[int, LoopGap]]:
    """Select the edges that are consistent with one another and still connect all nodes.

    Returns their indices, and the gap of each edge to drop. Random spanning trees are tried; the
    right one has the fewest inconsistent edges. Among several such, it is the one at whose poses
    the scans of its inconsistent edges fit each other, by ``is_good_fit(edge, poses)``. Raises
    ``Refused`` where that does not decide.
    """
    hypotheses = _list_hypotheses(nodes, edges, root)
    fewest = min(map(len, hypotheses))
    best = [dropped for dropped in hypotheses if len(dropped) == fewest]
    if len(best) > 1:
        best = [
            dropped
            for dropped in best
            if all(is_good_fit(edges[k], hypotheses[dropped]) for k in dropped)
        ]
    if len(best) != 1:
        worst = max(
            loop_gap(edges[k], poses) for dropped, poses in hypotheses.items() for k in dropped
        )
        raise Refused(
            "ambiguous",
            f"Pairs of scans contradict one another by {worst.shift_mm:.1f} mm and"
            f" {worst.turn_deg:.1f} degrees, and nothing tells which is wrong: take scans that"
            " overlap more, pick point pairs, or give the turntable's angle.",
        )
    (dropped,) = best
    gaps = {k: loop_gap(edges[k], hypotheses[dropped]) for k in dropped}
    return [k for k in range(len(edges)) if k not in dropped], gaps


def _list_hypotheses(nodes: int, edges: Sequence[Edge], root: int) -> dict[frozenset[int], Floats]:
    """Return the edges that are inconsistent with random spanning trees, with the poses (n, 4, 4)
    by the first of each.

    Only the empty set where one tree is consistent with all edges.
    """
    rng = np.random.default_rng(0)
    costs = np.array([edge.variance for edge in edges])
    hypotheses: dict[frozenset[int], np.ndarray] = {}
    for trial in range(_TREES):
        drawn = costs if trial == 0 else costs * np.exp(rng.normal(0, 3, len(edges)))
        poses, before = spanning_poses(nodes, edges, root, drawn)
        inconsistent = frozenset(
            k
            for k, edge in enumerate(edges)
            if closes_loop(edge, before) and not _is_consistent(edge, edges, before, poses)
        )
        if not inconsistent:
            return {inconsistent: poses}
        hypotheses.setdefault(inconsistent, poses)
    return hypotheses


def _is_consistent(edge: Edge, edges: Sequence[Edge], before: np.ndarray, poses: Floats) -> bool:
    """Whether the loop that an edge closes with the tree has a plausible gap at the rim of the
    overlap, for the variances of the loop's edges."""
    pairs = {edge.ends, *map(frozenset, pairwise(loop_nodes(edge, before)))}
    variance = sum(each.variance for each in edges if each.ends in pairs)
    gap = loop_gap(edge, poses)
    at_rim = gap.shift_mm + np.radians(gap.turn_deg) * _RIM * edge.size_mm
    return bool(at_rim <= max(_GAP_SIGMAS * np.sqrt(variance), _GAP_GATES * edge.gate_mm))


def optimise_poses(poses: Floats, edges: Sequence[Edge], root: int) -> Floats:
    """Optimise approximate poses T_root_node (n, 4, 4) mm by weighted least squares over all
    edges."""
    apply_step, cost, _ = _build_problem(poses, edges, root)
    return apply_step(least_squares(cost, np.zeros(6 * (len(poses) - 1)), x_scale="jac").x)


def pose_uncertainties(poses: Floats, edges: Sequence[Edge], root: int) -> list[Uncertainty]:
    """Return the uncertainty of each optimised pose T_root_node (n, 4, 4), at the mean of the
    edges' centres.

    It grows with the distance from the root along the graph; the root's own is 0.
    """
    _, cost, middle = _build_problem(poses, edges, root)
    lever = edges[0].lever_mm
    small = 1e-5 * lever
    steps = np.eye(6 * (len(poses) - 1)) * small
    J = np.stack([(cost(step) - cost(-step)) / (2 * small) for step in steps], axis=1)
    unit = np.repeat([1 / lever, 1.0], 3)
    covariance = np.linalg.inv(J.T @ J)
    blocks = [
        covariance[k : k + 6, k : k + 6] * np.outer(unit, unit) for k in range(0, len(steps), 6)
    ]
    blocks.insert(root, np.zeros((6, 6)))
    return [Uncertainty(block, middle) for block in blocks]


def _build_problem(
    poses: Floats, edges: Sequence[Edge], root: int
) -> tuple[Callable[[Floats], Floats], Callable[[Floats], Floats], Floats]:
    """Return the least-squares problem of the poses T_root_node (n, 4, 4): (apply_step, cost,
    middle).

    Its unknowns x (6 (n - 1),) are a rotation (in mm at the lever) and a translation about
    ``middle`` (3,) mm for each node but the root. ``apply_step(x)`` returns the moved poses,
    ``cost(x)`` the edges' residuals in sigmas.
    """
    free = [node for node in range(len(poses)) if node != root]
    whitening = np.linalg.inv(
        np.linalg.cholesky(np.array([edge.covariance + edge.floor for edge in edges]))
    )
    middle = np.mean(
        [move_points(poses[edge.onto], edge.centre[None])[0] for edge in edges], axis=0
    )

    def apply_step(x: Floats) -> Floats:
        """Return the poses (n, 4, 4) moved by the unknowns."""
        rotation, translation = x.reshape(-1, 2, 3).transpose(1, 0, 2)
        R = Rotation.from_rotvec(rotation / edges[0].lever_mm).as_matrix()
        moved = poses.copy()
        moved[free] = rigid_transform(R, translation + middle - R @ middle) @ poses[free]
        return moved

    def cost(x: Floats) -> Floats:
        """Return the whitened residuals (6 m,) of the edges."""
        return np.einsum("kij,kj->ki", whitening, edge_residuals(edges, apply_step(x))).ravel()

    return apply_step, cost, middle


def edge_residuals(edges: Sequence[Edge], poses: Floats) -> Floats:
    """Return (m, 6): rotation (rad) and translation (mm, at the edge's centre) from each edge to
    the poses' own."""
    scans, ontos = [edge.scan for edge in edges], [edge.onto for edge in edges]
    relative = np.linalg.inv(poses[ontos]) @ poses[scans]
    D = relative @ np.linalg.inv(np.array([edge.T for edge in edges]))
    centres = np.array([edge.centre for edge in edges])
    shift = np.einsum("kij,kj->ki", D[:, :3, :3], centres) + D[:, :3, 3] - centres
    return np.hstack([Rotation.from_matrix(D[:, :3, :3]).as_rotvec(), shift])
