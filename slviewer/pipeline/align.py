"""Scans aligned one after the other while they are captured, each to those before it.

Each scan that could be aligned has a result ``placement/NAME``, which says where it is in the frame
of the first one; one that could not has the reason. A merge of all starts from there, and closes
the loops.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, move_points
from slviewer.pipeline.capture_clouds import scan_cloud
from slviewer.pipeline.feedback import Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.models import check_accepted
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.pipeline.stored_records import load_record
from slviewer.reconstruction.cloud import Cloud, choose_pixels
from slviewer.reconstruction.reconstruct import normals
from slviewer.records.merge import Placement
from slviewer.records.record import to_matrix
from slviewer.registration.refusal import Refused
from slviewer.registration.static_scene import register_object
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
    inputs = store.input_hashes(name, "calibration/stereo", f"calibration/{cloud.model}")
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


def list_placements(store: Session) -> dict[str, Placement | None]:
    """The placement of every scan of an object (no planes and spheres), in the order in which they
    were captured; None where it has none, or one that a newer calibration or capture has
    outdated."""
    captures = [
        capture
        for capture in store.captures("scan")
        if capture.meta.get("settings", {}).get("purpose", "scan") == "scan"
    ]
    captures.sort(key=lambda capture: str(capture.meta.get("created", "")))
    return {
        name: load_record(store, Placement, name)
        if store.state_of(f"{FOLDER}/{name}") == "fresh"
        else None
        for name in (capture.name for capture in captures)
    }


def load_placements(store: Session) -> dict[str, Placement]:
    """The placement of every scan that has its place, in the order in which they were captured."""
    return {
        name: each
        for name, each in list_placements(store).items()
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
    together, seen_by = _count_views(thinned.values())
    return AlignedScans(
        tuple(thinned), together, seen_by, np.nan_to_num(np.concatenate(facing)).astype(np.float32)
    )


def _count_views(scans: Iterable[Floats]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return all points (n, 3) mm of scans in one frame, and for each how many of the scans have a
    point near it."""
    trees = [cKDTree(points) for points in scans]
    spacing = [np.median(tree.query(tree.data[::20], k=2)[0][:, 1]) for tree in trees]
    reach = _REACH * max(spacing, default=0.0)
    points, counts = [np.zeros((0, 3))], [np.zeros(0)]
    for tree in trees:
        near = [
            np.isfinite(other.query(tree.data, distance_upper_bound=reach, workers=-1)[0])
            for other in trees
            if other is not tree
        ]
        points.append(tree.data)
        counts.append(np.sum([np.ones(tree.n), *near], axis=0))
    return np.concatenate(points).astype(np.float32), np.concatenate(counts).astype(np.uint8)


def _load_cloud(store: Session, name: str, clouds: dict[str, Cloud], warn: Warn) -> Cloud:
    """The cloud of a scan, of at most `_PIXELS` pixels: the saved one where it is fresh, else
    reconstructed."""
    if name not in clouds:
        cloud = scan_cloud(store, name, None, ignore_progress, warn)
        step = max(1, int(np.ceil(np.sqrt(cloud.sigma_z.size / _PIXELS))))
        points, sigma_z = cloud.points[::step, ::step], cloud.sigma_z[::step, ::step]
        clouds[name] = Cloud(points, cloud.axis, cloud.model, sigma_z)
    return clouds[name]
