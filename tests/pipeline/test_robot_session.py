"""`hand-eye` and `import poses` on a rendered session whose robot is made from the truth."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from copies import copy_session
from facts import missing_facts, raises
from scipy.spatial.transform import Rotation

import slviewer as sl
from slviewer.errors import InputError
from slviewer.operations.hand_eye import hand_eye
from slviewer.pipeline.operation import save_record
from slviewer.records.machine import MachinePose
from slviewer.records.merge import Merge, Registered
from slviewer.records.record import to_matrix, to_vector
from slviewer.session.store import Session
from tests.proofs.hand_eye import disturb, rigid

pytestmark = pytest.mark.computes


@pytest.fixture
def session(recorded: Path, tmp_path: Path) -> Path:
    return copy_session(recorded / "session", tmp_path / "session")


def place_robot(session: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """T_flange_camera of an invented robot, and its pose of each capture of the board."""
    truth = json.loads((session / "truth.json").read_text())["poses"]
    turns = Rotation.from_euler("ZYX", [[30, 10, -20], [100, 5, 170]], degrees=True).as_matrix()
    X, Z = rigid(turns, np.array([[20.0, -60.0, 90.0], [700.0, 100.0, 50.0]]))
    robot = {}
    for name, scene in truth.items():
        robot[name] = Z @ np.linalg.inv(X @ np.array(scene["T_camera_board"]))
    noise = disturb(np.random.default_rng(2), np.array([*robot.values()]), 0.02, 0.005)
    return X, dict(zip(robot, noise, strict=True))


def write_kuka(path: Path, robot: dict[str, np.ndarray]) -> Path:
    """A CSV as KUKA has poses."""
    lines = ["capture,x,y,z,a,b,c"]
    for name, T in robot.items():
        angles = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX", degrees=True)
        lines.append(f"{name},{','.join(f'{each:.6f}' for each in (*T[:3, 3], *angles))}")
    path.write_text("\n".join(lines))
    return path


def test_the_camera_of_a_rendered_session_is_placed(
    session: Path, tmp_path: Path, run: Callable[..., tuple[int, str, str]]
) -> None:
    X, robot = place_robot(session)
    file = write_kuka(tmp_path / "robot.csv", robot)
    status, out, said = run(
        "hand-eye", session, "--poses", file, "--sigma-mm", "0.02", "--sigma-deg", "0.005", "--plan"
    )
    assert status == 0, said
    assert not missing_facts(out, "eye-in-hand", "pose_01", "U", "would help most")
    with Session.open(session) as store:
        (found,) = (store.load_meta(n) for n in store.result_names() if n.startswith("hand-eye/"))
    error = np.array(found["T_carrier_camera"])[:3, 3] - X[:3, 3]
    assert np.linalg.norm(error) < 2 * found["U_mm"] < 1.0
    turned = np.array([*robot.values()])
    turned[:, :3, 3] /= 1000
    write_kuka(file, dict(zip(robot, turned, strict=True)))
    status, _, said = run("hand-eye", session, "--poses", file, "--unit", "mm")
    assert status == 1 and not missing_facts(said, "in m")


def test_imported_poses_give_the_same(session: Path, tmp_path: Path) -> None:
    _, robot = place_robot(session)
    file = write_kuka(tmp_path / "robot.csv", robot)
    stored = sl.import_poses(session, file, sigma_mm=0.02, sigma_deg=0.005)
    assert isinstance(stored["pose_01"], MachinePose) and stored["pose_01"].sigma_mm == 0.02
    (one,), (other,) = (
        hand_eye(session, **options).values()
        for options in ({}, {"poses": file, "sigma_mm": 0.02, "sigma_deg": 0.005})
    )
    assert np.allclose(one.T_carrier_camera, other.T_carrier_camera)
    assert one.U_mm == pytest.approx(other.U_mm)


def test_a_part_serves_in_place_of_the_board(session: Path, tmp_path: Path) -> None:
    X, robot = place_robot(session)
    truth = json.loads((session / "truth.json").read_text())["poses"]
    boards = {name: np.array(truth[name]["T_camera_board"]) for name in robot}
    first, *others = robot
    middle = boards[first][:3, 3]
    rng = np.random.default_rng(5)
    pairs = {}
    for name in others:
        T = boards[first] @ np.linalg.inv(boards[name])
        about = np.eye(4)
        about[:3, 3] = middle
        noisy = about @ disturb(rng, np.linalg.inv(about)[None] @ T, 0.02, 0.005)[0]
        pairs[name] = Registered(
            rms_mm=0.02, overlap=0.8, T_reference_scan=to_matrix(noisy), sigma_shift_mm=0.02,
            sigma_turn_deg=0.005, middle=to_vector(middle),
        )  # fmt: skip
    pairs[others[-1]] = Registered(rms_mm=None, overlap=0.0, T_reference_scan=to_matrix(np.eye(4)))
    with Session.open(session, write=True) as store:
        merged = Merge(
            reference=first, scans=[*robot], pairs=pairs, model="stereo", points=9, ply="m.ply",
            inputs=store.input_hashes(*robot),
        )  # fmt: skip
        save_record(store, "1", merged, {})
    file = write_kuka(tmp_path / "robot.csv", robot)
    (found,) = hand_eye(
        session, poses=file, merge="merge/1", sigma_mm=0.02, sigma_deg=0.005
    ).values()
    error = np.array(found.T_carrier_camera)[:3, 3] - X[:3, 3]
    assert 0 < np.linalg.norm(error) < found.U_mm < 0.5 and found.ratio < 1.5
    assert list(found.skipped) == [others[-1]] and "machine alone" in found.skipped[others[-1]]
    assert "merge/1" in found.inputs and len(found.poses) == len(robot) - 1
    with raises(InputError, "there is no merge '7'"):
        hand_eye(session, poses=file, merge="7")
