"""Many scans of one object brought into the frame of one of them: pairs, loops, and what contradicts them.

Scans that follow one another are expected to overlap, and the last one with the first; where they do not, every other
pair that could join what is apart is tried. Once every scan has a place, pairs that must overlap there are registered
too: they close loops. A pair that the others contradict is dropped; the rest is adjusted together.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from threading import Lock
from typing import TypeVar

import numpy as np

from slviewer.errors import InputError
from slviewer.reconstruction.cloud import Cloud
from slviewer.registration import graph
from slviewer.registration.consistency import select_consistent_edges
from slviewer.registration.graph import Edge, LoopGap
from slviewer.registration.pairwise import Progress, Registration, register_prepared, search_starts
from slviewer.registration.prepared import LEAST_POINTS, PreparedScan, prepare_scan
from slviewer.registration.refine import Uncertainty
from slviewer.registration.refusal import Refused
from slviewer.registration.scan import Scan
from slviewer.registration.start import Candidate, Start
from slviewer.registration.turntable import TurntableAxis, fit_turntable_axis

Given = TypeVar("Given")
Made = TypeVar("Made")
Pair = tuple[str, str]
"""A scan, and the one that it lies on."""

MOST_SCANS = 255
ALL_PAIRS = 4
"""So few scans are registered each with every other."""
_MORE_PAIRS = 2
"""For each scan, at most, once its place is known."""
_OVERLAPPING = 0.3


@dataclass(frozen=True, eq=False)
class Starts:
    """Where to start from. ``poses`` (4, 4) by name are last poses: where each scan lies in any one frame (identity for
    scans that were registered before). ``step_deg`` is a turntable's angle from each scan to the next, ``axis`` its
    axis, found from the first pairs where it is None. ``picked`` starts, by pair. Where nothing is given: features."""

    poses: Mapping[str, np.ndarray] | None = None
    step_deg: float | None = None
    axis: TurntableAxis | None = None
    picked: Mapping[Pair, Candidate] | None = None


@dataclass(frozen=True)
class Loop:
    """Round ``names``, and from the last to the first, the pairs should lead back to where they began; ``before`` the
    adjustment and ``after``."""

    names: tuple[str, ...]
    before: LoopGap
    after: LoopGap


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where every scan lies.

    ``T_reference_scan`` (4, 4) by name, into the frame of ``reference``, and how sure each is (``uncertainties``), by
    all that lies between the two. ``pairs``: the registrations that it was made from; ``loops`` that they close, the
    worst first. ``dropped``: pairs that registered and that the others contradict, and ``refused`` ones that did not
    register, each with why.
    """

    reference: str
    T_reference_scan: Mapping[str, np.ndarray]
    uncertainties: Mapping[str, Uncertainty]
    pairs: Mapping[Pair, Registration]
    loops: tuple[Loop, ...]
    dropped: Mapping[Pair, str]
    refused: Mapping[Pair, str]

    def on_reference(self) -> dict[str, Registration]:
        """For every scan but the reference: its pose in the reference's frame, after the adjustment, with the
        uncertainty of that; the other figures are those of the surest pair that it is part of, that with the reference
        itself where there is one."""
        found = {}
        for name, T in self.T_reference_scan.items():
            if name != self.reference:
                own = [pair for pair in self.pairs if name in pair]
                best = min(own, key=lambda p: (self.reference not in p, self.pairs[p].uncertainty.shift_mm))
                found[name] = replace(self.pairs[best], T_reference_scan=T, uncertainty=self.uncertainties[name])
        return found


def register_all(
    scans: Mapping[str, Scan | Cloud],
    reference: str,
    starts: Starts | None = None,
    progress: Progress | None = None,
) -> Alignment:
    """Bring 2 to 255 scans, in the order in which they were taken, into the frame of the one called ``reference``.

    ``progress`` receives the share of the work done, 0 to 1, and may raise to cancel.

    Raises ``InputError`` for an unknown reference or too few scans, and ``Refused``, naming the scans, where one hangs
    on nothing or where pairs contradict one another and nothing tells which is wrong.
    """
    if reference not in scans:
        raise InputError(f"There is no scan called {reference!r}: choose the reference among {', '.join(scans)}.")
    if not 2 <= len(scans) <= MOST_SCANS:
        raise InputError(f"{len(scans)} scan(s) given: registering takes 2 to {MOST_SCANS} scans of one object.")
    work = _Work(scans, reference, starts or Starts(), progress or (lambda share: None))
    return work.done()


def _check_trusted(name: str, scan: Scan) -> None:
    """Raises InputError, with what becomes of its points, where too few of a scan can be used."""
    if scan.trusted is None or np.count_nonzero(scan.trusted) >= LEAST_POINTS or len(scan.points) < LEAST_POINTS:
        return
    raise InputError(
        f"{name} has {len(scan.points)} points, and all but {np.count_nonzero(scan.trusted)} lie beside holes or depth "
        "steps: the cloud is too sparse or too noisy to be aligned; capture it with more light and longer exposure, or "
        "with more phase steps"
    )


class _Work:
    """One call of ``register_all``: what was tried so far."""

    def __init__(self, scans: Mapping[str, Scan | Cloud], reference: str, starts: Starts, say: Progress) -> None:
        self.names, self.reference, self.starts, self._progress = list(scans), reference, starts, say
        self._share, self._saying = 0.0, Lock()
        self.root = self.names.index(reference)
        self.found: dict[Pair, Registration] = {}
        self.refused: dict[Pair, Refused] = {}
        self.say(0.0)
        self.scans = _side_by_side(self._ready, list(scans.items()))
        self.size = min(scan.size for scan in self.scans)
        self.expected = len(self._first_pairs()) + (_MORE_PAIRS * len(scans) if len(scans) > ALL_PAIRS else 0)

    def done(self) -> Alignment:
        for pair, start in (self.starts.picked or {}).items():
            self._try(*pair, start)
        known = self._known_poses()
        self._try_each([(pair, self._start(known, *pair)) for pair in self._first_pairs()])
        self._join()
        poses = self._tree()[0]
        if len(self.names) > ALL_PAIRS:
            self._close_loops(poses)
        return self._adjusted()

    # which pairs, and from where

    def _first_pairs(self) -> list[Pair]:
        names = self.names
        if len(names) <= ALL_PAIRS:
            pairs = [(a, b) for i, a in enumerate(names) for b in names[:i]]
        else:
            pairs = [(b, a) for a, b in pairwise(names)] + [(names[-1], names[0])]
        return [(b, a) if a == self.reference else (a, b) for a, b in pairs]

    def _known_poses(self) -> dict[str, tuple[np.ndarray, Start]]:
        """Where scans lie in a frame of their own, as far as it is known before any search."""
        if self.starts.poses is not None:
            return {name: (np.asarray(T, dtype=np.float64), "initial") for name, T in self.starts.poses.items()}
        step = self.starts.step_deg
        if step is None:
            return {}
        axis = self.starts.axis or self._axis(step)
        return {name: (axis.turned(-step * k), "turntable") for k, name in enumerate(self.names)}

    def _axis(self, step_deg: float) -> TurntableAxis:
        """Found from pairs in a row that register without knowing it."""
        steps = []
        for before, name in pairwise(self.names):
            if (found := self._register(name, before, None)) is not None:
                steps.append(found.T_reference_scan)
            if len(steps) == 2:
                break
        if not steps:
            raise Refused("overlap", "No two scans in a row register, so that the turntable's axis cannot be found: "
                          "give the axis, or scan at smaller steps.")  # fmt: skip
        return fit_turntable_axis(steps, step_deg)

    def _start(self, known: Mapping[str, tuple[np.ndarray, Start]], scan: str, onto: str) -> Candidate | None:
        if scan not in known or onto not in known:
            return None
        return Candidate(np.linalg.inv(known[onto][0]) @ known[scan][0], known[scan][1])

    def _join(self) -> None:
        """Try what could join scans that are apart from the reference's, the most promising first."""
        while lost := [k for k, pose in enumerate(self._tree()[0]) if not np.isfinite(pose).all()]:
            there = [k for k in range(len(self.names)) if k not in lost]
            waiting = []
            for a in lost:
                for b in there:
                    pair = self.names[a], self.names[b]
                    if not {pair, pair[::-1]} & {*self.found, *self.refused}:
                        begun = search_starts(self.scans[a], self.scans[b], self.size)
                        waiting.append((begun[0].score if begun else 0.0, pair, begun))
            for _, pair, begun in sorted(waiting, key=lambda one: -one[0]):
                if self._try(*pair, None, begun):
                    break
            else:
                raise self._hanging([self.names[k] for k in lost])

    def _hanging(self, lost: list[str]) -> Refused:
        told = next(error for pair, error in self.refused.items() if set(pair) & set(lost))
        if len(lost) == 1:
            return told.about(f"{lost[0]} could not be merged: nothing joins it to {self.reference}.")
        return told.about(f"{', '.join(lost)} could not be merged: nothing joins them to {self.reference}.")

    def _close_loops(self, poses: np.ndarray) -> None:
        """Register pairs that must overlap where the scans lie now."""
        count = dict.fromkeys(self.names, 0)
        shares, wanted = [], []
        for i, a in enumerate(self.names):
            for j, b in enumerate(self.names[:i]):
                if not {(a, b), (b, a)} & {*self.found, *self.refused}:
                    self.say(self._share)  # it may raise to cancel
                    T = np.linalg.inv(poses[j]) @ poses[i]
                    shares.append((_overlap(self.scans[i], self.scans[j], T), (a, b), T))
        for share, (a, b), T in sorted(shares, key=lambda one: -one[0]):
            if share < _OVERLAPPING or max(count[a], count[b]) >= _MORE_PAIRS:
                continue
            count[a], count[b] = count[a] + 1, count[b] + 1
            wanted.append(((a, b), Candidate(T, "initial")))
        self._try_each(wanted)

    # registering

    def _ready(self, given: tuple[str, Scan | Cloud]) -> PreparedScan:
        name, scan = given
        scan = scan if isinstance(scan, Scan) else Scan.from_cloud(scan)
        chosen = slice(None) if scan.trusted is None else scan.trusted
        _check_trusted(name, scan)
        normals = None if scan.normals is None else scan.normals[chosen]
        made = prepare_scan(name, scan.points[chosen], normals, scan.sigma_mm)
        self.say(self._share + 0.2 / len(self.names))
        return made

    def _try_each(self, wanted: Sequence[tuple[Pair, Candidate | None]]) -> None:
        """Register pairs, none of which waits for another, and keep what came in their order."""
        waiting = [(pair, start) for pair, start in wanted if not {pair, pair[::-1]} & set(self.found)]
        for (pair, _), result in zip(waiting, _side_by_side(lambda one: self._registered(*one), waiting), strict=True):
            self._keep(pair, result)

    def _try(self, scan: str, onto: str, start: Candidate | None, begun: list[Candidate] | None = None) -> bool:
        if (scan, onto) in self.found or (onto, scan) in self.found:
            return True
        return self._register(scan, onto, start, begun) is not None

    def _register(
        self, scan: str, onto: str, start: Candidate | None, begun: list[Candidate] | None = None
    ) -> Registration | None:
        return self._keep((scan, onto), self._registered((scan, onto), start, begun))

    def _registered(
        self, pair: Pair, start: Candidate | None, begun: list[Candidate] | None = None
    ) -> Registration | Refused:
        tried = len(self.found) + len(self.refused)
        share = 0.2 + 0.7 * min(1.0, tried / (self.expected + 1))
        one = 0.7 / (self.expected + 1)
        a, b = (self.scans[self.names.index(name)] for name in pair)
        try:
            return register_prepared(
                a, b, size=self.size, initial=start, starts=begun, progress=lambda part: self.say(share + one * part)
            )
        except Refused as error:
            return error

    def _keep(self, pair: Pair, result: Registration | Refused) -> Registration | None:
        if isinstance(result, Refused):
            self.refused[pair] = result
            return None
        self.found[pair] = result
        self.refused.pop(pair, None)
        self.refused.pop(pair[::-1], None)
        return result

    def say(self, share: float) -> None:
        """The share of the work that is done, which never goes back; whoever hears it may raise to cancel."""
        with self._saying:
            self._share = max(self._share, share)
            self._progress(self._share)

    # putting together

    def _edges(self) -> list[Edge]:
        return [
            Edge(
                self.names.index(scan), self.names.index(onto), found.T_reference_scan,
                found.uncertainty.covariance, found.uncertainty.centre,
            )
            for (scan, onto), found in self.found.items()
        ]  # fmt: skip

    def _tree(self) -> tuple[np.ndarray, list[int]]:
        return graph.spanning_poses(len(self.names), self._edges(), self.root)

    def _adjusted(self) -> Alignment:
        self.say(0.92)
        pairs, edges = list(self.found), self._edges()
        gates = [self.found[pair].gate_mm for pair in pairs]
        kept, dropped = select_consistent_edges(len(self.names), edges, self.root, gates, self._fits)
        told = {
            pairs[k]: f"{pairs[k][0]} -> {pairs[k][1]} contradicts the other pairs by {shift:.1f} mm "
            f"and {turn:.1f} degrees, and is left out"
            for k, (shift, turn) in dropped.items()
        }
        edges, pairs = [edges[k] for k in kept], [pairs[k] for k in kept]
        start, by = graph.spanning_poses(len(self.names), edges, self.root)
        poses = graph.optimise_poses(start, edges, self.root) if len(edges) >= len(self.names) else start
        loops = []
        for k, edge in enumerate(edges):
            if k not in by:
                expected = graph.expected_mm(edge, edges, by)
                names = tuple(self.names[node] for node in graph.loop_of(edge, edges, by))
                loops.append(Loop(names, graph.loop_gap(edge, start, expected), graph.loop_gap(edge, poses)))
        self.say(1.0)
        return Alignment(
            self.reference,
            dict(zip(self.names, poses, strict=True)),
            dict(zip(self.names, graph.pose_uncertainties(poses, edges, self.root), strict=True)),
            {pair: self.found[pair] for pair in pairs},
            tuple(sorted(loops, key=lambda loop: -loop.before.shift_mm)),
            told,
            {pair: str(error) for pair, error in self.refused.items()},
        )

    def _fits(self, edge: Edge, T: np.ndarray) -> bool:
        """Whether the two scans of an edge also lie well on each other where ``T`` puts them."""
        try:
            found = register_prepared(
                self.scans[edge.scan], self.scans[edge.onto], size=self.size, initial=Candidate(T, "initial")
            )
        except Refused:
            return False
        one = replace(edge, T=found.T_reference_scan)
        left = graph.residuals([replace(one, scan=0, onto=1)], np.stack([T, np.eye(4)]))[0]
        return bool(np.linalg.norm(left[3:]) < found.gate_mm)


def _side_by_side(do: Callable[[Given], Made], each: Sequence[Given]) -> list[Made]:
    """What ``do`` makes of each, in their order; on all cores, for most of it runs outside the interpreter."""
    with ThreadPoolExecutor(max(1, min(len(each), os.cpu_count() or 1))) as pool:
        return list(pool.map(do, each))


def _overlap(scan: PreparedScan, reference: PreparedScan, T: np.ndarray) -> float:
    """Share of the scan that lies on the reference where ``T`` puts it, as far as thinned clouds tell."""
    voxel = reference.size / 80.0
    points = np.asarray(scan.thinned(voxel).points)
    distance, _ = reference.fine_tree.query(points @ T[:3, :3].T + T[:3, 3], distance_upper_bound=voxel)
    return float(np.count_nonzero(np.isfinite(distance)) / len(points))
