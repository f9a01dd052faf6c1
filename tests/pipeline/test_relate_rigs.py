"""Two rigs in one frame by what both see, and scans of both in one merge."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts
from scipy.spatial.transform import Rotation
from test_machine_places import make_surface

import slviewer as sl
from slviewer.errors import InputError, UsageError
from slviewer.geometry.rigid import move_points, rigid_transform
from slviewer.registration.rig_places import fit_rig, sight_board, sight_spheres
from tests.proofs.relate_rigs import draw_sightings, measure_error, place_rig, prove_relate_rigs

T = rigid_transform(Rotation.from_rotvec([0.1, 0.4, -0.2]).as_matrix(), np.array([120.0, -30, 80]))
"""T_reference_rig."""


def make_rig(folder: Path, clouds: dict[str, tuple[np.ndarray, np.ndarray]], T: np.ndarray) -> Path:
    """A session whose scans are points and normals of the reference's frame, seen by a rig."""
    files = []
    for name, (points, normals) in clouds.items():
        files.append(folder.parent / folder.name / f"{name}.ply")
        files[-1].parent.mkdir(exist_ok=True)
        to_rig = np.linalg.inv(T)
        moved, turned = move_points(to_rig, points), normals @ to_rig[:3, :3].T
        sl.write_ply(files[-1], moved.astype(np.float32), None, turned.astype(np.float32))
    sl.import_cloud(folder / "rig", files, sigma_um=10.0)
    (folder / "rig").rename(folder.parent / f"{folder.name}_rig")
    return folder.parent / f"{folder.name}_rig"


def test_rigs_are_related_by_a_part_and_their_scans_merged(
    tmp_path: Path, run: Callable[..., tuple[int, str, str]]
) -> None:
    shared = make_surface(-60, 20, 1), make_surface(-20, 60, 2)
    one = make_rig(
        tmp_path / "left", {"shared": shared[0], "a": make_surface(-60, 0, 3)}, np.eye(4)
    )
    other = make_rig(tmp_path / "right", {"shared": shared[1], "b": make_surface(5, 60, 4)}, T)
    status, out, said = run(
        "relate-rigs", one, other, "--captures", "shared", "--by", "part", "--scans", "b"
    )
    assert status == 0, said
    assert not missing_facts(out, "right_rig", "U", "single capture", "right_rig_b")
    with pytest.raises(InputError, match="no capture"):
        sl.relate_rigs(one, [other], ["a"], by="part")
    merged = sl.merge(one, ["right_rig_b"], "a", start="machine", fixed=True).only
    assert np.abs(merged.poses["right_rig_b"] - T).max() < 0.1 and merged.points > 10_000


def make_balls(rng: np.random.Generator, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of four balls of 12 mm, seen from one side."""
    centres = np.array([[0.0, 0, 0], [70, 10, 0], [20, 90, 5], [-45, 40, -8]])
    normals = rng.normal(size=(4, 1500, 3))
    normals /= np.linalg.norm(normals, axis=2)[..., None]
    normals[..., 0] = np.abs(normals[..., 0]) * side
    points = centres[:, None] + 12.0 * normals + 0.01 * rng.normal(size=(4, 1500, 1)) * normals
    return points.reshape(-1, 3), normals.reshape(-1, 3)


def test_rigs_are_related_by_spheres_that_they_see_from_opposite_sides(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    one = make_rig(tmp_path / "left", {"balls": make_balls(rng, 1.0)}, np.eye(4))
    other = make_rig(tmp_path / "right", {"balls": make_balls(rng, -1.0)}, T)
    place = sl.relate_rigs(one, [other], ["balls"], by="spheres", radius=12.0).only.rigs[
        "right_rig"
    ]
    assert np.abs(np.array(place.T_reference_rig) - T).max() < 0.02 and place.U_mm < 0.01


@pytest.mark.parametrize("by", ["board", "spheres"])
def test_the_place_is_within_u(by: str) -> None:
    outside = 0
    for k in range(12):
        rng, true = np.random.default_rng([1, k]), place_rig(20.0 * k - 100)
        fit = fit_rig(draw_sightings(rng, true, by))
        error = measure_error(fit, true)
        outside += int(np.sum(np.abs(error) > 2 * np.sqrt(np.diag(fit.covariance))))
    assert outside <= 9  # of 72


def test_captures_of_a_moved_object_are_refused() -> None:
    sightings = draw_sightings(np.random.default_rng(2), place_rig(40.0), "board")
    moved = sight_board("moved", (sightings[0].T, np.eye(6) * 1e-6), (np.eye(4), np.eye(6) * 1e-6))
    off = rigid_transform(np.eye(3), np.array([0, 0, 5.0])) @ moved.T
    wrong = sight_board("moved", (off, np.eye(6) * 1e-8), (np.eye(4), np.eye(6) * 1e-8))
    with pytest.raises(InputError, match="moved"):
        fit_rig([*sightings, wrong])


def test_a_symmetric_board_needs_several_tilts() -> None:
    rng, true = np.random.default_rng(4), place_rig(30.0)
    noise = np.diag([1e-9] * 3 + [1e-4] * 3)
    half = rigid_transform(Rotation.from_rotvec([0, 0, np.pi]).as_matrix(), np.zeros(3))
    sightings = []
    for k in range(3):
        turn = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix()
        own = rigid_transform(turn, np.array([0, 0, 600.0]))
        seen = np.linalg.inv(true) @ own @ (half if k == 1 else np.eye(4))
        sightings.append(sight_board(f"{k}", (own, noise), (seen, noise), symmetry=2))
    assert np.linalg.norm(measure_error(fit_rig(sightings), true)) < 0.01
    with pytest.raises(InputError, match="looks the same"):
        fit_rig(sightings[:1])


def test_spheres_that_do_not_match_are_refused() -> None:
    rng = np.random.default_rng(5)
    centres, sigma = rng.uniform(-100, 100, (4, 3)), np.full(4, 0.01)
    with pytest.raises(InputError, match="differ by"):
        sight_spheres("s", (centres, sigma), (rng.uniform(-100, 100, (4, 3)), sigma))
    with pytest.raises(InputError, match="2 spheres"):
        sight_spheres("s", (centres, sigma), (centres[:2], sigma[:2]))
    square = np.array([[0.0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0]])
    with pytest.raises(InputError, match="8 ways"):
        sight_spheres("s", (square, sigma), (square, sigma))


def test_settings_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="captures"):
        sl.relate_rigs(tmp_path, [tmp_path])
    with pytest.raises(UsageError, match="radius"):
        sl.relate_rigs(tmp_path, [tmp_path], ["a"], radius=3.0)


@pytest.mark.slow
@pytest.mark.computes
def test_rigs_in_one_frame_are_proved() -> None:
    proof = prove_relate_rigs(0.2, 5, lambda share, stage: None)
    assert proof.holds, proof.text()
