"""Poses of machines arrive in every notation, or are refused where it is not known."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.session.importers.pose_files import match_captures, read_pose_file

RNG = np.random.default_rng(1)
TURNS = Rotation.random(3, random_state=RNG)
PLACES = RNG.uniform(-400, 400, (3, 3))


def write(folder: Path, header: str, turns: np.ndarray, scale: float = 1.0) -> Path:
    """A CSV with the poses named a, b and c."""
    numbers = np.hstack([PLACES * scale, turns])
    rows = [f"{n},{','.join(map(repr, row.tolist()))}" for n, row in zip("abc", numbers)]  # noqa: B905
    path = folder / "poses.csv"
    path.write_text("\n".join([f"capture,{header}", *rows]))
    return path


def assert_poses(read, names=("a", "b", "c")) -> None:
    poses = read.poses()
    assert read.names == names
    assert np.allclose(poses[:, :3, 3], PLACES) and np.allclose(poses[:, :3, :3], TURNS.as_matrix())


@pytest.mark.parametrize(
    ("header", "turns", "scale", "options"),
    [
        ("x,y,z,a,b,c", TURNS.as_euler("ZYX", degrees=True), 1, {}),
        ("X_mm,Y_mm,Z_mm,W,P,R", TURNS.as_euler("xyz", degrees=True), 1, {}),
        ("x,y,z,rx,ry,rz", TURNS.as_euler("xyz", degrees=True), 1, {"convention": "abb"}),
        ("x,y,z,rx,ry,rz", TURNS.as_rotvec(), 0.001, {"convention": "ur"}),
        ("x [mm],y [mm],z [mm],rx [deg],ry [deg],rz [deg]", TURNS.as_rotvec(True), 1,
         {"convention": "ur"}),
        ("x,y,z,q1,q2,q3,q4", np.roll(TURNS.as_quat(), 1, axis=1), 1, {}),
        ("x,y,z,qx,qy,qz,qw", TURNS.as_quat(), 0.001, {"unit": "m"}),
    ],
)  # fmt: skip
def test_conventions(tmp_path, header, turns, scale, options) -> None:
    assert_poses(read_pose_file(write(tmp_path, header, turns, scale), **options))


def test_makers_conventions_by_hand(tmp_path) -> None:
    """KUKA's A turns about z first; Fanuc's W about x, and R about z last."""
    path = tmp_path / "poses.csv"
    path.write_text("x,y,z,a,b,c\n0,0,0,90,0,0\n500,0,0,0,0,90\n")
    z, x = read_pose_file(path).poses()[:, :3, :3]
    assert np.allclose(z @ [1, 0, 0], [0, 1, 0]) and np.allclose(x @ [0, 1, 0], [0, 0, 1])
    path.write_text("x,y,z,w,p,r\n0,0,0,90,0,90\n500,0,0,0,0,0\n")
    assert np.allclose(read_pose_file(path).poses()[0, :3, :3] @ [0, 1, 0], [0, 0, 1])


def test_json_of_matrices_and_of_ros(tmp_path) -> None:
    path, T = tmp_path / "poses.json", np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = TURNS.as_matrix(), PLACES
    path.write_text(json.dumps(dict(zip("abc", T.tolist(), strict=True))))
    assert_poses(read_pose_file(path))
    path.write_text(json.dumps(T.tolist()))
    assert_poses(read_pose_file(path), ())
    ros = [
        {
            "name": name,
            "position": dict(zip("xyz", (place / 1000).tolist(), strict=True)),
            "orientation": dict(zip("xyzw", turn.tolist(), strict=True)),
        }
        for name, place, turn in zip("abc", PLACES, TURNS.as_quat(), strict=True)
    ]
    path.write_text(json.dumps({"unit": "m", "poses": ros}))
    assert_poses(read_pose_file(path))


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("x,y,z,rx,ry,rz\n1,2,3,10,20,30\n400,5,6,20,30,40\n", ("abb", "ur", "--convention")),
        ("1 2 3 1 0 0 0\n400 5 6 1 0 0 0\n", ("quaternion-wxyz", "quaternion-xyzw")),
        ("x,y,z,a,b,c\n1,2,3,10,20,30\n1.2,2.1,3.3,20,30,40\n", ("--unit m",)),
        ("x,y,z,a,b,c\n1,2,3,1.1,0.3,0.2\n400,5,6,1.2,0.3,0\n", ("--angles rad",)),
        ("x,y,z,qw,qx,qy,qz\n1,2,3,1,1,0,0\n400,5,6,1,0,0,0\n", ("pose 1", "1.41")),
        ("x,y,z,a,b,c\n1,2,3,10,20\n", ("row 2", "5", "6")),
        ("x,y,z,a,b,c\n1,2,3,10,20,thirty\n", ("row 2", "thirty")),
        ("1 0 0 0 0 1 0 0 0 0 1 0 500 20 3 1\n1 0 0 0 0 1 0 0 0 0 1 0 5 2 3 1\n", ("columns",)),
        ("2 0 0 5 0 2 0 5 0 0 2 5\n", ("pose 1", "rotation")),
        ("1 2 3\n", ("3",)),
        ("capture,x,y,z,a,b,c\np,1,2,3,10,20,30\np,400,2,3,10,20,30\n", ("name",)),
        ("capture,x\n", ("0 poses",)),
        ("x,y,z,a,b,c\nnan,2,3,10,20,30\n", ("finite",)),
    ],
)
def test_what_can_be_read_in_several_ways_is_refused(tmp_path, text, facts) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_pose_file(path)
    assert all(fact in str(caught.value) for fact in facts), caught.value


def test_poses_are_matched_by_name_or_order() -> None:
    assert match_captures(("b.png", "a"), ("a", "b"), "f") == ({"a": 1, "b": 0}, [])
    assert match_captures((), ("a", "b"), "f") == ({"a": 0, "b": 1}, [])
    with pytest.raises(InputError, match="x1"):
        match_captures(("x1",), ("a", "b"), "f")
