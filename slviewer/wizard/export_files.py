"""Files for other programs, made in the session's `exports` folder."""

from slviewer.pipeline.export import What, default_file_name, export
from slviewer.pipeline.feedback import Warn
from slviewer.pipeline.measured_surface import MERGED
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
    texture: int | None,
    report: Reporter,
    warn: Warn,
    white: str = "",
) -> str:
    """Write one file, as `pipeline.export.export` does; returns a sentence that begins with the
    file's name.

    ``texture``: side of the image of a mesh, px, None for a mesh without one; ``white``: its white
    balance.
    """
    accepts, progress = accepts_rejected(session), report.within(0, 0.98)
    if texture is None:
        with session.guarded(report.saving).staged_export(
            default_file_name(what, name, file_format)
        ) as path:
            exported = export(
                session,
                what,
                name,
                out=path,
                plan=plan,
                accept_rejected=accepts,
                progress=progress,
                warn=warn,
            )
        words = exported.words
    else:
        source = f"{MERGED}{name}" if what == "merged-mesh" else name
        path = session.exports / default_file_name(what, name, file_format)
        made = mesh(
            session, [source], path, plan=plan, texture=texture, white=white,
            accept_rejected=accepts,
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
