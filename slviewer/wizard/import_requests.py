"""Requests to import captures that other tools made."""

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from slviewer.errors import InputError
from slviewer.pipeline.import_captures import Role, describe_import, import_captures
from slviewer.session import atomic
from slviewer.session.importers.archive import unpack, unpacked_size
from slviewer.session.names import new_name
from slviewer.session.reading import expand_user
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.requests import RequestHandler, request

IMPORTING = "Importing"
UNPACKED = "import"
"""Name in the session's folder beside which an upload is unpacked: the session clears what a crash
leaves of it."""


class ImportRequests(RequestHandler):
    """Requests that import captures on the worker, as the command line does."""

    @request(IMPORTING)
    def import_folder(
        self, folder: Path | str, layout: str = "detect", role: Role = "calibration", **options: Any
    ) -> None:
        """Import the captures in a folder of this computer; `options` as `import_captures` takes
        them."""
        path = str(folder).strip()
        if not path:
            raise InputError(
                "no folder is named: enter the path of a folder on the computer that runs slviewer"
            )
        store = self._engine.store

        def work(report: Reporter) -> list[str]:
            """Import the folder's captures; returns their names."""
            session = store.guarded(report.saving)
            source = expand_user(path)
            warn = self._warner("frames")
            return import_captures(
                source, session, layout, role=role, progress=report, warn=warn, **options
            )

        self._submit_import(work, role)

    @request(IMPORTING)
    def import_zip(
        self,
        name: str,
        content: bytes,
        layout: str = "detect",
        role: Role = "calibration",
        **options: Any,
    ) -> None:
        """Import the captures in a zip that was uploaded as `name`; images outside of folders
        become one capture of that name."""
        self._submit_import(partial(self._read_zip, name, content, layout, role, options), role)

    def _submit_import(self, work: Callable[[Reporter], list[str]], role: Role) -> None:
        """Queue an import as `role`; `work(report)` returns the names of the captures, which are
        then processed."""

        def import_and_process(report: Reporter) -> list[str]:
            """Import, and queue the processing of the new captures; returns their names."""
            names = work(report)
            self._engine.queue_processing()
            return names

        self._submit(IMPORTING, import_and_process, lambda names: describe_import(names, role))

    def _read_zip(
        self,
        name: str,
        content: bytes,
        layout: str,
        role: Role,
        options: dict[str, Any],
        report: Reporter,
    ) -> list[str]:
        """Unpack an uploaded zip into a temporary folder and import it; returns the names of the
        captures."""
        store, archive = self._engine.store, io.BytesIO(content)
        report(0.0, f"unpacking {name}")
        with atomic.staged_folder(store.folder / UNPACKED, unpacked_size(archive)) as staged:
            folder = staged / _make_capture_name(Path(name).stem)
            folder.mkdir()
            try:
                unpacking = report.within(0, 0.2)
                source, warnings = unpack(
                    archive, folder, lambda done: unpacking(done, f"unpacking {name}")
                )
                for warning in warnings:
                    self._warner("frames")(warning)
                return import_captures(
                    source, store.guarded(report.saving), layout, role=role, origin=name,
                    progress=report.within(0.2, 1), warn=self._warner("frames"), **options,
                )  # fmt: skip
            finally:
                atomic.discard(staged)


def _make_capture_name(name: str) -> str:
    """Return a valid capture name, ASCII and at most 100 characters, made from the name of an
    upload."""
    plain = "".join(c if (c.isalnum() and c.isascii()) or c in "_-." else "_" for c in name).strip(
        "._-"
    )
    return new_name(plain[:100] or "capture")
