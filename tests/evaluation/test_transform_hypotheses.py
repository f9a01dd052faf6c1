"""R and T of random rigs as programs write them: right, inverted, transposed, in other units, the
devices exchanged. Each is recognised from what a capture shows, or stays unchecked; the right one
is never refused."""

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from slviewer.errors import InputError
from slviewer.evaluation.transform_hypotheses import (
    UNITS_MM,
    check_by_axes,
    check_by_board,
    check_by_single_axis,
    check_by_sphere,
)
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.reconstruction.axis_agreement import REMEDIES, list_directions

CAMERA, PROJECTOR, PERIOD = (128, 96), (912, 1140), 18.0
NOISE_PX = 0.05


@dataclass(frozen=True)
class Scene:
    rig: StereoRig
    depth_mm: float
    points: np.ndarray  # (h, w, 3) of a wall with a ball before it
    ball: tuple[np.ndarray, float]
    measured: np.ndarray  # (h, w, 2) px


def random_scene(rng: np.random.Generator) -> Scene:
    """A rig with its projector beside, above or below the camera, and what it measures of a ball
    before a wall."""
    f = rng.uniform(1.1, 2.4) * CAMERA[0]
    K = np.array([[f, 0, 63.5 + rng.normal(0, 2)], [0, f, 47.5 + rng.normal(0, 2)], [0, 0, 1]])
    camera = Lens(K, np.array([rng.normal(0, 0.05), 0, 0, 0, 0]), CAMERA)
    depth, ratio = rng.uniform(250, 1500), rng.uniform(0.2, 0.45)
    at = rng.choice([-90, 0, 90, 180]) + rng.normal(0, 8)  # deg, the projector about the camera
    place = ratio * depth * np.array([np.cos(np.deg2rad(at)), np.sin(np.deg2rad(at)), 0])
    place[2] = rng.normal(0, 0.05) * depth
    forward = np.array([0, 0, depth]) - place
    forward /= np.linalg.norm(forward)
    right = np.cross([0, 1, 0], forward) / np.linalg.norm(np.cross([0, 1, 0], forward))
    R = np.stack([right, np.cross(forward, right), forward])
    R = cv2.Rodrigues(np.append(rng.normal(0, 0.02, 2), rng.normal(0, 0.05)))[0] @ R
    fp = 2.2 * f / CAMERA[0] * PROJECTOR[0] / 2
    Kp = np.array(
        [[fp, 0, 455 + rng.normal(0, 9)], [0, 1.3 * fp, 570 + rng.normal(0, 200)], [0, 0, 1]]
    )
    rig = StereoRig(camera, Lens(Kp, np.zeros(5), PROJECTOR), R, -R @ place)
    rays = np.dstack([camera.rays(), np.ones(CAMERA[::-1])])
    z = 1.1 * depth / (1 + rays[..., 0] * rng.normal(0, 0.3) + rays[..., 1] * rng.normal(0, 0.3))
    centre = np.array([0.05, 0.02, 1.0]) * depth * rng.uniform(0.9, 1.0)
    radius = 0.17 * depth * CAMERA[0] / f
    b, rr = rays @ centre, np.sum(rays**2, axis=2)
    with np.errstate(invalid="ignore"):
        hit = (b - np.sqrt(b**2 - rr * (centre @ centre - radius**2))) / rr
    points = rays * np.where(np.isfinite(hit), hit, z)[..., None]
    seen = rig.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
    seen += rng.normal(0, NOISE_PX, seen.shape)
    seen[~((seen > 0) & (seen < np.array(PROJECTOR))).all(axis=2)] = np.nan
    return Scene(rig, depth, points, (centre, radius), seen)


def phase_map(scene: Scene, axis: str) -> PhaseMap:
    coordinate = scene.measured[..., "xy".index(axis)].astype(np.float32)
    level = np.full(coordinate.shape, 100.0, np.float32)
    reason = np.where(np.isfinite(coordinate), Reason.VALID, Reason.DARK).astype(np.uint8)
    phase = coordinate * np.float32(2 * np.pi / PERIOD)
    return PhaseMap(axis, PERIOD, phase, phase, level, level, reason, (1.0, 0.0), 18)


def stated(rig: StereoRig, direction: str, unit: str) -> StereoRig:
    """The rig as a file states it; each direction is its own inverse, but the last one."""
    R, t = rig.R, rig.t
    transforms = {
        "as stated": (R, t), "inverted": (R.T, -R.T @ t), "transposed": (R.T, t),
        "transposed and inverted": (R, -R @ t),
    }  # fmt: skip
    R, t = transforms[direction]
    return StereoRig(rig.camera, rig.projector, R, t / UNITS_MM[unit])


def check(scene: Scene, rig: StereoRig, evidence: str, rng: np.random.Generator):
    axes = {each: phase_map(scene, each) for each in ("x", "y")}
    if evidence == "two axes":
        return check_by_axes("a", rig, axes)
    if evidence.startswith("board"):
        at = rng.integers(0, scene.points.size // 3, 150)
        measured = scene.measured.reshape(-1, 2)[at]
        if evidence == "board x":
            measured[:, 1] = np.nan
        points = scene.points.reshape(-1, 3)[at] * rng.normal(1, 0.003)
        return check_by_board("a", rig, points, measured)
    if evidence == "sphere":
        baseline_along_x = abs(scene.rig.t[0]) > abs(scene.rig.t[1])
        return check_by_sphere("a", rig, axes["x" if baseline_along_x else "y"], scene.ball[1])
    return check_by_single_axis("a", rig, {evidence[0]: axes[evidence[0]]})


def count(seeds: range, evidences: tuple[str, ...]) -> Counter:
    """{(evidence, truth, answer, named right): how often}."""
    counts: Counter = Counter()
    for seed in seeds:
        scene = random_scene(np.random.default_rng(seed))
        for direction in ("as stated", *REMEDIES):
            for unit in UNITS_MM:
                rig = stated(scene.rig, direction, unit)
                for evidence in evidences:
                    try:
                        found = check(scene, rig, evidence, np.random.default_rng(seed))
                    except InputError:
                        counts[evidence, direction, unit, "InputError", False] += 1
                        continue
                    wanted = REMEDIES.get(direction, "")
                    is_named = wanted in found.remedy and (
                        unit == "mm" or evidence in ("two axes", "x", "y") or unit in found.remedy
                    )
                    counts[evidence, direction, unit, found.answer, is_named] += 1
    return counts


def test_each_direction_undoes_itself() -> None:
    rig = random_scene(np.random.default_rng(1)).rig
    for direction in ("as stated", *REMEDIES):
        again = list_directions(stated(rig, direction, "mm"))[direction]
        np.testing.assert_allclose(again.R, rig.R, atol=1e-12)
        np.testing.assert_allclose(again.t, rig.t, atol=1e-9)


def judge_counts(counts: Counter, evidence: str, strong: bool) -> None:
    """The right calibration is never refused; no wrong one agrees; all that is decided is named."""
    for (which, direction, unit, answer, is_named), n in counts.items():
        if which != evidence:
            continue
        is_right = direction == "as stated" and (unit == "mm" or not strong)
        case = f"{n} of {which}, {direction}, {unit}: {answer}, named: {is_named}"
        assert answer in (("agrees", "undecided") if is_right else ("disagrees", "undecided")), case
        assert answer != "disagrees" or is_named, case


EVIDENCES = {"two axes": False, "board": True, "board x": True, "sphere": True, "x": False}


@pytest.mark.computes
@pytest.mark.parametrize("evidence", ["two axes", "board x"])
def test_directions_and_units_are_recognised(evidence: str) -> None:
    counts = count(range(3), (evidence,))
    judge_counts(counts, evidence, EVIDENCES[evidence])
    right = [n for key, n in counts.items() if key[3] == "agrees"]
    assert sum(right) >= 3


@pytest.mark.slow
@pytest.mark.parametrize("evidence", EVIDENCES)
def test_directions_and_units_of_many_rigs_are_recognised(evidence: str) -> None:
    seeds = range(200, 204) if evidence == "sphere" else range(200, 220)
    counts = count(seeds, (evidence,))
    judge_counts(counts, evidence, EVIDENCES[evidence])
    decided = sum(n for key, n in counts.items() if key[3] != "undecided")
    assert evidence == "x" or decided > 0.9 * counts.total()


@pytest.mark.parametrize("seed", range(3))
def test_exchanged_devices_are_named(seed: int) -> None:
    scene = random_scene(np.random.default_rng(seed))
    rig, inverse = scene.rig, list_directions(scene.rig)["inverted"]
    camera, projector = (
        Lens(other.K, other.D, own.size)
        for own, other in ((rig.camera, rig.projector), (rig.projector, rig.camera))
    )
    exchanged = StereoRig(camera, projector, inverse.R, inverse.t)
    found = check(scene, exchanged, "two axes", np.random.default_rng(0))
    assert found.answer == "disagrees" and "camera and projector are exchanged" in found.remedy
