"""Several calibrated rigs round one part in one frame: by a board, spheres or a part that all see
at once."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.geometry.rigid import Floats
from slviewer.inputs import RADIUS
from slviewer.operations.hand_eye import measure_boards
from slviewer.pipeline.export import export
from slviewer.pipeline.import_cloud import import_cloud
from slviewer.pipeline.imported_calibration import check_calibration
from slviewer.pipeline.models import available_models, frame_of, load_model, preferred_model
from slviewer.pipeline.operation import (
    Found,
    Job,
    list_records,
    match_names,
    opened_to_save,
    operation,
    save_record,
)
from slviewer.pipeline.reconstruct import scan_cloud
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.machine import MachinePose, RigPlace, RigRelation
from slviewer.records.record import to_matrix, to_vector
from slviewer.registration.rig_places import (
    RigFit,
    Sighting,
    find_spheres,
    fit_rig,
    place_of_scan,
    sight_board,
    sight_spheres,
)
from slviewer.registration.static_scene import register_object
from slviewer.session.store import Session

RelatedBy = Literal["board", "spheres", "part"]


@dataclass(frozen=True)
class RelateRigsSettings:
    """Which rigs, and by what they are related.

    Args:
        others: Session folders of the other rigs, each calibrated.
        captures: Names, or patterns such as 'shared_*', of captures that every session has under
            the same name, taken while the object was in one place; two or more check each other.
        by: What they show: the calibration's board, three or more spheres, or a part whose surface
            overlaps in both views.
        radius: Nominal radius of the spheres, with --by spheres.
        scans: Names, or patterns, of scans of the other sessions to take into this one, as
            RIG_NAME, for `merge --start machine`.
        accept_rejected: Use calibrations although their verdict rejects them.
    """

    others: Sequence[Path | str]
    UNRECORDED: ClassVar = ("scans",)
    captures: Sequence[str] = ()
    by: RelatedBy = "board"
    radius: Annotated[float | None, RADIUS] = None
    scans: Sequence[str] = ()
    accept_rejected: bool = False

    def __post_init__(self) -> None:
        names = [Path(each).name for each in self.others]
        if not names or len(set(names)) < len(names):
            raise UsageError("name the sessions of the other rigs, whose folders differ by name")
        if not self.captures:
            raise UsageError(
                "no captures named",
                "give by --captures those that all rigs took of the object in one place",
            )
        if (self.by == "spheres") != (self.radius is not None):
            raise UsageError("--radius belongs to --by spheres", "give both, or neither")


@operation("relate-rigs", RigRelation, RelateRigsSettings)
def relate_rigs(job: Job, settings: RelateRigsSettings) -> Iterator[Found[RigRelation]]:
    """Put several rigs into the frame of this session's, with the uncertainty of each place.

    Their scans are taken into this session on demand, where `merge` places them.
    """
    store = job.store
    names = match_names(store.capture_names(), settings.captures, "capture", InputError)
    own, symmetry = _measure(job.part(0.0, 0.3), settings, names)
    rigs, poses = dict[str, RigPlace](), dict[str, MachinePose]()
    scans = dict[str, list[str]]()
    for k, folder in enumerate(settings.others):
        begin, end = (0.3 + 0.7 * j / len(settings.others) for j in (k, k + 1))
        with opened_to_save(folder, job.warn) as other:
            rig = other.folder.name
            if missing := [name for name in names if name not in other.capture_names()]:
                raise InputError(
                    f"{rig} has no capture called {', '.join(missing)}",
                    "every rig must have taken each of --captures, under the same name",
                )
            there = replace(job.part(begin, end, rig), store=other)
            seen, symmetry = _measure(there, settings, names)
            both = [name for name in names if name in own and name in seen]
            if not both:
                raise InputError(
                    f"no capture shows the {settings.by} to both {store.folder.name} and {rig}",
                    "see that it is wholly in view of both, and calibrated with the same board",
                )
            sightings = [_sight(name, own[name], seen[name], symmetry) for name in both]
            fit = fit_rig(sightings)
            rigs[rig] = _make_place(other, settings, both, fit)
            scans[rig] = _take_scans(job, other, settings.scans)
            poses |= dict.fromkeys(scans[rig], _make_pose(rig, fit.T, fit))
    record = RigRelation(
        by=settings.by,
        rigs=rigs,
        scans={rig: each for rig, each in scans.items() if each},
        inputs=store.input_hashes(*names),
    )
    yield Found("", record)
    if poses and store.is_writable:
        placed = {each.name for each in list_records(store, MachinePose)} | poses.keys()
        free = [name for name in store.capture_names("scan") if name not in placed]
        for name, pose in (poses | dict.fromkeys(free, _make_pose("this rig", np.eye(4)))).items():
            inputs = store.input_hashes(name)
            save_record(store, name, msgspec.structs.replace(pose, inputs=inputs), {})


Seen = tuple[Floats, Floats] | Cloud
"""A board's T_camera_board (4, 4) mm and covariance (6, 6), spheres' centres (k, 3) mm and standard
deviations (k,), or the cloud of a part."""


def _measure(
    job: Job, settings: RelateRigsSettings, names: Sequence[str]
) -> tuple[Mapping[str, Seen], int]:
    """Return what a rig measures of each capture, and in how many orientations the board looks the
    same."""
    job = job.accepting(settings)
    check_calibration(job)
    if settings.by == "board":
        boards, skipped, symmetry = measure_boards(job, load_model(job.store, None), names)
        for name, why in skipped.items():
            job.warn(f"{job.store.folder.name}: {name} is skipped: {why}")
        return boards, symmetry
    clouds = {name: scan_cloud(job, name) for name in names}
    if settings.radius is None:
        return clouds, 1
    found = dict[str, Seen]()
    for name, cloud in clouds.items():
        sigma_mm = float(np.nanmedian(cloud.sigma_z[cloud.mask]))
        found[name] = find_spheres(cloud.measured, settings.radius, sigma_mm)
    return found, 1


def _sight(name: str, own: Seen, other: Seen, symmetry: int) -> Sighting:
    """Return where the other rig is by a capture of both. Raises InputError or Refused."""
    if isinstance(own, Cloud) and isinstance(other, Cloud):
        clouds = {"reference": own, "rig": other}
        found = register_object(clouds, "reference").alignment.on_reference()["rig"]
        pose = found.uncertainty
        return Sighting(name, found.T_reference_scan, pose.covariance, np.asarray(pose.centre))
    assert isinstance(own, tuple) and isinstance(other, tuple)
    if own[0].shape[1] == 3:
        return sight_spheres(name, own, other)
    return sight_board(name, own, other, symmetry)


def _make_place(
    other: Session, settings: RelateRigsSettings, names: Sequence[str], fit: RigFit
) -> RigPlace:
    """Return the figures of a rig's place."""
    turns, shifts = np.linalg.norm(fit.residuals.reshape(-1, 2, 3), axis=2).T
    model = preferred_model(other) if available_models(other) else ""
    return RigPlace(
        session=str(other.folder),
        model=model,
        frame=frame_of(other, model),
        T_reference_rig=to_matrix(fit.T),
        covariance=fit.covariance.tolist(),
        middle=to_vector(fit.middle),
        U_mm=fit.U_mm,
        U_deg=fit.U_deg,
        ratio=fit.ratio,
        shift_mm=dict(zip(names, shifts.tolist(), strict=True)),
        turn_deg=dict(zip(names, np.degrees(turns).tolist(), strict=True)),
    )


def _take_scans(job: Job, other: Session, patterns: Sequence[str]) -> list[str]:
    """Import scans of another session, with normals and sigmas, and return their names here."""
    if not patterns:
        return []
    names = match_names(other.capture_names("scan"), patterns, "scan", InputError)
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{other.folder.name}_{name}.ply" for name in names]
        for name, file in zip(names, files, strict=True):
            export(
                other, "cloud", name, out=file, warn=job.warn, accept_rejected=job.accept_rejected
            )
        return list(import_cloud(job.store, files, unit="mm", force=True))


def _make_pose(rig: str, T: Floats, fit: RigFit | None = None) -> MachinePose:
    """Return where the scans of a rig are; without ``fit`` they are in this session's own frame."""
    covariance = 1e-12 * np.eye(6) if fit is None else place_of_scan(T, fit.covariance, fit.middle)
    return MachinePose(
        operation="relate-rigs",
        T_base_machine=to_matrix(T),
        covariance=covariance.tolist(),
        of="scan",
        sigma_mm=float(np.sqrt(covariance[3, 3])),
        sigma_deg=float(np.degrees(np.sqrt(covariance[0, 0]))),
        file=rig,
        convention="relate-rigs",
    )
