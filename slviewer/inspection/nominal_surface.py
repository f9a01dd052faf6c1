"""A nominal model: signed distances of points from it, and initial alignment of a scan to it."""

from contextlib import suppress
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from slviewer.errors import InputError, SlviewerError
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import box_middle, diagonal, lengths, subsample, unit_vectors
from slviewer.registration.open3d_loader import open3d, raycasting_scene
from slviewer.registration.pairwise import (
    MOST_ATTEMPTS,
    Progress,
    Registration,
    register_prepared,
    search_starts,
)
from slviewer.registration.refusal import Refused
from slviewer.registration.scan import PreparedScan, prepare_scan
from slviewer.surface.shapes import Mesh, count_edges

RIM = 0.5
"""Cosine: what the rim of an open surface faces less than this lies beyond it, not above it."""
CORNER = 1e-4
"""Barycentric: nearer to a side than this, the nearest place lies on it."""
NEGLIGIBLE = 1e-4
"""mm: directions from nearer than this to the surface are rounding."""


class NominalSurface:
    """A mesh, closed or open, whose normals point outside. Distances are right within a
    micrometre."""

    def __init__(self, mesh: Mesh):
        import trimesh

        if not len(mesh.faces):
            raise InputError("The nominal model has no triangles: give a mesh.")
        vertices = mesh.vertices.astype(np.float64)
        self.middle = box_middle(vertices)  # casting in float32 is finest about 0
        self.diagonal = diagonal(vertices)
        self._mesh: Any = trimesh.Trimesh(vertices - self.middle, mesh.faces, process=False)
        if not self._mesh.area > 0:
            raise InputError("The nominal model's triangles have no area: give another file.")
        self._flat = np.asarray(self._mesh.face_normals)
        # normals of the vertices weighted by the triangles' angles tell the side of a place
        # (Bærentzen and Aanæs 2005)
        self._smooth = np.asarray(self._mesh.vertex_normals)
        self._faces = mesh.faces
        # the vertices at edges of one triangle alone
        half, first, _, triangles = count_edges(mesh.faces)
        self._at_rim = np.zeros(len(vertices), bool)
        self._at_rim[half[first[triangles == 1]]] = True
        self._scene = raycasting_scene(vertices - self.middle, mesh.faces)

    def signed(self, points: Floats) -> tuple[Floats, Floats]:
        """Distances (n,) mm of places (n, 3), positive outside, infinite beyond the rim of an open
        mesh; and the surface's normals (n, 3) where each is nearest."""
        centred = points - self.middle
        nearest = self._scene.compute_closest_points(
            open3d().core.Tensor(centred.astype(np.float32))
        )
        face = nearest["primitive_ids"].numpy().astype(np.int64)
        s, t = nearest["primitive_uvs"].numpy().astype(np.float64).T
        offsets = centred - nearest["points"].numpy().astype(np.float64)
        normals = self._flat[face]
        # inside a triangle its own plane says how far; at a side or corner the direction does, and
        # the side of the surface follows from the normals of the vertices there
        at_side = (s < CORNER) | (t < CORNER) | (1 - s - t < CORNER)
        away = np.sum(normals * offsets, axis=1)
        weights, corners = np.stack([1 - s - t, s, t], axis=1), self._faces[face]
        smooth = unit_vectors((self._smooth[corners] * weights[..., None]).sum(axis=1))
        gaps, above = lengths(offsets), np.sum(smooth * offsets, axis=1)
        signs = np.where(above < 0, -1.0, 1.0)
        is_off = at_side & (gaps > NEGLIGIBLE)
        away = np.where(is_off, signs * gaps, away)
        at_rim = (self._at_rim[corners] | (weights < CORNER)).all(axis=1)
        away[is_off & at_rim & (np.abs(above) < RIM * gaps)] = np.inf
        towards = (signs / np.maximum(gaps, 1e-300))[:, None] * offsets
        is_clear = at_side & (gaps > 10 * NEGLIGIBLE)
        normals = np.where(is_clear[:, None], towards, normals)
        return away, normals

    def seen_from(self, places: Floats, facing: Floats, view: Floats, least: float) -> Mask:
        """Return which places (n, 3) on the surface, facing (n, 3), are visible from far away in
        the direction ``view`` (3,); ``least``: cosine between the two. Returns (n,) bool."""
        is_visible = facing @ view > least
        lift = 1e-4 * self.diagonal
        origins = (places[is_visible] - self.middle + lift * facing[is_visible]).astype(np.float32)
        rays = np.concatenate([origins, np.broadcast_to(view, origins.shape)], axis=1).astype(
            np.float32
        )
        is_visible[is_visible] = ~self._scene.test_occlusions(open3d().core.Tensor(rays)).numpy()
        return is_visible

    def sample(self, count: int, seed: int = 0) -> tuple[Floats, Floats]:
        """Places (count, 3) mm evenly over the area, and the unit normals (count, 3) there."""
        import trimesh

        places, face = trimesh.sample.sample_surface(self._mesh, count, seed=seed)
        return np.asarray(places) + self.middle, self._flat[face]


SAMPLES = 60_000
"""Points of the nominal that a scan is aligned with, all around it."""
MAX_POINTS = 40_000
MIN_VISIBLE = 2_000
GOOD_RMS = 0.002
"""Of the nominal's diagonal: no better place is looked for than one that leaves less, or thrice the
noise, of most of the scan."""
GOOD_OVERLAP = 0.6
LEAST_SCORE = 0.1
"""Share of the scan that must lie on the nominal after the coarse search: from there on a pose is
refined. The part itself reaches 0.5 and more, other parts below 0.15."""
VIEWS = [
    unit_vectors(np.array(view))
    for view in sorted(
        product((-1, 0, 1), repeat=3), key=lambda v: (np.count_nonzero(v), -abs(v[2]))
    )[1:]
]
"""From where a model is looked at: its sides, from below and above first, then its edges, then its
corners."""
MIN_FACING_COSINE = 0.1
AWAY = 3.0
"""Diagonals: from so far."""


def search_start(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    sigma_mm: float | None,
    report: Progress,
    has_camera: bool = True,
) -> Registration:
    """The scan (n, 3) registered to the nominal.

    A scan that ``has_camera`` shows one side of a part: the nominal is tried as a camera sees it
    from each of `VIEWS`, until one fits well; else the best that is accepted. Raises the first
    refusal where none is.
    """
    places, facing = surface.sample(SAMPLES)
    if normals is not None:
        normals = subsample(normals, MAX_POINTS)
    scan = prepare_scan("scan", subsample(points, MAX_POINTS), normals, sigma_mm, has_camera)
    if not has_camera:
        whole = prepare_scan("nominal model", places, facing, has_camera=False)
        with suppress(SlviewerError):  # it may show one side all the same
            return _register_symmetric(scan, whole)
    good = max(GOOD_RMS * surface.diagonal, 3.0 * (sigma_mm or 0.0))
    refusal: SlviewerError | None = None
    best: Registration | None = None
    for turn, view in enumerate(VIEWS):
        report(turn / len(VIEWS))
        visible = surface.seen_from(places, facing, view, MIN_FACING_COSINE)
        if np.count_nonzero(visible) < MIN_VISIBLE:
            continue
        camera = surface.middle + AWAY * surface.diagonal * view
        try:
            result = _register_symmetric(
                scan, prepare_scan("nominal model", places[visible] - camera, facing[visible])
            )
        except SlviewerError as error:
            refusal = refusal or error
            continue
        T = result.T_reference_scan.copy()
        T[:3, 3] += camera
        result = replace(result, T_reference_scan=T)
        if best is None or result.rms_mm / result.overlap < best.rms_mm / best.overlap:
            best = result
        if best.rms_mm <= good and best.overlap >= GOOD_OVERLAP:
            break
    if best is None and isinstance(refusal, Refused):
        raise refusal.with_context(
            "The scan could not be aligned to the nominal model: see that it shows this part, at"
            " this size, and that little else is in view. One of the tries ended so:"
        )
    if best is None:
        raise refusal or SlviewerError(
            "The nominal model shows no side that a scan could lie on: check the file."
        )
    return best


def _register_symmetric(scan: PreparedScan, reference: PreparedScan) -> Registration:
    """Register as ``register_prepared``; of a part with symmetries return the pose of least
    residuals: the choice among them does not change the deviations."""
    size = min(scan.size, reference.size)
    starts = search_starts(scan, reference, size)
    if starts[0].score < LEAST_SCORE:
        raise Refused(
            "overlap",
            f"At most {100 * starts[0].score:.0f} % of the scan lies on a side of the model, in any"
            " of its poses.",
        )
    try:
        return register_prepared(scan, reference, size, starts)
    except Refused as error:
        if error.reason != "ambiguous":
            raise
        refusal = error
    alike = []
    for start in starts[:MOST_ATTEMPTS]:
        try:
            given = replace(start, start="initial")
            alike.append(register_prepared(scan, reference, size, given))
        except Refused:
            continue
    if not alike:
        raise refusal
    return min(alike, key=lambda result: result.rms_mm / result.overlap)
