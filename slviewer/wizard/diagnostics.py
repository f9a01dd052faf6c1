"""A zip to be sent with a bug report: versions, settings, logs, small previews.

It holds no frames, and no passwords, which addresses of cameras may contain.
"""

import importlib.metadata
import json
import logging
import os
import platform
import sys
import zipfile
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime
from typing import Any

import cv2

from slviewer import __version__
from slviewer.errors import SessionError, hide_passwords
from slviewer.pipeline.operation import Job
from slviewer.session.atomic import to_json
from slviewer.session.reading import MAX_JSON_BYTES, read_file
from slviewer.wizard.snapshot import PoseView, PreviewView, ScanView, Snapshot

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


def write_bundle(job: Job, snapshot: Snapshot, preview: PreviewView | None, log: LogKeeper) -> str:
    """Write ``diagnostics_<time>.zip`` into the exports; returns a sentence that begins with its
    name."""
    name = f"diagnostics_{datetime.now():%Y%m%d_%H%M%S}.zip"
    with (
        job.store.staged_export(name) as path,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bundle,
    ):
        for entry, content in _collect(job, snapshot, log):
            text = content if isinstance(content, str) else to_json(content).decode()
            bundle.writestr(entry, hide_passwords(text))
        job.progress(0.8, "previews")
        views: list[PoseView | ScanView] = [*snapshot.content.poses, *snapshot.content.scans]
        for view in views:
            bundle.writestr(f"previews/{view.name}.jpg", view.thumbnail)
        if preview:
            bundle.writestr("previews/now.jpg", bytes(cv2.imencode(".jpg", preview.image)[1]))
    job.progress(1.0, "collected")
    return f"{name} is ready to download"


def _collect(job: Job, snapshot: Snapshot, log: LogKeeper) -> Iterator[tuple[str, Any]]:
    """Yield the name of each entry and its content, as text or as plain values."""
    session, versions = job.store, {}
    job.progress(0.1, "versions and settings")
    for package in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    yield (
        "versions.json",
        {
            "slviewer": __version__,
            "python": sys.version,
            "system": platform.platform(),
            "processors": os.cpu_count(),
            "packages": versions,
        },
    )
    notices = [[each.time.isoformat(), each.level, each.text] for each in snapshot.notices]
    yield (
        "state.json",
        {
            "rig": snapshot.rig,
            "steps": snapshot.steps,
            "notices": notices,
            "space": snapshot.space,
        },
    )
    yield "log.txt", "\n".join(log.lines) + "\n"
    for file in ("session.json", "decisions.json"):
        # whatever it holds: a damaged one may be the reason for the report
        with suppress(OSError):
            text = read_file(session.folder / file, MAX_JSON_BYTES).decode(errors="replace")
            with suppress(ValueError, AttributeError, RecursionError):
                known = json.loads(text)
                if known.pop("report", None):  # the customer's name concerns nobody else
                    text = json.dumps(known, indent=2)
            yield f"session/{file}", text
    job.progress(0.4, "captures and results")
    for capture in session.captures():
        described = {key: value for key, value in capture.meta.items() if key != "sequence"}
        yield f"session/captures/{capture.name}.json", described
    for result in session.result_names():
        try:
            described = session.load_meta(result)
        except SessionError as error:
            described = {"damaged": str(error)}
        yield f"session/results/{result}.json", described
