"""Causes told from evidence, and a robust fit that one bad pose does not change."""

import dataclasses
import json
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from analytic_rig import BOARD, PROJECTOR, board_poses, observation, rig
from facts import missing_facts

from slviewer.calibration.diagnosis.diagnose import DiagnosedCalibration, calibrate_with_diagnosis
from slviewer.calibration.diagnosis.evidence import AxisEvidence, Evidence, PoseEvidence
from slviewer.calibration.diagnosis.frames import fit_mean_turn
from slviewer.calibration.diagnosis.numbering import describe_misnumbering
from slviewer.calibration.diagnosis.rules import judge_evidence
from slviewer.calibration.known_camera import KnownCamera
from slviewer.calibration.observe import Observation
from slviewer.fringe.response import gamma_from_harmonic
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import move_points
from slviewer.geometry.triangulation import triangulate_pixels
from slviewer.records.record import from_plain, to_plain
from slviewer.records.verdict import CAUSES, Finding, Verdict

TRUE = rig()
UPRIGHT = ((1.5, 0.1), (-0.1, 3.0))


def axis(**change: float) -> AxisEvidence:
    sound = AxisEvidence(18.0, 18, 1.0, 0.0, 0.0, 18.0)
    return dataclasses.replace(sound, **change)


def pose(number: int, **change: object) -> PoseEvidence:
    sound = PoseEvidence(
        f"pose_{number:02d}", axes={"x": axis(), "y": axis()}, moved_px=0.01, turn=UPRIGHT
    )
    return dataclasses.replace(sound, **change)


def causes(*poses: PoseEvidence, **more: object) -> tuple[str, ...]:
    return judge_evidence(
        Evidence("circles:21x16:9", (912, 1140), poses, tilt_spread_deg=30.0, **more)
    ).causes


def observations(count: int = 20) -> list[Observation]:
    return [observation(TRUE, T, f"pose_{k:02d}") for k, T in enumerate(board_poses(count))]


def attempt(poses: list[Observation]) -> DiagnosedCalibration:
    return calibrate_with_diagnosis(poses, [PoseEvidence(o.name) for o in poses], PROJECTOR, BOARD)


def plane_rms_mm(found: DiagnosedCalibration, poses: list[Observation]) -> float:
    """Of the features of all poses, reconstructed from x: the mean over the poses."""
    assert found.stereo is not None
    rms = []
    for o in poses:
        X = triangulate_pixels(found.stereo.rig, o.camera, o.projector[:, 0], "x")
        rms.append(np.linalg.svd(X - X.mean(0), full_matrices=False)[1][2] / np.sqrt(len(X)))
    return float(np.mean(rms))


@pytest.mark.computes
@pytest.mark.parametrize(
    ("factor", "level"), [(1.0, "good"), (1.005, "doubtful"), (1.2, "rejected")]
)
def test_a_fixed_camera_is_compared_with_the_poses(factor: float, level: str) -> None:
    poses, true = observations(8), rig().camera
    fx, fy, *rest = true.parameters[:9]
    lens = Lens.from_parameters((factor * fx, factor * fy, *rest), true.size)
    known = KnownCamera(lens, "lens.yaml", True, 0.001 * fx)
    evidence = [PoseEvidence(o.name) for o in poses]
    found = calibrate_with_diagnosis(poses, evidence, PROJECTOR, BOARD, camera=known)
    assert found.verdict.level == level
    if level != "good":
        assert found.verdict.causes[0] == "camera-file"
        assert not missing_facts(found.verdict.reason, "shorter", "lens.yaml", "--fix-camera")
        assert found.evidence.camera is not None
        assert found.evidence.camera.change == pytest.approx(1 / factor - 1, abs=0.002)


@pytest.mark.computes
def test_a_sound_calibration_is_good() -> None:
    found = attempt(observations(8))
    assert (
        found.verdict == Verdict() and found.verdict.level == "good" and found.verdict.reason == ""
    )
    assert len(found.observations) == 8 and not found.excluded


@pytest.mark.computes
def test_a_corner_that_no_pose_reaches_is_named() -> None:
    width, height = TRUE.camera.size
    lit = np.ones((height, width), bool)
    lit[: height // 3, -width // 3 :] = False
    away = []
    for o in observations(8):
        u0, v0, u1, v1 = o.box
        box = (u0, v0, u1 - (u1 - u0) // 2 * (o.name == "pose_07"), v1)  # the last sees a half
        lit_here = np.packbits(lit[v0:v1, u0 : box[2]])
        away.append(dataclasses.replace(o, box=box, packed_region=lit_here))
    assert attempt(observations(8)).verdict.causes == ()
    found = attempt(away)
    assert found.verdict.causes == ("empty-corner",)
    assert found.evidence.solution.empty_corners == ("top right",)


@pytest.mark.computes
def test_cells_that_are_not_square_are_named() -> None:
    scaled = np.array([1, 1 / 0.7, 1])
    poses = [dataclasses.replace(o, points=o.points * scaled) for o in observations(8)]
    found = attempt(poses)
    assert found.verdict.causes[0] == "board-size" and found.verdict.level != "good"
    squareness = found.evidence.solution.squareness
    assert 0.698 < squareness.explaining < 0.702
    assert f"{squareness.explaining:.4f}" in found.verdict.findings[0].observation
    assert "fringe-period" not in found.verdict.causes


@pytest.mark.computes
def test_pixels_that_are_not_square_are_no_fault_where_tilts_prove_them() -> None:
    K = TRUE.camera.K * np.array([[1], [0.5], [1]])
    low = dataclasses.replace(TRUE, camera=dataclasses.replace(TRUE.camera, K=K))
    found = attempt([observation(low, T, f"pose_{k:02d}") for k, T in enumerate(board_poses(9))])
    (note,) = (each for each in found.verdict.findings if each.cause == "board-size")
    assert note.severity == "note" and "0.50" in note.observation
    assert "fringe-period" not in found.verdict.causes


@pytest.mark.computes
@pytest.mark.parametrize(("corner", "level"), [(0.1, "rejected"), (0.02, "doubtful"), (0, "good")])
def test_a_projector_that_moves_its_corners_is_named(corner: float, level: str) -> None:
    outer = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32) * np.float32(PROJECTOR)
    inner = outer.copy()
    inner[0, 0] += corner * PROJECTOR[0]
    inner[3, 0] -= corner * PROJECTOR[0]
    H = cv2.getPerspectiveTransform(inner, outer)
    found = attempt(
        [
            dataclasses.replace(o, projector=cv2.perspectiveTransform(o.projector[None], H)[0])
            for o in observations(9)
        ]
    )
    assert found.verdict.level == level
    assert "board-size" not in found.verdict.causes
    if corner:
        first = found.verdict.findings[0]
        assert first.cause == "fringe-period" and "keystone" in first.remedy


@pytest.mark.computes
def test_places_captured_twice_are_no_more_poses() -> None:
    places = board_poses(9)[::2]
    seen = [observation(TRUE, T, f"pose_{k}") for k, T in enumerate([*places, *places])]
    (finding,) = (f for f in attempt(seen).verdict.findings if f.cause == "too-few-poses")
    assert not missing_facts(finding.observation, 10, 5, "places")


@pytest.mark.computes
def test_a_telecentric_lens_is_not_taken_for_parallel_boards() -> None:
    seen = [
        dataclasses.replace(o, camera=move_points(T, o.points)[:, :2] * 890 / 600 + [203, 147])
        for o, T in zip(observations(9), board_poses(9), strict=True)
    ]
    (finding,) = attempt(seen).verdict.findings
    assert finding.severity == "rejected" and "telecentric" in finding.observation
    parallel = []
    for k in range(9):
        T = board_poses(9)[0]
        T[:3, 3] += [12.0 * k - 48, 8.0 * k - 32, 20.0 * k]
        parallel.append(observation(TRUE, T, f"pose_{k:02d}"))
    finding = attempt(parallel).verdict.findings[0]
    assert finding.severity == "rejected" and "nearly parallel" in finding.observation


@pytest.mark.computes
@pytest.mark.parametrize(("tilt_deg", "level"), [(6, "doubtful"), (25, "good")])
def test_boards_near_one_plane_leave_focal_lengths_uncertain(tilt_deg: float, level: str) -> None:
    """A board that is bent by 0.3 mm disturbs the fits by more than its features' noise."""
    poses = [
        observation(TRUE, T, f"pose_{k:02d}", 0.05, bend_per_mm=4.7e-5)
        for k, T in enumerate(board_poses(10, max_tilt_deg=tilt_deg))
    ]
    found = attempt(poses)
    assert found.stereo is not None and found.verdict.level == level
    for device, f in (("camera", 890), ("projector", 700)):
        lens = getattr(found.stereo.rig, device)
        assert abs(lens.K[0, 0] - f) < 3 * found.stereo.focal_sigma_px[device]
    if level != "good":
        assert "parallel-poses" in found.verdict.causes
        assert not missing_facts(found.verdict.text(), "degrees", 15)


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize(
    "order",
    [
        "transposed",
        "noise",
        "moved",
        *(pytest.param(each, marks=pytest.mark.slow) for each in ("row", "mirrored", "bent")),
    ],
)
def test_one_bad_pose_of_twenty_is_named_and_changes_nothing(order: str) -> None:
    clean = observations()
    base = attempt(clean)
    index = np.arange(99).reshape(9, 11)
    turns: dict[str, Callable[[], np.ndarray]] = {
        "transposed": lambda: index.T,
        "row": lambda: np.roll(index, 1, axis=0),
        "mirrored": lambda: index[:, ::-1],
    }
    bad, poses = clean[4], observations()
    if order in turns:
        turned = turns[order]().ravel()
        poses[4] = dataclasses.replace(
            bad, camera=bad.camera[turned], projector=bad.projector[turned]
        )
    elif order == "noise":
        noise = np.random.default_rng(1).normal(0, 3, bad.camera.shape)
        poses[4] = dataclasses.replace(bad, camera=bad.camera + noise)
    elif order == "bent":
        bent = np.outer((bad.points[:, 0] / 16 - 5) ** 2, [0.05, 0.0])
        poses[4] = dataclasses.replace(bad, camera=bad.camera + bent)
    else:
        behind = board_poses(20)[4]
        behind[2, 3] += 8.0
        poses[4] = dataclasses.replace(
            bad, projector=observation(TRUE, behind, "pose_04").projector
        )
    found = attempt(poses)
    cause = {"noise": "outlier", "bent": "outlier", "moved": "moved"}.get(order, "board-numbering")
    assert found.verdict.causes == (cause,) and found.verdict.findings[0].poses == ("pose_04",)
    assert found.verdict.level == "good"  # it is excluded
    assert list(found.excluded) == ["pose_04"] and "pose" in found.excluded["pose_04"]
    assert found.stereo is not None and base.stereo is not None
    assert found.stereo.baseline_mm == pytest.approx(base.stereo.baseline_mm, rel=2e-3)
    assert plane_rms_mm(found, clean) == pytest.approx(plane_rms_mm(base, clean), rel=0.02)


@pytest.mark.computes
def test_what_cannot_be_used_is_kept_to_look_into_if_it_is_a_rig_at_all() -> None:
    bent = observations(6)
    for k, o in enumerate(bent):
        ripple = 6 * np.sin(np.arange(len(o.points)) * (2.0 + k))
        bent[k] = dataclasses.replace(o, projector=o.projector + np.stack([ripple, -ripple], 1))
    found = attempt(bent)
    assert found.verdict.level == "rejected" and found.verdict.causes[0] == "residuals"
    assert found.stereo is not None and found.stereo.reprojection_rms_px["stereo"] > 2
    assert missing_facts(found.verdict.findings[0].observation, "reprojection error") == []
    exchanged = [dataclasses.replace(o, projector=o.projector[:, ::-1]) for o in observations(6)]
    evidence = [PoseEvidence(o.name, turn=fit_mean_turn(o.camera, o.projector)) for o in exchanged]
    found = calibrate_with_diagnosis(exchanged, evidence, PROJECTOR, BOARD)
    assert found.verdict.level == "rejected" and found.verdict.causes[0] == "axes-swapped"
    assert found.stereo is None or np.isfinite(found.stereo.reprojection_rms_px["stereo"])


@pytest.mark.parametrize(
    ("turn", "cause", "axes"),
    [
        (((0.1, 1.5), (3.0, -0.1)), "axes-swapped", ("x", "y")),
        (((-1.5, 0.1), (0.1, 3.0)), "axis-reversed", ("x axis",)),
        (((1.5, 0.1), (0.1, -3.0)), "axis-reversed", ("y axis",)),
    ],
)
def test_a_mirror_image_is_explained(turn: tuple, cause: str, axes: tuple[str, ...]) -> None:
    verdict = judge_evidence(
        Evidence("circles:21x16:9", (912, 1140), tuple(pose(k, turn=turn) for k in range(6)))
    )
    assert verdict.causes == (cause,) and verdict.level == "rejected"
    assert missing_facts(verdict.reason, *axes) == []


def test_a_projector_upside_down_is_sound() -> None:
    turned = tuple(pose(k, turn=((-1.5, 0.1), (-0.1, -3.0))) for k in range(8))
    assert causes(*turned) == ()


def test_the_root_cause_hides_its_consequences() -> None:
    late = Finding("frame-lag", "rejected", "all frames are one image late", "wait longer")
    spoilt = {"refused": "no board", "findings": (late,), "axes": {"x": axis(period_seen_px=7.0)}}
    assert causes(*(pose(k, **spoilt) for k in range(6)), refusal="0 usable poses") == (
        "frame-lag",
    )
    # codes beyond the projector: of another size, or of other fringes
    text, remedy = "10 % of the x codes lie outside", "give the size"
    beyond = (Finding("projector-size", "rejected", text, remedy, axis="x", value=1000.0),)
    assert causes(*(pose(k, findings=beyond, refused="codes") for k in range(6))) == (
        "projector-size",
    )
    wrong = {"axes": {"x": axis(period_px=20.0)}, "refused": "codes", "findings": beyond}
    assert causes(*(pose(k, **wrong) for k in range(6))) == ("fringe-period",)
    # a board that is never found says why before it says that too few are left
    assert causes(*(pose(k, refused="336 of 352", grid=(20, 16)) for k in range(6))) == (
        "board-size",
    )


def test_a_frame_that_is_white_too_early_or_late_tells_which_way() -> None:
    assert causes(*(pose(k, displaced=-1) for k in range(6)))[0] == "missing-frame"
    assert causes(*(pose(k, displaced=1) for k in range(6)))[0] == "frame-lag"
    # what the other frames show comes first
    swapped = (Finding("frame-order", "rejected", "frames 3 and 4 have changed places", "sort"),)
    assert causes(*(pose(k, findings=swapped, displaced=1) for k in range(6)))[0] == "frame-order"


def test_findings_that_harm_little_refuse_no_calibration() -> None:
    harmless = (Finding("room-light", "doubtful", "brighter", "keep it constant"),)
    assert causes(*(pose(k, findings=harmless) for k in range(6))) == ()


def test_gamma_from_its_harmonic() -> None:
    phase = 2 * np.pi * np.arange(360) / 360
    light = (0.5 + 0.5 * np.cos(phase)) ** 2.2
    first, second = (np.mean(light * np.cos(m * phase)) for m in (1, 2))
    assert gamma_from_harmonic(second / first) == pytest.approx(2.2, abs=1e-6)
    for harmonic in (0.28, 1.0, 2.0, -0.6):  # no power has the last three
        assert causes(*(pose(k, axes={"x": axis(harmonic=harmonic)}) for k in range(8))) == (
            "gamma",
        )


def test_features_numbered_otherwise_are_seen_through_any_lens() -> None:
    seen = observations(1)[0]
    assert describe_misnumbering(BOARD, seen.points, seen.camera) == ""
    r2 = np.sum(((seen.camera - 200) / 200) ** 2, axis=1, keepdims=True)
    barrel = 200 + (seen.camera - 200) * (1 - 0.25 * r2)  # some 25 % at the rim
    assert describe_misnumbering(BOARD, seen.points, barrel) == ""
    index = np.arange(99).reshape(9, 11)
    for order, word in (
        (index.T, "transposed"),
        (np.roll(index, -1, 0), "row"),
        (np.roll(index, 1, 1), "column"),
    ):
        assert (
            missing_facts(describe_misnumbering(BOARD, seen.points, barrel[order.ravel()]), word)
            == []
        )
    shuffled = np.random.default_rng(3).permutation(99)
    assert describe_misnumbering(BOARD, seen.points, seen.camera[shuffled]) == "mixed up"


def test_evidence_and_verdicts_survive_saving() -> None:
    late = Finding("duplicate-frame", "rejected", "frame 4 repeats", "look", frames=(3,), value=2.0)
    kept = pose(1, findings=(late,), grid=(21, 16), moved_px=np.nan)
    again = PoseEvidence.from_json(json.loads(json.dumps(to_plain(kept))))
    assert np.isnan(again.moved_px)
    assert dataclasses.replace(again, moved_px=0.0) == dataclasses.replace(kept, moved_px=0.0)
    verdict = Verdict.of(
        [
            Finding("gamma", "doubtful", "curved", "correct it"),
            Finding("moved", "rejected", "it", "hold it"),
        ]
    )
    assert verdict.causes == ("moved", "gamma") and verdict.level == "rejected"
    assert from_plain(json.loads(json.dumps(to_plain(verdict))), Verdict) == verdict
    assert missing_facts(verdict.text(), "rejected", "it", "hold it") == []
    assert len(set(CAUSES)) == len(CAUSES)
