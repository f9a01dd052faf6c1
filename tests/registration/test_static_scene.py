"""An object on a turntable before a wall that stands still: its motion is measured, and the wall is
kept out of it."""

import re
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import raises
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.reconstruction.cloud import Cloud
from slviewer.registration.multiway import register_all
from slviewer.registration.scan import away_from_edges
from slviewer.registration.static_scene import (
    measure_contradiction,
    register_object,
    sample_surface,
)
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.scenes import Surface
from slviewer.simulation.turning import AXIS, AXIS_POINT, turning

pytestmark = [pytest.mark.computes, pytest.mark.slow]

NOISE = 0.04
SIZE = (220, 165)
WALL_MM = 780.0


def rays() -> np.ndarray:
    w, h = SIZE
    v, u = np.mgrid[:h, :w]
    return np.stack([(u - w / 2) / (2.4 * w), (v - h / 2) / (2.4 * w), np.ones(u.shape)], axis=2)


def seen(scene: MeshScene, seed: int, wall: bool) -> Cloud:
    """What a camera at the origin measures of the object, and of a wall with a step behind it."""
    surface: Surface = scene.trace(rays()[..., :2])
    z = surface.points[..., 2].copy()
    behind = WALL_MM + 12.0 * (rays()[..., 0] > 0.05) + 30.0 * rays()[..., 0]
    rng = np.random.default_rng(seed)
    z = np.where(np.isfinite(z), z, behind if wall else np.nan) + rng.normal(0, NOISE, z.shape)
    return Cloud(
        (rays() * z[..., None]).astype(np.float32),
        "x",
        "stereo",
        np.full(z.shape, NOISE, np.float32),
    )


def turned(deg: float) -> np.ndarray:
    """(4, 4): the table's motion."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(deg) * AXIS).as_matrix()
    T[:3, 3] = AXIS_POINT - T[:3, :3] @ AXIS_POINT
    return T


def error(T: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """mm at the object, degrees."""
    D = T @ np.linalg.inv(true)
    shift = np.linalg.norm(D[:3, :3] @ AXIS_POINT + D[:3, 3] - AXIS_POINT)
    return float(shift), float(
        np.degrees(np.linalg.norm(Rotation.from_matrix(D[:3, :3]).as_rotvec()))
    )


@cache
def scans(deg: float, wall: bool) -> tuple[dict[str, Cloud], dict[str, np.ndarray]]:
    """Two scans, the object turned by so many degrees between them; and where the wall is seen in
    each."""
    first = turning()["turn_01"]
    pose, T = first.pose, turned(deg)
    second = MeshScene(
        first.vertices,
        first.triangles,
        type(pose)(T[:3, :3] @ pose.R, T[:3, :3] @ pose.t + T[:3, 3]),
    )
    clouds = {"a": seen(first, 1, wall), "b": seen(second, 2, wall)}
    return clouds, {name: cloud.points[..., 2] > 700 for name, cloud in clouds.items()}


@pytest.mark.parametrize("deg", [pytest.param(2.0, marks=pytest.mark.slow), 25.0])
def test_a_wall_behind_a_turned_object_is_recognised_and_does_not_move_it(deg: float) -> None:
    alone, _ = scans(deg, wall=False)
    clouds, wall = scans(deg, wall=True)
    true = np.linalg.inv(turned(deg))
    bare = error(register_all(alone, "a").T_reference_scan["b"], true)
    found = register_object(clouds, "a")
    shift, turn = error(found.alignment.T_reference_scan["b"], true)
    assert shift < max(1.5 * bare[0], 0.03) and turn < max(1.5 * bare[1], 0.02)
    for name, mask in found.static.items():
        wall_there = wall[name] & clouds[name].mask
        assert (mask & wall_there).sum() > 0.95 * wall_there.sum()
        assert (mask & ~wall_there).sum() < 0.04 * (
            clouds[name].mask & ~wall_there
        ).sum()  # its rim
        assert not (found.clouds[name].mask & mask).any()
    assert 0 <= found.contradictions["b", "a"].share < 0.02


def test_an_object_alone_has_nothing_that_stands_still() -> None:
    clouds, _ = scans(25.0, wall=False)
    found = register_object(clouds, "a")
    assert not any(mask.any() for mask in found.static.values())
    assert found.clouds["a"] is clouds["a"]
    assert (
        found.contradictions["b", "a"].share < 0.01
        and found.contradictions["b", "a"].compared > 1000
    )


def test_a_scan_that_is_all_holes_says_where_its_points_are_lost() -> None:
    clouds = dict(scans(25.0, wall=True)[0])
    sparse = clouds["b"].points.copy()
    sparse[np.random.default_rng(0).random(sparse.shape[:2]) < 0.4] = np.nan
    clouds["b"] = Cloud(sparse, "x", "stereo", clouds["b"].sigma_z)
    with raises(InputError, "b") as refused:
        register_object(clouds, "a")
    total, trusted = map(int, re.findall(r"\b\d+\b", str(refused.value))[:2])
    assert trusted < total and 10_000 <= total <= clouds["b"].mask.sum()


def test_steps_within_the_noise_are_no_edges() -> None:
    clouds, _ = scans(25.0, wall=True)
    z = clouds["a"].points[..., 2]
    noisy = np.where(np.isfinite(z), z + np.random.default_rng(1).normal(0, 3.0, z.shape), np.nan)
    points = clouds["a"].points * (noisy / z)[..., None]
    assert away_from_edges(points).mean() < 0.2
    assert away_from_edges(points, np.full(z.shape, 3.0)).mean() > 0.6


def test_contradictions_are_counted_where_one_scan_sees_through_the_others_points() -> None:
    clouds, wall = scans(2.0, wall=True)
    views = {name: sample_surface(cloud.measured) for name, cloud in clouds.items()}
    share = float(wall["b"].sum() / clouds["b"].mask.sum())
    T = np.linalg.inv(turned(2.0))
    moved = measure_contradiction(views["b"], views["a"], T, 1.0).share
    # half of the turned wall lies before itself, the other half behind
    assert 0.2 * share < moved < 0.8 * share
    still = measure_contradiction(views["b"], views["a"], np.eye(4), 1.0).share
    assert 0.001 < still < 0.5 * (1 - share)


def test_real_shells_turn_while_their_background_stands_still(real_data: Path) -> None:
    clouds = {}
    calibration = real_data / "sltk_shells" / "procam_2016_12_09.yaml"
    for name in ("scan_0020", "scan_0021"):
        file = calibration.with_name(f"{name}_cloud.ply")
        if not file.exists():
            pytest.skip(f"{file} is not among the real captures")
        clouds[name] = organised_ply(file, calibration)
    found = register_object(clouds, "scan_0020")
    turn = np.degrees(
        Rotation.from_matrix(found.alignment.T_reference_scan["scan_0021"][:3, :3]).magnitude()
    )
    assert turn == pytest.approx(1.37, abs=0.03)
    for name, cloud in clouds.items():
        share = found.static[name].sum() / cloud.mask.sum()
        assert 0.02 < share < 0.1, "the wall and the rim beside the shells"
        shell = cloud.mask & (cloud.points[..., 0] > -200) & (cloud.points[..., 2] > 640)
        assert (found.static[name] & shell).sum() < 0.005 * shell.sum()
    assert found.contradictions["scan_0021", "scan_0020"].share < 0.01


def organised_ply(file: Path, calibration: Path, step: int = 3) -> Cloud:
    """The authors' cloud on the grid of every third pixel of their camera."""
    data = file.read_bytes()
    vertices = np.frombuffer(
        data[data.index(b"end_header\n") + 11 :], dtype=[("p", "<f4", 3), ("c", "u1", 3)]
    )
    points = vertices["p"].astype(np.float64) * (1, -1, -1)
    storage = cv2.FileStorage(str(calibration), cv2.FILE_STORAGE_READ)
    K, distortion = storage.getNode("cam_K").mat(), storage.getNode("cam_kc").mat()
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]
    u, v = np.rint(pixels / step).astype(int).T
    grid = np.full((1944 // step + 1, 2592 // step + 1, 3), np.nan, np.float32)
    grid[v, u] = points
    return Cloud(grid, "x", "stereo", np.full(grid.shape[:2], 0.15, np.float32))
