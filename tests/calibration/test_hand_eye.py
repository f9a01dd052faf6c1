"""Hand-eye calibration of simulated robots: within U, or refused by name."""

from dataclasses import replace

import numpy as np
import pytest

from slviewer.calibration.hand_eye import Mounting, plan_poses, solve_hand_eye
from slviewer.errors import InputError
from slviewer.geometry.rigid import coverage_radius
from tests.proofs.hand_eye import (
    FILES,
    MOUNTINGS,
    POSES,
    disturb,
    draw_boards,
    draw_robot,
    list_refusals,
    measure_errors,
    prove_hand_eye,
)


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_the_camera_is_placed_within_u(mounting: Mounting) -> None:
    outside = 0
    for k in range(6):
        robot = draw_robot(np.random.default_rng([3, k]), mounting)
        fit = solve_hand_eye(robot.views)
        error = measure_errors(robot, fit)
        assert np.linalg.norm(error[3:]) < 0.2 and 0.6 < fit.ratio < 1.5
        outside += int(np.sum(np.abs(error) > 2 * np.sqrt(np.diag(fit.covariance)[:6])))
    assert outside <= 5  # of 36


def test_degenerate_motions_and_wrong_files_are_refused_by_name() -> None:
    files = {name: FILES[name] for name in ("two exchanged", "in m")}
    answers = dict(list_refusals(np.random.default_rng(4), "eye-to-hand", files))
    assert len(answers) == 5 and set(answers.values()) == {"refused by name"}, answers


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_every_wrong_file_is_refused_by_name(name: str) -> None:
    answers = dict(list_refusals(np.random.default_rng(5), "eye-in-hand", {name: FILES[name]}))
    assert answers[name] == "refused by name", answers


def test_a_pose_that_contradicts_the_others_is_excluded_and_named() -> None:
    views = draw_robot(np.random.default_rng(5), "eye-in-hand").views
    robot = views.robot.copy()
    robot[4, :3, 3] += [2.0, 1.0, 0.0]
    fit = solve_hand_eye(replace(views, robot=robot))
    assert list(fit.excluded) == ["pose_05"] and "2." in fit.excluded["pose_05"]


def test_a_less_accurate_robot_raises_u() -> None:
    rng = np.random.default_rng(6)
    true = draw_robot(rng, "eye-in-hand")
    poor = replace(true.views, robot=disturb(rng, true.views.robot, 0.5, 0.1))
    fit, good = solve_hand_eye(poor), solve_hand_eye(true.views)
    assert 6 < fit.ratio < 14 and not fit.excluded
    U = coverage_radius(fit.covariance[3:6, 3:6])
    assert 5 * coverage_radius(good.covariance[3:6, 3:6]) < U
    assert np.linalg.norm(measure_errors(true, fit)[3:]) < U


def test_a_symmetric_board_may_be_numbered_from_either_end() -> None:
    rng = np.random.default_rng(7)
    robot = draw_robot(rng, "eye-in-hand")
    flipped = replace(robot.views, symmetry=2, board=robot.views.board.copy())
    half_turn = flipped.ways[1]
    for k in (2, 5, 6):
        flipped.board[k] = flipped.board[k] @ half_turn
    fit = solve_hand_eye(flipped)
    assert np.linalg.norm(measure_errors(robot, fit)[3:]) < 0.2 and fit.ratio < 1.5


def test_repeated_poses_are_named_and_planned_ones_reduce_u() -> None:
    rng = np.random.default_rng(8)
    boards = draw_boards(rng, POSES - 4)
    views = draw_robot(rng, "eye-in-hand", np.concatenate([boards, boards[2:3]])).views
    fit = solve_hand_eye(views)
    assert fit.repeated() == {"pose_09": "pose_03"}
    poses, U = plan_poses(fit, 6)
    now = coverage_radius(fit.covariance[3:6, 3:6])
    assert poses.shape == (6, 4, 4) and np.all(np.diff(U[:, 0]) < 0) and U[5, 0] < 0.75 * now


def test_four_poses_are_needed() -> None:
    views = draw_robot(np.random.default_rng(9), "eye-in-hand").views
    with pytest.raises(InputError, match="3 poses"):
        solve_hand_eye(views.select(np.arange(3)))


@pytest.mark.slow
def test_hand_eye_is_proved() -> None:
    proof = prove_hand_eye(0.2, 11, lambda share, stage: None)
    assert proof.holds, proof.text()
