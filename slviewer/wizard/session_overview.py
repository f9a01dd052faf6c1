"""What a list of sessions shows of each: a picture, its date, what it holds and how good its
calibration is."""

from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from slviewer.errors import SlviewerError
from slviewer.pipeline.calibrate import load_last_verdict
from slviewer.pipeline.models import available_models
from slviewer.records.measurement import Measurement
from slviewer.records.table import format_count, format_counts
from slviewer.records.verdict import Level
from slviewer.session.store import Session
from slviewer.wizard.result_views import make_thumbnail


@dataclass(frozen=True)
class SessionOverview:
    """A session: when it was changed last, what it `holds` in words, the verdict on its
    calibration, None where there is none, and a JPEG of its first scan, else pose.

    `fault`: why it cannot be read, empty where it can.
    """

    folder: Path
    changed: datetime
    holds: str = ""
    is_calibrated: bool = False
    verdict: Level | None = None
    thumbnail: bytes = b""
    fault: str = ""


def read_overview(folder: Path) -> SessionOverview:
    """Read what a list shows of a session; a damaged one has a fault."""
    parts = [folder / name for name in ("session.json", "decisions.json", "captures", "results")]
    times = [part.stat().st_mtime for part in parts if part.exists()]
    changed = datetime.fromtimestamp(max(times, default=0.0)).astimezone()
    try:
        with Session.open(folder) as session:
            return _read(session, changed)
    except SlviewerError as error:
        return SessionOverview(folder, changed, fault=str(error))


def _read(session: Session, changed: datetime) -> SessionOverview:
    """Read the overview of an open session."""
    captures = session.captures()
    holds = format_counts(each.purpose for each in captures)
    if n := sum(name.startswith(f"{Measurement.kind}/") for name in session.result_names()):
        holds += f", {format_count(n, 'measurement')}"
    verdict, is_calibrated = None, "stereo" in available_models(session)
    with suppress(SlviewerError):
        verdict = load_last_verdict(session)
    picture = b""
    for capture in sorted(captures, key=lambda each: each.purpose == "scan", reverse=True):
        with suppress(SlviewerError):
            picture = make_thumbnail(capture)
            break
    level = verdict.level if verdict else None
    return SessionOverview(session.folder, changed, holds, is_calibrated, level, picture)
