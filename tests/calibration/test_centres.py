"""Circles at their centres: what perspective and distortion do to a centroid, and that the
correction takes it away."""

from dataclasses import replace

import numpy as np
import pytest
from analytic_rig import BOARD, PROJECTOR, board_poses, observation, rig
from facts import raises

from slviewer.calibration.centres import calibrate_centres, centroid_shifts, move_to_centres
from slviewer.calibration.stereo import calibrate_stereo
from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.simulation.boards import Pose, printed_board
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.truth import rig_record
from slviewer.target.board import Board
from slviewer.target.detect import detect

RADIUS = 4.0
TILTED = Board.parse("circles:11x9:14")


def tilted(degrees: float, towards: float) -> np.ndarray:
    """(4, 4) board to camera, 600 mm away."""
    a = np.radians(towards)
    T = np.eye(4)
    T[:3, :3] = rotation(np.radians(degrees) * np.array([np.cos(a), np.sin(a), 0]))
    T[:3, 3] = np.array([10.0, 5.0, 620.0]) - T[:3, :3] @ TILTED.points.mean(0)
    return T


def noise_free(psf_px: float) -> tuple[SimulatedRig, Lens]:
    simulated = letter(0.5, 3, local_distortion_px=0.0)
    simulated = replace(
        simulated,
        sensor=replace(simulated.sensor, read_variance=0.0, shot_variance=0.0, psf_px=psf_px),
    )
    record = rig_record(simulated)["camera"]
    return simulated, Lens(np.array(record["K"]), np.array(record["D"]), simulated.camera.size)


def test_the_shift_is_that_of_the_image_s_area() -> None:
    """Against a sum over the disc's surface, each piece as large as it appears."""
    lens, T = rig().camera, tilted(35, 60)
    r, a = RADIUS * np.sqrt((np.arange(40) + 0.5) / 40), np.arange(48) / 48 * 2 * np.pi
    disc = np.stack(
        [np.outer(r, np.cos(a)).ravel(), np.outer(r, np.sin(a)).ravel(), np.zeros(1920)], axis=1
    )

    def seen(points: np.ndarray) -> np.ndarray:
        return lens.project(points @ T[:3, :3].T + T[:3, 3])

    shifts = centroid_shifts(lens, T, TILTED.points, RADIUS)
    for k in (0, 30, 98):
        points, step = TILTED.points[k] + disc, 1e-3
        along_x, along_y = (seen(points + d) - seen(points - d) for d in step * np.eye(3)[:2])
        area = along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0]
        centroid = area @ (seen(points) - seen(TILTED.points[k])) / area.sum()
        np.testing.assert_allclose(shifts[k], centroid, atol=2e-5)
        assert np.linalg.norm(shifts[k]) > 5e-3


def test_points_do_not_move_and_the_shift_grows_with_the_square_of_the_radius() -> None:
    lens, T = rig().camera, tilted(30, 10)
    small, large = (centroid_shifts(lens, T, TILTED.points, r) for r in (1.0, 3.0))
    np.testing.assert_allclose(large, 9 * small, atol=2e-4)
    assert not centroid_shifts(lens, T, TILTED.points, 0.0).any()
    with raises(InputError, "radius", -1):
        centroid_shifts(lens, T, TILTED.points, -1.0)


@pytest.mark.computes
@pytest.mark.parametrize(("towards", "psf_px"), [(0, 0.6), (90, 0.6), (135, 1.5)])
def test_no_bias_is_left_on_a_board_turned_by_35_degrees(towards: float, psf_px: float) -> None:
    simulated, lens = noise_free(psf_px)
    T = tilted(35, towards)
    scene = printed_board(TILTED, Pose(T[:3, :3], T[:3, 3]))
    image = np.empty(simulated.camera.size[::-1], np.uint8)
    Renderer(simulated, scene).frame(("x", np.full(912, 255.0)), np.zeros(2, np.uint32), image)
    found = detect(TILTED, image)
    off = found.pixels - lens.project(TILTED.points @ T[:3, :3].T + T[:3, 3])
    left = off - centroid_shifts(lens, T, TILTED.points, found.radius_mm)
    assert 0.02 < np.linalg.norm(off.mean(0)) < 0.04
    assert np.abs(left.mean(0)).max() < 0.0015
    assert np.sqrt((left**2).sum(1).mean()) < 0.006


def test_a_calibration_from_centroids_finds_the_centres() -> None:
    true = rig()
    poses = dict(zip((f"pose_{k:02d}" for k in range(12)), board_poses(12), strict=True))
    exact = {name: observation(true, T, name, 0.0) for name, T in poses.items()}
    seen = []
    for name, o in exact.items():
        shift = centroid_shifts(true.camera, poses[name], BOARD.points, RADIUS)
        slopes = np.tile([[0.8, 0.02], [-0.01, 1.5]], (len(shift), 1, 1))
        projector = o.projector + np.einsum("nij,nj->ni", slopes, shift)
        seen.append(
            replace(
                o, camera=o.camera + shift, projector=projector, slopes=slopes, radius_mm=RADIUS
            )
        )
    stereo, corrected = calibrate_centres(seen, PROJECTOR, str(BOARD))
    before = max(np.abs(o.camera - exact[o.name].camera).max() for o in seen)
    left = max(np.abs(o.camera - exact[o.name].camera).max() for o in corrected)
    assert before > 0.02 and left < before / 50
    assert max(np.abs(o.projector - exact[o.name].projector).max() for o in corrected) < before / 25
    raw = calibrate_stereo(seen, PROJECTOR, str(BOARD))
    assert stereo.reprojection_rms_px["camera"] < raw.reprojection_rms_px["camera"] / 10
    assert all(
        new is old for new, old in zip(move_to_centres(corrected, stereo), corrected, strict=True)
    ), "once is enough"
