"""Whether a scan that misses its nominal model fits its mirror image, or the model at another
scale: another hand, another unit, another part."""

from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rigid import (
    Floats,
    distance_jacobian,
    move_points,
    rigid_transform,
    turn_about,
)
from slviewer.geometry.robust import robust_sigma, tukey_weights
from slviewer.geometry.vectors import diagonal, rms_length, subsample, unit_vectors
from slviewer.inspection.nominal_pose import VIEWS, improve_pose, search_pose
from slviewer.inspection.nominal_surface import NominalSurface
from slviewer.registration.refusal import Refused
from slviewer.surface.shapes import Mesh

SAMPLES = 6_000
BETTER = 0.25
"""Share of the points off the model that may be off the other one."""
LEAST_OFF, MOST_OFF = 0.01, 0.1
"""Shares of the points off the model that need an explanation, and off the other one."""
UNITS = {
    1 / 1000: "a thousandth of the model's size: metres read as mm",
    1 / 25.4: "1/25.4 of the model's size: inches read as mm",
    1 / 10: "a tenth of the model's size: cm read as mm",
    10.0: "ten times the model's size: mm read as cm",
    25.4: "25.4 times the model's size: mm read as inches",
    1000.0: "a thousand times the model's size: mm read as metres",
}
MATCHING = 1.5
"""Ratio of two sizes that may be one."""
NEAREST_VIEWS = 8
"""From which a mirror image is looked at."""
SCALE_STEPS, SCALE_SIGMAS = 12, 5.0

Report = Callable[[float], None]


def explain_misfit(
    points: Floats,
    normals: Floats | None,
    nominal: Mesh,
    T: Floats | None,
    near_mm: float,
    has_camera: bool = True,
) -> str:
    """Return what a scan's points (n, 3) mm fit by far better than the nominal model, in words;
    empty where nothing does.

    ``T`` (4, 4), T_nominal_scan: its best pose on the model, None where none was accepted;
    ``near_mm``: points that deviate less lie on a model.
    """
    points = subsample(points, SAMPLES)
    normals = None if normals is None else subsample(normals, SAMPLES)
    surface = NominalSurface(nominal)
    off = 1.0 if T is None else _share_off(points, normals, surface, T, near_mm)
    if off < LEAST_OFF:
        return ""
    most = BETTER if T is None else min(BETTER * off, MOST_OFF)  # without: foreign points too
    views = VIEWS
    if T is not None:  # its pose on the model says roughly from where it is seen
        seen = np.abs(unit_vectors(T[:3, 3] - surface.middle))
        views = sorted(VIEWS, key=lambda view: -float(np.abs(view) @ seen))[
            : NEAREST_VIEWS if has_camera else 0
        ]
    if T is not None:
        scale, sigma = _fit_scale(points, normals, surface, T, near_mm)
        scaled = NominalSurface(_scale(nominal, scale, surface.middle))
        share = _share_off_best(points, normals, scaled, T, near_mm)
        if abs(scale - 1) > SCALE_SIGMAS * sigma and share < most:
            change = "larger" if scale > 1 else "smaller"
            return (
                f"the scan fits the model where that is {100 * abs(scale - 1):.2f} % {change}:"
                f" {100 * (1 - share):.0f} % of the points lie within {near_mm:.3g} mm of it then,"
                f" and {100 * (1 - off):.0f} % of the model as it is"
            )
    for words, mesh, factor in _list_others(nominal, points, surface.diagonal):
        other, near = NominalSurface(mesh), factor * near_mm
        with suppress(Refused, InputError):
            share = 1.0
            if T is not None:  # whose outline is the model's
                start = rigid_transform(np.eye(3), other.middle - surface.middle) @ T
                pose = improve_pose(points, normals, other, near / 4, start)
                share = _share_off_best(points, normals, other, pose, near)
            if share >= most and off > MOST_OFF:
                pose = search_pose(points, normals, other, near / 4, _ignore, has_camera, views)
                share = _share_off_best(points, normals, other, pose, near)
            if share < most:
                return (
                    f"the scan fits {words} ({100 * (1 - share):.0f} % of its points lie within"
                    f" {near:.3g} mm of that, and {100 * (1 - off):.0f} % of the model as it is)"
                )
    return ""


def _ignore(share: float) -> None:
    """Report no progress."""


def _list_others(nominal: Mesh, points: Floats, size: float) -> Iterator[tuple[str, Mesh, float]]:
    """Yield the models that a scan may show instead: what each is in words, and its scale."""
    mirrored = nominal.vertices * np.array([-1, 1, 1], np.float32)
    ratio = diagonal(np.percentile(points, [1, 99], axis=0)) / size
    if 1 / MATCHING < ratio < MATCHING:
        yield "the mirror image of the model", Mesh(mirrored, nominal.faces[:, ::-1]), 1.0
    for factor, words in UNITS.items():
        if 1 / MATCHING < ratio / factor < MATCHING:
            yield f"a part of {words}", _scale(nominal, factor, np.zeros(3)), factor


def _scale(nominal: Mesh, factor: float, middle: Floats) -> Mesh:
    """Return a model scaled about a point (3,)."""
    vertices = middle + factor * (nominal.vertices.astype(np.float64) - middle)
    return Mesh(vertices.astype(np.float32), nominal.faces)


def _share_off(
    points: Floats, normals: Floats | None, surface: NominalSurface, T: Floats, near: float
) -> float:
    """Return the share of a scan's points that do not lie within ``near`` mm of a model."""
    return float(np.mean(~np.isfinite(surface.distances(points, normals, T, near)[0])))


def _share_off_best(
    points: Floats, normals: Floats | None, surface: NominalSurface, T: Floats, near: float
) -> float:
    """Return `_share_off` at the pose of most points of a scan on a model, found from ``T``."""
    best = _fit(points, normals, surface, T, with_scale=False)[0]
    return _share_off(points, normals, surface, best, near)


def _fit_scale(
    points: Floats, normals: Floats | None, surface: NominalSurface, T: Floats, near: float
) -> tuple[float, float]:
    """Return by what factor a model must be scaled to fit, and its standard uncertainty."""
    _, scale, sigma = _fit(points, normals, surface, T, with_scale=True)
    return scale, sigma


def _fit(
    points: Floats, normals: Floats | None, surface: NominalSurface, T: Floats, with_scale: bool
) -> tuple[Floats, float, float]:
    """Fit a pose (4, 4), and where wanted a factor of the model's size with its standard
    uncertainty, by Tukey's weights."""
    scale, sigma = 1.0, np.inf
    reach = 0.1 * surface.diagonal
    for _ in range(SCALE_STEPS):
        moved = surface.middle + (move_points(T, points) - surface.middle) / scale
        off, towards = surface.distances(moved, _turned(normals, T), np.eye(4), reach)
        near = np.isfinite(off)
        if near.sum() < 50:
            return T, 1.0, np.inf
        arm, away = moved[near] - surface.middle, off[near]
        J = distance_jacobian(arm, towards[near])
        size = rms_length(arm)
        J[:, :3] /= size
        if with_scale:
            J = np.column_stack([J, -np.einsum("ij,ij->i", arm, towards[near]) / size])
        noise = max(robust_sigma(away, about=0.0), 1e-9)
        weights = tukey_weights(away, noise)
        normal = (J * weights[:, None]).T @ J + 1e-9 * len(J) * np.eye(J.shape[1])
        step = -np.linalg.solve(normal, (J * weights[:, None]).T @ away)
        if with_scale:
            scale *= 1 + step[6] / size
            sigma = noise * float(np.sqrt(np.linalg.inv(normal)[6, 6])) / size
        motion = np.asarray(step, np.float64)
        T = turn_about(motion[:3] / size, surface.middle, scale * motion[3:6]) @ T
        reach = max(4.685 * noise, 0.2 * reach)
    return T, scale, sigma


def _turned(normals: Floats | None, T: Floats) -> Floats | None:
    """Return normals (n, 3) turned by a pose."""
    return None if normals is None else normals @ T[:3, :3].T
