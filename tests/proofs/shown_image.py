"""Where the colours of an image that is projected onto a part lie there.

A rig is calibrated from rendered poses, a relief and a staircase are scanned at three depths, and
half-spaces are marked on them. The image that shows them is projected by the true rig, and the
edges that the camera sees are compared with those of the true surface, moved to the scan as a
whole: no calibration tells where the camera stands behind its image.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh

from slviewer.evaluation.render import Row
from slviewer.geometry.rigid import fit_rigid, move_points
from slviewer.geometry.vectors import finite_rows, rms, unit_vectors
from slviewer.operations.show_on_part import Colours, projection_image
from slviewer.pipeline.operation import Progress, part, track
from slviewer.reconstruction.reconstruct import triangulate_grid
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.plans import letter_plan, objects, pose_at
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import Scene
from tests.proofs.proof import BandCheck, Proof, prove_checks
from tests.rendered_calibration import calibrate_rendered, render_phase

DEPTHS_MM = (520.0, 600.0, 680.0)
NORMALS = unit_vectors(np.array([[1, 0, 0.1], [0, 1, -0.1], [1, 1, 0.3], [-1, 1, 0.2]], np.float64))
"""Of the half-spaces that are marked."""
MARKED, BESIDE = (255, 255, 255), (255, 0, 255)
"""RGB: green shows which."""
LEAST_PX, MOST_PX = 0.01, 0.3
"""Of the edges, px of the projector: RMS, and what 99 % are within."""
MOST_BESIDE = 0.15
"""Share of the edges beside what was measured."""
JUMP = 2.0
"""Pixels so many times farther apart on the projector than most lie on two sides of a step."""
LIT = 0.9
"""Red light where the image covers the part."""


def staircase(depth_mm: float) -> MeshScene:
    """Three steps of 12 mm, turned towards the projector."""
    box = trimesh.creation.box()
    steps = [box.vertices * (40, 90, 12 * k) + (40 * (k - 2), 0, -6 * k) for k in (1, 2, 3)]
    faces = [box.faces + 8 * k for k in range(3)]
    pose = pose_at((4, 10, 3), (0, 0, depth_mm))
    return MeshScene(np.concatenate(steps), np.concatenate(faces), pose)


def list_parts() -> Mapping[str, Scene]:
    """Return the parts by name."""
    stairs = {f"staircase at {depth:g} mm": staircase(depth) for depth in DEPTHS_MM}
    return {
        **{name.replace("object_", "relief "): each for name, each in objects().items()},
        **stairs,
    }


def mark_half_space(normal: np.ndarray, offset: float) -> Colours:
    """Return what colours places (n, 3) mm by the side of a plane that they lie on."""
    return lambda places: np.where((places @ normal > offset)[:, None], MARKED, BESIDE)


@dataclass(frozen=True)
class Edges:
    """Distances ``off_px`` (n,) px of the projector of edges from where they belong;
    ``is_measured`` (n,): the scan has all pixels of the camera within one of its own and one of the
    projector's."""

    off_px: np.ndarray
    is_measured: np.ndarray


def find_edges(
    renderer: Renderer, image: np.ndarray, marked: np.ndarray, measured: np.ndarray
) -> Edges:
    """Find the edges of green that the renderer's camera sees on a part under an image (h, w, 3),
    and their distances from where ``marked`` (h, w) mm, the true distance from the half-space, is
    0. ``measured`` (h', w') bool: pixels of the scan, of the same camera at any resolution.

    Distances are perpendicular to the edge, of projector pixels: along the line from one camera
    pixel to the next they would be as many times longer as the edge is oblique to that.
    """
    truth, light = renderer.truth(), renderer.rig.light
    u, v = np.moveaxis(truth.projector.astype(np.float32), 2, 0)
    blurred = cv2.GaussianBlur((image / 255.0) ** light.gamma, (0, 0), light.blur_px)
    red, seen, _ = np.moveaxis(cv2.remap(blurred, u, v, cv2.INTER_LINEAR), 2, 0)
    seen[~truth.mask | (red < LIT)] = np.nan
    # per px of the projector: gradients per camera pixel times the inverse of its Jacobian
    (du_dy, du_dx), (dv_dy, dv_dx), (dm_dy, dm_dx) = map(np.gradient, (u, v, marked))
    slope = np.hypot(dm_dx * dv_dy - dm_dy * dv_dx, dm_dy * du_dx - dm_dx * du_dy)
    slope /= np.abs(du_dx * dv_dy - du_dy * dv_dx)
    # a pixel of the camera, or of the projector, beside a step sees or lights both of its sides
    across = np.nanmedian(np.hypot(du_dx, dv_dx)) * u.shape[1] / measured.shape[1]
    size = 1 + 2 * (1 + round(float(1 / across)))
    eroded = cv2.erode(measured.astype(np.uint8), np.ones((size, size), np.uint8))
    resized = cv2.resize(eroded, u.shape[::-1], interpolation=cv2.INTER_NEAREST)
    inner: np.ndarray = resized.astype(bool)
    off, is_measured = [np.zeros(0)], [np.zeros(0, bool)]
    for before, behind in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        a, b = seen[before], seen[behind]
        step = np.hypot(u[behind] - u[before], v[behind] - v[before])
        crossed = ((a < 0.5) != (b < 0.5)) & np.isfinite(a + b + slope[before] + slope[behind])
        crossed &= step < JUMP * np.nanmedian(step)
        at = (0.5 - a[crossed]) / (b[crossed] - a[crossed])
        away, steepness = (
            each[before][crossed] * (1 - at) + each[behind][crossed] * at
            for each in (marked, slope)
        )
        off.append(away / steepness)
        is_measured.append((inner[before] & inner[behind])[crossed])
    return Edges(np.concatenate(off), np.concatenate(is_measured))


def prove_shown(scale: float, seed: int, progress: Progress) -> Proof:
    """Show half-spaces on parts, and measure where their edges lie. ``scale``: of the camera."""
    rig = letter(scale, seed)
    # as large as the edges need to be seen: the same lenses
    observing = letter(max(scale, 1.0), seed)
    _, model, _ = calibrate_rendered(rig, letter_plan(rig), part(progress, 0.0, 0.5))
    rows: list[Row] = []
    for number, (name, scene, _) in enumerate(track(progress, list_parts(), 0.5, 1.0)):
        renderer, observer = Renderer(rig, scene), Renderer(observing, scene)
        points = model.points(render_phase(renderer, name, number)).astype(np.float64)
        measured = finite_rows(points)
        vertices, faces = points[measured], triangulate_grid(points)
        truth = renderer.truth().points
        both = measured & np.isfinite(truth).all(axis=2)
        true_points = move_points(fit_rigid(truth[both], points[both]), observer.truth().points)
        found = []
        for normal in NORMALS:
            offset = float(np.median(vertices @ normal))
            colours = mark_half_space(normal, offset)
            image = projection_image(
                model, vertices, faces, vertices, colours, gamma=rig.light.gamma
            )
            found.append(find_edges(observer, image, true_points @ normal - offset, measured))
        is_measured = np.concatenate([each.is_measured for each in found])
        off = np.concatenate([each.off_px for each in found])[is_measured]
        rows.append(
            {
                "part": name,
                "edges": len(off),
                "RMS px": rms(off),
                "99 % px": float(np.quantile(np.abs(off), 0.99)),
                "mean px": float(off.mean()),
                "beside %": 100 * float(1 - is_measured.mean()),
            }
        )
    bands = {
        "RMS px": (LEAST_PX, MOST_PX),
        "99 % px": (LEAST_PX, MOST_PX),
        "beside %": (0.0, 100 * MOST_BESIDE),
    }
    checks = [
        BandCheck(str(row["part"]), what, float(row[what]), *band)  # type: ignore[arg-type]
        for row in rows
        for what, band in bands.items()
    ]
    return prove_checks(checks, scale, rows, {"parts": rows})
