"""Stereo calibration against an exactly known rig."""

import dataclasses

import cv2
import numpy as np
import pytest
from analytic_rig import BOARD, PROJECTOR, board_poses, observation, rig
from facts import missing_facts, raises

from slviewer.calibration.known_camera import KnownCamera
from slviewer.calibration.observe import Observation
from slviewer.calibration.stereo import MIN_POSES, StereoModel, calibrate_stereo
from slviewer.errors import CalibrationRejected
from slviewer.geometry.lens import Lens
from slviewer.geometry.vectors import box_middle

pytestmark = pytest.mark.computes

TRUE = rig()


def observations(count=12, noise_px=0.02, seed=0):
    return [
        observation(TRUE, T, f"pose_{k:02d}", noise_px, seed)
        for k, T in enumerate(board_poses(count, seed))
    ]


@pytest.fixture(scope="module")
def model():
    return calibrate_stereo(observations(), PROJECTOR, str(BOARD))


def test_the_reprojection_error_is_the_features_noise(model: StereoModel) -> None:
    # RMS of 2-D residuals of 0.02 px noise a coordinate, less what the parameters absorb
    for device in ("camera", "projector", "stereo"):
        assert 0.024 < model.reprojection_rms_px[device] < 0.030
    assert len(model.poses) == 12 and not model.excluded


def test_it_finds_the_rig(model: StereoModel) -> None:
    assert model.baseline_mm == pytest.approx(np.linalg.norm(TRUE.t), abs=0.5)
    angle = np.linalg.norm(cv2.Rodrigues(model.rig.R @ TRUE.R.T)[0])
    assert 1e-8 < angle < 2e-3
    assert model.rig.camera.K[0, 0] == pytest.approx(TRUE.camera.K[0, 0], rel=2e-3)
    ratio = model.rig.projector.K[1, 1] / model.rig.projector.K[0, 0]
    assert ratio == pytest.approx(2.0, rel=2e-3)  # the aspect ratio is free


def test_depths_are_those_of_the_boards(model: StereoModel) -> None:
    assert 430 < model.depth_range_mm[0] < 520 and 680 < model.depth_range_mm[1] < 770


def test_it_survives_saving(model: StereoModel) -> None:
    saved = model.to_dict()
    again = StereoModel.from_dict(saved)
    assert {"left_out", "features_set_aside"} < set(saved)  # the keys of older sessions
    assert np.array_equal(again.rig.R, model.rig.R) and again.pose_rms_px == model.pose_rms_px


def test_a_pose_that_moved_is_left_out_by_name_and_changes_nothing(model: StereoModel) -> None:
    poses = observations()
    moved = poses[4].projector + 1.5 * np.sin(np.arange(poses[4].projector.size)).reshape(-1, 2)
    poses[4] = dataclasses.replace(poses[4], projector=moved)
    found = calibrate_stereo(poses, PROJECTOR, str(BOARD))
    assert list(found.excluded) == ["pose_04"] and "moved" in found.excluded["pose_04"]
    assert found.baseline_mm == pytest.approx(model.baseline_mm, abs=0.5)


def test_single_wrong_features_are_set_aside(model: StereoModel) -> None:
    poses = observations()
    for k in (1, 5, 7):
        poses[k].camera[10 + k] += 3.0
    found = calibrate_stereo(poses, PROJECTOR, str(BOARD))
    assert found.features_excluded >= 3 and not found.excluded
    assert found.reprojection_rms_px["camera"] < 0.030


def test_a_pose_of_one_axis_is_left_out() -> None:
    poses = observations()
    poses[2] = observation(TRUE, board_poses(12)[2], "pose_02", axes=("x",))
    assert missing_facts(calibrate_stereo(poses, PROJECTOR).excluded["pose_02"], "x", "y") == []


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_poses_are_rejected(count: int) -> None:
    with raises(CalibrationRejected, count, MIN_POSES):
        calibrate_stereo(observations(12)[:count], PROJECTOR)


def test_parallel_poses_are_rejected() -> None:
    poses = []
    for k in range(8):
        T = np.eye(4)
        T[:3, 3] = np.array([-15.0 + 3 * k, 2.0 * k - 8, 520 + 22 * k]) - BOARD.points.mean(0)
        poses.append(observation(TRUE, T, f"pose_{k}"))
    with raises(CalibrationRejected, "parallel", 8):
        calibrate_stereo(poses, PROJECTOR)


@pytest.mark.parametrize("turned", [[-1.0, 1.0], [1.0, -1.0]])
def test_a_mirrored_projector_is_rejected_and_one_upside_down_is_not(turned: list[float]) -> None:
    def projected(signs: np.ndarray) -> list:
        middle = np.array(PROJECTOR) / 2 - 0.5
        return [
            dataclasses.replace(o, projector=(o.projector - middle) * signs + middle)
            for o in observations(6)
        ]

    with raises(CalibrationRejected, "mirror", 6):
        calibrate_stereo(projected(np.array(turned)), PROJECTOR)
    exchanged = [dataclasses.replace(o, projector=o.projector[:, ::-1]) for o in observations(6)]
    with raises(CalibrationRejected, "x and y"):
        calibrate_stereo(exchanged, PROJECTOR)
    upside_down = calibrate_stereo(projected(np.array([-1.0, -1.0])), PROJECTOR)
    assert upside_down.reprojection_rms_px["stereo"] < 0.03


def test_exchanged_axes_are_rejected() -> None:
    poses = [
        dataclasses.replace(o, projector=o.projector[:, ::-1] * np.array([1.0, 0.3]))
        for o in observations()
    ]
    for o in poses:
        o.projector[:, 0] += 40 * np.sin(np.arange(len(o.projector)))
    with pytest.raises(CalibrationRejected):
        calibrate_stereo(poses, PROJECTOR)


def parallel_boards() -> list[Observation]:
    """Four boards that face the camera at several distances."""
    poses = []
    for k, z in enumerate((480.0, 560.0, 620.0, 700.0)):
        T = np.eye(4)
        T[:3, 3] = np.array([8.0 * k - 12, 6.0 - 4 * k, z]) - box_middle(BOARD.points)
        poses.append(observation(TRUE, T, f"pose_{k}", 0.02))
    return poses


def test_parallel_boards_are_enough_for_the_projector_beside_a_fixed_camera() -> None:
    with raises(CalibrationRejected, "parallel"):
        calibrate_stereo(parallel_boards(), PROJECTOR)
    known = KnownCamera(TRUE.camera, "lens.yaml", is_fixed=True)
    found = calibrate_stereo(parallel_boards(), PROJECTOR, camera=known)
    assert np.array_equal(found.rig.camera.K, TRUE.camera.K) and found.fixed_camera == "lens.yaml"
    error = abs(found.rig.projector.K[0, 0] - TRUE.projector.K[0, 0])
    assert 1e-4 < error < 4 * found.focal_sigma_px["projector"] < 12
    assert found.baseline_mm == pytest.approx(np.linalg.norm(TRUE.t), abs=0.5)
    again = StereoModel.from_dict(found.to_dict()).known_camera
    assert again is not None and again.is_fixed and again.name == "lens.yaml"


def test_a_start_changes_nothing(model: StereoModel) -> None:
    fx, fy, *rest = TRUE.camera.parameters[:9]
    start = Lens.from_parameters((1.02 * fx, 1.02 * fy, *rest), TRUE.camera.size)
    found = calibrate_stereo(
        observations(), PROJECTOR, str(BOARD), camera=KnownCamera(start, "lens.yaml")
    )
    assert found.rig.camera.K[0, 0] == pytest.approx(model.rig.camera.K[0, 0], rel=1e-6)
    assert found.known_camera is None
