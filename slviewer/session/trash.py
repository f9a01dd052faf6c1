"""The session's trash: captures and results that were deleted or replaced, each in a folder named
after it and the time."""

import contextlib
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

_TIME = "%Y%m%dT%H%M%S%f"


@dataclass(frozen=True)
class Trashed:
    """A capture or result in the trash: its name, when it was deleted, and its folder there."""

    name: str
    is_capture: bool
    time: datetime
    place: Path


def trash_place(trash: Path, name: str) -> Path:
    """Return a new path in the trash for a capture or result of that name."""
    return trash / f"{name}-{datetime.now(UTC).strftime(_TIME)}"


def list_trash(trash: Path) -> list[Trashed]:
    """Return what is in the trash and complete, the last deleted first."""
    entries = []
    for place in trash.glob("*-*") if trash.is_dir() else ():
        name, _, when = place.name.rpartition("-")
        is_capture = (place / "capture.json").is_file()
        with contextlib.suppress(ValueError):
            time = datetime.strptime(when, _TIME).replace(tzinfo=UTC)
            if is_capture or (place / "meta.json").is_file():
                entries.append(
                    Trashed(
                        name if is_capture else name.replace("-", "/", 1), is_capture, time, place
                    )
                )
    return sorted(entries, key=lambda each: each.time, reverse=True)
