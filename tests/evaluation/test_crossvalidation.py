"""Leaving poses out, and what a model makes of a board that it was not made from."""

import json
from dataclasses import replace

import numpy as np
import pytest
from facts import missing_facts, raises

from slviewer.calibration.observe import Observation
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap
from slviewer.geometry.lens import Lens
from slviewer.geometry.polynomial import fit_polynomial
from slviewer.geometry.rig import StereoRig
from slviewer.pipeline.accept import (
    LEAST_POSES,
    gather_results,
    measure_held_out,
    split_folds,
)
from slviewer.pipeline.operation import read_record
from slviewer.records.acceptance import HeldOutPose, ModelComparison
from slviewer.records.record import render_text, to_plain
from slviewer.target.board import Board

SIZE, PERIOD = (200, 150), 18.0
BOARD = Board.parse("circles:9x7:12")
TURN = np.array([[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]])


def rig() -> StereoRig:
    camera = Lens(np.array([[450.0, 0, 99.5], [0, 450.0, 74.5], [0, 0, 1]]), np.zeros(5), SIZE)
    projector = Lens(
        np.array([[700.0, 0, 228.0], [0, 1400.0, 285.0], [0, 0, 1]]), np.zeros(5), (456, 570)
    )
    return StereoRig(camera, projector, TURN, -TURN @ np.array([180.0, 0.0, 0.0]))


def seen(true: StereoRig, depth: float, name: str = "pose") -> Observation:
    """A board tilted by some degrees, without any noise."""
    a = np.radians(12.0)
    R = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    t = np.array([0, 0, depth]) - R @ BOARD.points.mean(0)
    X = BOARD.points @ R.T + t
    u, v = (g.ravel() for g in np.meshgrid(np.arange(0, SIZE[0], 3), np.arange(0, SIZE[1], 3)))
    rays = np.c_[true.camera.undistort(np.c_[u, v].astype(float)), np.ones(len(u))]
    coordinate = true.project(rays * ((R[:, 2] @ t) / (rays @ R[:, 2]))[:, None])
    box = (-0.5, -0.5, SIZE[0] - 0.5, SIZE[1] - 0.5)
    surfaces = {
        axis: fit_polynomial(u, v, 2 * np.pi * coordinate[:, i] / PERIOD, None, box, 7)
        for i, axis in enumerate("xy")
    }
    region = np.zeros(SIZE[::-1], bool)
    low, high = true.camera.project(X).min(0).astype(int), true.camera.project(X).max(0).astype(int)
    region[low[1] : high[1] + 2, low[0] : high[0] + 2] = True
    return Observation(
        name, BOARD.points, true.camera.project(X), true.project(X), surfaces,
        {"x": PERIOD, "y": PERIOD}, SIZE,
        (0, 0, *SIZE), np.packbits(region),
    )  # fmt: skip


class Stretched:
    """A perfect calibration but for its scale, and a ripple in depth."""

    name, axes = "stretched", ("x", "y")

    def __init__(self, true: StereoRig, scale: float = 1.0, ripple_mm: float = 0.0):
        self.model, self.scale, self.ripple_mm = StereoModel.from_rig(true), scale, ripple_mm

    def points(self, phase: PhaseMap) -> np.ndarray:
        points = self.scale * self.model.points(phase).astype(float)
        wave = self.ripple_mm * np.sqrt(2) * np.sin(np.arange(SIZE[0]) / 4)
        return points * (1 + wave / points[..., 2])[..., None]

    def sigma_z(self, phase: PhaseMap, points: np.ndarray) -> np.ndarray:
        return np.zeros(points.shape[:2])


def test_poses_are_dealt_by_depth() -> None:
    depths = {f"p{k}": 500.0 + 37 * k % 200 for k in range(12)}
    folds = split_folds(depths, 5)
    assert sorted(name for fold in folds for name in fold) == sorted(depths)
    assert sorted(map(len, folds)) == [2, 2, 2, 3, 3]
    order = sorted(depths, key=lambda name: depths[name])
    assert all(order.index(fold[1]) - order.index(fold[0]) == 5 for fold in folds)
    assert len(split_folds({f"p{k}": float(k) for k in range(6)}, 9)) == 6
    with raises(InputError, 4, LEAST_POSES):
        split_folds({f"p{k}": float(k) for k in range(4)})
    with pytest.raises(InputError):
        split_folds(depths, 1)


def test_a_perfect_model_leaves_nothing_and_an_imperfect_one_its_error() -> None:
    true = rig()
    models = {
        "true": Stretched(true),
        "long": Stretched(true, 1.0005),
        "rippled": Stretched(true, 1.0, 0.05),
    }
    found = measure_held_out(models, seen(true, 600.0), "x", true)
    perfect = found["true"]
    assert perfect.plane_mm < 2e-3 and perfect.board_mm < 4e-3 and abs(perfect.scale_ppm) < 20
    assert (
        perfect.camera_px < 2e-3
        and perfect.projector_px < 4e-3
        and perfect.depth_mm == pytest.approx(600, abs=1)
    )
    assert found["long"].scale_ppm - perfect.scale_ppm == pytest.approx(500, abs=1)
    # stretched by 500 ppm about its middle: the RMS distance of the features from there times that
    spread = np.sqrt(np.mean(np.sum((BOARD.points - BOARD.points.mean(0)) ** 2, axis=1)))
    assert (
        found["long"].board_mm == pytest.approx(5e-4 * spread, rel=0.05)
        and found["long"].plane_mm < 2e-3
    )
    assert 0.035 < found["rippled"].plane_mm < 0.055  # along the rays, of a board that is tilted
    assert found["rippled"].projector_px > 5 * perfect.projector_px
    assert len({held.pixels for held in found.values()}) == 1


def test_pixels_that_one_model_does_not_measure_count_for_none() -> None:
    true = rig()

    class Half(Stretched):
        def points(self, phase: PhaseMap) -> np.ndarray:
            points = super().points(phase)
            points[:, :100] = np.nan
            return points

    pose = seen(true, 600.0)
    whole = measure_held_out({"true": Stretched(true)}, pose, "x", true)["true"].pixels
    found = measure_held_out({"true": Stretched(true), "half": Half(true)}, pose, "x", true)
    assert found["true"].pixels == found["half"].pixels < 0.6 * whole
    nothing = replace(pose, packed_region=np.zeros_like(pose.packed_region))
    assert measure_held_out({"true": Stretched(true)}, nothing, "x", true) == {}


def held(board_mm: float) -> HeldOutPose:
    return HeldOutPose(board_mm / 2, board_mm, 100.0, 0.1, 0.2, 1000, 600.0)


def test_the_best_is_recommended_and_of_equals_the_simpler() -> None:
    names = ("stereo", "pixelwise", "splined")

    def recommended(*errors: float) -> str:
        poses = ("p0", "p1", "p2", "p3")
        measured = {
            name: dict.fromkeys(poses, held(e)) for name, e in zip(names, errors, strict=True)
        }
        return gather_results(measured, (poses,), {}).recommended

    assert recommended(0.3, 0.2, 0.1) == "splined"
    assert recommended(0.3, 0.2, 0.199) == "pixelwise"
    assert recommended(0.1, 0.2, 0.15) == "stereo"


def test_it_survives_saving_and_says_what_failed() -> None:
    measured = {"stereo": {"p0": held(0.2), "p1": held(0.4)}, "pixelwise": {}}
    found = gather_results(measured, (("p0",), ("p1",)), {"pixelwise": "3 usable poses"})
    assert found.models["stereo"].board_mm == pytest.approx(np.sqrt(0.1))
    assert found.recommended == "stereo"
    (table,) = ModelComparison.tables({"1": found})
    assert (
        missing_facts(render_text(table), found.recommended, "pixelwise", found.failed["pixelwise"])
        == []
    )
    assert read_record(ModelComparison, json.loads(json.dumps(to_plain(found)))) == found
    with raises(InputError, "stereo", "why"):
        gather_results({"stereo": {}}, (), {"stereo": "why"})
