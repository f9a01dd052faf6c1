"""Files for other programs."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from slviewer.commands.parsing import Method, ModelName, deferred, ui

What = Literal["cloud", "mesh", "merge", "merged-mesh", "calibration", "coefficients", "poses", "report", "table"]


@deferred
def export(
    session: Positional[Path],
    what: Positional[What],
    name: Positional[str] = "",
    out: Path | None = None,
    format: str = "",
    model: ModelName | None = None,
    method: Method | None = None,
    fill_holes: float | None = None,
    triangles: int | None = None,
    smooth: int = 0,
    watertight: bool = False,
    accept_rejected: bool = False,
) -> None:
    """Write a file for other programs: shapes in mm as .ply .stl .obj .xyz, in metres as .glb; the calibration; poses.

    Args:
        session: Session folder.
        what: cloud and mesh of a scan; merge (the points) and merged-mesh; calibration for OpenCV or as JSON;
            coefficients of each pixel as .npz; poses of camera, projector, target and scans as 4x4 matrices; report as
            HTML; table of the verifications as CSV.
        name: The scan of a cloud or a mesh; the number of a merge, by default the last; the model of coefficients.
        out: The file, whose suffix says how it is written, or a folder; by default the session's exports.
        format: ply, stl, obj, glb, xyz, yml, xml, json, …, where out is a folder or left out.
        model: Which calibration to make a cloud with, by default the one that the scan is kept from, or the best; or
            which to write (of splined the pinhole and Brown lenses that come nearest, and what they leave).
        method: Of a mesh: triangles between the pixels of one scan, one surface fitted to all points, or the mean
            surface in small cells; by default grid for a scan, poisson for a merge.
        fill_holes: Of a mesh: fill holes up to so many mm across; by default those of a few points.
        triangles: Of a mesh: no more than so many.
        smooth: Of a mesh: rounds of smoothing; how far they moved the surface is said.
        watertight: Of a mesh: closed, or refused.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import export
    from slviewer.surface.meshing import MeshingPlan  # only now: nothing heavy is imported before it is needed

    found = export.export(
        session,
        what,
        name,
        out=out,
        file_format=format,
        model=model,
        plan=MeshingPlan(method, fill_holes, triangles, smooth, watertight),
        accept_rejected=accept_rejected,
        **ui(),
    )
    print(found.text())


@deferred
def decode(
    session: Positional[Path],
    capture: Positional[str],
    out: Path,
    format: Literal["npy", "exr"] = "npy",
) -> None:
    """Decode a capture: absolute phase and projector coordinate of each pixel, the mask with its reasons, a picture.

    Args:
        session: Session folder.
        capture: Name of the capture.
        out: Folder for the files; made if it does not exist. decoded.json in it explains them.
        format: npy (NumPy) or exr (OpenEXR) for the maps, float32, NaN where masked.
    """
    from slviewer.pipeline import decode

    print(decode.decode(session, capture, out, file_format=format, **ui()).text())
