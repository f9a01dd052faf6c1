"""Which registered pairs agree with one another, and which are contradicted by the others."""

from collections.abc import Callable, Sequence

import numpy as np

from slviewer.registration import graph
from slviewer.registration.graph import Edge
from slviewer.registration.refusal import Refused

_TREES = 200
_SIGMAS = 8.0
_GATES = 0.5
"""A loop is open where it gapes by more than so many times what is expected, and than this share of the gate: one that
was registered in the right place ends much nearer, and one in the wrong place nearly always farther."""


def select_consistent_edges(
    nodes: int,
    edges: Sequence[Edge],
    root: int,
    gates: Sequence[float],
    fits: Callable[[Edge, np.ndarray], bool],
) -> tuple[list[int], dict[int, tuple[float, float]]]:
    """The indices of the edges that agree, which still join all nodes, and those to drop with how far each is off, in
    mm and degrees.

    Many trees through the graph are tried; the one that the most other edges agree with is right. Of several that are
    as good, it is the one whose dropped pairs' surfaces lie well on each other where the others put them, which
    ``fits(edge, T_onto_scan)`` says. Raises ``Refused`` where that does not decide.
    """
    rng = np.random.default_rng(0)
    costs = np.array([edge.variance for edge in edges])
    found: dict[frozenset[int], np.ndarray] = {}
    for trial in range(_TREES):
        poses, by = graph.spanning_poses(
            nodes, edges, root, costs if trial == 0 else costs * np.exp(rng.normal(0, 3, len(edges)))
        )
        open_ones = frozenset(k for k, edge in enumerate(edges) if k not in by and _gapes(k, edges, by, poses, gates))
        found.setdefault(open_ones, poses)
        if not open_ones:
            return list(range(len(edges))), {}
    fewest = min(len(one) for one in found)
    best = [(one, poses) for one, poses in found.items() if len(one) == fewest]
    if len(best) > 1:
        best = [(one, poses) for one, poses in best if all(fits(edges[k], _put(edges[k], poses)) for k in one)]
    if len(best) != 1:
        worst = max(
            (graph.loop_gap(edges[k], poses) for one, poses in found.items() for k in one), key=lambda g: g.shift_mm
        )
        raise Refused(
            "ambiguous",
            f"Pairs of scans contradict one another by {worst.shift_mm:.1f} mm and {worst.turn_deg:.1f} degrees, and "
            "nothing tells which is wrong: take scans that overlap more, pick point pairs, or give the turntable's "
            "angle.",
        )
    dropped, poses = best[0]
    gaps = {k: graph.loop_gap(edges[k], poses) for k in dropped}
    kept = [k for k in range(len(edges)) if k not in dropped]
    return kept, {k: (gap.shift_mm, gap.turn_deg) for k, gap in gaps.items()}


def _gapes(k: int, edges: Sequence[Edge], by: Sequence[int], poses: np.ndarray, gates: Sequence[float]) -> bool:
    left = graph.loop_gap(edges[k], poses)
    at_rim = left.shift_mm + np.radians(left.turn_deg) * 50.0
    return bool(at_rim > max(_SIGMAS * graph.expected_mm(edges[k], edges, by), _GATES * gates[k]))


def _put(edge: Edge, poses: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.inv(poses[edge.onto]) @ poses[edge.scan])
