"""From scans or merged points to a mesh that a program or a printer takes: the whole chain, and
what it did."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal, TypeGuard

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError, SlviewerError
from slviewer.geometry.vectors import lengths, median_spacing
from slviewer.inputs import Input, check_inputs
from slviewer.reconstruction.cloud import Cloud, keep_pixels
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.reconstruction.reconstruct import triangulate_grid
from slviewer.surface.edit import (
    DroppedParts,
    FilledHoles,
    SurfaceShift,
    decimate,
    drop_small_parts,
    fill_holes,
    smooth,
)
from slviewer.surface.fuse import fuse
from slviewer.surface.implicit import (
    TrimmedPatches,
    poisson_surface,
    trim_far_patches,
    volume_surface,
)
from slviewer.surface.shapes import Mesh, PointSet, Topology, analyse_topology, select_faces
from slviewer.surface.view import clean, viewing_cosines

Method = Literal["grid", "poisson", "volume"]
Progress = Callable[[float, str], None]

SMALL_HOLE = 5.0
"""Spacings of the points: holes of that size are filled where no size is given."""
SMALL_PART = 1000.0
"""Points, about: larger parts stay, for before a wall an object is a small share of what was
scanned."""
TRIANGLES_PER_POINT = 2
"""Of a closed triangulation of points (Euler's formula); a mesh with more does not show more."""
MOST_IMAGINED = 1 / 3
"""Share of a watertight surface that may be filled in where nothing was measured: the foot of what
stood on a table."""


@dataclass(frozen=True)
class MeshingPlan:
    """How to mesh. Nothing needs to be given.

    Args:
        method: Of a mesh: grid joins the pixels of one scan; poisson fits one surface to all
            points; volume averages them in small cells. By default grid for one scan and poisson
            for merged ones.
        fill_holes_mm: Of a mesh: fill holes of up to so many mm across; by default a few spacings
            of the points.
        triangles: Of a mesh: thin it to so many triangles; by default to two for each point, about
            what a surface through them has.
        smooth: Of a mesh: rounds of smoothing, 0 for none; how far it moved the surface is
            reported.
        watertight: Of a mesh: close the surface, or report why it cannot be closed. A gap that no
            scan shows, such as the foot that an object stands on, is closed flat, and reported.

    `slviewer mesh` and `export` show this. Poisson fills any hole by default where the mesh is to
    be watertight.
    """

    method: Method | None = None
    fill_holes_mm: Annotated[float | None, Input(0, 1e5, "mm", "Hole size", 0.1)] = None
    triangles: Annotated[int | None, Input(4, 1e9, step=1000)] = None
    smooth: Annotated[int, Input(0, 1000)] = 0
    watertight: bool = False

    def __post_init__(self) -> None:
        check_inputs(self)

    def largest_hole_mm(self, method: Method, cell_mm: float) -> float:
        """Return how far across a hole may be to be filled."""
        if self.fill_holes_mm is not None:
            return self.fill_holes_mm
        # Only poisson knows how to go on where there is nothing.
        return np.inf if self.watertight and method == "poisson" else SMALL_HOLE * cell_mm


@dataclass(frozen=True, eq=False)
class BuiltMesh:
    """A mesh and how it was made; steps that were not done are None. ``cell_mm``: the spacing of
    the points."""

    mesh: Mesh
    method: Method
    cell_mm: float
    dropped: DroppedParts
    trimmed: TrimmedPatches | None
    filled: FilledHoles | None
    smoothed: SurfaceShift | None
    thinned: SurfaceShift | None
    topology: Topology

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        plain: dict[str, Any] = {
            name: None if (step := getattr(self, name)) is None else asdict(step)
            for name in ("dropped", "trimmed", "filled", "smoothed", "thinned")
        }
        return {
            "method": self.method,
            "cell_mm": self.cell_mm,
            "vertices": len(self.mesh.vertices),
            "triangles": len(self.mesh.faces),
            **plain,
            "watertight": self.topology.watertight,
            "openings_mm": list(self.topology.openings_mm),
            "volume_mm3": self.topology.volume_mm3 if self.topology.watertight else None,
        }

    def text(self) -> str:
        """Describe the mesh for the terminal."""
        lines = [
            f"{len(self.mesh.faces)} triangles by {self.method}, points {self.cell_mm:.2f} mm apart"
        ]
        if self.dropped.parts:
            lines.append(
                f"{self.dropped.parts} floating parts removed, up to"
                f" {self.dropped.largest_mm2:.1f} mm2"
            )
        for done, holes in ((self.trimmed, "filled"), (self.filled, "holes")):
            if done is not None and (n := getattr(done, holes)):
                lines.append(
                    f"{n} hole{'s' * (n > 1)} filled, up to {done.largest_mm:.1f} mm across"
                )
        if self.trimmed is not None:
            if self.trimmed.flattened:
                lines.append(
                    f"{self.trimmed.flattened} of them filled flat, because the surface bulged"
                    " there"
                )
            if self.trimmed.imagined:
                share = f"{100 * self.trimmed.imagined:.1f} %"
                lines.append(f"{share} of the surface was not measured: it closes those holes")
        for what, change in (("smoothing", self.smoothed), ("thinning", self.thinned)):
            if change is not None:
                lines.append(
                    f"{what} moved the surface by {change.rms_mm:.4f} mm RMS, {change.max_mm:.3f}"
                    f" mm at most ({change.before} -> {change.after} triangles)"
                )
        if self.topology.watertight:
            lines.append(f"watertight, {self.topology.volume_mm3 / 1000:.2f} cm3")
        else:
            lines.append(f"not watertight: {self.topology.faults()}")
        return "\n".join(lines)


def build_mesh(
    shape: Cloud | PointSet,
    plan: MeshingPlan | None = None,
    progress: Progress | None = None,
) -> BuiltMesh:
    """Mesh one scan's organised cloud, or the points of a merge (with normals), as planned.

    ``progress`` receives the share of the work done, 0 to 1, and what is being done; it may raise
    to cancel.

    Raises InputError for a plan that does not go with the shape, and SlviewerError where there is
    no surface, or none that can be closed as asked.
    """
    plan, report = plan or MeshingPlan(), progress or (lambda share, step: None)
    method = plan.method or ("grid" if _has_grid(shape) and not plan.watertight else "poisson")
    report(0.0, "finding the surface")
    points = (
        shape if isinstance(shape, PointSet) else fuse({"scan": shape}, {"scan": np.eye(4)}).surface
    )
    cell = measure_spacing(points)
    limit = plan.largest_hole_mm(method, cell)
    report(0.1, f"meshing by {method}")
    trimmed = filled = smoothed = None
    if method == "grid":
        mesh = grid_mesh(shape)
    elif points.normals is None:
        raise InputError(
            "These points have no normals",
            "a surface through them needs to know its outside; merge the scans again.",
        )
    elif method == "volume":
        mesh = volume_surface(points, cell)
    else:
        mesh = poisson_surface(points, cell)
        report(0.5, "cutting off what was not measured")
        mesh, trimmed = trim_far_patches(mesh, points, cell, limit)
    if not len(mesh.faces):
        raise SlviewerError(
            "No surface could be laid through the points", "merge scans that overlap more."
        )
    report(0.6, "excluding floating parts")
    mesh, dropped = drop_small_parts(mesh, SMALL_PART * cell**2)
    if method != "poisson" and limit > 0:
        report(0.65, "filling holes")
        mesh, filled = fill_holes(mesh, limit)
    if plan.smooth:
        report(0.7, "smoothing")
        mesh, smoothed = smooth(mesh, plan.smooth)
    report(0.8, "thinning")
    mesh, thinned = _thin(mesh, plan, len(points))
    report(0.95, "checking")
    topology = analyse_topology(mesh)
    if plan.watertight:
        _refuse_if_open(topology, trimmed, method)
    report(1.0, "meshed")
    return BuiltMesh(mesh, method, cell, dropped, trimmed, filled, smoothed, thinned, topology)


def _thin(mesh: Mesh, plan: MeshingPlan, points: int) -> tuple[Mesh, SurfaceShift | None]:
    """Thin a mesh through a number of points to the plan's number of triangles, by default that of
    the points; None where it has no more."""
    most = plan.triangles or TRIANGLES_PER_POINT * points
    if len(mesh.faces) <= most:
        return mesh, None
    thinned, shift = decimate(mesh, most)
    if plan.triangles is None and plan.watertight and not analyse_topology(thinned).watertight:
        return mesh, None  # it was closed, perhaps
    return thinned, shift


def _has_grid(shape: Cloud | PointSet) -> TypeGuard[Cloud]:
    """Return whether pixels of a shape are neighbours on the surface."""
    return isinstance(shape, Cloud) and shape.normals is None


def measure_spacing(points: PointSet) -> float:
    """Median distance in mm of a point to its nearest neighbour."""
    if len(points) < 2:
        raise InputError(f"{len(points)} points make no surface.")
    if not np.isfinite(points.points).all():
        raise InputError("Some points are NaN", "select the valid ones first.")
    median_mm = median_spacing(cKDTree(points.points), 20_000)
    if not median_mm > 0:
        raise InputError("Most points are there twice", "merge the scans instead of joining them.")
    return median_mm


def _refuse_if_open(topology: Topology, trimmed: TrimmedPatches | None, method: Method) -> None:
    """Raise SlviewerError where the mesh is not watertight, or too much of it is extrapolated."""
    if not topology.watertight:
        remedy = "fill holes of that size, or use poisson"
        if method == "poisson":
            remedy = "fill larger holes, or scan there"
        raise SlviewerError(f"The surface does not close: {topology.faults()}; {remedy}.")
    if trimmed is not None and trimmed.imagined > MOST_IMAGINED:
        raise SlviewerError(
            f"{100 * trimmed.imagined:.0f} % of the closed surface would be imagined, not measured"
            f" (the largest gap is {trimmed.largest_mm:.0f} mm across)",
            "scan the object from more sides, or do without watertight.",
        )


def grid_mesh(cloud: Cloud | PointSet) -> Mesh:
    """Triangles of an organised cloud in its camera's frame, cut at depth jumps, without flying and
    stray pixels.

    Vertices carry the pixels' normals, colours and sigmas (along the normal). Raises InputError for
    merged points, and where no two neighbouring pixels lie on a surface.
    """
    if not _has_grid(cloud):
        raise InputError(
            "Merged or imported points have no pixels",
            "the method grid takes a single scan; use poisson or volume.",
        )
    normals = grid_normals(cloud.points)
    cleaned, _ = clean(cloud, normals)
    points = keep_pixels(cloud.points, cleaned)
    faces = triangulate_grid(points)
    if not len(faces):
        raise InputError(
            "No two neighbouring pixels of this scan lie on a surface", "reconstruct it again."
        )
    along = viewing_cosines(points, normals) * lengths(points) / points[..., 2]
    sigma = (cloud.sigma * along)[cleaned]
    colours = None if (rgb := cloud.rgb) is None else rgb[cleaned]
    known = sigma if np.isfinite(sigma).all() else None
    mesh = Mesh(points[cleaned], faces, normals[cleaned], colours, known)
    return select_faces(mesh, np.ones(len(faces), bool))
