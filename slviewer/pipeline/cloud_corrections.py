"""What is done to the clouds of scans: the scale that an acceptance test measured and the operator
applied; the region of interest, and the points that were deleted."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.geometry.vectors import finite_rows
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.acceptance import AcceptanceTest
from slviewer.records.record import from_plain
from slviewer.session.layout import time_now
from slviewer.session.reading import expand_user, read_toml
from slviewer.session.scan_edits import load_edits, load_region
from slviewer.session.store import Session
from slviewer.surface.region_of_interest import RegionOfInterest, crop_mask

LARGEST_FACTOR = 1.25
"""Of a scale correction: a larger one means another artefact, unit or target."""


def load_scale_correction(store: Session, model: str) -> dict[str, Any] | None:
    """Return the scale correction of a calibration, as ``record_scale`` stored it; None where there
    is none, or it is of another calibration. Its standard uncertainty is half of ``U_ppm``; without
    a correction the scale is the target's."""
    name, calibration = f"scale/{model}", f"calibration/{model}"
    if not (model and store.has_result(name) and store.has_result(calibration)):
        return None
    meta = store.load_meta(name)
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
            f" {LARGEST_FACTOR:g})",
            "check the certificate's length, temperature and expansion, and that its captures show"
            " this artefact",
        )
    meta = {
        "factor": factor,
        "ppm": acceptance.scale.ppm,
        "U_ppm": acceptance.scale.U_ppm,
        "before": before,
        "artefact": acceptance.artefact.name,
        "certificate": acceptance.artefact.certificate,
        "captures": [position.capture for position in acceptance.positions],
        "time": time_now(),
        "inputs": store.input_hashes(f"calibration/{acceptance.model}"),
    }
    store.save_result(f"scale/{acceptance.model}", meta, {})
    return factor


OFF = "off"
C = TypeVar("C", bound=Cloud)
_EXAMPLE = "such as --roi=-50,50,-40,40,300,500"


def resolve_region(store: Session, roi: str) -> RegionOfInterest | None:
    """Return the region that an option ``--roi`` states; empty: the session's, ``off``: None."""
    if not roi:
        return load_region(store)
    return None if roi == OFF else parse_region(roi)


def parse_region(roi: str) -> RegionOfInterest:
    """Return the box of six numbers "x0,x1,y0,y1,z0,z1" in mm, or of a TOML file with
    ``centre_mm``, ``size_mm`` and, where it is turned, ``rotation_deg``. UsageError for other text,
    InputError for a file that states no box.
    """
    parts = roi.replace(",", " ").split()
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        return _read_region(expand_user(roi))
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise UsageError(
            f"--roi has {len(numbers)} numbers, six are needed",
            f"x0,x1,y0,y1,z0,z1 in mm, {_EXAMPLE}",
        )
    low, high = numbers[::2], numbers[1::2]
    if any(a >= b for a, b in zip(low, high, strict=True)):
        raise UsageError(
            f"--roi {roi} ends before it begins",
            f"give the lower number of each axis first, {_EXAMPLE}",
        )
    return RegionOfInterest.between(low, high)


def restrict_cloud(store: Session, scan: str, cloud: C, region: RegionOfInterest | None) -> C:
    """Return a scan's cloud with NaN for what was deleted from it and what lies outside of the
    region.

    InputError, with the numbers, where nothing remains.
    """
    points, history = cloud.points, load_edits(store, scan)
    if region is None and not history.active:
        return cloud
    kept = history.keep_mask(points)
    measured = int(np.count_nonzero(finite_rows(points)))
    if measured and not kept.any():
        raise InputError(
            f"{scan}: all of its {measured} points were deleted by {history.applied} edits",
            f"undo some, with `slviewer edit SESSION {scan} --undo 1` or in the step Scan",
        )
    if region is not None:
        kept &= crop_mask(scan, np.where(kept[..., None], points, np.nan), region)
    nan = np.float32(np.nan)
    return replace(
        cloud,
        points=np.where(kept[..., None], points, nan),
        sigma_z=np.where(kept, cloud.sigma_z, nan),
    )


def restriction_notes(
    store: Session, scans: Sequence[str], region: RegionOfInterest | None
) -> tuple[str, ...]:
    """Return what restricts scans, in sentences, for the comments of files and for reports."""
    notes = [] if region is None else [f"region of interest: {region.text()}"]
    for scan in scans:
        if edits := load_edits(store, scan).active:
            notes.append(f"edits of {scan}: {'; '.join(edit.text() for edit in edits)}")
    return tuple(notes)


def _read_region(path: Path) -> RegionOfInterest:
    """Return the box that a TOML file states. UsageError without the file, InputError for another
    content."""
    if not path.is_file():
        raise UsageError(
            f"--roi {path} is neither six numbers (x0,x1,y0,y1,z0,z1 in mm, {_EXAMPLE}), nor a TOML"
            " file, nor off"
        )
    try:
        return from_plain(read_toml(path), RegionOfInterest)
    except InputError as error:
        raise InputError(
            f"{path} states no region ({error})",
            "write centre_mm = [x, y, z], size_mm = [x, y, z] and, for a turned box, rotation_deg ="
            " [x, y, z]",
        ) from error
