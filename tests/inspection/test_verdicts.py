"""Verdicts on a plate with a pin and a block, as it should be and with errors."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from facts import raises

from slviewer.geometry.rigid import Floats
from slviewer.inspection.deviation import Deviation, deviation
from slviewer.inspection.tolerance import judge_deviation
from slviewer.inspection.wrong_part import explain_misfit
from slviewer.records.measurement import ToleranceVerdict
from slviewer.records.record import from_plain, to_plain
from slviewer.registration.refusal import WrongPart
from slviewer.surface.shapes import Mesh
from tests.proofs.drawn_parts import Part, PartFeature

NOISE, TOLERANCE, PLATE = 0.02, 0.2, 5.0
PIN = PartFeature((18.0, 9.0), (4.0, 4.0), 0.0, 11.0, is_round=True)
BLOCK = PartFeature((-20.0, -10.0), (6.0, 4.0), 0.0, 8.0)
HOLE = PartFeature((-8.0, 10.0), (3.0, 3.0), 0.0, -np.inf, is_round=True)
PART = Part((-30.0, 30.0), (0.0,), 20.0, PLATE, False, False, 0, (PIN, BLOCK, HOLE))
PARTS = {
    "right": PART,
    "short pin": replace(PART, features=(replace(PIN, height=9.0), BLOCK, HOLE)),
    "long pin": replace(PART, features=(replace(PIN, height=13.0), BLOCK, HOLE)),
    "no pin": replace(PART, features=(BLOCK, HOLE)),
    "moved pin": replace(PART, features=(replace(PIN, centre=(10.0, 9.0)), BLOCK, HOLE)),
    "no hole": replace(PART, features=(PIN, BLOCK)),
    "second pin": replace(PART, features=(*PART.features, replace(PIN, centre=(0.0, -5.0)))),
    "thin pin": replace(PART, features=(replace(PIN, half=(3.6, 3.6)), BLOCK, HOLE)),
}


def nominal() -> Mesh:
    mesh = PART.build()
    return Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32))


def scan(part: Part, seed: int = 1, count: int = 20_000) -> tuple[Floats, Floats]:
    mesh = part.build()
    points, face = trimesh.sample.sample_surface(mesh, count, seed=seed)
    normals = np.asarray(mesh.face_normals)[face]
    noise = np.random.default_rng(seed).normal(0, NOISE, (count, 1))
    return np.asarray(points) + noise * normals, normals


def judge(points: Floats, normals: Floats, **options: object) -> tuple[Deviation, ToleranceVerdict]:
    found = deviation(
        points,
        nominal(),
        normals=normals,
        sigma_mm=NOISE,
        initial=np.eye(4),
        **({"views": None} | options),  # type: ignore[arg-type]
    )
    return found, judge_deviation(found, np.full(len(points), NOISE), TOLERANCE)


@pytest.mark.parametrize(
    "name, value, place",
    [
        ("short pin", -2.0, (18, 9, 9)),
        ("long pin", 2.0, (18, 9, 13)),
        ("no pin", -11.0, (18, 9, 5)),
        ("moved pin", -8.0, (18, 9, 5)),
        ("no hole", 3.0, (-8, 10, -2.5)),
        ("second pin", 11.0, (0, -5, 11)),
        ("thin pin", -0.4, (18, 9, 5)),
    ],
)
def test_a_wrong_feature_fails_by_its_error_at_its_place(name, value, place) -> None:
    _, verdict = judge(*scan(PARTS[name]))
    assert verdict.decision == "fail"
    worst = verdict.places[0]
    # the largest distance between two surfaces depends on where points happen to lie
    assert worst.value_mm == pytest.approx(value, abs=max(worst.U_mm, 0.12 * abs(value)))
    assert np.abs(np.subtract(worst.place, place)).max() < 9
    assert from_plain(to_plain(verdict), ToleranceVerdict) == verdict


def test_the_right_part_passes_and_states_its_evidence() -> None:
    found, verdict = judge(*scan(PART))
    assert verdict.decision == "pass" and not verdict.places and not found.excluded
    assert verdict.area is not None and verdict.area > 99
    assert verdict.spot_mm is not None and 0.5 < verdict.spot_mm < 4
    assert abs(verdict.lowest[0]) < 3 * NOISE and abs(verdict.highest[0]) < 3 * NOISE


def test_what_stands_beside_the_part_is_excluded_and_listed() -> None:
    points, normals = scan(PART)
    above = points[:, 2] > -PLATE + 3 * NOISE  # a table hides the underside
    rng = np.random.default_rng(2)
    xy = rng.uniform(-70, 70, (20_000, 2))
    xy = xy[(np.abs(xy) > [30.3, 20.3]).any(axis=1)]
    table = np.column_stack([xy, np.full(len(xy), -PLATE)])
    clamp = trimesh.creation.box((10, 10, 12))
    clamp.apply_translation((42, 0, 5))
    block, face = trimesh.sample.sample_surface(clamp, 1500, seed=3)
    together = np.concatenate([points[above], table, block])
    facing = np.concatenate(
        [normals[above], np.tile([0.0, 0, 1], (len(table), 1)), clamp.face_normals[face]]
    )
    found, verdict = judge(together, facing, views=[np.array([[0.0, 0, 400.0]])])
    assert verdict.decision == "pass"
    reasons = {each.reason: each for each in found.excluded}
    assert reasons["table"].points > 0.99 * len(table)
    assert reasons["beside"].points > 0.9 * len(block)
    assert np.allclose(reasons["beside"].place, [42, 0, 5], atol=6)


def test_what_touches_the_part_leaves_it_undecided() -> None:
    points, normals = scan(PART)
    clamp = trimesh.creation.box((12, 12, 12))
    clamp.apply_translation((36.0, 0, 0))
    block, face = trimesh.sample.sample_surface(clamp, 3000, seed=3)
    outside = block[:, 0] > 30.01
    found, verdict = judge(
        np.concatenate([points, block[outside]]),
        np.concatenate([normals, clamp.face_normals[face][outside]]),
    )
    assert verdict.decision == "undecided" and "touching" in {e.reason for e in found.excluded}


def test_isolated_points_are_excluded() -> None:
    points, normals = scan(PART)
    spikes = np.random.default_rng(4).uniform([-40, -30, -20], [40, 30, 30], (60, 3))
    found, verdict = judge(
        np.concatenate([points, spikes]), np.concatenate([normals, np.tile([0.0, 0, 1], (60, 1))])
    )
    assert verdict.decision == "pass"
    assert [each.reason for each in found.excluded] == ["alone"]


def test_a_spot_that_was_not_measured_does_not_pass() -> None:
    points, normals = scan(PART)
    seen = np.hypot(points[:, 0] - 18, points[:, 1] - 9) > 4.5
    _, verdict = judge(points[seen], normals[seen])
    assert verdict.decision == "undecided" and verdict.area is not None and verdict.area > 90
    assert verdict.gap_mm is not None and verdict.gap_mm > 6


@pytest.mark.computes
def test_the_mirror_image_and_another_scale_are_named() -> None:
    points, normals = scan(PART, count=8000)
    model = nominal()
    flip = np.array([1.0, -1, 1])
    found = deviation(flip * points, model, normals=flip * normals, sigma_mm=NOISE, views=None)
    for shown, T, fact in (
        (flip * points, found.T_nominal_scan, "mirror image"),
        (1.02 * points, np.eye(4), "2.00 % larger"),
        (0.98 * points, np.eye(4), "2.00 % smaller"),
        (points, np.eye(4), ""),
    ):
        facing = flip * normals if fact == "mirror image" else normals
        reason = explain_misfit(shown, facing, model, T, TOLERANCE, has_camera=False)
        assert fact in reason and bool(fact) == bool(reason)
    with raises(WrongPart, "25.4"):
        deviation(25.4 * points, model, normals=normals, sigma_mm=NOISE, views=None)


@pytest.mark.parametrize("off, decision", [(0.205, "pass"), (0.215, "undecided"), (0.245, "fail")])
def test_a_row_of_points_that_may_be_noise_does_not_pass(off: float, decision: str) -> None:
    points, normals = scan(PART)
    row = np.column_stack([np.linspace(5, 7, 7), np.full(7, -12.0), np.full(7, off)])
    _, verdict = judge(
        np.concatenate([points, row]), np.concatenate([normals, np.tile([0.0, 0, 1], (7, 1))])
    )
    assert verdict.decision == decision
    assert bool(verdict.places) == (decision == "fail")
    if decision == "undecided":
        (doubt,) = verdict.doubts
        assert doubt.startswith("7 points at x y z 6.0 -12.0 0.2 mm of the model lie 0.21")


@pytest.mark.parametrize("spikes, decision", [(1, "pass"), (3, "fail")])
def test_one_spike_is_no_counterpart_of_an_open_place(spikes: int, decision: str) -> None:
    points, normals = scan(PART)
    found, _ = judge(points, normals)
    area, bottom = found.area, np.array([-8.0, 10.0, -PLATE])
    near = np.argsort(np.linalg.norm(area.places - bottom, axis=1))[:18]
    deviates, counterpart = area.deviation.copy(), area.counterpart.copy()
    deviates[near] = -7.0
    counterpart[near] = bottom + [[0.1 * (i % spikes), 0, 7] for i in range(18)]
    changed = replace(found, area=replace(area, deviation=deviates, counterpart=counterpart))
    verdict = judge_deviation(changed, np.full(len(points), NOISE), TOLERANCE)
    assert verdict.decision == decision


def test_a_speck_of_dirt_that_may_be_noise_does_not_pass() -> None:
    points, normals = scan(PART)
    hidden = np.linalg.norm(points - [6.0, -12.0, 0.0], axis=1) < 0.6
    points, normals = points[~hidden], normals[~hidden]
    height = TOLERANCE * np.array([1.9, 1.8, 1.5, 1.4, 1.05, 0.97, 0.96, 0.88, 0.81])
    across = 0.3 * np.stack(np.meshgrid([0, -1, 1], [0, -1, 1]), -1).reshape(-1, 2)
    order = np.argsort(np.linalg.norm(across, axis=1), kind="stable")
    dirt = np.column_stack([across[order] + [6.0, -12.0], height])
    found, _ = judge(
        np.concatenate([points, dirt]), np.concatenate([normals, np.tile([0.0, 0, 1], (9, 1))])
    )
    rough = judge_deviation(found, np.full(len(points) + 9, TOLERANCE / 3), TOLERANCE)
    assert rough.decision == "undecided" and not rough.places
    assert rough.doubts[0].startswith("6 points at x y z 6.")
