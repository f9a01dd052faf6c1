"""Scans aligned one after the other while they are captured, each to those before it.

Each scan that could be aligned has a result ``placement/NAME``, which says where it is in the frame
of the first one; one that could not has the reason. A merge of all starts from there, and closes
the loops.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, move_points
from slviewer.pipeline.capture_clouds import capture_cloud, check_capture_sizes
from slviewer.pipeline.capture_phases import decode_captures
from slviewer.pipeline.feedback import Warn, ignore_warnings
from slviewer.pipeline.models import check_accepted, load_model, preferred_model
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.pipeline.scan_edits import restrict_cloud
from slviewer.pipeline.stored_records import load_record
from slviewer.reconstruction.cloud import Cloud, choose_pixels
from slviewer.reconstruction.reconstruct import normals
from slviewer.records.merge import Placement
from slviewer.records.record import to_matrix
from slviewer.registration.refusal import Refused
from slviewer.registration.static_scene import register_object
from slviewer.session.scan_edits import load_region
from slviewer.session.store import Session

FOLDER = Placement.kind
MOST_TRIED = 3
"""Scans that a new one is aligned to at most: the latest, then those before it."""
_PIXELS = 130_000
"""Of a scan that is aligned: rows and columns of larger ones are skipped."""
_SHOWN_POINTS = 25_000  # of a scan
_REACH = 2.5  # spacings of the shown points


@dataclass(frozen=True, eq=False)
class AlignedScans:
    """What the aligned scans show together: points (n, 3) float32 mm in the frame of the first one,
    and how many of the scans see each of them, (n,) uint8. ``facing`` (n,) float32: cosine of the
    angle between the surface's normal and the view of its scan. ``names``: the scans, in the order
    in which they were captured."""

    names: tuple[str, ...]
    points: NDArray[np.float32]
    seen_by: NDArray[np.uint8]
    facing: NDArray[np.float32]

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
    check_accepted(store, settings.accept_rejected)
    names = list(settings.captures) or [
        name for name in list_scans(store) if load_placement(store, name) is None
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
    inputs = store.input_hashes(
        name, *dict.fromkeys(("calibration/stereo", f"calibration/{cloud.model}"))
    )
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


def remove_placement(store: Session, name: str) -> None:
    """Move the placement of a scan to the trash: it is no longer shown with the others, and can be
    aligned again."""
    if store.has_result(f"{FOLDER}/{name}"):
        store.trash_result(f"{FOLDER}/{name}")


def list_scans(store: Session) -> list[str]:
    """Names of the captures of objects, in the order in which they were captured; no planes and
    spheres."""
    scans = [
        c
        for c in store.captures("scan")
        if c.meta.get("settings", {}).get("purpose", "scan") == "scan"
    ]
    return [scan.name for scan in sorted(scans, key=lambda scan: str(scan.meta.get("created", "")))]


def load_placement(store: Session, name: str) -> Placement | None:
    """The placement of a scan; None where it has none, or one that a newer calibration or capture
    has outdated."""
    fresh = store.state_of(f"{FOLDER}/{name}") == "fresh"
    return load_record(store, Placement, name) if fresh else None


def load_placements(store: Session) -> dict[str, Placement]:
    """The placement of every scan that has its place, in the order in which they were captured."""
    placements = {name: load_placement(store, name) for name in list_scans(store)}
    return {
        name: each
        for name, each in placements.items()
        if each is not None and each.T_first_scan is not None
    }


def load_places(store: Session) -> dict[str, Floats]:
    """T_first_scan (4, 4) of every scan in place, in the order in which they were captured."""
    return {name: np.array(each.T_first_scan) for name, each in load_placements(store).items()}


def view_aligned(store: Session) -> AlignedScans:
    """The scans in place, thinned, with the number of scans that see each point."""
    return view_places(load_placements(store), {}, store)


def view_places(
    placed: Mapping[str, Placement], clouds: dict[str, Cloud], store: Session
) -> AlignedScans:
    """Scans in their places, thinned, with the number of scans that see each point; ``clouds``:
    those that were loaded before."""
    thinned, facing = {}, [np.zeros(0)]
    for name, each in placed.items():
        cloud = _load_cloud(store, name, clouds, ignore_warnings)
        points, directions = cloud.measured, choose_pixels(normals(cloud.points), cloud.mask)
        step = max(1, len(points) // _SHOWN_POINTS)
        points, directions = points[::step], directions[::step]
        thinned[name] = move_points(np.array(each.T_first_scan), points)
        facing.append(-np.sum(points * directions, axis=1) / np.linalg.norm(points, axis=1))
    together, seen_by = count_views(thinned)
    return AlignedScans(
        tuple(thinned), together, seen_by, np.nan_to_num(np.concatenate(facing)).astype(np.float32)
    )


def count_views(scans: Mapping[str, Floats]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return all points (n, 3) mm of scans in one frame, and for each how many of the scans have a
    point near it."""
    trees = {name: cKDTree(points) for name, points in scans.items()}
    spacing = [np.median(tree.query(tree.data[::20], k=2)[0][:, 1]) for tree in trees.values()]
    reach = _REACH * max(spacing, default=0.0)
    counts = []
    for name in trees:
        seen = np.ones(trees[name].n, np.uint8)
        for other in trees.keys() - {name}:
            seen += np.isfinite(
                trees[other].query(trees[name].data, distance_upper_bound=reach, workers=-1)[0]
            )
        counts.append(seen)
    points = [tree.data for tree in trees.values()]
    return (
        np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32),
        np.concatenate([np.zeros(0, np.uint8), *counts]),
    )


def _load_cloud(store: Session, name: str, clouds: dict[str, Cloud], warn: Warn) -> Cloud:
    """The cloud of a scan, of at most `_PIXELS` pixels: the saved one where it is fresh, else
    reconstructed."""
    if name not in clouds:
        if store.state_of(f"clouds/{name}") == "fresh":
            meta, arrays = store.load_result(f"clouds/{name}", only=("points", "sigma_z"))
            cloud = Cloud(arrays["points"], meta["axis"], meta["model"], arrays["sigma_z"])
        else:
            check_capture_sizes(store, [name])
            model = load_model(store, preferred_model(store))
            ((shot, _, phases),) = decode_captures(store, [name], warn)
            cloud = capture_cloud(store, model, shot, phases, warn=warn)
        cloud = restrict_cloud(store, name, cloud, load_region(store))
        step = max(1, int(np.ceil(np.sqrt(cloud.sigma_z.size / _PIXELS))))
        clouds[name] = replace(
            cloud,
            points=cloud.points[::step, ::step],
            sigma_z=cloud.sigma_z[::step, ::step],
            texture=None,
            sigma_calibration=None,
            sigma_edges=None,
        )
    return clouds[name]
