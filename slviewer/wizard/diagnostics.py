"""A zip to be sent with a bug report: versions, settings, logs, small previews.

It holds no frames, and no passwords, which addresses of cameras may contain.
"""

import importlib.metadata
import logging
import os
import platform
import sys
import zipfile
from collections import deque
from contextlib import suppress
from datetime import datetime
from typing import Any

import cv2

from slviewer import __version__
from slviewer.errors import SessionError, hide_passwords
from slviewer.session.atomic import to_json
from slviewer.session.reading import MAX_JSON_BYTES, read_file
from slviewer.session.store import Session
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.snapshot import PreviewView, Snapshot

LINES = 4000
PACKAGES = (
    "numpy",
    "opencv-python-headless",
    "numba",
    "scipy",
    "zarr",
    "open3d-cpu",
    "open3d",
    "viser",
    "trimesh",
)


class LogKeeper(logging.Handler):
    """Logging handler that stores the latest lines of slviewer's log until `close`."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.lines: deque[str] = deque(maxlen=LINES)
        self.setFormatter(
            logging.Formatter("%(asctime)s %(levelname)s %(name)s %(threadName)s: %(message)s")
        )
        self._logger = logging.getLogger("slviewer")
        if self._logger.level == logging.NOTSET:
            self._logger.setLevel(logging.INFO)
        self._logger.addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Store one record."""
        self.lines.append(hide_passwords(self.format(record)))

    def close(self) -> None:
        """Stop logging here."""
        self._logger.removeHandler(self)
        super().close()


def write_bundle(
    session: Session,
    snapshot: Snapshot,
    preview: PreviewView | None,
    log: LogKeeper,
    report: Reporter,
) -> str:
    """Write ``diagnostics_<time>.zip`` into the exports; returns its name."""
    name = f"diagnostics_{datetime.now():%Y%m%d_%H%M%S}.zip"
    guarded = session.guarded(report.saving)
    with (
        guarded.staged_export(name) as path,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bundle,
    ):
        report(0.1, "versions and settings")
        bundle.writestr("versions.json", to_json(_collect_versions()))
        state = {
            "rig": snapshot.rig,
            "steps": snapshot.steps,
            "notices": [
                [each.time.isoformat(), each.level, each.text] for each in snapshot.notices
            ],
            "space": snapshot.space,
        }
        bundle.writestr("state.json", hide_passwords(to_json(state).decode()))
        bundle.writestr("log.txt", "\n".join(log.lines) + "\n")
        for file in ("session.json", "decisions.json"):
            # whatever it holds: a damaged one may be the reason for the report
            with suppress(OSError):
                content = read_file(session.folder / file, MAX_JSON_BYTES)
                bundle.writestr(f"session/{file}", hide_passwords(content.decode(errors="replace")))
        report(0.4, "captures and results")
        for capture in session.captures():
            described = {key: value for key, value in capture.meta.items() if key != "sequence"}
            bundle.writestr(
                f"session/captures/{capture.name}.json", hide_passwords(to_json(described).decode())
            )
        for result in session.result_names():
            try:
                described = session.load_result(result, only=())[0]
            except SessionError as error:
                described = {"damaged": str(error)}
            bundle.writestr(f"session/results/{result}.json", to_json(described))
        report(0.8, "previews")
        if snapshot.session:
            thumbnails = {pose.name: pose.thumbnail for pose in snapshot.session.poses}
            thumbnails |= {scan.name: scan.thumbnail for scan in snapshot.session.scans}
            for each, jpeg in thumbnails.items():
                bundle.writestr(f"previews/{each}.jpg", jpeg)
        if preview:
            bundle.writestr("previews/now.jpg", bytes(cv2.imencode(".jpg", preview.image)[1]))
    report(1.0, "collected")
    return name


def _collect_versions() -> dict[str, Any]:
    """Return the versions of slviewer, Python, the operating system and the installed packages."""
    versions = {}
    for package in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return {
        "slviewer": __version__,
        "python": sys.version,
        "system": platform.platform(),
        "processors": os.cpu_count(),
        "packages": versions,
    }
