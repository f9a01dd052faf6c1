"""Multiway registration: bring many scans of one object into the frame of one of them.

Consecutive scans are expected to overlap, and the last one with the first; where they do not, every
other pair that could connect the pose graph is tried. Once all scans are connected, further pairs
that overlap at the estimated poses are registered, which close loops. Pairs that contradict the
others are dropped; the poses are then optimised together.
"""

import os
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from threading import Lock

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, Uncertainty, move_points, rotation_angle
from slviewer.reconstruction.cloud import Cloud, choose_pixels
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.records.merge import LoopClosure
from slviewer.registration import graph
from slviewer.registration.graph import Edge
from slviewer.registration.markers import MarkerPose, MeasuredMarkers, fit_marker_pose
from slviewer.registration.pairwise import Progress, Registration, register_prepared
from slviewer.registration.refusal import Refused
from slviewer.registration.scan import LEAST_POINTS, PreparedScan, away_from_edges, prepare_scan
from slviewer.registration.start import (
    MAX_ANGLE_ERROR_DEG,
    Candidate,
    TurntableAxis,
    determines_axis,
    fit_turntable_axis,
    search_starts,
    shortest_turn,
)

Pair = tuple[str, str]
"""Names of a scan and of the scan whose frame it is registered to."""

MOST_SCANS = 255
ALL_PAIRS = 4
"""Up to this number of scans, every pair is registered."""
_LOOP_PAIRS = 2
"""Largest number of loop-closing pairs per scan."""
_MARKER_PAIRS = 3
"""Pairs with common markers that are registered for each of many scans."""
_LOOP_OVERLAP = 0.3
"""Least predicted overlap of a loop-closing pair."""


@dataclass(frozen=True, eq=False)
class Starts:
    """Initial alignments of a multiway registration; by features where nothing is given.

    ``poses``: approximate T_world_scan (4, 4) mm by name, in any common frame; ``is_decided``: they
    follow from registrations. ``table_deg``: the angle of a turntable by name, of some of the scans
    at least; its axis is estimated from the first pairs. ``picked``: initial poses from picked
    points, by pair. ``markers``: coded markers by name, which give initial poses and constrain the
    registration.
    """

    poses: Mapping[str, Floats] | None = None
    is_decided: bool = False
    table_deg: Mapping[str, float] | None = None
    picked: Mapping[Pair, Candidate] | None = None
    markers: Mapping[str, MeasuredMarkers] | None = None


@dataclass(frozen=True, eq=False)
class MultiwayAlignment:
    """Result of a multiway registration.

    ``T_reference_scan`` (4, 4) mm by name, into the frame of ``reference``, with ``uncertainties``.
    ``pairs``: the registrations from which it was computed; ``loops`` of them, the one with the
    largest gap first. ``dropped``: pairs that the others contradict; ``refused``: pairs that could
    not be registered; each with the reason. ``markers``: of pairs with common ones, the pose that
    they alone determine.
    """

    reference: str
    T_reference_scan: Mapping[str, Floats]
    uncertainties: Mapping[str, Uncertainty]
    pairs: Mapping[Pair, Registration]
    loops: list[LoopClosure]
    dropped: Mapping[Pair, str]
    refused: Mapping[Pair, str]
    markers: Mapping[Pair, MarkerPose]

    def on_reference(self) -> dict[str, Registration]:
        """Return a registration onto the reference for every other scan, with its optimised pose
        and uncertainty.

        The remaining figures are those of the pair with the reference where there is one, else of
        the scan's pair with the smallest uncertainty.
        """
        registrations = {}
        for name, T in self.T_reference_scan.items():
            if name != self.reference:
                own = [pair for pair in self.pairs if name in pair]
                best = min(
                    own, key=lambda p: (self.reference not in p, self.pairs[p].uncertainty.shift_mm)
                )
                registrations[name] = replace(
                    self.pairs[best], T_reference_scan=T, uncertainty=self.uncertainties[name]
                )
        return registrations


def register_all(
    scans: Mapping[str, Cloud | PreparedScan],
    reference: str,
    starts: Starts | None = None,
    progress: Progress | None = None,
) -> MultiwayAlignment:
    """Register 2 to 255 scans, by name in the order of capture, into the frame of the one called
    ``reference``.

    ``progress`` receives the completed share of the work, 0 to 1, and may raise to cancel.

    Raises ``InputError`` for an unknown reference or too few scans, and ``Refused``, naming the
    scans, where a scan cannot be connected to the reference or where it is undecidable which of
    contradicting pairs are wrong.
    """
    if reference not in scans:
        raise InputError(
            f"There is no scan called {reference!r}",
            f"choose the reference among {', '.join(scans)}.",
        )
    if not 2 <= len(scans) <= MOST_SCANS:
        raise InputError(
            f"{len(scans)} scan(s) given",
            f"registering takes 2 to {MOST_SCANS} scans of one object.",
        )
    return _PoseGraphBuilder(
        scans, reference, starts or Starts(), progress or (lambda share: None)
    ).build()


class _PoseGraphBuilder:
    """Builds the pose graph of one call of ``register_all``, pair by pair, and optimises it."""

    def __init__(
        self,
        scans: Mapping[str, Cloud | PreparedScan],
        reference: str,
        starts: Starts,
        progress: Progress,
    ) -> None:
        self.names, self.reference = list(scans), reference
        self.starts, self._progress = starts, progress
        self._share, self._progress_lock = 0.0, Lock()
        self.root = self.names.index(reference)
        self.registered: dict[Pair, Registration] = {}
        self.refused: dict[Pair, Refused] = {}
        self._report(0.0)
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            self.scans = list(threads.map(self._prepare, self.names, scans.values()))
        self.size = min(scan.size for scan in self.scans)
        self.markers = self._fit_markers()
        self.expected = len(self._list_first_pairs()) + (
            _LOOP_PAIRS * len(scans) if len(scans) > ALL_PAIRS else 0
        )

    def build(self) -> MultiwayAlignment:
        """Register pairs until all scans are connected, close loops, and optimise the poses."""
        self._register(self.starts.picked or {})
        known = self._initial_poses()
        self._register({pair: _relative_pose(known, *pair) for pair in self._list_first_pairs()})
        self._connect()
        poses = self._spanning_poses()
        if len(self.names) > ALL_PAIRS:
            self._close_loops(poses)
        return self._optimise()

    # selection of pairs and of their initial poses

    def _list_first_pairs(self) -> list[Pair]:
        """List every pair of a few scans, or each scan with the one before it and the last with the
        first; with markers those pairs that show the same ones."""
        names = self.names
        if self.starts.markers is not None and not self.starts.table_deg:
            return list(self.markers)
        if len(names) <= ALL_PAIRS:
            pairs = [(a, b) for i, a in enumerate(names) for b in names[:i]]
        else:
            pairs = [(b, a) for a, b in pairwise(names)] + [(names[-1], names[0])]
        pairs = [(b, a) if a == self.reference else (a, b) for a, b in pairs]
        return pairs + [pair for pair in self.markers if not {pair, pair[::-1]} & {*pairs}]

    def _initial_poses(self) -> dict[str, Candidate]:
        """Return T_world_scan (4, 4) mm by name from given poses or the turntable, and its origin;
        {} without these."""
        if self.starts.poses is not None:
            decided = self.starts.is_decided
            return {
                name: Candidate(T, "initial", is_decided=decided)
                for name, T in self.starts.poses.items()
            }
        table_deg = self.starts.table_deg
        if not table_deg:
            return {}
        angles = {name: table_deg[name] for name in self.names if name in table_deg}
        axis = self._estimate_axis(angles)
        decided = all(result.rival_mm is None for result in self.registered.values())
        return {
            name: Candidate(axis.rotation(-deg), "turntable", is_decided=decided)
            for name, deg in angles.items()
        }

    def _estimate_axis(self, angles: Mapping[str, float]) -> TurntableAxis:
        """Estimate the turntable's axis from the first two consecutive pairs that register by
        features, or from one whose ambiguity the table's angle decides.

        ``angles``: of the table, degrees, by name.
        """
        steps, steps_deg = [], []
        given = {(b, a): shortest_turn(angles[b] - angles[a]) for a, b in pairwise(angles)}
        usable = {pair: deg for pair, deg in given.items() if determines_axis(deg)} or given
        for pair, deg in usable.items():
            self._register({pair: None})
            if pair in self.refused and self.refused[pair].reason == "ambiguous":
                self._register_turned(pair, abs(deg))
            if pair in self.registered:
                steps.append(self.registered[pair].T_reference_scan)
                steps_deg.append(deg)
                if len(steps) == 2 or self.registered[pair].rival_mm is not None:
                    break
        if not steps:
            raise Refused(
                "overlap",
                "No two scans in a row register, so that the turntable's axis cannot be found: "
                "scan at smaller steps.",
            )
        return fit_turntable_axis(steps, steps_deg)

    def _register_turned(self, pair: Pair, deg: float) -> None:
        """Register a pair whose poses fit alike from the best one that turns by ``deg``."""
        a, b = (self.scans[self.names.index(name)] for name in pair)
        for start in search_starts(a, b, self.size):
            turned_deg = float(np.degrees(rotation_angle(start.T[:3, :3])))
            if abs(turned_deg - deg) < MAX_ANGLE_ERROR_DEG:
                self._register({pair: replace(start, start="turntable")})
                return

    def _fit_markers(self) -> dict[Pair, MarkerPose]:
        """Fit the poses of pairs with common markers: of a few scans all, of many each scan's
        `_MARKER_PAIRS` best."""
        poses: dict[Pair, MarkerPose] = {}
        seen = self.starts.markers or {}
        shown = [name for name in self.names if name in seen]
        for i, a in enumerate(shown):
            for b in shown[:i]:
                pair = (b, a) if a == self.reference else (a, b)
                try:
                    pose = fit_marker_pose(*(seen[name] for name in pair))
                except Refused as error:
                    self.refused[pair] = error
                    continue
                if pose is not None:
                    poses[pair] = pose
        if len(self.names) <= ALL_PAIRS:
            return poses
        count, chosen = Counter[str](), {}
        for (a, b), pose in sorted(poses.items(), key=lambda item: -len(item[1].ids)):
            if min(count[a], count[b]) < _MARKER_PAIRS:
                count.update((a, b))
                chosen[a, b] = pose
        return chosen

    def _connect(self) -> None:
        """Register further pairs, the most promising first, until every scan is connected to the
        reference.

        Raises ``Refused`` where no pair is left to try.
        """
        while True:
            joined = np.isfinite(self._spanning_poses()).all(axis=(1, 2))
            if joined.all():
                return
            candidates = {}
            for a in np.flatnonzero(~joined):
                for b in np.flatnonzero(joined):
                    pair = self.names[a], self.names[b]
                    if not self._was_tried(pair):
                        candidates[pair] = search_starts(self.scans[a], self.scans[b], self.size)
            for pair, starts in sorted(candidates.items(), key=lambda item: -item[1][0].score):
                self._register({pair: starts})
                if pair in self.registered:
                    break
            else:
                names = [self.names[k] for k in np.flatnonzero(~joined)]
                error = next(
                    error for pair, error in self.refused.items() if set(pair) & set(names)
                )
                pronoun = "it" if len(names) == 1 else "them"
                raise error.with_context(
                    f"{', '.join(names)} could not be merged: nothing joins {pronoun} to"
                    f" {self.reference}."
                )

    def _close_loops(self, poses: Floats) -> None:
        """Register the pairs that overlap most at ``poses`` (n, 4, 4), up to a number per scan."""
        overlaps = []
        for i, a in enumerate(self.names):
            for j, b in enumerate(self.names[:i]):
                if not self._was_tried((a, b)):
                    self._report(self._share)  # it may raise to cancel
                    T = np.linalg.inv(poses[j]) @ poses[i]
                    overlaps.append((_estimate_overlap(self.scans[i], self.scans[j], T), (a, b), T))
        count, pairs = Counter[str](), {}
        for overlap, (a, b), T in sorted(overlaps, key=lambda entry: -entry[0]):
            if overlap >= _LOOP_OVERLAP and max(count[a], count[b]) < _LOOP_PAIRS:
                count.update((a, b))
                pairs[a, b] = Candidate(T, "initial", is_decided=True)
        self._register(pairs)

    # registration of pairs

    def _was_tried(self, pair: Pair) -> bool:
        """Whether a pair, either way round, was registered or refused."""
        return bool({pair, pair[::-1]} & {*self.registered, *self.refused})

    def _prepare(self, name: str, cloud: Cloud | PreparedScan) -> PreparedScan:
        """Prepare a named scan for registration, using only its points away from edges; InputError
        where these are too few, so that it would fail later."""
        if isinstance(cloud, PreparedScan):
            return cloud
        sigma = cloud.sigma_z[cloud.mask & np.isfinite(cloud.sigma_z)]
        sigma_mm = float(np.median(sigma)) if sigma.size else None
        if cloud.normals is not None:
            facing = choose_pixels(cloud.normals, cloud.mask)
            return prepare_scan(name, cloud.measured, facing, sigma_mm, has_camera=False)
        measured = np.count_nonzero(cloud.mask)
        trusted = away_from_edges(cloud.points, cloud.sigma_z)
        points = choose_pixels(cloud.points, trusted)
        if len(points) < LEAST_POINTS <= measured:
            raise InputError(
                f"{name} has {measured} points, and all but {len(points)} lie beside holes or depth"
                " steps",
                "the cloud is too sparse or too noisy to be aligned; capture it with more light and"
                " longer exposure, or with more phase steps",
            )
        facing = choose_pixels(grid_normals(cloud.points), trusted)
        prepared = prepare_scan(name, points, facing, sigma_mm)
        self._report(self._share + 0.2 / len(self.names))
        return prepared

    def _register(self, starts: Mapping[Pair, Candidate | list[Candidate] | None]) -> None:
        """Register independent pairs in parallel, and store the results in their order in
        ``registered`` or ``refused``.

        ``starts``: the initial pose of each, or the candidate poses of an earlier search.
        """
        pending = [pair for pair in starts if not {pair, pair[::-1]} & set(self.registered)]
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            results = list(threads.map(lambda pair: self._align(pair, starts[pair]), pending))
        for pair, result in zip(pending, results, strict=True):
            if isinstance(result, Refused):
                self.refused[pair] = result
            else:
                self.registered[pair] = result
                self.refused.pop(pair, None)
                self.refused.pop(pair[::-1], None)

    def _align(
        self, pair: Pair, start: Candidate | list[Candidate] | None
    ) -> Registration | Refused:
        """Register a pair and return the result or the refusal; may run in several threads."""
        tried = len(self.registered) + len(self.refused)
        before = 0.2 + 0.7 * min(1.0, tried / (self.expected + 1))
        step = 0.7 / (self.expected + 1)
        a, b = (self.scans[self.names.index(name)] for name in pair)
        turned = self.markers.get(pair[::-1])
        markers = self.markers.get(pair) or (None if turned is None else turned.inverse())
        try:
            return register_prepared(
                a,
                b,
                self.size,
                start,
                markers,
                lambda share: self._report(before + step * share),
            )
        except Refused as error:
            return error

    def _report(self, share: float) -> None:
        """Report the completed share of the work, never less than before; the receiver may raise to
        cancel."""
        with self._progress_lock:
            self._share = max(self._share, share)
            self._progress(self._share)

    # optimisation

    def _edges(self) -> list[Edge]:
        """Return the registered pairs as edges of the pose graph."""
        return [
            Edge(
                self.names.index(scan), self.names.index(onto), result.T_reference_scan,
                result.uncertainty.covariance, result.uncertainty.centre, self.size,
                result.gate_mm,
            )
            for (scan, onto), result in self.registered.items()
        ]  # fmt: skip

    def _spanning_poses(self) -> Floats:
        """Return the poses of ``graph.spanning_poses`` by all registered pairs."""
        return graph.spanning_poses(len(self.names), self._edges(), self.root)[0]

    def _optimise(self) -> MultiwayAlignment:
        """Drop contradicting pairs and optimise the poses of all scans."""
        self._report(0.92)
        pairs, edges = list(self.registered), self._edges()
        consistent, gaps = graph.select_consistent_edges(
            len(self.names), edges, self.root, self._is_good_fit
        )
        dropped = {
            pairs[k]: (
                f"{pairs[k][0]} -> {pairs[k][1]} contradicts the other pairs by {gap.shift_mm:.1f}"
                f" mm and {gap.turn_deg:.1f} degrees, and is excluded"
            )
            for k, gap in gaps.items()
        }
        edges = [edges[k] for k in consistent]
        start, before = graph.spanning_poses(len(self.names), edges, self.root)
        poses = start
        if len(edges) >= len(self.names):
            poses = graph.optimise_poses(start, edges, self.root)
        loops = [
            LoopClosure(
                [self.names[node] for node in graph.loop_nodes(edge, before)],
                *graph.loop_gap(edge, start),
                *graph.loop_gap(edge, poses),
            )
            for edge in edges
            if graph.closes_loop(edge, before)
        ]
        self._report(1.0)
        return MultiwayAlignment(
            self.reference,
            dict(zip(self.names, poses, strict=True)),
            dict(zip(self.names, graph.pose_uncertainties(poses, edges, self.root), strict=True)),
            {pairs[k]: self.registered[pairs[k]] for k in consistent},
            sorted(loops, key=lambda loop: -loop.error_mm),
            dropped,
            {pair: str(error) for pair, error in self.refused.items()},
            self.markers,
        )

    def _is_good_fit(self, edge: Edge, poses: Floats) -> bool:
        """Whether ICP of an edge's scans from ``poses`` (n, 4, 4) succeeds and stays within its
        gate."""
        T = np.linalg.inv(poses[edge.onto]) @ poses[edge.scan]
        result = self._align(
            (self.names[edge.scan], self.names[edge.onto]),
            Candidate(T, "initial", is_decided=True),
        )
        if isinstance(result, Refused):
            return False
        return (
            graph.loop_gap(replace(edge, T=result.T_reference_scan), poses).shift_mm
            < result.gate_mm
        )


def _relative_pose(known: Mapping[str, Candidate], scan: str, onto: str) -> Candidate | None:
    """Return the initial pose of a pair from poses in a common frame; None where one of them is not
    known."""
    if scan not in known or onto not in known:
        return None
    return replace(known[scan], T=np.linalg.inv(known[onto].T) @ known[scan].T)


def _estimate_overlap(scan: PreparedScan, reference: PreparedScan, T: Floats) -> float:
    """Estimate the share of the scan within a voxel of the reference at the pose ``T`` (4, 4), from
    thinned clouds."""
    voxel = reference.size / 80.0
    points = np.asarray(scan.thinned(voxel).points)
    distance, _ = reference.fine_tree.query(move_points(T, points), distance_upper_bound=voxel)
    return float(np.count_nonzero(np.isfinite(distance)) / len(points))
