"""The preset's captures: in view, illuminated, spread, and where the Letter had them."""

import importlib.util
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from slviewer.errors import InputError
from slviewer.simulation.boards import FLAT, BoardShape
from slviewer.simulation.plans import letter_plan, objects, planes, spheres, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.truth import rig_record, scene_record
from slviewer.target.board import Board

BOARD = Board.parse("circles:21x16:9")

TABLE_1 = {  # R1, R2, R3 in percent, from the Letter
    "plane_01": (100, 0, 0), "plane_02": (91.2, 8.8, 0), "plane_03": (0, 100, 0),
    "plane_04": (0, 100, 0),
    "plane_05": (0, 47.6, 52.4), "plane_06": (0, 0.7, 99.3), "plane_07": (0, 0, 100),
    "plane_08": (0, 0, 100),
    "plane_09": (2.1, 97.9, 0), "plane_10": (0, 87, 13),
}  # fmt: skip


def shares(scene):
    truth = Renderer(letter(0.1), scene).truth()
    z = truth.points[..., 2][truth.mask]
    return 100 * np.array([(z < 500).mean(), ((z >= 500) & (z <= 700)).mean(), (z > 700).mean()])


def test_planes_lie_where_the_letter_had_them():
    found = planes()
    assert list(found) == list(TABLE_1)
    for name, scene in found.items():
        assert np.abs(shares(scene) - TABLE_1[name]).max() < 3, name
    assert shares(found["plane_10"])[1] >= 87


@pytest.mark.slow
@pytest.mark.computes
def test_spheres_and_objects_lie_in_their_ranges():
    for i, scene in enumerate(spheres().values()):
        assert shares(scene)[i // 2] > 90
        assert scene.radius_mm == 98
    for i, scene in enumerate(objects().values()):
        assert shares(scene)[i] > 99
    one, two, three = (scene.pose.R for scene in objects().values())
    for R in (one, two):
        # something for ICP to do
        assert 1 < np.degrees(np.arccos((np.trace(R.T @ three) - 1) / 2)) < 10


@pytest.mark.parametrize("seed", [0, 7])
def test_target_poses_are_in_view_lit_and_spread(seed):
    rig = letter(0.25, seed=seed)
    poses = target_poses(rig, BOARD)
    seen = np.zeros((300, 400), int)
    for pose in poses:
        points = pose.to_camera(BOARD.points)
        camera, projector = rig.camera.project(points), rig.project(points)
        assert (camera > 5).all() and (camera < [394, 294]).all()
        assert (projector > 5).all() and (projector < [906, 1134]).all()
        assert points[:, 2].min() > 470 and points[:, 2].max() < 730
        assert 5 < np.degrees(np.arccos(pose.R[2, 2])) < 30
        corners = rig.camera.project(pose.to_camera(BOARD.outline()))
        seen += cv2.fillConvexPoly(
            np.zeros(seen.shape, np.uint8), np.rint(corners).astype(np.int32), 1
        )
    assert (seen >= 4).mean() > 0.85 and (seen >= 2).mean() > 0.93
    depths = [pose.to_camera(BOARD.points.mean(0))[2] for pose in poses]
    assert min(depths) < 530 and max(depths) > 670


def test_poses_do_not_depend_on_the_scale():
    small, large = target_poses(letter(0.25), BOARD, 4), target_poses(letter(1.0), BOARD, 4)
    assert all(
        np.array_equal(a.R, b.R) and np.array_equal(a.t, b.t)
        for a, b in zip(small, large, strict=True)
    )


def test_a_board_too_large_is_refused():
    with pytest.raises(InputError):
        target_poses(letter(), Board.parse("circles:21x16:30"), 3)


def test_the_plan_names_every_capture_and_its_truth_can_be_saved():
    rig = letter(0.25)
    plan = letter_plan(rig, poses=3)
    assert list(plan)[:3] == ["pose_01", "pose_02", "pose_03"]
    assert [
        sum(name.startswith(word) for name in plan) for word in ("plane_", "sphere_", "object_r")
    ] == [10, 6, 3]
    json.dumps(rig_record(rig))
    for scene in plan.values():
        json.dumps(scene_record(scene))
    for shape, low, high in ((FLAT, 0.0, 0.0), (BoardShape(misplaced_mm=0.01), 0.008, 0.012)):
        board = letter_plan(rig, poses=3, shape=shape)["pose_01"]
        offset = (board.features - BOARD.points)[:, :2].std()
        assert low <= offset <= high


def test_the_shipped_object_is_what_its_script_makes():
    assets = Path(__file__).parents[2] / "assets"
    spec = importlib.util.spec_from_file_location(
        "make_demo_object", assets / "make_demo_object.py"
    )
    assert spec and spec.loader
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    vertices, triangles = script.build()
    shipped = objects()["object_r2"]
    assert np.array_equal(shipped.triangles, triangles)
    assert np.abs(shipped.vertices - vertices).max() < 1e-4
    assert (assets / "objects" / "ammonite.ply").stat().st_size < 3_000_000
