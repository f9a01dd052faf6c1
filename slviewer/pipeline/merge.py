"""Registering scans of one object: one after the other while they are captured, each to those
before it, and all of them, whose loops are closed, to be fused into one surface.

A scan that could be aligned has a result ``placement/NAME``, which says where it is in the frame of
the first one; one that could not has the reason. A merge of all may start from there."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slviewer.errors import InputError, UsageError
from slviewer.evaluation import letter
from slviewer.geometry.rigid import Floats32, Uncertainty, move_points, rotation_angle
from slviewer.pipeline.cloud_corrections import (
    describe_calibration,
    resolve_region,
    restrict_cloud,
    restriction_notes,
)
from slviewer.pipeline.cloud_record import list_outside_depths
from slviewer.pipeline.imported_calibration import check_calibration
from slviewer.pipeline.machine_poses import load_places, place_inputs
from slviewer.pipeline.models import (
    ModelName,
    check_accepted,
    frame_of,
    load_model,
    preferred_model,
)
from slviewer.pipeline.operation import (
    Found,
    Job,
    Warn,
    ignore_warnings,
    next_name,
    operation,
    placed_file,
    read_record,
    stage,
)
from slviewer.pipeline.reconstruct import reconstruct_captures, scan_cloud
from slviewer.reconstruction.cloud import Cloud, choose_pixels
from slviewer.reconstruction.reconstruct import cloud_normals
from slviewer.records.merge import (
    ContradictingPair,
    MarkerPair,
    Merge,
    PlacedByMachine,
    Placement,
    RefusedPair,
    Registered,
    rests_on_start,
)
from slviewer.records.record import to_matrix, to_vector
from slviewer.registration.machine_places import MachinePlace, at_point, compare_place
from slviewer.registration.markers import (
    MeasuredMarkers,
    fit_marker_pose,
    marker_notes,
    measure_markers,
)
from slviewer.registration.multiway import MultiwayAlignment, Pair, Starts
from slviewer.registration.pairwise import Registration
from slviewer.registration.refusal import Refused
from slviewer.registration.start import Candidate, fit_picked_start, shortest_turn
from slviewer.registration.static_scene import ObjectAlignment, register_object
from slviewer.session.ply import write_ply
from slviewer.session.scan_edits import restriction_inputs
from slviewer.session.store import Session
from slviewer.surface.fuse import Fused, fuse

MAX_CONTRADICTION_SHARE = 0.01
"""Share of contradicting points from which on a pair is warned about: noise alone has fewer than
one in a million."""
MAT_MARKERS, MAT_TURN_DEG = 3, 3.0
"""Markers in common from which on a turntable's mat is used, and how far its turn may be from the
table's."""
PLACEMENTS = Placement.kind
MOST_TRIED = 3
"""Scans that a new one is aligned to at most: the latest, then those before it."""
_PIXELS = 130_000
"""Of a scan that is aligned: rows and columns of larger ones are skipped."""
_SHOWN_POINTS = 25_000  # of a scan
_REACH = 2.5  # spacings of the shown points
StartKind = Literal["features", "turntable", "identity", "placed", "markers", "machine"]
Picked = Mapping[Pair, tuple[np.ndarray, np.ndarray]]
"""Of a pair (scan, onto): three or more points (n, 3) mm on either, in their cameras' frames."""


@dataclass(frozen=True, eq=False)
class MergedScans:
    """Scans aligned to one of them, the surface that they were fused to, and the record of it.

    In the file ``seen_by`` counts the scans that a point is the mean of, and ``source`` numbers the
    one that its place comes from, 0 for the first of ``fused.names``.
    """

    alignment: MultiwayAlignment
    fused: Fused
    clouds: Mapping[str, Cloud]
    found: Found[Merge]

    @property
    def record(self) -> Merge:
        """The figures of the merge."""
        return self.found.record


@dataclass(frozen=True, eq=False)
class MergeSettings:
    """How scans are merged.

    Args:
        captures: Names of the captures, in the order in which they were captured.
        reference: The capture whose frame the merged cloud takes.
        out: PLY file. Without it the session stores the merge as merge/1 and so on, for mesh,
            compare, measure and export, and its file is in the session's exports.
        start: Initial alignment: features estimates it from the scans; turntable uses the angles of
            the turntable, and the markers of a mat on it where the scans show them; identity
            assumes that the scans are nearly aligned already; placed takes the places that `align`
            found; markers takes coded markers (`slviewer target markers:0-23:20`) that the scans
            show, which also hold what the shape leaves open; machine takes the poses of a robot, a
            CMM or a stage (`slviewer import poses`).
        fixed: Keep the scans where the machine has them, with --start machine; by default the
            surfaces refine their places. Either way their disagreement is reported.
        angle: Degrees that the turntable turns from each capture to the next, with --start
            turntable; by default as stored with the captures of `slviewer turn`.
        model: Which calibration to use; by default the best one available.
        roi: Region of interest, outside of which points are ignored: x0,x1,y0,y1,z0,z1 in mm in the
            camera's frame of each scan (x right, y down, z away), a TOML file, or off; by default
            the session's.
        accept_rejected: Use the calibration although its verdict rejects it.

    Python alone: ``picked``, for a pair (scan, onto), three or more points (n, 3) mm on either, in
    their cameras' frames, that these pairs start from. The static background is separated from the
    moving object and excluded from the surface.
    """

    UNRECORDED: ClassVar = ("out", "picked")
    captures: Sequence[str]
    reference: str
    out: Path | str | None = None
    model: ModelName | None = None
    start: StartKind = "features"
    angle: float | None = None
    fixed: bool = False
    roi: str = ""
    accept_rejected: bool = False
    picked: Picked | None = None

    def __post_init__(self) -> None:
        if len(self.names) < 2:
            raise UsageError(f"only {self.reference} was named", "name the scans to merge with it")
        if self.out is not None and Path(self.out).suffix.lower() != ".ply":
            raise UsageError(
                f"merged points are written as .ply, not as {Path(self.out).name}",
                "a mesh goes into other files too",
            )
        if self.angle is not None and self.start != "turntable":
            raise UsageError(
                "an angle from scan to scan is that of a turntable",
                "give --start turntable too, or neither",
            )
        if self.fixed and self.start != "machine":
            raise UsageError(
                "fixed places are those of a machine", "give --start machine too, or neither"
            )
        self.fit_picks()

    def fit_picks(self) -> dict[Pair, tuple[Candidate, np.ndarray]]:
        """Return what the picked points give for each pair, and how far they then are apart, mm."""
        picks = {}
        for (scan, onto), (there, here) in (self.picked or {}).items():
            if not {scan, onto} <= set(self.names):
                raise UsageError(
                    f"points were picked on {scan} and {onto}, which are not both among the scans"
                    " to merge"
                )
            picks[scan, onto] = fit_picked_start(there, here)
        return picks

    @property
    def names(self) -> list[str]:
        """The captures and the reference, each once."""
        return list(dict.fromkeys([*self.captures, self.reference]))


@operation("merge", Merge, MergeSettings)
def merge(job: Job, settings: MergeSettings) -> Iterator[Found[Merge]]:
    """Register scans to a reference scan, close their loops, and fuse them into one surface.

    Reports the uncertainty of each registered pair, how well loops close, and what was excluded,
    and why.
    """
    with merge_scans(job, settings) as merged:
        yield merged.found  # and its file appears once that is stored


@contextmanager
def merge_scans(job: Job, settings: MergeSettings) -> Iterator[MergedScans]:
    """Context manager: registered and fused scans, not stored yet; the file of the merge gets its
    place at the end."""
    job, store, names, warn = job.accepting(settings), job.store, settings.names, job.warn
    if settings.out is not None:
        Path(settings.out).parent.mkdir(parents=True, exist_ok=True)  # or it fails now

    # captures to clouds, and what their places are estimated from
    table_deg = _list_table_angles(store, settings)
    starts = _initial_alignments(job, settings, table_deg)
    places = _load_places(store, settings)
    if places:
        starts = replace(starts, poses={name: each.T for name, each in places.items()})
    check_calibration(job)
    restrictions = restriction_notes(store, names, resolve_region(store, settings.roi))
    inputs = restriction_inputs(store, names, with_region=not settings.roi)
    model, clouds = _read_clouds(job.part(0.0, 0.4), settings)
    if settings.start == "markers" or table_deg is not None:
        markers = {name: measure_markers(cloud) for name, cloud in clouds.items()}
        if table_deg is None:
            _check_markers(markers, warn)
        if table_deg is None or _is_mat(markers, table_deg, warn):
            starts = replace(starts, markers=markers)

    # clouds to places, without what did not move with the object
    registered, machine = _register(job, settings, clouds, starts, places)
    alignment = registered.alignment
    for why in _list_warnings(clouds, registered):
        warn(why)
    for each in machine:
        if not each.agrees or each.why:
            warn(each.text())
    clouds = dict(registered.clouds)

    # placed clouds to one surface
    progress = stage(job.progress, 0.75, 0.9, "fusing")
    fused = fuse(clouds, alignment.T_reference_scan, progress, alignment.uncertainties)

    # the surface to the file, which appears once the caller has stored the record
    job.progress(0.9, "writing")
    used = describe_calibration(store, model, fused.names)
    used["inputs"] |= inputs
    used["depths"] = list_outside_depths(store, clouds, warn)
    used |= {"restrictions": list(restrictions), "machine": machine}
    used["inputs"] |= place_inputs(store, list(places))
    record = _make_record(registered, fused, **used)
    with _write_merge(store, settings, fused, record) as found:
        yield MergedScans(alignment, fused, clouds, found)
    job.progress(1.0, "merged")


def _load_places(store: Session, settings: MergeSettings) -> dict[str, MachinePlace]:
    """Return the places of the scans by the machine; empty where the merge does not start from
    them."""
    if settings.start != "machine":
        return {}
    imported = all(store.load_capture(name).is_imported_cloud for name in settings.names)
    model = "" if imported else settings.model or preferred_model(store)
    return load_places(store, settings.names, model)


def _register(
    job: Job,
    settings: MergeSettings,
    clouds: Mapping[str, Cloud],
    starts: Starts,
    places: Mapping[str, MachinePlace],
) -> tuple[ObjectAlignment, list[PlacedByMachine]]:
    """Register the scans, and compare the result with the places that a machine has them in, which
    are kept where they are fixed."""
    reference = settings.reference
    given = {name: places[reference].relative(place) for name, place in places.items()}
    middles = {
        name: T[:3, :3] @ clouds[name].measured.mean(0) + T[:3, 3] for name, (T, _) in given.items()
    }
    fixed = {
        name: Uncertainty(at_point(covariance, middles[name]), middles[name])
        for name, (_, covariance) in given.items()
    }
    T_reference_scan = {name: T for name, (T, _) in given.items()}
    try:
        progress = stage(job.progress, 0.4, 0.75, "registering")
        registered = register_object(clouds, reference, starts, progress)
    except Refused as error:
        if not settings.fixed:
            raise
        nan = float("nan")
        pairs = {
            (name, reference): Registration(T, nan, nan, 0.0, nan, nan, nan, "initial", fixed[name])
            for name, T in T_reference_scan.items()
            if name != reference
        }
        alignment = MultiwayAlignment(reference, T_reference_scan, fixed, pairs, [], {}, {}, {})
        none = {name: np.zeros_like(cloud.mask) for name, cloud in clouds.items()}
        machine = [PlacedByMachine(name, True, why=str(error)) for name, _ in pairs]
        return ObjectAlignment(alignment, clouds, none, {}), machine
    found = registered.alignment.on_reference() if given else {}
    checks = {
        name: compare_place(given[name], each.T_reference_scan, each.uncertainty)
        for name, each in found.items()
    }
    machine = [PlacedByMachine(name, settings.fixed, **vars(each)) for name, each in checks.items()]
    if settings.fixed:
        alignment = replace(
            registered.alignment, T_reference_scan=T_reference_scan, uncertainties=fixed
        )
        registered = replace(registered, alignment=alignment)
    return registered, machine


def _read_clouds(job: Job, settings: MergeSettings) -> tuple[str, dict[str, Cloud]]:
    """Return the calibration's name, "" where all scans were imported, and the scans' clouds."""
    store, names, roi = job.store, settings.names, settings.roi
    model, clouds, region = "", dict[str, Cloud](), resolve_region(store, roi)
    if own := [n for n in names if not store.load_capture(n).is_imported_cloud]:
        fitted = load_model(store, settings.model)
        made = reconstruct_captures(job, fitted, own)
        clouds = {shot.name: restrict_cloud(store, shot.name, c, region) for shot, _, c in made}
        model = fitted.name
    found = {n: clouds[n] if n in own else scan_cloud(job, n, roi=roi) for n in names}
    if kept := dict.fromkeys(name for cloud in found.values() for name in cloud.scalars):
        job.warn(f"a merge holds no {', '.join(kept)}: export the scans for these")
    return model, found


@contextmanager
def _write_merge(
    store: Session, settings: MergeSettings, fused: Fused, record: Merge
) -> Iterator[Found[Merge]]:
    """Context manager: the record of a merge with its PLY, to be stored unless that has a place of
    its own, which it gets at the end."""
    surface, model = fused.surface, record.model
    scalars = {} if surface.sigma_mm is None else {"sigma": surface.sigma_mm}
    scalars |= {"seen_by": fused.seen_by, "source": fused.source}
    frame = f"{frame_of(store, model)}, at {settings.reference}"
    scans = f"scans {', '.join(settings.names)}, frame: {frame}"
    comments = (scans, f"calibration {model}", *record.restrictions)
    number = next_name(store, Merge) if settings.out is None else ""
    with placed_file(store, settings.out, f"merged_{number}.ply") as (path, written):
        write_ply(
            written, surface.points, surface.colours, surface.normals, scalars, notes=comments
        )
        r1, r2 = letter.EXPERIMENT_3_ICP_RMS_MM.values()
        notes = [
            f"(The Letter's three depths: point to point {r1:.2f} and {r2:.2f} mm.)",
            f"{record.points:,} points -> {path}",
        ]
        if number:
            notes.append(
                f"the session stores it as merge/{number}: mesh, compare and measure accept that"
                " name"
            )
        placed = msgspec.structs.replace(record, ply=path.name)
        yield Found(
            number or path.stem, placed, files=(path,), notes=tuple(notes), stored=bool(number)
        )


def _check_markers(measured: Mapping[str, MeasuredMarkers], warn: Warn) -> None:
    """Warn of coded markers that cannot be used; InputError where no two scans show the same
    one."""
    for note in marker_notes(measured):
        warn(note)
    numbers = [set(markers.ids.tolist()) for markers in measured.values()]
    if not any(one & other for i, one in enumerate(numbers) for other in numbers[:i]):
        counts = ", ".join(f"{name} {len(markers.ids)}" for name, markers in measured.items())
        raise InputError(
            f"no two scans show the same marker (measured: {counts})",
            "print some by `slviewer target markers:0-23:20`, put them on or beside the object so"
            " that neighbouring scans share three or more, and scan again; or start from features",
        )


def _is_mat(
    measured: Mapping[str, MeasuredMarkers], table_deg: Mapping[str, float], warn: Warn
) -> bool:
    """Whether the markers on the scans turn with the turntable, so that its axis follows from
    them."""
    compared = []
    for a, b in pairwise(name for name in measured if name in table_deg):
        with suppress(Refused):
            pose = fit_marker_pose(measured[a], measured[b])
            if pose is not None and len(pose.ids) >= MAT_MARKERS:
                turn_deg = abs(shortest_turn(table_deg[b] - table_deg[a]))
                compared.append(abs(float(np.degrees(rotation_angle(pose.T[:3, :3]))) - turn_deg))
    if compared and max(compared) > MAT_TURN_DEG:
        warn(
            f"coded markers are in view, and they turn by {max(compared):.1f} degrees more or less"
            " than the table: they are ignored; put them on the table, or check its angles"
        )
        return False
    return bool(compared)


def _list_warnings(clouds: Mapping[str, Cloud], registered: ObjectAlignment) -> Iterator[str]:
    """Yield warnings of markers that have moved, of pairs that were dropped, and of points that are
    not the object, or contradict another scan, with the remedy."""
    for (a, b), pose in registered.alignment.markers.items():
        if pose.moved:
            yield (
                f"{a} -> {b}: marker {', '.join(map(str, pose.moved))} has moved between the"
                " scans, and is ignored: glue it on, or take it away"
            )
    for (a, b), each in registered.alignment.pairs.items():
        if each.rival_mm is not None:
            yield rests_on_start(a, b, each.start, each.rival_mm)
    yield from registered.alignment.dropped.values()
    if still := {name: int(mask.sum()) for name, mask in registered.static.items() if mask.any()}:
        total = sum(int(clouds[name].mask.sum()) for name in still)
        counts = ", ".join(f"{count} of {name}" for name, count in still.items())
        yield (
            f"{100 * sum(still.values()) / total:.2g} % of the points ({counts}) stand still while"
            " the object moves: they are not part of the merge"
        )
    for (one, other), contradiction in registered.contradictions.items():
        if contradiction.share > MAX_CONTRADICTION_SHARE:
            yield (
                f"{one} -> {other}: {100 * contradiction.share:.2g} % of the points contradict,"
                f" they lie more than {contradiction.gate_mm:.2g} mm in front of what the other"
                " scan sees there: something moved alone or stands still; restrict the scans to"
                " the object, or scan again"
            )


def _make_record(registered: ObjectAlignment, fused: Fused, **origin: Any) -> Merge:
    """Return the record of a merge; ``origin``: its file, calibration, restrictions and inputs."""
    alignment = registered.alignment
    return Merge(
        reference=alignment.reference,
        scans=list(fused.names),
        pairs={
            scan: _make_registered(scan, alignment.reference, r)
            for scan, r in alignment.on_reference().items()
        },
        points=len(fused.surface),
        registered=[
            _make_registered(*pair, registration) for pair, registration in alignment.pairs.items()
        ],
        loops=alignment.loops,
        dropped=[RefusedPair(*pair, why) for pair, why in alignment.dropped.items()],
        refused=[RefusedPair(*pair, why) for pair, why in alignment.refused.items()],
        markers=[
            MarkerPair(*pair, list(pose.ids), list(pose.moved), pose.rms_mm)
            for pair, pose in alignment.markers.items()
        ],
        static_points={name: int(mask.sum()) for name, mask in registered.static.items()},
        contradictions=[
            ContradictingPair(*pair, each.share, each.compared, each.gate_mm)
            for pair, each in registered.contradictions.items()
        ],
        left_out={name: dict(counts) for name, counts in fused.excluded.items()},
        shared=fused.shared,
        **origin,
    )


def _make_registered(scan: str, onto: str, registration: Registration) -> Registered:
    """Return the figures of a registration."""
    uncertainty = registration.uncertainty
    same = ("rms_mm", "overlap", "agreement", "slack_mm", "gate_mm", "start", "rival_mm")
    return Registered(
        scan=scan,
        onto=onto,
        point_to_point_rms_mm=_known(registration.inlier_rmse_mm),
        sigma_shift_mm=uncertainty.shift_mm,
        sigma_turn_deg=uncertainty.turn_deg,
        middle=to_vector(uncertainty.centre),
        T_reference_scan=to_matrix(registration.T_reference_scan),
        **{name: _known(getattr(registration, name)) for name in same},
    )


def _known(value: Any) -> Any:
    """Return a figure, None for NaN: of a scan that no surface places."""
    return None if value != value else value


def _list_table_angles(store: Session, settings: MergeSettings) -> dict[str, float] | None:
    """Return the turntable's angle, deg, of each scan, of a single turn where they are stored with
    the captures; None where the merge does not start from them. Raises UsageError where they are
    not known."""
    names = settings.names
    if settings.start != "turntable":
        return None
    if settings.angle is not None:
        return {name: settings.angle * k for k, name in enumerate(names)}
    stored = {name: store.load_capture(name).turn_step for name in names}
    table_deg = {name: step.deg for name, step in stored.items() if step is not None}
    if missing := [name for name in names if name not in table_deg]:
        raise UsageError(
            f"no angle of a turntable is stored with {', '.join(missing)}",
            "give the angle from scan to scan, or start from features",
        )
    if len(turns := dict.fromkeys(step.turn for step in stored.values() if step is not None)) > 1:
        raise UsageError(
            f"the scans belong to several turns ({', '.join(turns)}), between which the object may"
            " have been moved",
            "start from features",
        )
    return table_deg


def _initial_alignments(
    job: Job, settings: MergeSettings, table_deg: Mapping[str, float] | None
) -> Starts:
    """Return the initial alignments for the requested start; raises for options that do not fit
    it."""
    names, poses = settings.names, None
    if settings.start == "placed":
        placed = load_placements(job.store)
        if missing := [name for name in names if name not in placed]:
            raise InputError(
                f"{' and '.join(missing)} were not aligned",
                "align them first, or start from features",
            )
        poses = {name: np.array(placed[name].T_first_scan) for name in names}
    elif settings.start == "identity":
        poses = dict.fromkeys(names, np.eye(4))
    picks = {}
    for (scan, onto), (pick, apart) in settings.fit_picks().items():
        picks[scan, onto] = pick
        job.warn(
            f"{scan} -> {onto}: the picked points come within {apart.max():.2f} mm of each other"
        )
    for base in {onto for _, onto in picks} if poses is None and table_deg is None else ():
        # pairs without picked points start there too
        others = [name for name in names if name != base]
        if all((name, base) in picks for name in others):
            poses = {base: np.eye(4)} | {name: picks[name, base].T for name in others}
    return Starts(poses, settings.start == "placed", table_deg, picks)


@dataclass(frozen=True, eq=False)
class AlignedScans:
    """What the aligned scans show together: points (n, 3) float32 mm in the frame of the first one,
    how many of the scans see each of them, (n,) uint8, and their unit normals (n, 3) float32, NaN
    where unknown. ``names``: the scans, in the order in which they were captured."""

    names: tuple[str, ...]
    points: Floats32
    seen_by: NDArray[np.uint8]
    normals: Floats32

    @property
    def share_seen_again(self) -> float:
        """Share of the points that more than one scan sees."""
        return float(np.mean(self.seen_by > 1)) if len(self.seen_by) else 0.0


@dataclass(frozen=True)
class AlignSettings:
    """Which scans are aligned.

    Args:
        captures: Names of the captures, in the order in which they were captured; by default all
            scans that are not in place yet.
        accept_rejected: Use the calibration although its verdict rejects it.

    ``only_reconstructed``: skip scans that were not reconstructed.
    """

    UNRECORDED: ClassVar = ("only_reconstructed",)
    captures: Sequence[str] = ()
    accept_rejected: bool = False
    only_reconstructed: bool = False


@operation("align", Placement, AlignSettings)
def align(job: Job, settings: AlignSettings) -> Iterator[Found[Placement]]:
    """Align scans one after the other, each to those before it, as the wizard does while they are
    captured.

    A scan that cannot be aligned is kept apart, with the reason. `merge` then starts from the
    places found.
    """
    store = job.store
    check_accepted(store, job.accept_rejected)
    names = list(settings.captures) or [
        name for name, each in list_placements(store).items() if each is None
    ]
    if settings.only_reconstructed:
        names = [name for name in names if store.state_of(f"clouds/{name}") == "fresh"]
    placed, clouds = load_placements(store), dict[str, Cloud]()
    for i, name in enumerate(names):
        job.progress(i / len(names), f"aligning {name}")
        placed.pop(name, None)
        found = _align_scan(job, name, placed, clouds)
        if found.T_first_scan is not None:
            placed[name] = found
        if i == len(names) - 1 and len(placed) > 1:
            found = msgspec.structs.replace(
                found, seen_again=view_places(placed, clouds, store).share_seen_again
            )
        yield Found(name, found)
    job.progress(1.0, "aligned")


def _align_scan(
    job: Job, name: str, placed: Mapping[str, Placement], clouds: dict[str, Cloud]
) -> Placement:
    """Align one scan to those in place; clouds that are reconstructed are added to ``clouds``.

    It is stale with the scan that it was aligned to, and with all that this was aligned by.
    """
    store, refusals = job.store, list[str]()
    cloud = _load_cloud(store, name, clouds, job.warn)
    inputs = describe_calibration(store, cloud.model, [name])["inputs"]
    if not placed:
        return Placement(T_first_scan=to_matrix(np.eye(4)), inputs=inputs)
    for onto in [*reversed(list(placed))][:MOST_TRIED]:
        pair = {onto: _load_cloud(store, onto, clouds, job.warn), name: cloud}
        try:
            registered = register_object(pair, onto).alignment.on_reference()[name]
        except (Refused, InputError) as error:
            refusals.append(str(error))
            continue
        T = to_matrix(np.array(placed[onto].T_first_scan) @ registered.T_reference_scan)
        return Placement(
            T_first_scan=T,
            onto=onto,
            rms_mm=registered.rms_mm,
            overlap=registered.overlap,
            inputs=placed[onto].inputs | inputs,
        )
    return Placement(why=refusals[0], inputs=inputs)


def list_placements(store: Session) -> dict[str, Placement | None]:
    """The placement of every scan of an object (no planes and spheres), in the order of capture;
    None where it has none, or one that a newer calibration or capture has outdated."""
    captures = sorted(store.captures("scan"), key=lambda each: str(each.meta.get("created", "")))
    return {
        each.name: store.decode_fresh(
            f"{PLACEMENTS}/{each.name}", lambda meta, _: read_record(Placement, meta), only=()
        )
        for each in captures
        if each.purpose == "scan"
    }


def load_placements(store: Session) -> dict[str, Placement]:
    """The placement of every scan that has its place, in the order in which they were captured."""
    return {
        name: each
        for name, each in list_placements(store).items()
        if each is not None and each.T_first_scan is not None
    }


def view_places(
    placed: Mapping[str, Placement], clouds: dict[str, Cloud], store: Session
) -> AlignedScans:
    """Scans in their places, thinned; ``clouds``: those that were loaded before."""
    trees, normals = [], [np.zeros((0, 3))]
    for name, each in placed.items():
        cloud = _load_cloud(store, name, clouds, ignore_warnings)
        step = max(1, np.count_nonzero(cloud.mask) // _SHOWN_POINTS)
        T = np.array(each.T_first_scan)
        trees.append(cKDTree(move_points(T, cloud.measured[::step])))
        normals.append(choose_pixels(cloud_normals(cloud), cloud.mask)[::step] @ T[:3, :3].T)
    spacing = [np.median(tree.query(tree.data[::20], k=2)[0][:, 1]) for tree in trees]
    reach = _REACH * max(spacing, default=0.0)
    counts = [np.zeros(0)]
    for tree in trees:
        near = [
            np.isfinite(other.query(tree.data, distance_upper_bound=reach, workers=-1)[0])
            for other in trees
            if other is not tree
        ]
        counts.append(np.sum([np.ones(tree.n), *near], axis=0))
    return AlignedScans(
        tuple(placed),
        np.concatenate([np.zeros((0, 3)), *(tree.data for tree in trees)]).astype(np.float32),
        np.concatenate(counts).astype(np.uint8),
        np.concatenate(normals).astype(np.float32),
    )


def _load_cloud(store: Session, name: str, clouds: dict[str, Cloud], warn: Warn) -> Cloud:
    """The cloud of a scan, of at most `_PIXELS` pixels, reconstructed where none is fresh."""
    if name not in clouds:
        cloud = scan_cloud(Job(store, warn=warn), name)
        step = max(1, int(np.ceil(np.sqrt(cloud.sigma_z.size / _PIXELS))))
        points, sigma_z = (each[::step, ::step] for each in (cloud.points, cloud.sigma_z))
        facing = None if cloud.normals is None else cloud.normals[::step, ::step]
        clouds[name] = Cloud(points, cloud.axis, cloud.model, sigma_z, normals=facing)
    return clouds[name]
