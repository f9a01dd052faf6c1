"""Surfaces that light themselves: a V-groove and a bowl with interreflections, and wax in which
light scatters.

The light that a surface receives from itself is linear in the projected pattern. It is computed
once per scene as a matrix from projector columns, or rows, to vertices, and multiplied by the
profile of each frame. Radiosity of patches: Goral et al., "Modeling the interaction of light
between diffuse surfaces", SIGGRAPH 1984; form factors from a point to a polygon: Lambert's formula;
glossy lobes: Phong's, normalised.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from slviewer.fringe.sequence import Axis
from slviewer.geometry.vectors import lengths, unit_vectors
from slviewer.simulation.boards import Pose
from slviewer.simulation.light import window
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.rig import SimulatedRig

_CHUNK = 64  # vertices at a time, which bounds the memory
_SAMPLES = 8
"""Samples of the pattern along each side of a patch: patches are wider than a stripe is fine."""
_FINEST_MM, _COARSEST_MM = 0.3, 3.0
"""Width of patches at a fold and far from it."""


@dataclass(frozen=True)
class Indirect:
    """Light that reaches a surface from itself.

    ``bounces``: 0 to 2 reflections between patches. ``gloss``: share of the reflected light that
    forms a lobe about the mirrored direction, of Phong's ``exponent``; the rest is diffuse, as is
    all light after the first bounce. ``scattered``: share of the light that enters the material,
    and leaves it ``reach_mm`` away in the mean.
    """

    bounces: int = 2
    gloss: float = 0.0
    exponent: float = 20.0
    scattered: float = 0.0
    reach_mm: float = 2.0


@dataclass(frozen=True, eq=False)
class ConcaveScene(MeshScene):
    """A mesh of quadrilateral patches (m, 4) each of which sees all others in front of it, and its
    indirect light."""

    patches: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), int))
    indirect: Indirect = field(default_factory=Indirect)

    def light_matrix(self, rig: SimulatedRig, axis: Axis) -> np.ndarray:
        """Return (n, extent) float32: irradiance of each vertex by the surface itself, per
        projector column or row.

        In the unit of the renderer's direct light; its sum over the columns is that in full white
        light.
        """
        received = self._direct_matrix(rig, axis)
        total = np.zeros((len(self.vertices), received.shape[1]), np.float32)
        light = self.indirect
        if light.scattered:
            total += light.scattered * (self._scattering @ received)
        if light.bounces:
            first = (self._form_factors * self._lobe(rig)) @ received
            total += first
            if light.bounces == 2:
                total += self._form_factors @ (self.albedo * first[self.patches].mean(axis=1))
        return total

    def pixel_weights(self, rays: np.ndarray) -> csr_matrix:
        """Return the (h w, n) weights that interpolate values of vertices at the points that rays
        (h, w, 2) meet."""
        index, uv = self.cast(rays)
        pixel = np.flatnonzero(index >= 0)
        s, t = uv.reshape(-1, 2)[pixel].T
        corners = self.triangles[index.ravel()[pixel]]
        weights = np.stack([1 - s - t, s, t], axis=1)
        shape = (index.size, len(self.vertices))
        return csr_matrix(
            (weights.ravel(), (np.repeat(pixel, 3), corners.ravel())), shape=shape, dtype=np.float32
        )

    def _direct_matrix(self, rig: SimulatedRig, axis: Axis) -> np.ndarray:
        """Return (m, extent) float32: mean irradiance of each patch by each projector column or
        row.

        Each patch is sampled at many places, so that stripes narrower than a patch are averaged
        rather than aliased.
        """
        corners, (normal, _) = self._corners, self._normals_and_areas
        k = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        a, b = (each.ravel()[:, None] for each in np.meshgrid(k, k))
        # (4, samples)
        weights = np.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b])[..., 0]
        points = np.einsum("mkd,ks->msd", corners, weights)
        way = rig.projector_centre - points
        distance = lengths(way)
        facing = np.clip((way * normal[:, None]).sum(-1) / distance, 0, None)
        shade = facing * (rig.light.focus_mm / distance) ** 2
        shade[shade > 0] *= ~self.occluded(points[shade > 0], rig.projector_centre)
        u, v = np.moveaxis(rig.project(points), -1, 0)
        columns, rows = rig.projector.size
        blur = np.full(u.shape, rig.light.blur_px)
        shade *= window(u, columns, blur) * window(v, rows, blur) / weights.shape[1]
        coordinate, extent = (u, columns) if axis == "x" else (v, rows)
        place = np.clip(np.nan_to_num(coordinate), 0, extent - 1.001)
        left = place.astype(int)
        share = place - left
        out = np.zeros((len(corners), extent), np.float32)
        patch = np.arange(len(corners))[:, None]
        np.add.at(out, (patch, left), shade * (1 - share))
        np.add.at(out, (patch, left + 1), shade * share)
        return out

    @cached_property
    def _corners(self) -> np.ndarray:
        """(m, 4, 3) mm: the patches' corners in the camera frame."""
        return self.placed[self.patches]

    @cached_property
    def _normals_and_areas(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals (m, 3) and areas (m,) mm^2 of the patches."""
        corners = self._corners
        twice = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        size = lengths(twice)
        return twice / size[:, None], size / 2

    @cached_property
    def _form_factors(self) -> np.ndarray:
        """(n, m) float32 in 0 ... 1: irradiance of each vertex by each patch of radiosity 1, by
        Lambert's formula."""
        corners, facing = self._corners, self._normals_and_areas[0]
        out = np.zeros((len(self.vertices), len(corners)), np.float32)
        for first in range(0, len(out), _CHUNK):
            some = slice(first, first + _CHUNK)
            normals, at = self.vertex_normals[some], self.placed[some, None, None]
            to = corners[None] - at
            size = np.linalg.norm(to, axis=-1, keepdims=True)
            beside = (size < 1e-6).any(axis=(2, 3))  # of its own patches a vertex receives nothing
            to /= np.maximum(size, 1e-9)
            after = np.roll(to, -1, axis=2)
            across = np.cross(to, after)
            sine = lengths(across)
            angle = np.arctan2(sine, (to * after).sum(-1)) / np.maximum(sine, 1e-12)
            total = (angle[..., None] * across).sum(2) @ normals[:, :, None]
            middle = corners.mean(axis=1)[None] - at[:, :, 0]
            visible = (middle * normals[:, None]).sum(-1) > 0
            visible &= (middle * facing[None]).sum(-1) < 0
            factor = np.abs(total)[..., 0] / (2 * np.pi)
            out[some] = np.where(visible & ~beside, factor, 0)
        return out

    def _lobe(self, rig: SimulatedRig) -> np.ndarray:
        """Return (n, m) float32: radiosity of each patch as each vertex sees it, per irradiance by
        the projector."""
        light = self.indirect
        if not light.gloss:
            return np.full((1, 1), self.albedo, np.float32)
        normal, middle = self._normals_and_areas[0], self._corners.mean(axis=1)
        source = unit_vectors(rig.projector_centre - middle)
        mirrored = 2 * (source * normal).sum(-1, keepdims=True) * normal - source
        way = unit_vectors(self.placed[:, None] - middle[None])
        cosine = np.clip((way * mirrored[None]).sum(-1), 0, 1)
        lobe = (light.exponent + 2) / 2 * cosine**light.exponent
        return (self.albedo * (1 - light.gloss + light.gloss * lobe)).astype(np.float32)

    @cached_property
    def _scattering(self) -> np.ndarray:
        """(n, m) float32: share of the light on a patch that leaves at a vertex, exponential in
        their distance."""
        area, middle = self._normals_and_areas[1], self._corners.mean(axis=1)
        distance = lengths(self.placed[:, None] - middle[None])
        # the mean distance of exp(-r / length) over a plane is twice its length
        length = self.indirect.reach_mm / 2
        return (area / (2 * np.pi * length**2) * np.exp(-distance / length)).astype(np.float32)


def groove(
    pose: Pose, angle_deg: float = 90.0, albedo: float = 0.8, indirect: Indirect = Indirect()
) -> ConcaveScene:
    """Return a V-groove: two walls 60 mm wide that meet at ``angle_deg`` in a fold along y, open
    towards -z."""
    half = np.radians(angle_deg / 2)
    steps = [0.0]  # from the fold: fine ones first, which grow
    while steps[-1] < 60.0:
        steps.append(steps[-1] + np.clip(0.15 * steps[-1], _FINEST_MM, _COARSEST_MM))
    away = np.array(steps) * (60.0 / steps[-1])
    along = np.linspace(-45.0, 45.0, int(np.ceil(90.0 / _COARSEST_MM)) + 1)
    walls = []
    for side in (-1, 1):
        x, z = np.stack([side * away * np.sin(half), -away * np.cos(half)])[:, ::side]
        walls.append(np.stack(np.broadcast_arrays(x[:, None], along[None], z[:, None]), axis=-1))
    return _make_scene(walls, pose, albedo, indirect)


def bowl(
    pose: Pose, radius_mm: float = 60.0, opening_deg: float = 70.0, albedo: float = 0.8
) -> ConcaveScene:
    """Return the inside of a sphere, up to ``opening_deg`` from its deepest point, which is the
    origin; open to -z."""
    edge = radius_mm * np.sin(np.radians(opening_deg))
    side = np.linspace(-1, 1, 2 * int(np.ceil(edge / 2.0)) + 1)
    a, b = np.meshgrid(side, side, indexing="ij")
    # A square onto a disc, so that patches are alike everywhere.
    x, y = a * np.sqrt(1 - b**2 / 2), b * np.sqrt(1 - a**2 / 2)
    polar = np.radians(opening_deg) * np.hypot(x, y)
    share = np.where(polar > 0, np.sin(polar) / np.maximum(np.hypot(x, y), 1e-12), 0) * radius_mm
    grid = np.stack([x * share, y * share, radius_mm * (np.cos(polar) - 1)], axis=-1)
    return _make_scene([grid], pose, albedo, Indirect())


def wax(pose: Pose) -> ConcaveScene:
    """Return a wavy plate of wax of 90 mm, in which 60 % of the light scatters, facing -z."""
    x, y = np.meshgrid(*[np.linspace(-45.0, 45.0, 61)] * 2, indexing="ij")
    z = 4.0 * np.sin(2 * np.pi * x / 45) * np.cos(2 * np.pi * y / 60)
    grid = np.stack([x, y, z], axis=-1)
    return _make_scene([grid], pose, 0.8, Indirect(0, scattered=0.6, reach_mm=3.0))


CONCAVE: dict[str, Callable[[Pose], ConcaveScene]] = {"groove": groove, "bowl": bowl, "wax": wax}
"""The surfaces by the names under which they are placed before the simulated rig."""


def _make_scene(
    grids: Sequence[np.ndarray], pose: Pose, albedo: float, indirect: Indirect
) -> ConcaveScene:
    """Return the scene of grids of vertices (k, l, 3), whose x and y grow in order: each cell is a
    patch of two triangles that face -z."""
    patches, count = [], 0
    for grid in grids:
        index = count + np.arange(grid.size // 3).reshape(grid.shape[:2])
        corners = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        patches.append(np.stack([each.ravel() for each in corners], axis=1))
        count += index.size
    quads = np.concatenate(patches)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices = np.concatenate(grids).reshape(-1, 3)
    return ConcaveScene(vertices, triangles, pose, albedo, quads, indirect)
