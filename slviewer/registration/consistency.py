"""Selection of the registered pairs that agree with one another, by the loops of the pose graph."""

from collections.abc import Callable, Sequence

import numpy as np

from slviewer.registration import graph
from slviewer.registration.graph import Edge
from slviewer.registration.refusal import Refused

_TREES = 200
_RIM_MM = 50.0
_GAP_SIGMAS = 8.0
_GAP_GATES = 0.5
"""A loop is inconsistent where its gap exceeds both 8 times the expected gap and half the
registration's gate."""


def select_consistent_edges(
    nodes: int,
    edges: Sequence[Edge],
    root: int,
    gates: Sequence[float],
    is_good_fit: Callable[[Edge, np.ndarray], bool],
) -> tuple[list[int], dict[int, tuple[float, float]]]:
    """Select the edges that are consistent with one another and still connect all nodes.

    Returns their indices, and the gap (mm, degrees) of each edge to drop. Random spanning trees are
    tried; the right one has the fewest inconsistent edges. Among several such, it is the one at
    whose poses the scans of its inconsistent edges fit each other, by ``is_good_fit(edge,
    T_onto_scan)``. Raises ``Refused`` where that does not decide. ``gates``: registration gate of
    each edge, mm.
    """
    hypotheses = _list_hypotheses(nodes, edges, root, gates)
    fewest = min(len(dropped) for dropped in hypotheses)
    best = [(dropped, poses) for dropped, poses in hypotheses.items() if len(dropped) == fewest]
    if len(best) > 1:
        best = [
            (dropped, poses)
            for dropped, poses in best
            if all(
                is_good_fit(edges[k], np.linalg.inv(poses[edges[k].onto]) @ poses[edges[k].scan])
                for k in dropped
            )
        ]
    if len(best) != 1:
        gaps = [
            graph.loop_gap(edges[k], poses)
            for dropped, poses in hypotheses.items()
            for k in dropped
        ]
        worst = max(gaps, key=lambda gap: gap.shift_mm)
        raise Refused(
            "ambiguous",
            f"Pairs of scans contradict one another by {worst.shift_mm:.1f} mm and"
            f" {worst.turn_deg:.1f} degrees, and nothing tells which is wrong: take scans that"
            " overlap more, pick point pairs, or give the turntable's angle.",
        )
    dropped, poses = best[0]
    gaps_by_edge = {k: graph.loop_gap(edges[k], poses) for k in dropped}
    consistent = [k for k in range(len(edges)) if k not in dropped]
    return consistent, {k: (gap.shift_mm, gap.turn_deg) for k, gap in gaps_by_edge.items()}


def _list_hypotheses(
    nodes: int, edges: Sequence[Edge], root: int, gates: Sequence[float]
) -> dict[frozenset[int], np.ndarray]:
    """Return the edges that are inconsistent with random spanning trees, with the poses (n, 4, 4)
    by the first of each.

    Only the empty set where one tree is consistent with all edges.
    """
    rng = np.random.default_rng(0)
    costs = np.array([edge.variance for edge in edges])
    hypotheses: dict[frozenset[int], np.ndarray] = {}
    for trial in range(_TREES):
        drawn = costs if trial == 0 else costs * np.exp(rng.normal(0, 3, len(edges)))
        poses, tree = graph.spanning_poses(nodes, edges, root, drawn)
        inconsistent = frozenset(
            k
            for k in range(len(edges))
            if k not in tree and not _is_consistent(k, edges, tree, poses, gates)
        )
        if not inconsistent:
            return {inconsistent: poses}
        hypotheses.setdefault(inconsistent, poses)
    return hypotheses


def _is_consistent(
    k: int, edges: Sequence[Edge], tree: Sequence[int], poses: np.ndarray, gates: Sequence[float]
) -> bool:
    """Whether the loop that edge ``k`` closes with the tree has a plausible gap at the rim of the
    overlap."""
    gap = graph.loop_gap(edges[k], poses)
    at_rim = gap.shift_mm + np.radians(gap.turn_deg) * _RIM_MM
    return bool(
        at_rim
        <= max(_GAP_SIGMAS * graph.expected_gap_mm(edges[k], edges, tree), _GAP_GATES * gates[k])
    )
