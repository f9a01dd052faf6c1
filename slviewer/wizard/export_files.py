"""Files for other programs, made in the session's `exports` folder."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slviewer.pipeline.export import What, default_file_name, export
from slviewer.pipeline.feedback import Warn
from slviewer.pipeline.mesh import MERGE, mesh
from slviewer.pipeline.models import accepts_rejected
from slviewer.session import atomic
from slviewer.session.atomic import rename
from slviewer.session.names import safe_name
from slviewer.session.store import Session
from slviewer.surface.meshing import MeshingPlan
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.snapshot import ExportView


@contextmanager
def staged_export(session: Session, name: str, report: Reporter) -> Iterator[Path]:
    """Yield a temporary path for `name`; at the end the file is moved to the exports, unless the work was cancelled."""
    target = session.exports / safe_name(name)
    with atomic.staged_folder(target, 0) as folder:
        yield folder / name
        report.saving()
        rename(folder / name, target)
    atomic.discard(folder)


def export_file(
    session: Session,
    what: What,
    name: str,
    file_format: str,
    plan: MeshingPlan | None,
    texture: int | None,
    report: Reporter,
    warn: Warn,
    white: str = "",
) -> str:
    """Write one file, as `pipeline.export.export` does; returns a sentence that begins with the file's name.

    ``texture``: side of the image of a mesh, px, None for a mesh without one; ``white``: its white balance.
    """
    accepts, progress = accepts_rejected(session), report.within(0, 0.98)
    if texture is None:
        with staged_export(session, default_file_name(what, name, file_format), report) as path:
            exported = export(
                session, what, name, out=path, plan=plan, accept_rejected=accepts, progress=progress, warn=warn
            )
        words = exported.words
    else:
        source = f"{MERGE}{name}" if what == "merged-mesh" else name
        path = session.exports / default_file_name(what, name, file_format)
        made = mesh(
            session, [source], path, plan=plan, texture=texture, white=white, accept_rejected=accepts,
            progress=progress, warn=warn,
        )  # fmt: skip
        assert made.textured is not None
        words = f"{made.meshed.text().splitlines()[0]}; {made.textured.text()}"
    report(1.0, "exported")
    return f"{path.name} is ready to download: {words}"


def list_exports(session: Session) -> tuple[ExportView, ...]:
    """List the files in the exports folder, sorted by path."""
    files = sorted(each for each in (session.folder / "exports").glob("[!.]*") if each.is_file())
    return tuple(ExportView(each.name, each, each.stat().st_size) for each in files)
