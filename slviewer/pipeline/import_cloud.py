"""Bringing clouds and meshes that other scanners made into a session, as scans that were never
captured: they have no frames, and need no calibration."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from slviewer.errors import InputError, SlviewerError, UsageError
from slviewer.fringe.sequence import PatternSequence
from slviewer.geometry.vectors import box_middle, diagonal
from slviewer.inputs import Input
from slviewer.pipeline.operation import (
    Callbacks,
    Findings,
    SessionLike,
    list_records,
    opened_or_made,
    save_record,
    takes_settings,
)
from slviewer.records.merge import ImportedPoints, Reconstruction
from slviewer.session.capture import NewCapture
from slviewer.session.importers.clouds import ReadCloud, read_cloud, unit_warning
from slviewer.session.reading import expand_user
from slviewer.session.results import digest_bytes
from slviewer.session.store import Session
from slviewer.session.units import Units, find_origin
from slviewer.surface.unorganised import estimate_normals, estimate_point_noise

_ROW = 1024
"""Points in a row of the arrays, in which neighbours mean nothing."""


@dataclass(frozen=True)
class ImportCloudSettings(Callbacks):
    """Which files are imported, and as what.

    Args:
        session: Session folder; made if it does not exist.
        files: PLY, XYZ (.txt, .asc, .pts and .csv too: x y z a line, then normals and colours, if
            any), PCD, E57, LAS, LAZ, MAT, STL, OBJ, OFF, STEP or 3MF. Each becomes a scan of the
            file's name; an E57 one for each of its scans.
        unit: What the numbers in the files are; by default what their comments or columns state,
            else mm, in E57 and LAS m. STEP and 3MF state theirs.
        sigma_um: Standard deviation of a point along the surface's normal, um; by default what the
            file states, else an estimate from the points and their neighbours.
        force: Replace scans of the same name (the old ones go to the session's trash).
    """

    session: SessionLike
    files: Sequence[Path | str]
    _: KW_ONLY
    unit: Units | None = None
    sigma_um: Annotated[float | None, Input(0.001, 1e6, "µm")] = None
    force: bool = False

    def __post_init__(self) -> None:
        if not self.files:
            raise UsageError("no file named", "give one or more clouds to import")


@takes_settings(ImportCloudSettings)
def import_cloud(settings: ImportCloudSettings) -> Findings[Reconstruction]:
    """Import clouds and meshes of other scanners as scans, to align, merge, measure and compare.

    Returns the record of each by its name. Files that cannot be used are skipped with a warning;
    raises InputError where none is left.
    """
    made, faults, warn = dict[str, Reconstruction](), list[str](), settings.warn
    with opened_or_made(settings.session) as store:
        for i, file in enumerate(settings.files):
            settings.progress(i / len(settings.files), f"reading {Path(file).name}")
            try:
                for capture, record, arrays in _make_scans(store, file, settings):
                    if capture.name in made:
                        raise InputError(
                            f"two files give a scan {capture.name!r}", f"rename {file}"
                        )
                    store.save_captures([capture], "scan", force=settings.force)
                    inputs = store.input_hashes(capture.name)
                    made[capture.name] = msgspec.structs.replace(record, inputs=inputs)
                    save_record(store, capture.name, made[capture.name], arrays)
            except SlviewerError as error:
                faults.append(str(error))
        if not made:
            raise InputError("; ".join(faults))
    for fault in faults:
        warn(f"not imported: {fault}")
    settings.progress(1.0, "imported")
    return Findings(Reconstruction, made)


def _make_scans(
    store: Session, file: Path | str, settings: ImportCloudSettings
) -> Iterator[tuple[NewCapture, Reconstruction, dict[str, np.ndarray]]]:
    """Yield the captures of a file, with the record and the arrays of their points."""
    path = expand_user(file)
    content, clouds = read_cloud(path, settings.unit)
    for k, cloud in enumerate(clouds, 1):
        cloud, origin = _subtract_origin(store, cloud)
        name = re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem) + (f"_{k}" if len(clouds) > 1 else "")
        if note := unit_warning(name, cloud.points, cloud.unit):
            settings.warn(note)
        normals, whence = _find_normals(cloud, is_far=origin is not None)
        sigma, stated = _find_sigma(cloud, settings.sigma_um)
        columns: dict[str, Any] = {"points": cloud.points, "normals": normals, "sigma_z": sigma}
        arrays = {key: _to_rows(values.astype(np.float32)) for key, values in columns.items()}
        if cloud.colours is not None:
            arrays["texture"] = _to_rows(cloud.colours)
        if scalars := [*cloud.scalars.values()]:
            kind = np.result_type(np.float32, *scalars)
            arrays["scalars"] = _to_rows(np.stack(scalars, axis=-1, dtype=kind))
        digest = digest_bytes(b"".join(each.tobytes() for each in arrays.values())).hex()
        capture = NewCapture(
            name,
            PatternSequence(None, ()),
            np.zeros((0, *arrays["sigma_z"].shape), np.uint8),
            source=str(path),
            settings={"cloud": digest},
        )
        record = Reconstruction(
            operation="import-cloud",
            settings={"files": [str(path)], "unit": cloud.unit, "sigma_um": settings.sigma_um},
            axis="",
            points=len(cloud.points),
            noise_mm=float(np.median(sigma)),
            frame=f"of the file {path.name}" + (" less its origin" if origin else ""),
            imported=ImportedPoints(
                path.name,
                content,
                cloud.unit,
                whence,
                stated,
                cloud.notes,
                tuple(cloud.scalars),
                origin,
            ),
        )
        yield capture, record, arrays


def _subtract_origin(
    store: Session, cloud: ReadCloud
) -> tuple[ReadCloud, tuple[float, float, float] | None]:
    """Return a cloud less an origin where it is so far that float32 would round it, and that
    origin, mm: one of the session's other clouds where it serves, so that they keep their place to
    each other."""
    origin, notes = find_origin(cloud.points), cloud.notes
    imported = (each.record.imported for each in list_records(store, Reconstruction))
    known = dict.fromkeys(each.origin_mm for each in imported if each and each.origin_mm)
    near = (
        []
        if origin is None
        else (each for each in known if find_origin(cloud.points - each) is None)
    )
    shared = next(iter(near), None)
    if known and shared is None:
        notes += ("far from other clouds of the session: its place to them is not kept",)
    if origin is None:
        return replace(cloud, notes=notes), None
    origin = shared or origin
    sensor = None if cloud.sensor is None else cloud.sensor - origin
    return replace(cloud, points=cloud.points - origin, sensor=sensor, notes=notes), origin


def _find_normals(cloud: ReadCloud, is_far: bool) -> tuple[np.ndarray, str]:
    """Return the normals (n, 3) of a cloud, and what they rest on; ``is_far``: an origin was
    subtracted, in which no scanner stood."""
    if cloud.normals is not None:
        return cloud.normals, "normals as in the file"
    sensor, where = cloud.sensor, "the place of the scanner that the file states"
    if (
        sensor is None
        and not is_far
        and np.linalg.norm(box_middle(cloud.points)) > diagonal(cloud.points)
    ):
        sensor, where = np.zeros(3), "the origin, from where the scanner is taken to have looked"
    normals, is_seen = estimate_normals(cloud.points, sensor)
    where = where if is_seen else "the outside, as no place is known that all points are seen from"
    return normals, f"normals estimated, towards {where}"


def _find_sigma(cloud: ReadCloud, sigma_um: float | None) -> tuple[np.ndarray, str]:
    """Return the standard deviation (n,) mm of each point, and what it rests on."""
    if sigma_um is None and cloud.sigma_mm is not None:
        return cloud.sigma_mm, "sigma as in the file"
    stated = "sigma as given"
    if sigma_um is None:
        sigma_um = 1000 * estimate_point_noise(cloud.points)
        stated = (
            "sigma estimated from the points' distances from smooth surfaces through their"
            " neighbours, without errors that these share"
        )
    return np.full(len(cloud.points), sigma_um / 1000), f"{stated}, {sigma_um:.3g} um"


def _to_rows(values: np.ndarray) -> np.ndarray:
    """Return values (n, ...) in rows (h, w, ...); the last is filled up with NaN, or 0."""
    width = min(_ROW, len(values))
    shape = -(-len(values) // width), width, *values.shape[1:]
    filled = np.full(shape, np.nan if values.dtype.kind == "f" else 0, values.dtype)
    filled.reshape(-1, *values.shape[1:])[: len(values)] = values
    return filled
