"""Restricting scans to the region of interest, and to the points that were not deleted; editing
them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.plain import from_plain
from slviewer.session.reading import expand_user, read_toml
from slviewer.session.scan_edits import load_edits, load_region
from slviewer.session.store import Session
from slviewer.surface.region_of_interest import RegionOfInterest, crop_mask

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
            f"--roi has {len(numbers)} numbers, six are needed: x0,x1,y0,y1,z0,z1 in mm, {_EXAMPLE}"
        )
    low, high = numbers[::2], numbers[1::2]
    if any(a >= b for a, b in zip(low, high, strict=True)):
        raise UsageError(
            f"--roi {roi} ends before it begins: give the lower number of each axis first,"
            f" {_EXAMPLE}"
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
    measured = int(np.count_nonzero(np.isfinite(points).all(axis=-1)))
    if measured and not kept.any():
        raise InputError(
            f"{scan}: all of its {measured} points were deleted by {history.applied} edits: undo"
            f" some, with `slviewer edit SESSION {scan} --undo 1` or in the step Scan"
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
            f"{path} states no region ({error}): write centre_mm = [x, y, z], size_mm = [x, y, z]"
            " and, for a turned box, rotation_deg = [x, y, z]"
        ) from error
