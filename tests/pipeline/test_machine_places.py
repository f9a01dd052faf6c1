"""Scans that a machine placed are merged there, or from there, and contradictions are findings."""

from pathlib import Path

import numpy as np
import pytest
from clocks import HANG_S
from scipy.spatial.transform import Rotation

import slviewer as sl
from slviewer.errors import UsageError
from slviewer.geometry.rigid import move_points
from slviewer.pipeline.operation import load_stored, next_name, save_record
from slviewer.records.machine import HandEye
from slviewer.records.merge import Merge
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator
from tests.proofs.hand_eye import rigid

pytestmark = pytest.mark.computes
TURNS = Rotation.from_rotvec([[0, 0, 0], [0.2, -0.1, 0.3]]).as_matrix()
PLACES = rigid(TURNS, np.array([[300.0, 20, 40], [280.0, 60, 10]]))
"""T_base_scan of two scans."""


def make_surface(low: float, high: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a wavy sheet between two x, in the machine's base, with noise."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(low, high, 9000), rng.uniform(-40, 40, 9000)
    z = 4 * np.sin(x / 9) * np.cos(y / 13) + 0.002 * (x - 10) * y + 2 * np.sin(y / 5 + x / 17)
    dx = 4 / 9 * np.cos(x / 9) * np.cos(y / 13) + 0.002 * y + 2 / 17 * np.cos(y / 5 + x / 17)
    dy = -4 / 13 * np.sin(x / 9) * np.sin(y / 13) + 0.002 * (x - 10)
    dy += 2 / 5 * np.cos(y / 5 + x / 17)
    normals = np.column_stack([-dx, -dy, np.ones_like(x)])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return np.column_stack([x, y, z]) + 0.01 * rng.normal(size=(9000, 1)) * normals, normals


def make_session(folder: Path, ranges: list[tuple[float, float]]) -> Path:
    """A session with two imported scans, a and b, of those parts of the sheet."""
    files = []
    for k, (name, part) in enumerate(zip("ab", ranges, strict=True)):
        points, normals = make_surface(*part, k)
        T = np.linalg.inv(PLACES[k])
        files.append(folder / f"{name}.ply")
        moved = normals @ T[:3, :3].T
        sl.write_ply(files[-1], move_points(T, points).astype(np.float32), None,
                     moved.astype(np.float32))  # fmt: skip
    sl.import_cloud(folder / "session", files, sigma_um=10.0)
    return folder / "session"


def import_places(session: Path, places: np.ndarray, of: str = "scan") -> None:
    """Store where the machine has the scans, with 0.02 mm and 0.005 degrees."""
    file = session.parent / "places.csv"
    np.savetxt(file, places.reshape(2, 16))
    sl.import_poses(session, file, of=of, sigma_mm=0.02, sigma_deg=0.005)


def merge(session: Path, **how: bool) -> Merge:
    return sl.merge(session, ["b"], "a", start="machine", **how).only


def test_surfaces_refine_the_machines_places_and_agree(tmp_path: Path) -> None:
    session = make_session(tmp_path, [(-60, 20), (-20, 60)])
    import_places(session, PLACES)
    record = merge(session)
    true = np.linalg.inv(PLACES[0]) @ PLACES[1]
    (check,) = record.machine
    assert check.agrees and not check.is_used and check.shift_mm < 0.1 and record.is_good
    assert np.abs(record.poses["b"] - true).max() < 0.05
    assert np.array_equal(np.round(merge(session, fixed=True).poses["b"], 9), np.round(true, 9))


def place_camera(session: Path) -> None:
    """Store a hand-eye calibration whose camera is in the flange itself."""
    eye = tuple(map(tuple, np.eye(4).tolist()))
    record = HandEye(
        mounting="eye-in-hand", frame="imported file", T_carrier_camera=eye, T_other_board=eye,
        U_mm=0.02, U_deg=0.01, U_axes_mm=(0.02,) * 3, U_axes_deg=(0.01,) * 3,
        covariance=(1e-8 * np.eye(6)).tolist(), ratio=1.0, poses={},
    )  # fmt: skip
    with Session.open(session, write=True) as store:
        save_record(store, next_name(store, HandEye), record, {})


def test_a_merge_placed_by_a_robot_is_stale_once_its_camera_is_placed_anew(tmp_path: Path) -> None:
    session = make_session(tmp_path, [(-60, 20), (-20, 60)])
    import_places(session, PLACES, of="robot")
    place_camera(session)
    assert set(merge(session).inputs) >= {"machine-pose/a", "hand-eye/1"}

    def is_stale() -> bool:
        with Session.open(session) as store:
            return load_stored(store, Merge, "1").stale

    assert not is_stale()
    place_camera(session)
    assert is_stale()


def test_a_pose_that_surfaces_contradict_is_a_finding(tmp_path: Path) -> None:
    session, off = make_session(tmp_path, [(-60, 20), (-20, 60)]), PLACES.copy()
    off[1, :3, 3] += [0.0, 0.0, 0.6]
    import_places(session, off)
    for fixed in (False, True):
        record = merge(session, fixed=fixed)
        (check,) = record.machine
        assert not check.agrees and check.is_used is fixed and not record.is_good
        assert 0.4 < check.shift_mm < 0.9 and check.U_mm < 0.2
        assert "contradict" in record.list_tables("1")[0].notes[1]


def test_scans_without_overlap_are_merged_where_the_machine_has_them(tmp_path: Path) -> None:
    session = make_session(tmp_path, [(-60, -10), (10, 60)])
    import_places(session, PLACES)
    with pytest.raises(sl.SlviewerError):
        merge(session)
    record = merge(session, fixed=True)
    (check,) = record.machine
    assert check.is_used and check.why and record.pairs["b"].rms_mm is None
    assert record.points > 10_000 and "placed by the machine" in record.summary()
    with Operator(session) as operator:  # the wizard does the same
        for fixed in (False, True):
            assert operator.merge(["a", "b"], "a", start="machine", fixed=fixed)
            shown = operator.wait_until_idle(HANG_S)
            assert bool(shown.merge_failure) is not fixed
        assert shown.content.merge is not None and shown.content.merge.record.machine == [check]


def test_fixed_places_need_a_machine(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="machine"):
        sl.merge(tmp_path, ["b"], "a", fixed=True)


@pytest.mark.parametrize(
    ("what", "name"),
    [("cloud", "b"), ("merge", ""), pytest.param("merged-mesh", "", marks=pytest.mark.slow)],
)
def test_shapes_are_written_in_the_machines_frame(tmp_path: Path, what, name) -> None:
    session = make_session(tmp_path, [(-60, 20), (-20, 60)])
    import_places(session, PLACES)
    if not name:
        merge(session)
    sl.export(session, what, name, out=tmp_path / "out.ply", frame="robot")
    x, y, z = np.asarray(sl.read_ply(tmp_path / "out.ply").points, float).T
    expected = 4 * np.sin(x / 9) * np.cos(y / 13) + 0.002 * (x - 10) * y
    expected += 2 * np.sin(y / 5 + x / 17)
    assert np.median(np.abs(z - expected)) < 0.06


def test_documents_have_no_frame(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="frame"):
        sl.export(tmp_path, "poses", frame="robot")
