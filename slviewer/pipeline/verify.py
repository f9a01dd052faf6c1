"""Measuring known shapes with each model, and comparing."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.evaluation.compare import Comparison, fit_clouds
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.capture_clouds import capture_cloud, check_capture_sizes
from slviewer.pipeline.capture_phases import capture_texture, decode_captures
from slviewer.pipeline.models import (
    Model,
    ModelName,
    check_accepted,
    load_models,
    load_stereo,
    preferred_model,
    warn_if_stale,
)
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.pipeline.reconstruct import (
    ReconstructSettings,
    cloud_record,
    masked_share,
    segment_board,
)
from slviewer.pipeline.scale import scale_factor
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.reconstruction import Reconstruction
from slviewer.records.verification import Shape, Verification
from slviewer.session.capture import Capture
from slviewer.session.store import Session


@dataclass(frozen=True)
class VerifySettings:
    """How captures of a known shape are measured.

    Args:
        captures: Names of the captures.
        shape: What the captures show.
        models: Which calibrations to compare; by default all there are.
        depth_range: Near and far end of the calibrated depths R2, mm; by default those of the board
            poses.
        radius: Nominal radius of the sphere, mm: helps to detect it; the fitted radius stays free.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted
            noise.
        accept_rejected: Use the calibration although its verdict rejects it.

    ``check``: also compare the frames with each other, and warn of those that do not fit.
    """

    UNRECORDED: ClassVar = ("check",)
    captures: Sequence[str]
    shape: Shape
    models: Sequence[ModelName] = ()
    depth_range: tuple[float, float] | None = None
    radius: float | None = None
    axis: Axis | None = None
    accept_rejected: bool = False
    check: bool = True

    def __post_init__(self) -> None:
        if not self.captures:
            raise UsageError(
                "no capture named: give the captures to measure, for instance plane_01 plane_02"
            )
        if self.depth_range is not None and not 0 < self.depth_range[0] < self.depth_range[1]:
            near, far = self.depth_range
            raise UsageError(f"the range {near:g} {far:g} is empty: give near and far in mm")
        if self.radius is not None and not self.radius > 0:
            raise UsageError(f"a radius of {self.radius:g} mm is not possible: give a positive one")


@dataclass(frozen=True, eq=False)
class ComparedCapture:
    """A capture that models were compared on: its phases, what was found, and {model: share of the
    shape's pixels that it masks, because no target pose illuminated what they look through} of
    models that do."""

    capture: Capture
    frames: np.ndarray
    phases: Mapping[Axis, PhaseMap]
    found: Comparison
    masked: Mapping[str, float]


@operation("verify", Verification, VerifySettings)
def verify(
    job: Job, settings: VerifySettings
) -> Iterator[Found[Verification] | Found[Reconstruction]]:
    """Measure captures of a plane or a sphere with each model, over the pixels that all of them
    measure, and compare.

    The session stores the figures, the error maps, and the cloud of the model that it prefers, if
    that is compared.
    """
    store = job.store
    chosen = load_models(store, settings.models)
    for each in compare_captures(job, settings, chosen):
        name, models = each.capture.name, tuple(each.found.results)
        record = each.found.record(
            each.masked,
            scales={model: scale_factor(store, model) for model in models},
            inputs=store.input_hashes(name, *(f"calibration/{model}" for model in models)),
        )
        yield Found(
            name, record, {f"error_{m}": r.error_map for m, r in each.found.results.items()}
        )
        if store.is_writable and (best := chosen.get(preferred_model(store))) is not None:
            # by its own best axis, as reconstruct
            yield _reconstruct_best(store, best, each, settings)


def compare_captures(
    job: Job, settings: VerifySettings, chosen: Mapping[str, Model]
) -> Iterator[ComparedCapture]:
    """Yield the comparison of models on each capture."""
    store, names = job.store, settings.captures
    check_accepted(store, settings.accept_rejected)
    warn_if_stale(store, job.warn)
    check_capture_sizes(store, names)
    depths = settings.depth_range or load_stereo(store).depth_range_mm
    for i, (shot, frames, phases) in enumerate(
        decode_captures(store, names, job.warn, check=settings.check)
    ):
        job.progress(i / len(names), f"measuring {shot.name}")
        clouds: dict[str, Cloud] = {}
        axis = settings.axis  # of the first, so that all can be compared pixel by pixel
        accepts = settings.accept_rejected
        for model, fitted in chosen.items():
            clouds[model] = capture_cloud(
                store, fitted, shot, phases, axis=axis, accept_rejected=accepts, warn=job.warn
            )
            axis = axis or clouds[model].axis
        assert axis is not None
        phase = phases[axis]
        region: np.ndarray | None = None
        if settings.shape == "plane" and shot.role == "calibration":
            region = segment_board(store, shot, capture_texture(shot, frames), job.warn)
        try:
            found = fit_clouds(
                settings.shape,
                clouds,
                phase.illuminated,
                region=region,
                depth_range=depths,
                radius=settings.radius,
            )
        except InputError as error:
            raise InputError(f"{shot.name}: {error}") from error
        for message in found.warnings:
            job.warn(f"{shot.name}: {message}")
        shares = {name: masked_share(each, phase, found.region) for name, each in chosen.items()}
        masked = {name: share for name, share in shares.items() if share is not None}
        yield ComparedCapture(shot, frames, phases, found, masked)
    job.progress(1.0, "measured")


def _reconstruct_best(
    store: Session, model: Model, each: ComparedCapture, settings: VerifySettings
) -> Found[Reconstruction]:
    """Return the cloud of a capture as `reconstruct` stores it."""
    shot, found = each.capture, each.found
    texture = capture_texture(shot, each.frames, stretch=shot.role == "calibration")
    axis, accepts = settings.axis, settings.accept_rejected
    cloud = capture_cloud(
        store, model, shot, each.phases, axis=axis, texture=texture, accept_rejected=accepts
    )
    region = None if found.is_searched else found.region
    as_reconstructed = ReconstructSettings(shot.name, axis=axis, accept_rejected=accepts)
    return cloud_record(store, as_reconstructed, model, cloud, each.phases[cloud.axis], region)
