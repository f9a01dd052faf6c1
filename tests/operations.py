"""Operations on a session by its folder, with the arrays that they compute with."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from slviewer.pipeline.measure import MeasuredSurface, load_surface
from slviewer.pipeline.merge import MergedScans, MergeSettings, merge_scans
from slviewer.pipeline.operation import Job, ignore_warnings
from slviewer.pipeline.reconstruct import (
    ReconstructedCapture,
    ReconstructSettings,
    reconstruct_capture,
)
from slviewer.session.store import Session

Warn = Callable[[str], None]


def loaded(session: Path, scan: str) -> MeasuredSurface:
    with Session.open(session) as store:
        return load_surface(Job(store), scan)


def reconstructed(
    session: Path, capture: str, warn: Warn = ignore_warnings, **settings: Any
) -> ReconstructedCapture:
    with Session.open(session) as store:
        chosen = ReconstructSettings(capture, **settings)
        with reconstruct_capture(Job(store, warn=warn), chosen) as made:
            return made


def merged(
    session: Path,
    captures: Sequence[str],
    reference: str,
    warn: Warn = ignore_warnings,
    **settings: Any,
) -> MergedScans:
    with Session.open(session) as store:
        chosen = MergeSettings(captures, reference, **settings)
        with merge_scans(Job(store, warn=warn), chosen) as made:
            return made
