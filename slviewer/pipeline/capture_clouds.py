"""The cloud of a capture by one of the session's calibrations, once it is known that they belong
together."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.feedback import Warn, ignore_warnings
from slviewer.pipeline.models import Model, load_stereo
from slviewer.pipeline.scale import scale_cloud, scale_factor
from slviewer.reconstruction.axis_agreement import check_phases, check_sizes
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import reconstruct_cloud
from slviewer.reconstruction.relative_phase import resolve_phase
from slviewer.session.capture import Capture
from slviewer.session.store import Session


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
    return raise_uncertainty(cloud, check.sigma_factor, check.excess_px, phases)


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
    near_far, whose = (
        depth_range or stereo.depth_range_mm,
        ("" if depth_range else ", the calibrated depths"),
    )
    if near_far is None:
        raise InputError(
            f"{name}: its phase is not absolute, and the calibration knows no depths: state those"
            " of the scene with --depth-range NEAR FAR, mm"
        )
    absolute, refusals = (
        {axis: phase for axis, phase in phases.items() if not phase.is_relative},
        [],
    )
    for axis, phase in phases.items():
        if not phase.is_relative:
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


def raise_uncertainty(
    cloud: Cloud,
    factor: float,
    excess_px: NDArray[np.float32] | None = None,
    phases: Mapping[Axis, PhaseMap] | None = None,
) -> Cloud:
    """The cloud with sigmas larger by a factor, and, by tiles of the image, by an error of the
    projector's coordinate in px in addition to the noise of the ``phases``."""
    if excess_px is not None and phases is not None:
        phase = phases[cloud.axis]
        noise_px = phase.sigma_px
        excess = cv2.resize(excess_px, noise_px.shape[::-1], interpolation=cv2.INTER_LINEAR)
        error = cloud.sigma_z * excess / np.maximum(noise_px, np.float32(1e-9))
        known = cloud.sigma_edges
        return replace(cloud, sigma_edges=error if known is None else np.hypot(known, error))
    if factor == 1.0:
        return cloud
    sigma_calibration = (
        None if cloud.sigma_calibration is None else cloud.sigma_calibration * np.float32(factor)
    )
    return replace(
        cloud, sigma_z=cloud.sigma_z * np.float32(factor), sigma_calibration=sigma_calibration
    )
