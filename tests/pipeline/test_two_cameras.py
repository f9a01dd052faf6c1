"""Two cameras from the terminal: simulated, calibrated, scanned and merged; and a recorded pair."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from facts import raises

from slviewer.calibration.observe import Smoothing
from slviewer.cli import main
from slviewer.devices.capture import capture_frames, capture_with_texture
from slviewer.errors import InputError
from slviewer.fringe.presets import gray, p18
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.shapes import fit_plane
from slviewer.pipeline.capture import capture
from slviewer.pipeline.capture_phases import decode_capture, match_second
from slviewer.pipeline.models import load_calibration, load_pair
from slviewer.pipeline.operation import load_record
from slviewer.pipeline.poses import read_stored_poses
from slviewer.pipeline.rig_choice import set_up
from slviewer.reconstruction.camera_match import epipolar_lines
from slviewer.records.calibration import ModelCalibration
from slviewer.records.merge import Reconstruction
from slviewer.records.verification import Verification
from slviewer.session.capture import NewCapture, Role
from slviewer.session.store import Session
from slviewer.simulation.plans import letter_plan, rotation, spheres
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.second_camera import second_camera
from slviewer.target.board import Board

pytestmark = pytest.mark.computes
TWO = {"driver": "simulated", "scale": 0.1, "cameras": 2}


def test_both_cameras_are_captured_in_every_exposure(tmp_path: Path) -> None:
    with set_up(TWO, None).rig.opened() as rig:
        sequence = gray(rig.projector.size)
        captured = capture_with_texture(rig, sequence, (0.5, 1.0))
        assert captured.second is not None
        assert (
            captured.second.shape == captured.frames.shape == (2 * len(sequence.frames), 120, 160)
        )
        single = np.zeros((len(sequence.frames), 120, 160), np.uint8)
        first = capture_frames(rig, sequence, second=single)
        assert single.any() and not np.array_equal(first, single)
        assert [camera.settings().exposure_ms for camera in rig.cameras] == [1.0, 1.0]
    saved = capture(tmp_path / "session", "a", TWO, role="scan", exposures_ms=(0.5, 1.0))
    assert saved.second is not None
    assert saved.second.exposures_ms == saved.exposures_ms == (0.5, 1.0)
    saved.verify()


@pytest.mark.slow
def test_two_cameras_are_calibrated_scan_and_merge(tmp_path: Path) -> None:
    session = str(tmp_path / "session")
    simulate = ["simulate", session, "--preset", "pair", "--scale", "0.25", "--poses", "10"]
    assert main(simulate) == 0
    assert main(["calibrate", session, "--target", "circles:21x16:9"]) == 0
    with Session.open(session) as store:
        assert load_record(store, ModelCalibration, "splined").second_camera
    rig = load_calibration(session, "splined").pinholes
    assert rig.projector.size == rig.camera.size == (400, 300)
    assert np.linalg.norm(rig.t) == pytest.approx(260.0, abs=0.2)
    planes = ["plane_05", "plane_09"]
    assert main(["verify", session, *planes, "--shape", "plane"]) == 0
    with Session.open(session) as store:
        for name in planes:
            found = load_record(store, Verification, name).models["splined"]
            assert found.noise_floor_mm is not None
            ratio = found.rms_mm / found.noise_floor_mm
            assert 0.85 < ratio < 1.25
    names = [*spheres()]
    assert main(["verify", session, *names, "--shape", "sphere"]) == 0
    check_what_the_projector_fills(session)
    scans = ["object_r1", "object_r2", "object_r3"]
    assert main(["merge", session, *scans, "--reference", "object_r2"]) == 0


def check_what_the_projector_fills(session: str) -> None:
    """Of a near plane, much of which the second camera does not see; and nothing after a turn."""
    rig = letter(0.25)
    turn = rotation(np.array([0.0, 0.001, 0.0]))
    turned = replace(rig, R=turn @ rig.R, t=turn @ rig.t)
    scene, sequence = letter_plan(rig, poses=10)["plane_01"], one_axis(p18(rig.projector.size), "x")
    frames = Renderer(turned, scene).capture(sequence, 1)
    seen = second_camera(turned).capture(scene, sequence, 1)
    after = NewCapture("turned", sequence, frames, second=NewCapture("turned", sequence, seen))
    with Session.open(session, write=True) as store:
        store.save_captures([after], "scan")
    for name in ("plane_01", "turned"):
        assert main(["reconstruct", session, name]) == 0
    with Session.open(session) as store:
        (found, turned_since) = (
            load_record(store, Reconstruction, n) for n in ("plane_01", "turned")
        )
        arrays, after_turn = (store.load_result(f"clouds/{n}")[1] for n in ("plane_01", "turned"))
    unseen, unseen_then = (
        np.isnan(each["phase"]) & np.isfinite(each["points"]).all(axis=-1)
        for each in (arrays, after_turn)
    )
    assert not unseen_then.any()
    assert found.fill is not None and found.fill.is_used
    known = ~arrays["extrapolated"] if "extrapolated" in arrays else True
    filled = unseen & known
    assert 5_000 < np.count_nonzero(filled) <= found.fill.points
    plane = fit_plane(arrays["points"][~np.isnan(arrays["phase"]) & known])
    off = (arrays["points"][filled] @ plane.normal - plane.offset) / plane.normal[2]
    parts = (arrays[f"sigma_{part}"][filled] for part in ("z", "calibration", "edges"))
    sigma = np.sqrt(sum(part**2 for part in parts))
    assert 0.7 < np.sqrt(np.mean((off / sigma) ** 2)) < 1.3
    assert turned_since.fill is not None and not turned_since.fill.is_used
    assert turned_since.fill.different_mm == pytest.approx(1.3, abs=0.3)
    assert turned_since.points == pytest.approx(found.points - np.count_nonzero(filled), rel=0.01)


@pytest.mark.slow
def test_two_cameras_are_calibrated_with_patterns_along_one_axis(tmp_path: Path) -> None:
    rig = letter(0.25)
    second, plan = second_camera(rig), letter_plan(rig, poses=10)
    sequence = one_axis(p18(rig.projector.size), "x")

    def render(name: str) -> NewCapture:
        scene, number = plan[name], [*plan].index(name)
        seen = NewCapture(name, sequence, second.capture(scene, sequence, number))
        frames = Renderer(rig, scene).capture(sequence, number)
        return NewCapture(name, sequence, frames, second=seen)

    with Session.create(tmp_path / "session") as store:
        store.save_captures((render(each) for each in plan if "pose" in each), "calibration")
        store.save_captures([render("plane_05"), render("plane_09")], "scan")
    session = str(tmp_path / "session")
    assert main(["calibrate", session, "--target", "circles:21x16:9"]) == 0
    assert np.linalg.norm(load_calibration(session).pinholes.t) == pytest.approx(260.0, abs=0.3)
    assert main(["verify", session, "plane_05", "plane_09", "--shape", "plane"]) == 0
    with Session.open(session) as store:
        for name in ("plane_05", "plane_09"):
            found = load_record(store, Verification, name).models["splined"]
            assert found.noise_floor_mm is not None
            assert 0.85 < found.rms_mm / found.noise_floor_mm < 1.35


def test_frames_of_the_second_camera_are_examined(tmp_path: Path) -> None:
    """One frame late they decode, shifted by a step."""
    session, rig = tmp_path / "session", {**TWO, "scale": 0.25}
    roles: dict[str, Role] = {"pose": "calibration", "scan": "scan"}
    for name, role in roles.items():
        saved = capture(session, name, rig, role=role, patterns="p18")
        assert saved.second is not None
        late = NewCapture(name, saved.sequence, np.roll(saved.second.frames, 1, axis=0))
        with Session.open(session, write=True) as store:
            frames = saved.frames
            store.save_capture(name, role, saved.sequence, frames, second=late, force=True)
    with Session.open(session, write=True) as store:
        scan = store.load_capture("scan")
        with raises(InputError, "scan", "second camera", "one image"):
            match_second(scan, decode_capture(scan))
        board = Board.parse("circles:21x16:9")
        (judged,) = read_stored_poses(store, ["pose"], board, Smoothing())
    assert judged.observation is None and "second camera" in judged.refused


def test_a_recorded_pair_gives_what_an_independent_decoding_gives(
    real_data: Path, tmp_path: Path
) -> None:
    source, session = real_data / "pairs" / "sphere_two_cameras", tmp_path / "session"
    described = tmp_path / "sequence.toml"
    described.write_text(
        'projector = "1143x720"\ngray_cell_px = 9.0\ngray_origin = -9.0\norder = "name"\n'
        '[[frames]]\nkind = "phase"\naxis = "x"\nsteps = 12\nperiod_px = 18.0\n'
        '[[frames]]\nkind = "gray"\naxis = "x"\nbits = 7\n'
    )
    images = ["import", "frames", str(source), str(session), "--sequence", str(described)]
    assert main([*images, "--role", "scan"]) == 0
    assert main(["import", "opencv-calibration", str(source / "caliInfo.yml"), str(session)]) == 0
    with Session.open(session) as store:
        (capture,) = store.captures()
        pair = load_pair(store)
        matched = match_second(capture, decode_capture(capture), lambda _: epipolar_lines(pair))[
            "x"
        ]
    # of the limb, whose fringes are dim, what is not among the 190,000 of every third row
    seen = matched.mask & (matched.modulation > 19)
    points = pair.points(matched)[seen].astype(float)
    points = points[np.isfinite(points).all(axis=1)]
    rectified = (8800.9 / pair.pinholes.camera.K[0, 0]) ** 2  # pixels of the rectified image
    assert rectified * len(points) / 3 == pytest.approx(190_000, rel=0.02)
    radius, residual = fit_sphere(points)
    assert radius == pytest.approx(10.53, abs=0.015)
    assert 0.011 < residual < 0.013


def fit_sphere(points: np.ndarray) -> tuple[float, float]:
    """The radius, and the robust standard deviation from it, by algebraic least squares."""
    kept = np.ones(len(points), bool)
    for _ in range(8):
        design = np.column_stack([2 * points, np.ones(len(points))])[kept]
        found = np.linalg.lstsq(design, (points[kept] ** 2).sum(axis=1), rcond=None)[0]
        radius = float(np.sqrt(found[3] + found[:3] @ found[:3]))
        off = np.linalg.norm(points - found[:3], axis=1) - radius
        sigma = 1.4826 * float(np.median(np.abs(off[kept])))
        kept = np.abs(off) < 5 * sigma
    return radius, sigma
