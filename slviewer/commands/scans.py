"""From captures to clouds, merged scans and meshes, and how right they are."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from slviewer.commands.parsing import Axis, Method, ModelName, Start, deferred, ui, write_json
from slviewer.errors import SlviewerError


@deferred
def reconstruct(
    session: Positional[Path],
    capture: Positional[str],
    model: ModelName | None = None,
    axis: Axis | None = None,
    depth_range: tuple[float, float] | None = None,
    out: Path | None = None,
    grid: Path | None = None,
    mesh: bool = False,
    accept_rejected: bool = False,
) -> None:
    """Reconstruct a capture as a cloud; a board pose also says how flat each model measures the board.

    Args:
        session: Session folder.
        capture: Name of the capture.
        model: Which calibration to use; by default the best one available.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted noise.
        depth_range: For patterns that do not cover the projector: near and far end, mm, of the depths between which
            all surfaces lie; by default the calibrated depths.
        out: PLY file; by default in the session's exports. That of a board pose holds the points inside the board's
            outline.
        grid: Also write the whole organised cloud, (h, w, 3) float32 mm, NaN where invalid, as .npy.
        mesh: Put the triangles between neighbouring pixels into the PLY.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import reconstruct

    result = reconstruct.reconstruct(
        session,
        capture,
        model=model,
        axis=axis,
        depth_range=depth_range,
        out=out,
        grid=grid,
        mesh=mesh,
        accept_rejected=accept_rejected,
        **ui(),
    )
    print(result.text())


@deferred
def verify(
    session: Positional[Path],
    captures: Positional[tuple[str, ...]],
    shape: Literal["plane", "sphere"],
    model: tuple[ModelName, ...] = (),
    range: tuple[float, float] | None = None,
    radius: float | None = None,
    axis: Axis | None = None,
    json: Path | None = None,
    accept_rejected: bool = False,
) -> None:
    """Measure captures of a plane or a sphere with each model, and compare.

    Args:
        session: Session folder.
        captures: Names of the captures.
        shape: What the captures show.
        model: Which calibrations to compare; by default all there are.
        range: Near and far end of the calibrated depths R2, mm; by default those of the board poses.
        radius: Nominal radius of the sphere, mm: helps to find it; the fitted radius stays free.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted noise.
        json: Write the result to this file too.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import verify

    result = verify.verify(
        session,
        captures,
        shape,
        models=model,
        depth_range=range,
        radius=radius,
        axis=axis,
        accept_rejected=accept_rejected,
        **ui(),
    )
    write_json(json, result.to_json())
    print(result.text())


@deferred
def merge(
    session: Positional[Path],
    captures: Positional[tuple[str, ...]],
    reference: str,
    out: Path | None = None,
    model: ModelName | None = None,
    start: Start = "features",
    angle: float | None = None,
    json: Path | None = None,
    accept_rejected: bool = False,
) -> None:
    """Register scans to a reference scan, close their loops, and fuse them into one surface.

    Says how surely each pair lies, how well loops close, and what was left out, and why.

    Args:
        session: Session folder.
        captures: Names of the captures, in the order in which they were taken.
        reference: The capture whose frame the merged cloud takes.
        out: PLY file. Left out, the session keeps the merge as merge/1 and so on, for mesh, compare, measure and
            export, and its file is in the session's exports.
        start: Where registration starts from: features finds by itself how the scans lie; turntable uses --angle;
            identity takes them to lie nearly right already.
        angle: Degrees that the turntable turns from each capture to the next, with --start turntable.
        model: Which calibration to use; by default the best one available.
        json: Write the registrations to this file too.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import merge

    result = merge.merge(
        session,
        captures,
        reference,
        out,
        model=model,
        start=start,
        angle=angle,
        accept_rejected=accept_rejected,
        **ui(),
    )
    write_json(json, result.to_json())
    print(result.text())


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


@deferred
def compare(
    session: Positional[Path],
    scan: Positional[str],
    nominal: Positional[Path],
    tolerance: float | None = None,
    units: Literal["mm", "cm", "m", "inch"] | None = None,
    reach: float | None = None,
    out: Path | None = None,
    json: Path | None = None,
    model: ModelName | None = None,
    accept_rejected: bool = False,
) -> None:
    """Compare a scan with a nominal model after best-fit alignment: figures, coloured points, pictures in the report.

    Args:
        session: Session folder.
        scan: Name of the capture, or merge/1 and the like for a merge that the session keeps.
        nominal: STL, PLY or OBJ file of the part as it should be.
        tolerance: Plus and minus, mm; the answer is pass, fail, or too close to tell.
        units: What the file's numbers are; asked for where its size does not fit the scan's.
        reach: Points farther than this from the nominal, mm, belong to something else (a table, a clamp); by default
            2 % of the nominal's diagonal.
        out: PLY file, the deviation as a scalar and as colours; by default in the session's exports.
        json: Write the figures to this file too.
        model: Which calibration to use; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import compare

    result = compare.compare(
        session,
        scan,
        nominal,
        tolerance=tolerance,
        units=units,
        reach=reach,
        out=out,
        model=model,
        accept_rejected=accept_rejected,
        **ui(),
    )
    write_json(json, result.to_json())
    print(result.text())


@deferred
def batch(
    sessions: Positional[tuple[str, ...]],
    do: Literal["reconstruct", "verify", "mesh"],
    captures: tuple[str, ...] = (),
    shape: Literal["plane", "sphere"] | None = None,
    radius: float | None = None,
    model: ModelName | None = None,
    scheduler: str | None = None,
    json: Path | None = None,
    accept_rejected: bool = False,
) -> None:
    """Reconstruct, verify or mesh the captures of many sessions, on this machine's cores or a Dask cluster.

    What it makes is what each command makes alone, in each session's exports. A capture that fails is named in the end,
    with status 1, and stops no other.

    Args:
        sessions: Session folders that all workers see, or addresses such as s3://bucket/session.
        do: What to do with each capture.
        captures: Their names, or patterns such as 'plane_*'; by default all scans.
        shape: What the captures show, with --do verify.
        radius: Nominal radius of the spheres, mm, with --do verify.
        model: Which calibration to use; by default each session's best one, and all there are with --do verify.
        scheduler: Address of a Dask scheduler, such as tcp://host:8786; by default a cluster of this machine's cores.
        json: Write the summary to this file too.
        accept_rejected: Use calibrations although their verdict rejects them.
    """
    from slviewer.pipeline import batch

    result = batch.batch(
        sessions,
        do,
        captures=captures,
        shape=shape,
        radius=radius,
        model=model,
        scheduler=scheduler,
        accept_rejected=accept_rejected,
        **ui(),
    )
    write_json(json, result.to_json())
    print(result.text())
    if result.failed:
        raise SlviewerError(f"{len(result.failed)} of the batch failed: the summary says which, and why")
