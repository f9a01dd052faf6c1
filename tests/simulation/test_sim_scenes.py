"""The surfaces that rays meet, and the shadows they throw."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from facts import raises

from slviewer.errors import InputError
from slviewer.simulation.boards import BoardShape, Pose, blank_board, printed_board
from slviewer.simulation.mesh import MeshScene, demo_object
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import Spheres, sphere
from slviewer.target.board import Board

pytestmark = pytest.mark.computes

RIG = letter(0.25)
TILTED = Pose(rotation(np.array([0.2, -0.3, 0.1])), np.array([5.0, -4.0, 600.0]))


def test_a_blank_board_lies_on_its_plane():
    truth = Renderer(RIG, blank_board(TILTED)).truth()
    points = truth.points[np.isfinite(truth.points[..., 2])]
    assert len(points) > 0.4 * 400 * 300
    assert np.abs((points - TILTED.t) @ TILTED.R[:, 2]).max() < 1e-9


def test_a_bowed_board_has_the_shape_it_says():
    scene = replace(blank_board(TILTED), shape=BoardShape(0.3, -0.2, 0.25))
    surface = scene.trace(RIG.camera.rays())
    hit = np.isfinite(surface.points[..., 2])
    local = (surface.points[hit] - TILTED.t) @ TILTED.R
    X, Y = local[:, 0] / 110, local[:, 1] / 88
    assert np.abs(local[:, 2] - (0.3 * (1 - X**2) - 0.2 * (1 - Y**2) + 0.25 * X * Y)).max() < 1e-9
    # Normals look at the camera, and are those of the surface: neighbouring points lie across them.
    assert ((surface.normals[hit] * surface.points[hit]).sum(-1) < 0).all()
    step = surface.points[:, 1:] - surface.points[:, :-1]
    across = (step * (surface.normals[:, 1:] + surface.normals[:, :-1]) / 2).sum(-1)
    assert np.nanmax(np.abs(across)) < 1e-4 * np.nanmedian(np.linalg.norm(step, axis=-1))


def test_printed_circles_cover_their_share_of_the_plate():
    board = Board.parse("circles:21x16:9")
    pose = Pose(np.eye(3), np.array([-90.0, -67.5, 620.0]))
    scene = printed_board(board, pose, BoardShape(misplaced_mm=0.02))
    surface = scene.trace(RIG.camera.rays())
    # mm^2, but for the lens's distortion
    per_pixel = np.prod(620 / np.array(RIG.camera.focal_px) / 0.25)
    local = surface.points[..., :2] - pose.t[:2]
    # without the plate's rim, dark in part for its own reason
    inner = ((local > -6) & (local < [186, 141])).all(-1)
    dark = (scene.white - surface.albedo[inner]).sum() / (scene.white - scene.dark)
    assert dark * per_pixel == pytest.approx(336 * np.pi * 2.25**2, rel=0.02)
    assert np.allclose(scene.misplacement.std(), 0.02, rtol=0.1)
    again = printed_board(board, TILTED, BoardShape(misplaced_mm=0.02))
    assert np.array_equal(scene.misplacement, again.misplacement)  # the same board at another pose


@pytest.mark.slow
def test_a_chessboard_s_corners_are_where_its_features_are():
    board = Board.parse("chessboard:9x7:15")
    pose = Pose(np.eye(3), np.array([-60.0, -45.0, 600.0]))
    albedo = printed_board(board, pose).trace(letter(0.5).camera.rays()).albedo
    corners = letter(0.5).camera.project(pose.to_camera(board.points))
    offset = 6
    for u, v in np.rint(corners).astype(int):
        diagonal = albedo[v - offset, u - offset], albedo[v + offset, u + offset]
        other = albedo[v - offset, u + offset], albedo[v + offset, u - offset]
        assert diagonal[0] == diagonal[1] and other[0] == other[1] and diagonal[0] != other[0]


def test_charuco_boards_are_refused():
    with raises(InputError, "ChArUco"):
        printed_board(Board.parse("charuco:8x6:30"), TILTED)


def test_sphere_points_lie_on_the_sphere():
    scene = sphere((10.0, -5.0, 640.0))
    truth = Renderer(RIG, scene).truth()
    points = truth.points[np.isfinite(truth.points[..., 2])]
    assert np.abs(np.linalg.norm(points - scene.centres[0], axis=1) - 98).max() < 1e-9
    assert points[:, 2].max() < 640  # the front
    assert truth.mask.sum() < len(points)  # the side away from the projector is dark


def test_one_sphere_shades_the_other():
    towards = RIG.projector_centre - np.array([0.0, 0.0, 600.0])
    towards /= np.linalg.norm(towards)
    behind = Spheres(np.array([[0.0, 0.0, 600.0]]) + np.outer([-30.0, 30.0], towards), 25.0)
    point = behind.centres[0] + 25 * towards
    assert behind.occluded(point[None], RIG.projector_centre).all()
    apart = Spheres(np.array([[-75.0, 0.0, 600.0], [75.0, 0.0, 600.0]]), 25.0)
    truth = Renderer(RIG, apart).truth()
    hit = np.isfinite(truth.points[..., 2])
    distance = np.linalg.norm(truth.points[hit][:, None] - apart.centres, axis=-1)
    assert np.abs(distance.min(1) - 25).max() < 1e-9


def test_a_plate_throws_its_shadow_where_geometry_says():
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    near, far = square * 15 + [0, 0, 540], square * 300 + [0, 0, 600]
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    scene = MeshScene(
        np.concatenate([near, far]),
        np.concatenate([faces, faces + 4]),
        Pose(np.eye(3), np.zeros(3)),
    )
    truth = Renderer(RIG, scene).truth()
    back = np.abs(truth.points[..., 2] - 600) < 1e-6
    front = np.abs(truth.points[..., 2] - 540) < 1e-6
    assert truth.mask[front].all() and front.sum() > 1000
    way = RIG.projector_centre - truth.points
    crossing = truth.points + way * ((540 - truth.points[..., 2]) / way[..., 2])[..., None]
    margin = np.abs(crossing[..., :2]).max(-1) - 15
    assert (~truth.mask[back & (margin < -0.1)]).all() and (back & (margin < -0.1)).sum() > 1000
    illuminated = (
        back
        & (margin > 0.1)
        & (truth.projector > 0).all(-1)
        & (truth.projector < [911, 1139]).all(-1)
    )
    assert truth.mask[illuminated].all()


def test_the_demo_object_is_closed_and_its_truth_lies_on_it():
    scene = demo_object(Pose(rotation(np.array([0.1, -0.05, 0.2])), np.array([0.0, 0.0, 600.0])))
    mesh = trimesh.Trimesh(scene.vertices, scene.triangles, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert 60_000 <= len(mesh.faces) <= 150_000
    assert 120 < mesh.extents[:2].max() < 150
    truth = Renderer(RIG, scene).truth()
    hit = np.isfinite(truth.points[..., 2])
    assert hit.mean() > 0.2
    local = (truth.points[hit] - scene.pose.t) @ scene.pose.R
    chosen = local[:: len(local) // 200]
    import open3d  # loaded by the scene

    cloud = open3d.core.Tensor(chosen.astype(np.float32))
    caster = open3d.t.geometry.RaycastingScene()
    caster.add_triangles(
        open3d.core.Tensor(scene.vertices.astype(np.float32)),
        open3d.core.Tensor(scene.triangles.astype(np.uint32)),
    )
    assert caster.compute_distance(cloud).numpy().max() < 1e-3
