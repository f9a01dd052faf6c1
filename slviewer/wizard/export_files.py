"""Files for other programs, made in the session's `exports` folder."""

from slviewer.pipeline.export import What, default_file_name, export
from slviewer.pipeline.feedback import Warn
from slviewer.pipeline.mesh import mesh
from slviewer.pipeline.models import accepts_rejected
from slviewer.session.store import Session
from slviewer.surface.meshing import MeshingPlan
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.snapshot import ExportView


def export_file(
    session: Session,
    what: What,
    name: str,
    file_format: str,
    plan: MeshingPlan | None,
    report: Reporter,
    warn: Warn,
) -> str:
    """Write one file, as `pipeline.export.export` does; returns a sentence that begins with the
    file's name."""
    with session.guarded(report.saving).staged_export(
        default_file_name(what, name, file_format)
    ) as path:
        exported = export(
            session,
            what,
            name,
            out=path,
            plan=plan,
            accept_rejected=accepts_rejected(session),
            progress=report.within(0, 0.98),
            warn=warn,
        )
    report(1.0, "exported")
    return f"{path.name} is ready to download: {exported.words}"


def export_textured(
    session: Session,
    source: str,
    file_name: str,
    plan: MeshingPlan | None,
    texture: int,
    white: str,
    report: Reporter,
    warn: Warn,
) -> str:
    """Write the mesh of a scan or a merge with a texture, as `pipeline.mesh.mesh` does; returns a
    sentence that begins with the file's name.

    ``texture``: side of its image, px; ``white``: its white balance.
    """
    made = mesh(
        session,
        [source],
        session.exports / file_name,
        plan=plan,
        texture=texture,
        white=white,
        accept_rejected=accepts_rejected(session),
        progress=report.within(0, 0.98),
        warn=warn,
    )
    assert made.textured is not None
    report(1.0, "exported")
    return (
        f"{file_name} is ready to download: {made.meshed.text().splitlines()[0]};"
        f" {made.textured.text()}"
    )


def list_exports(session: Session) -> tuple[ExportView, ...]:
    """List the files in the exports folder, sorted by path."""
    files = sorted(each for each in (session.folder / "exports").glob("[!.]*") if each.is_file())
    return tuple(ExportView(each.name, each, each.stat().st_size) for each in files)
