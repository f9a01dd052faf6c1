"""A scale that an acceptance test measured and the operator applied: what later clouds are
multiplied by."""

from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.acceptance import AcceptanceTest
from slviewer.session.store import Session

LARGEST_FACTOR = 1.25
"""Of a scale correction: a larger one means another artefact, unit or target."""


def load_scale_correction(store: Session, model: str) -> dict[str, Any] | None:
    """Return the scale correction of a calibration, as ``record_scale`` stored it; None where there
    is none, or it is of another calibration. Its standard uncertainty is half of ``U_ppm``; without
    a correction the scale is the target's."""
    name, calibration = f"scale/{model}", f"calibration/{model}"
    if not (model and store.has_result(name) and store.has_result(calibration)):
        return None
    meta = store.load_result(name, only=())[0]
    return meta if meta["inputs"] == store.input_hashes(calibration) else None


def scale_factor(store: Session, model: str) -> float:
    """Return the scale factor of a calibration's clouds: 1 where no correction was applied."""
    applied = load_scale_correction(store, model)
    return 1.0 if applied is None else float(applied["factor"])


def describe_scale(store: Session, model: str) -> str:
    """Describe the scale correction of a calibration in words; empty where there is none."""
    applied = load_scale_correction(store, model)
    if applied is None:
        return ""
    ppm = f"{1e6 * (applied['factor'] - 1):+.0f}".replace("-", "−")
    return f"scale corrected by {ppm} ppm, by certificate {applied['certificate']}"


def describe_calibration(store: Session, model: str, captures: Iterable[str]) -> dict[str, Any]:
    """Return what a record of clouds of captures states of their calibration, none ("") of imported
    ones, and its inputs."""
    calibrations = dict.fromkeys(("calibration/stereo", f"calibration/{model}")) if model else ()
    return {
        "model": model,
        "scale": describe_scale(store, model),
        "scales": {model: scale_factor(store, model)} if model else {},
        "inputs": store.input_hashes(*captures, *calibrations),
    }


def scale_cloud(cloud: Cloud, factor: float) -> Cloud:
    """Return the cloud enlarged by a factor, with its noise."""
    if factor == 1.0:
        return cloud
    names = ("points", "sigma_z", "sigma_calibration", "sigma_edges")
    known = {name: values for name in names if (values := getattr(cloud, name)) is not None}
    return replace(cloud, **{name: values * np.float32(factor) for name, values in known.items()})


def record_scale(store: Session, acceptance: AcceptanceTest) -> float:
    """Record that the calibration's clouds are to be corrected by a test's scale; returns the new
    factor.

    A correction that was in force during the test stays in it.
    """
    assert acceptance.scale is not None
    before = scale_factor(store, acceptance.model)
    factor = before / (1 + 1e-6 * acceptance.scale.ppm)
    if not 1 / LARGEST_FACTOR <= factor <= LARGEST_FACTOR:  # False for NaN
        raise InputError(
            f"the scale factor would be {factor:.6g}, which is not a correction (at most"
            f" {LARGEST_FACTOR:g}): check the certificate's length, temperature and expansion, and"
            " that its captures show this artefact"
        )
    meta = {
        "factor": factor,
        "ppm": acceptance.scale.ppm,
        "U_ppm": acceptance.scale.U_ppm,
        "before": before,
        "artefact": acceptance.artefact.name,
        "certificate": acceptance.artefact.certificate,
        "captures": [position.capture for position in acceptance.positions],
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "inputs": store.input_hashes(f"calibration/{acceptance.model}"),
    }
    store.save_result(f"scale/{acceptance.model}", meta, {})
    return factor
