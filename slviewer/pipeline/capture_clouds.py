"""The cloud of a capture, stored or by one of the session's calibrations, once it is known that
they belong together; and the points of merges."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import cv2
import numpy as np

from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.capture_phases import capture_texture, decode_captures
from slviewer.pipeline.feedback import Progress, Warn, ignore_warnings
from slviewer.pipeline.models import Model, load_model, load_stereo
from slviewer.pipeline.open_session import numbered_names
from slviewer.pipeline.scale import scale_cloud, scale_factor
from slviewer.pipeline.scan_edits import resolve_region, restrict_cloud
from slviewer.pipeline.stored_records import is_up_to_date, load_record
from slviewer.reconstruction.axis_agreement import check_phases, check_sizes
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import reconstruct_cloud
from slviewer.reconstruction.relative_phase import resolve_phase
from slviewer.records.merge import Merge
from slviewer.session.capture import Capture
from slviewer.session.ply import Ply, read_ply
from slviewer.session.store import Session
from slviewer.surface.shapes import PointSet


def check_capture_sizes(store: Session, names: Iterable[str]) -> None:
    """Raise InputError where a capture's camera or projector has not the size that the session's
    calibration has: before anything is decoded, which would fail for reasons that follow from
    it."""
    rig = load_stereo(store).rig
    for capture in (store.load_capture(name) for name in names):
        check_sizes(capture.name, capture.size, capture.sequence.projector_size, rig)


def capture_cloud(
    store: Session,
    model: Model,
    capture: Capture,
    phases: Mapping[Axis, PhaseMap],
    *,
    axis: Axis | None = None,
    texture: np.ndarray | None = None,
    accept_rejected: bool = False,
    warn: Warn = ignore_warnings,
) -> Cloud:
    """Reconstruct the organised cloud of a decoded capture, with the scale of its calibration
    applied.

    Raises InputError where capture and calibration do not belong together: by their sizes, or by
    how far the axes of the capture miss each other, which is a warning if ``accept_rejected``.
    Where they miss each other by more than noise explains, the cloud's sigmas are raised by that
    factor, with a warning.
    """
    stereo = load_stereo(store)
    check_sizes(capture.name, capture.size, capture.sequence.projector_size, stereo.rig)
    calibration = model if isinstance(model, SplinedModel) else stereo
    check = check_phases(capture.name, phases, calibration, stereo.depth_range_mm, accept_rejected)
    for message in check.warnings:
        warn(message)
    cloud = scale_cloud(
        reconstruct_cloud(model, phases, axis=axis, texture=texture),
        scale_factor(store, model.name),
    )
    if check.excess_px is not None:  # by tiles of the image, in addition to the noise
        noise_px, known = phases[cloud.axis].sigma_px, cloud.sigma_edges
        excess = cv2.resize(check.excess_px, noise_px.shape[::-1], interpolation=cv2.INTER_LINEAR)
        error = cloud.sigma_z * excess / np.maximum(noise_px, np.float32(1e-9))
        return replace(cloud, sigma_edges=error if known is None else np.hypot(known, error))
    factor, sigma = np.float32(check.sigma_factor), cloud.sigma_calibration
    return replace(
        cloud,
        sigma_z=cloud.sigma_z * factor,
        sigma_calibration=None if sigma is None else sigma * factor,
    )


def absolute_phases(
    store: Session,
    name: str,
    phases: Mapping[Axis, PhaseMap],
    depth_range: tuple[float, float] | None = None,
    warn: Warn = ignore_warnings,
) -> dict[Axis, PhaseMap]:
    """Return a capture's phases, ambiguous ones made absolute by the depth range (near, far) mm of
    the scene; by default the calibrated one. An axis that more than one depth fits is solved by the
    other axis, with a warning.

    Raises InputError where no axis is unique in the range, and where no range is known.
    """
    if not any(phase.is_relative for phase in phases.values()):
        if depth_range is not None:
            warn(
                f"{name}: its phase is absolute, and the depth range is not needed: it was not used"
            )
        return dict(phases)
    stereo = load_stereo(store)
    near_far = depth_range or stereo.depth_range_mm
    whose = "" if depth_range else ", the calibrated depths"
    if near_far is None:
        raise InputError(
            f"{name}: its phase is not absolute, and the calibration knows no depths: state those"
            " of the scene with --depth-range NEAR FAR, mm"
        )
    absolute, refusals = dict[Axis, PhaseMap](), list[str]()
    for axis, phase in phases.items():
        if not phase.is_relative:
            absolute[axis] = phase
            continue
        try:
            resolved = resolve_phase(stereo.rig, phase, near_far)
        except InputError as error:
            refusals.append(str(error))
            continue
        absolute[axis] = resolved.phase
        warn(
            f"{name}: the phase of axis {axis} repeats every {phase.unambiguous_px:g} px, and each"
            f" pixel was given its one depth between {near_far[0]:.0f} and {near_far[1]:.0f}"
            f" mm{whose}; {100 * resolved.outside:.1f} % of the decoded pixels have none and are"
            " masked. A surface outside of this range would be measured about"
            f" {resolved.spacing_mm:.0f} mm from its place: change it with --depth-range"
        )
    if not absolute:
        raise InputError(
            f"{name}: {'; '.join(refusals)} (--depth-range NEAR"
            f" FAR{whose and '; by default' + whose[1:]})"
        )
    for refusal in refusals:
        warn(f"{name}: {refusal}; this axis was not used")
    return absolute


def scan_cloud(
    store: Session,
    name: str,
    model: str | None,
    progress: Progress,
    warn: Warn,
    accept_rejected: bool = False,
    roi: str = "",
) -> Cloud:
    """A capture's cloud: the stored one where it is up to date and of the requested model, else
    reconstructed; without what was deleted from it, and what lies outside of the region ``roi``, as
    `resolve_region` reads it.
    """
    region = resolve_region(store, roi)
    capture, stored = store.load_capture(name), f"clouds/{name}"
    meta = store.load_result(stored, only=())[0] if is_up_to_date(store, stored) else {}
    if meta and (not model or model == meta["model"]):
        names = {"points", "sigma_z", "texture", "sigma_calibration", "sigma_edges"}
        arrays = store.load_result(stored, only=names & set(meta["arrays"]))[1]
        cloud = Cloud(axis=meta["axis"], model=meta["model"], **arrays)
    else:
        fitted = load_model(store, model)
        progress(0.1, f"reading {name}")
        check_capture_sizes(store, [name])
        _, frames, phases = next(decode_captures(store, [name], warn))
        progress(0.4, f"reconstructing {name}")
        texture = capture_texture(capture, frames, stretch=False)
        cloud = capture_cloud(
            store,
            fitted,
            capture,
            phases,
            texture=texture,
            accept_rejected=accept_rejected,
            warn=warn,
        )
    return restrict_cloud(store, name, cloud, region)


def merge_name(store: Session, name: str) -> str:
    """The merge of that number, or the last one where none is named; raises InputError where it
    does not exist."""
    there = numbered_names(store, "merge")
    if not there:
        raise InputError("there is no merge yet: merge scans first")
    if name and name not in there:
        raise InputError(f"there is no merge {name!r}: the merges are {', '.join(there)}")
    return name or there[-1]


def read_merge(store: Session, result: str, warn: Warn) -> tuple[Merge, Ply]:
    """The record and the points of a merge that the session stores as ``merge/<number>``; warns of
    a stale one."""
    if not is_up_to_date(store, result):
        warn(f"{result} came from scans or a calibration that have changed since: merge again")
    merge = load_record(store, Merge, result.removeprefix(f"{Merge.kind}/"))
    return merge, read_ply(store.exports / merge.ply)


def points_with_normals(merged: Ply) -> PointSet:
    """Return the points of a merge whose normals are known, to make a mesh of; InputError for a
    merge without any."""
    if merged.normals is None:
        raise InputError("the merged cloud has no normals: merge the scans again")
    known, sigma = np.isfinite(merged.normals).all(axis=1), merged.scalars.get("sigma")
    if sigma is not None and not np.isfinite(sigma[known]).all():
        sigma = None
    return PointSet(
        merged.points[known],
        merged.normals[known],
        None if merged.colours is None else merged.colours[known],
        None if sigma is None else sigma[known],
    )
