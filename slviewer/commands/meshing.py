"""From scans to a mesh."""

from pathlib import Path

from tyro.conf import Positional

from slviewer.commands.parsing import Method, ModelName, Start, deferred, ui, write_json


@deferred
def mesh(
    session: Positional[Path],
    names: Positional[tuple[str, ...]],
    out: Path | None = None,
    method: Method | None = None,
    fill_holes: float | None = None,
    triangles: int | None = None,
    smooth: int = 0,
    watertight: bool = False,
    start: Start = "features",
    angle: float | None = None,
    model: ModelName | None = None,
    json: Path | None = None,
    accept_rejected: bool = False,
) -> None:
    """Make a mesh of a scan, or of several that are merged, and write it as .ply, .stl, .obj or .glb.

    Args:
        session: Session folder.
        names: One scan; several, to be merged into the frame of the first; or a merge that is kept, as merge/1.
        out: The file; by default a .ply in the session's exports.
        method: grid joins the pixels of one scan; poisson lays one surface through all points; volume averages them in
            small cells. By default grid for one scan and poisson for merged ones.
        fill_holes: Fill holes of up to so many mm across; by default a few spacings of the points.
        triangles: Thin the mesh to so many triangles.
        smooth: Rounds of smoothing, 0 for none; how far it moved the surface is told.
        watertight: Close the surface, or say why it cannot be closed. A gap that no scan shows, such as the foot
            that an object stands on, is closed flat, and told.
        start: Where the registration of several scans starts from: features finds by itself how they lie; turntable
            uses --angle; identity takes them to lie nearly right already.
        angle: Degrees that the turntable turns from each scan to the next, with --start turntable.
        model: Which calibration to use; by default the best one available.
        json: Write the figures to this file too.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import mesh
    from slviewer.surface.meshing import MeshingPlan

    result = mesh.mesh(
        session,
        names,
        out,
        plan=MeshingPlan(method, fill_holes, triangles, smooth, watertight),
        model=model,
        start=start,
        angle=angle,
        accept_rejected=accept_rejected,
        **ui(),
    )
    write_json(json, result.to_json())
    print(result.text())
