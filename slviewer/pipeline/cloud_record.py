"""What is stored of a capture's cloud: its figures, what the calibration did not see of it, and how
it lies to the calibrated depths."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from slviewer.calibration.splined.model import SplinedModel
from slviewer.fringe.phase import PhaseMap
from slviewer.pipeline.cloud_corrections import describe_calibration, scale_factor
from slviewer.pipeline.models import Model, frame_of, load_stereo
from slviewer.pipeline.operation import Found, Warn, plain_settings
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.merge import DepthCheck, Reconstruction
from slviewer.session.names import join_names
from slviewer.session.store import Session


def cloud_record(
    store: Session,
    settings: Any,
    model: Model,
    cloud: Cloud,
    phase: PhaseMap,
    region: np.ndarray | None,
) -> Found[Reconstruction]:
    """Return what is stored of a capture's cloud, before edits and region; ``settings``: of the
    operation `reconstruct`; ``region`` (h, w) bool: of the board."""
    whole, cloud, beyond = cloud, cloud.supported(), cloud.extrapolated
    mask = cloud.mask
    near, far = np.percentile(cloud.points[..., 2][mask], [1, 99]) if mask.any() else (0.0, 0.0)
    arrays = {
        "points": whole.points,
        "sigma_z": whole.sigma_z,
        "phase": phase.phase,
        "modulation": phase.modulation,
        "texture": whole.texture,
        "sigma_calibration": whole.sigma_calibration,
        "sigma_edges": whole.sigma_edges,
    }
    if cloud.misfit is not None:
        arrays |= vars(cloud.misfit)
    arrays["extrapolated"] = beyond
    known = {name: array for name, array in arrays.items() if array is not None}
    left = cloud.sigma_calibration
    if store.load_capture(settings.capture).role == "calibration":
        masked = masked_share(model, phase, region)
    elif isinstance(model, SplinedModel):  # the cloud has all points
        masked = 0.0 if beyond is None else _share(beyond, whole.mask, region)
    else:
        masked = None
    record = Reconstruction(
        operation="reconstruct",
        settings=plain_settings(settings),
        axis=cloud.axis,
        points=int(np.count_nonzero(mask)),
        depth_mm=(float(near), float(far)) if mask.any() else None,
        noise_mm=_median(cloud.sigma_z[mask]),
        sigma_calibration_mm=float(np.median(left[mask]))
        if left is not None and mask.any()
        else None,
        extrapolated=0 if beyond is None else int(np.count_nonzero(beyond)),
        extrapolated_mm=None if beyond is None else _median(whole.sigma[beyond]),
        raised=model.residuals_over_noise(cloud.axis) if isinstance(model, SplinedModel) else 1.0,
        misfit_px=None if cloud.misfit is None else float(cloud.misfit.excess_px.max()),
        masked=masked,
        depths=check_depths(store, cloud),
        fill=cloud.fill,
        frame=frame_of(store, cloud.model),
        **describe_calibration(store, cloud.model, [settings.capture]),
    )
    return Found(settings.capture, record, known)


def _median(values: np.ndarray) -> float | None:
    """Return the median of known values; None without any."""
    return float(np.median(values)) if len(values) else None


def masked_share(model: Model, phase: PhaseMap, region: np.ndarray | None) -> float | None:
    """Share of the pixels (of ``region`` (h, w) bool, or of all) that could be measured and are
    masked, because they look through parts of camera or projector that no target pose illuminated;
    None for models that mask none.
    """
    if not isinstance(model, SplinedModel):
        return None
    every = np.isfinite(model.points(phase, supported=False)[..., 2])
    return _share(~model.support(phase), every, region)


def _share(chosen: np.ndarray, every: np.ndarray, region: np.ndarray | None) -> float:
    """Return the share of ``chosen`` pixels among ``every`` one, in the ``region`` if given."""
    if region is not None:
        every = every & region
    return float(chosen[every].mean()) if every.any() else 0.0


def check_depths(store: Session, cloud: Cloud) -> DepthCheck | None:
    """Return how a cloud by one of the session's models lies to the depths that this was calibrated
    at; None for imported points, and a calibration that states no depths."""
    calibrated = load_stereo(store).depth_range_mm if cloud.model else None
    if calibrated is None or not cloud.mask.any():
        return None
    factor = scale_factor(store, cloud.model)
    near, far = (factor * mm for mm in calibrated)
    z = cloud.points[..., 2]
    outside = (z < near) | (z > far)
    share = float(np.mean(outside[cloud.mask]))
    if not share:
        return DepthCheck((near, far), 0.0)
    nearest, farthest = (float(np.percentile(z[outside], percent)) for percent in (1, 99))
    sigma_mm = float(np.nanmedian(cloud.sigma[outside]))
    is_whole = cloud.sigma_calibration is not None
    return DepthCheck((near, far), share, nearest, farthest, sigma_mm, is_whole)


def list_outside_depths(
    store: Session, clouds: Mapping[str, Cloud], warn: Warn
) -> dict[str, DepthCheck]:
    """Return the checks of the clouds that are partly outside the calibrated depths, and warn of
    them."""
    checks = {name: check_depths(store, cloud) for name, cloud in clouds.items()}
    found = {name: each for name, each in checks.items() if each and not each.is_good}
    if found:
        worst = max(found.values(), key=lambda each: each.outside)
        others = " (of the worst)" if len(found) > 1 else ""
        warn(f"{join_names(list(found), 3)}: {worst.text()}{others}")
    return found
