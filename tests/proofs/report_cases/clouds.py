"""Clouds and meshes of other scanners."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import trimesh

from slviewer.calibration.splined.model import SplinedModel
from slviewer.geometry.rigid import (
    fit_rigid,
    move_points,
    rigid_transform,
    rotation_angle,
    turn_about,
)
from slviewer.pipeline.compare import compare
from slviewer.pipeline.export import export
from slviewer.pipeline.import_cloud import import_cloud
from slviewer.pipeline.measure import measure
from slviewer.pipeline.merge import align, merge
from slviewer.pipeline.models import load_model
from slviewer.pipeline.reconstruct import reconstruct
from slviewer.pipeline.simulate import TRUTH
from slviewer.session.ply import write_ply
from slviewer.session.store import Session
from tests.proofs.report_cases.case import Case, Outcome, Workplace, read_refusal

_RADIUS, _CENTRE, _NOISE = 25.0, np.array([12.0, -7.0, 300.0]), 0.02
_TOO_HIGH = 0.3
_MAX_SHIFT, _MAX_TURN_DEG = 0.05, 0.02
_MOVED = turn_about(np.array([0.4, 1.1, -0.7]), np.zeros(3), np.array([-30.0, 80.0, -640.0]))
"""T_file_camera of a file whose coordinates are other than its camera's."""


def _ball() -> np.ndarray:
    """Return the noisy points (n, 3) mm of a sphere that are seen from the origin."""
    rng = np.random.default_rng(3)
    out = rng.normal(size=(20_000, 3))
    out /= np.linalg.norm(out, axis=1)[:, None]
    out = out[out @ _CENTRE < -0.3 * np.linalg.norm(_CENTRE)]
    return _CENTRE + (_RADIUS + _NOISE * rng.normal(size=(len(out), 1))) * out


def _write_pcd(path: Path, points: np.ndarray) -> None:
    """Write a binary PCD with a point that is not known, as depth cameras do."""
    records = np.vstack([points, np.full(3, np.nan)]).astype("<f4")
    path.write_bytes(
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(records)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(records)}\n"
        "DATA binary\n".encode()
        + records.tobytes()
    )


def _measure_ball(name: str, write: Callable[[Path, np.ndarray], None], at: Workplace) -> Outcome:
    """Import a sphere, in metres where the program says so, and measure its radius."""
    path, session, warnings = at.folder / name, at.folder / "session", list[str]()
    write(path, _ball())
    made = import_cloud(session, [path], warn=warnings.append).only
    if any("--force --unit m," in each for each in warnings):
        made = import_cloud(session, [path], unit="m", force=True).only
    region = (*_CENTRE.tolist(), _RADIUS + 5)
    found = measure(session, path.stem, "sphere", ball=region).only
    radius = found["radius"]
    assert made.noise_mm is not None and radius.U is not None
    return Outcome(
        f"radius {radius.value:.4f} +- {radius.U:.4f} mm, noise {1000 * made.noise_mm:.1f} um",
        f"{_RADIUS:g} mm, {1000 * _NOISE:g} um",
        abs(radius.value - _RADIUS) < radius.U < 0.01
        and 0.8 * _NOISE < made.noise_mm < 1.2 * _NOISE,
    )


def _true_pose(base: Path) -> np.ndarray:
    """Return T_r1_r2 (4, 4) of the object's scans, in the calibration's own frame: by the target
    poses it is turned against the camera's by a part of a milliradian."""
    truth = json.loads((base / TRUTH).read_text())
    with Session.open(base) as store:
        model = load_model(store, "splined")
    assert isinstance(model, SplinedModel)
    board, state = np.array([[0.0, 0, 0], [180, 0, 0], [0, 120, 0]]), model.bundle.state
    measured = rigid_transform(state.R_board, state.t_board)
    true = [np.array(truth["poses"][name]["T_camera_board"]) for name in model.bundle.poses]
    camera, calibrated = (
        np.concatenate([move_points(T, board) for T in poses]) for poses in (true, measured)
    )
    T_calibrated_camera = fit_rigid(camera, calibrated)
    first, second = (
        T_calibrated_camera @ np.array(truth["objects"][f"object_r{k}"]["T_camera_object"])
        for k in (1, 2)
    )
    return np.asarray(first @ np.linalg.inv(second))


def _merge_objects(moved: bool, own: bool, at: Workplace) -> Outcome:
    """Import two scans that were exported, or one beside a scan of its ``own``, and merge them."""
    base, one, two = at.base(), at.folder / "one.ply", at.folder / "two.xyz"
    T_true = _true_pose(base)
    export(base, "cloud", "object_r1", out=one)
    export(base, "cloud", "object_r2", out=two)
    points, T_file = np.loadtxt(two)[:, :3], _MOVED if moved else np.eye(4)
    np.savetxt(two, move_points(T_file, points), "%.5f")
    session, onto = (base, "object_r1") if own else (at.folder / "session", "one")
    import_cloud(session, [two] if own else [one, two])
    if not own:
        assert all(each.is_good for each in align(session, ["one", "two"]).values())
    pair = merge(session, ["two"], onto).only.pairs["two"]
    T = np.array(pair.T_reference_scan) @ T_file
    shift = np.linalg.norm((move_points(T, points) - move_points(T_true, points)).mean(axis=0))
    turn_deg = np.degrees(rotation_angle(T[:3, :3] @ T_true[:3, :3].T))
    return Outcome(
        f"{shift:.3f} mm and {turn_deg:.4f} degrees off, RMS {pair.rms_mm:.3f} mm",
        f"0, at most {_MAX_SHIFT:g} mm and {_MAX_TURN_DEG:g} degrees",
        bool(0 < shift < _MAX_SHIFT and turn_deg < _MAX_TURN_DEG),
    )


def _block(top: float = 8.0) -> trimesh.Trimesh:
    """Return a block without symmetries; its highest corner is ``top`` above the others, mm."""
    corners = [
        [0, 0, 0],
        [60, 0, 0],
        [60, 40, 0],
        [0, 40, 0],
        [0, 0, 20],
        [40, 30, 20],
        [0, 40, 25],
    ]
    return trimesh.convex.convex_hull(np.array([*corners, [45, 5, 20 + top]], float))


def _compare_block(kind: str, at: Workplace) -> Outcome:
    """Compare a block whose highest corner is too high with its model."""
    part, file, model = _block(8.0 + _TOO_HIGH), at.folder / f"part.{kind}", at.folder / "model.stl"
    _block().export(model)
    part.apply_transform(_MOVED)
    if kind == "stl":
        part.export(file)
    else:
        places = trimesh.sample.sample_surface(part, 20_000, seed=1)[0]
        noise = 0.5 * _NOISE * np.random.default_rng(2).normal(size=places.shape)
        np.savetxt(file, places + noise, "%.4f", delimiter=",", header="x,y,z", comments="")
    import_cloud(at.folder / "session", [file])
    found = compare(at.folder / "session", "part", model, tolerance=0.1).only.deviation
    assert found is not None and found.verdict is not None
    highest = found.statistics_mm.highest
    return Outcome(
        f"{found.verdict.decision}, up to {highest:.3f} mm, {100 * found.coverage:.0f} % measured",
        f"fail, at most {_TOO_HIGH:g} mm, 100 %",
        found.verdict.decision == "fail" and 0.12 < highest < 0.33 and found.coverage > 0.98,
    )


def _reconstruct_imported(at: Workplace) -> Outcome:
    """Ask for what needs frames, and follow what is answered."""
    np.savetxt(at.folder / "ball.xyz", _ball(), "%.4f")
    import_cloud(at.folder / "session", [at.folder / "ball.xyz"])
    said = read_refusal(lambda: reconstruct(at.folder / "session", "ball"), "reconstructed")
    named = "imported as a cloud" in said and "measure" in said
    followed = _measure_ball("again.ply", write_ply, at)
    return Outcome(f"{said} {followed.measured}", followed.truth, named and followed.holds)


def _write_metres(path: Path, points: np.ndarray) -> None:
    """Write points in mm as PLY in metres."""
    write_ply(path, points / 1000)


def _write_text(path: Path, points: np.ndarray) -> None:
    """Write points as text."""
    np.savetxt(path, points, "%.4f")


CASES: dict[str, Case] = {
    "sphere of another scanner, XYZ": partial(_measure_ball, "ball.xyz", _write_text),
    "sphere of another scanner, PLY in metres": partial(_measure_ball, "ball.ply", _write_metres),
    "sphere of another scanner, PCD with NaN": partial(_measure_ball, "ball.pcd", _write_pcd),
    "imported cloud reconstructed": _reconstruct_imported,
    "two imported clouds merged": partial(_merge_objects, False, False),
    "two imported clouds merged, coordinates of the part": partial(_merge_objects, True, False),
    "an imported cloud merged with a scan": partial(_merge_objects, True, True),
    "STL of a block compared": partial(_compare_block, "stl"),
    "points of a block compared": partial(_compare_block, "csv"),
}
