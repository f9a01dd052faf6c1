"""What an operator can ask of folders that other tools made: to bring their captures into the session."""

import io
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from slviewer.errors import InputError
from slviewer.pipeline.import_captures import import_captures
from slviewer.session import atomic
from slviewer.session.importers.archive import unpack, unpacked_size
from slviewer.session.names import safe_name
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.requests import RequestHandler, request

IMPORTING = "Importing"
UNPACKED = "import"
"""Beside which an upload is unpacked, in the session's folder: what a crash leaves of it is cleared with the rest."""
T = TypeVar("T")


class ImportRequests(RequestHandler):
    """Importing by the worker, with the function of the command line."""

    @request(IMPORTING)
    def import_folder(self, folder: Path | str, layout: str = "detect", **options: Any) -> None:
        """Import the captures in a folder of this computer; `options` as `import_captures` takes them."""
        if not str(folder).strip():
            raise InputError("no folder is named: type the path of a folder on the computer that runs slviewer")
        self._import(partial(self._read_folder, Path(str(folder).strip()).expanduser()), layout, options)

    @request(IMPORTING)
    def import_zip(self, name: str, content: bytes, layout: str = "detect", **options: Any) -> None:
        """Import the captures in a zip that was uploaded under `name`; images outside of folders become one capture,
        named after it."""
        self._import(partial(self._read_zip, name, content), layout, options)

    def _import(self, read: Callable[..., list[str]], layout: str, options: dict[str, Any]) -> None:
        engine = self._engine

        def done(names: list[str]) -> None:
            engine.notices.tell("good", f"{len(names)} capture{'s' * (len(names) != 1)} imported: {', '.join(names)}")
            engine.queue_unfinished()
            engine.publisher.changed(session=True)

        engine.jobs.submit(IMPORTING, partial(read, layout, options), done)

    def _read_folder(self, folder: Path, layout: str, options: dict[str, Any], report: Reporter) -> list[str]:
        store = self._engine.store.guarded(report.saving)
        return import_captures(folder, store, layout, progress=report, warn=self._warn, **options)

    def _read_zip(self, name: str, content: bytes, layout: str, options: dict[str, Any], report: Reporter) -> list[str]:
        store, archive = self._engine.store, io.BytesIO(content)
        report(0.0, f"unpacking {name}")
        with atomic.staged_folder(store.folder / UNPACKED, unpacked_size(archive)) as staged:
            folder = staged / _capture_name(Path(name).stem)
            folder.mkdir()
            try:
                unpacking = report.within(0, 0.2)
                source, warnings = unpack(archive, folder, lambda done: unpacking(done, f"unpacking {name}"))
                for warning in warnings:
                    self._warn(warning)
                return import_captures(
                    source, store.guarded(report.saving), layout, origin=name, progress=report.within(0.2, 1),
                    warn=self._warn, **options,
                )  # fmt: skip
            finally:
                atomic.discard(staged)

    @abstractmethod
    def _warn(self, text: str) -> None: ...


def _capture_name(name: str) -> str:
    """A name for a capture, from that of the upload."""
    plain = "".join(c if (c.isalnum() and c.isascii()) or c in "_-." else "_" for c in name).strip("._-")
    return safe_name(plain[:100] or "capture")
