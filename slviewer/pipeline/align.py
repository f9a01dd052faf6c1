"""Scans aligned one after the other while they are captured, each to those before it.

Each scan that could be aligned has a result ``placement/NAME``, which says where it is in the frame of the first one;
one that could not has the reason. A merge of all starts from there, and closes the loops.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, move_points
from slviewer.pipeline.capture_clouds import capture_cloud, check_capture_sizes
from slviewer.pipeline.capture_phases import decode_captures
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.models import check_accepted, load_model, preferred_model
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.pipeline.scan_edits import restrict_cloud
from slviewer.reconstruction.cloud import Cloud, choose_pixels
from slviewer.reconstruction.reconstruct import normals
from slviewer.registration.refusal import Refused
from slviewer.registration.static_scene import register_object
from slviewer.session.scan_edits import load_region
from slviewer.session.store import Session

FOLDER = "placement"
MOST_TRIED = 3
"""Scans that a new one is aligned to at most: the latest, then those before it."""
_PIXELS = 130_000
"""Of a scan that is aligned: rows and columns of larger ones are skipped."""
_SHOWN_POINTS = 25_000  # of a scan
_REACH = 2.5  # spacings of the shown points


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a scan is: ``T_first_scan`` (4, 4) maps its points, mm, into the frame of the first aligned scan; None
    where it could not be aligned, with the reason ``why``. ``onto``: the scan that it was aligned to, empty for the
    first, with the ``rms_mm`` of the distances along the normal, and the share ``overlap`` of its points."""

    scan: str
    T_first_scan: Floats | None
    onto: str = ""
    rms_mm: float | None = None
    overlap: float | None = None
    why: str = ""

    def text(self) -> str:
        """The placement in one sentence."""
        if self.T_first_scan is None:
            return f"{self.scan} is kept apart: {self.why}"
        if not self.onto:
            return f"{self.scan} is the first scan: others are aligned to it"
        assert self.rms_mm is not None and self.overlap is not None
        return f"{self.scan} -> {self.onto}: RMS {self.rms_mm:.3f} mm, overlap {100 * self.overlap:.0f} %"


@dataclass(frozen=True, eq=False)
class AlignedScans:
    """What the aligned scans show together: points (n, 3) float32 mm in the frame of the first one, and how many of
    the scans see each of them, (n,) uint8. ``facing`` (n,) float32: cosine of the angle between the surface's normal
    and the view of its scan. ``names``: the scans, in the order in which they were captured."""

    names: tuple[str, ...]
    points: NDArray[np.float32]
    seen_by: NDArray[np.uint8]
    facing: NDArray[np.float32]

    @property
    def share_seen_again(self) -> float:
        """Share of the points that more than one scan sees."""
        return float(np.mean(self.seen_by > 1)) if len(self.seen_by) else 0.0


@dataclass(frozen=True, eq=False)
class AlignReport:
    """The placements of the scans that were aligned, and what they show together."""

    placements: tuple[Placement, ...]
    aligned: AlignedScans

    def text(self) -> str:
        """A line a scan, and what is seen more than once."""
        lines = [placement.text() for placement in self.placements]
        if len(self.aligned.names) > 1:
            lines.append(
                f"{len(self.aligned.names)} scans are in place; {100 * self.aligned.share_seen_again:.0f} % of the "
                "surface is seen by more than one"
            )
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """The contract of ``align --json``."""
        return {
            "placements": {placement.scan: _to_meta(placement) for placement in self.placements},
            "seen_again": self.aligned.share_seen_again,
        }


def align(
    session: SessionLike,
    captures: Sequence[str] = (),
    *,
    accept_rejected: bool = False,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> AlignReport:
    """Align scans one after the other, each to those before it, as the wizard does while they are captured.

    A scan that cannot be aligned is kept apart, with the reason. `merge` then starts from the places found.

    Args:
        session: Session folder.
        captures: Names of the captures, in the order in which they were captured; by default all scans that are not in
            place yet.
        accept_rejected: Use the calibration although its verdict rejects it.

    Raises InputError where a capture does not belong to the calibration, and what `progress` raises.
    """
    with opened(session, write=True) as store:
        check_accepted(store, accept_rejected)
        names = list(captures) or [name for name in list_scans(store) if load_placement(store, name) is None]
        placements, clouds = [], dict[str, Cloud]()
        for i, name in enumerate(names):
            progress(i / len(names), f"aligning {name}")
            placements.append(align_scan(store, name, clouds=clouds, warn=warn))
        report = AlignReport(tuple(placements), view_aligned(store, clouds))
    progress(1.0, "aligned")
    return report


def align_scan(
    store: Session, name: str, *, clouds: dict[str, Cloud] | None = None, warn: Warn = ignore_warnings
) -> Placement:
    """Align one scan to those in place, and save its placement.

    ``clouds``: those that were reconstructed before, by name, to which others are added.
    """
    clouds = {} if clouds is None else clouds
    before = {other: T for other, T in load_places(store).items() if other != name}
    placement = Placement(name, np.eye(4)) if not before else None
    cloud = _load_cloud(store, name, clouds, warn)
    refusals: list[str] = []
    for onto in [*reversed(before)][:MOST_TRIED]:
        pair = {onto: _load_cloud(store, onto, clouds, warn), name: cloud}
        try:
            registered = register_object(pair, onto).alignment.on_reference()[name]
        except (Refused, InputError) as error:
            refusals.append(str(error))
            continue
        T = before[onto] @ registered.T_reference_scan
        placement = Placement(name, T, onto, registered.rms_mm, registered.overlap)
        break
    placement = placement or Placement(name, None, why=refusals[0])
    inputs = store.input_hashes(name, *dict.fromkeys(("calibration/stereo", f"calibration/{cloud.model}")))
    store.save_result(f"{FOLDER}/{name}", {**_to_meta(placement), "inputs": inputs}, {})
    return placement


def remove_placement(store: Session, name: str) -> None:
    """Move the placement of a scan to the trash: it is no longer shown with the others, and can be aligned again."""
    if store.has_result(f"{FOLDER}/{name}"):
        store.trash_result(f"{FOLDER}/{name}")


def list_scans(store: Session) -> list[str]:
    """Names of the captures of objects, in the order in which they were captured; no planes and spheres."""
    scans = [c for c in store.captures("scan") if c.meta.get("settings", {}).get("purpose", "scan") == "scan"]
    return [scan.name for scan in sorted(scans, key=lambda scan: str(scan.meta.get("created", "")))]


def load_placement(store: Session, name: str) -> Placement | None:
    """The placement of a scan; None where it has none, or one that a newer calibration or capture has outdated."""
    result = f"{FOLDER}/{name}"
    if store.state_of(result) != "fresh":
        return None
    return read_placement(name, store.load_result(result, only=())[0])


def read_placement(name: str, meta: Mapping[str, Any]) -> Placement:
    """The placement of a scan from the ``meta`` of its result."""
    T = meta.get("T_first_scan")
    figures = meta.get("onto", ""), meta.get("rms_mm"), meta.get("overlap"), meta.get("why", "")
    return Placement(name, None if T is None else np.array(T, dtype=np.float64), *figures)


def load_places(store: Session) -> dict[str, Floats]:
    """T_first_scan (4, 4) of every scan in place, in the order in which they were captured."""
    placements = (load_placement(store, name) for name in list_scans(store))
    return {p.scan: p.T_first_scan for p in placements if p is not None and p.T_first_scan is not None}


def view_aligned(store: Session, clouds: dict[str, Cloud] | None = None) -> AlignedScans:
    """The scans in place, thinned, with the number of scans that see each point. ``clouds`` as for `align_scan`."""
    clouds = {} if clouds is None else clouds
    thinned, facing = {}, [np.zeros(0)]
    for name, T in load_places(store).items():
        cloud = _load_cloud(store, name, clouds, ignore_warnings)
        points, directions = cloud.measured, choose_pixels(normals(cloud.points), cloud.mask)
        step = max(1, len(points) // _SHOWN_POINTS)
        points, directions = points[::step], directions[::step]
        thinned[name] = move_points(T, points)
        facing.append(-np.sum(points * directions, axis=1) / np.linalg.norm(points, axis=1))
    together, seen_by = count_views(thinned)
    return AlignedScans(tuple(thinned), together, seen_by, np.nan_to_num(np.concatenate(facing)).astype(np.float32))


def count_views(scans: Mapping[str, Floats]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return all points (n, 3) mm of scans in one frame, and for each how many of the scans have a point near it."""
    trees = {name: cKDTree(points) for name, points in scans.items()}
    spacing = [np.median(tree.query(tree.data[::20], k=2)[0][:, 1]) for tree in trees.values()]
    reach = _REACH * max(spacing, default=0.0)
    counts = []
    for name in trees:
        seen = np.ones(trees[name].n, np.uint8)
        for other in trees.keys() - {name}:
            seen += np.isfinite(trees[other].query(trees[name].data, distance_upper_bound=reach, workers=-1)[0])
        counts.append(seen)
    points = [tree.data for tree in trees.values()]
    return (
        np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32),
        np.concatenate([np.zeros(0, np.uint8), *counts]),
    )


def _load_cloud(store: Session, name: str, clouds: dict[str, Cloud], warn: Warn) -> Cloud:
    """The cloud of a scan, of at most `_PIXELS` pixels: the saved one where it is fresh, else reconstructed."""
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


def _to_meta(placement: Placement) -> dict[str, Any]:
    """Return a placement as plain values."""
    T = placement.T_first_scan
    return {
        "T_first_scan": None if T is None else T.tolist(),
        "onto": placement.onto,
        "rms_mm": placement.rms_mm,
        "overlap": placement.overlap,
        "why": placement.why,
    }
