"""Everything that a session holds, as files for other programs: without a rig, by Python and by the
command."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from facts import missing_facts, raises

from slviewer.calibration.pixelwise import PixelFit, PixelwiseModel
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import Cancelled, InputError, UsageError
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.presets import PRESETS
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.pipeline.compare import compare
from slviewer.pipeline.export import export, formats
from slviewer.pipeline.mesh import mesh
from slviewer.pipeline.models import save_model
from slviewer.session.importers import opencv_calibration
from slviewer.session.importers.filestorage import read_storage
from slviewer.session.ply import read_ply, write_ply
from slviewer.session.store import Session

Run = Callable[..., tuple[int, str, str]]
W, H = 64, 48
SPHERE = np.array([4.0, -3.0, 640.0]), 60.0
R = cv2.Rodrigues(np.array([0.01, 0.3, -0.02]))[0]
RIG = StereoRig(
    Lens(
        np.array([[160.0, 0, 31], [0, 161.0, 23], [0, 0, 1]]),
        np.array([-0.05, 0.01, 1e-3, 0, 0]),
        (W, H),
    ),
    Lens(np.array([[700.0, 0, 230.0], [0, 1400.0, 280.0], [0, 0, 1]]), np.zeros(5), (456, 570)),
    R,
    -R @ np.array([180.0, 5.0, 8.0]),
)
T_REFERENCE_SCAN = np.block(
    [[cv2.Rodrigues(np.array([0, 0.2, 0]))[0], np.array([[3.0], [1], [20]])], [0, 0, 0, 1]]
)


def seen() -> np.ndarray:
    """(h, w, 3) mm: a sphere before the camera; NaN beside it."""
    u, v = np.meshgrid(np.arange(W), np.arange(H))
    d = np.stack([(u - 31) / 160, (v - 23) / 161, np.ones((H, W))], -1)
    centre, radius = SPHERE
    a, b, c = (d * d).sum(-1), -2 * (d @ centre), centre @ centre - radius**2
    root = b * b - 4 * a * c
    with np.errstate(invalid="ignore"):
        return (d * ((-b - np.sqrt(root)) / (2 * a))[..., None]).astype(np.float32)


def pixelwise() -> PixelwiseModel:
    rng = np.random.default_rng(3)
    c = np.array([500.0, 0.4, 1e-4, 0.1, 0.05])[:, None, None] * rng.uniform(0.9, 1.1, (5, H, W))
    ones = np.ones((H, W))
    return PixelwiseModel(
        {"x": PixelFit(c, np.ones((3, H, W)), 9 * ones, 10 * ones, 60 * ones, ones)},
        {"x": 18.0},
        {},
        "x",
    )


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept") / "session"
    with Session.create(folder) as store:
        sequence = PRESETS["complementary"]((456, 570))
        for name in ("scan_01", "scan_02"):
            store.save_capture(
                name,
                "scan",
                sequence,
                np.zeros((len(sequence.frames), H, W), np.uint8),
                source="made",
            )
        board = {
            f"pose_{k:02d}": np.block([[np.eye(3), np.array([[k], [0], [600 + k]])], [0, 0, 0, 1]])
            for k in (2, 10)
        }
        figures = {"stereo": 0.1, "camera": 0.08, "projector": 0.12}
        depths = (560.0, 700.0)
        stereo = StereoModel(
            RIG,
            "circles:7x5:20",
            ("x", "y"),
            figures,
            board,
            {"pose_02": (0.1, 0.2)},
            {},
            depths,
            {"camera": 1.0},
        )
        save_model(store, stereo)
        save_model(store, pixelwise())
        points = seen()
        z = points[..., 2]
        sigma = np.where(np.isfinite(z), np.float32(0.02), np.nan).astype(np.float32)
        texture = np.random.default_rng(1).integers(0, 256, (H, W), dtype=np.uint8)
        arrays = {
            "points": points,
            "sigma_z": sigma,
            "sigma_calibration": sigma / 2,
            "texture": texture,
            "phase": z,
        }
        meta = {"model": "pixelwise", "axis": "x", "scales": {"pixelwise": 1.0}}
        for name in ("scan_01", "scan_02"):
            store.save_result(
                f"clouds/{name}", {**meta, "inputs": store.input_hashes(name)}, arrays
            )
        mask = np.isfinite(z)
        there = points[mask]
        outwards = (there - SPHERE[0]) / SPHERE[1]
        write_ply(
            store.exports / "merged_1.ply",
            there,
            normals=outwards,
            scalars={"sigma_noise": sigma[mask]},
        )
        pair = {"rms_mm": 0.05, "overlap": 0.8, "T_reference_scan": T_REFERENCE_SCAN.tolist()}
        merge = {
            "reference": "scan_01",
            "scans": ["scan_01", "scan_02"],
            "pairs": {"scan_02": pair},
            "points": len(there),
        }
        store.save_result(
            "merge/1", {**merge, "ply": "merged_1.ply", "model": "pixelwise", "inputs": {}}, {}
        )
        row = {
            "rms_mm": 0.05,
            "noise_floor_mm": 0.04,
            "radius_mm": None,
            "points": 9,
            "set_aside": 0,
            "coverage": 1.0,
        }
        verified = {
            "shape": "plane",
            "models": {"stereo": row},
            "incidence": None,
            "scales": {},
            "centres_mm": {},
        }
        store.save_result(
            "verify/scan_02", {**verified, "inputs": store.input_hashes("scan_02")}, {}
        )
        store.decide("names", {"scan_02": "=1+1"})
    return folder


@pytest.mark.computes
def test_a_cloud_and_a_mesh_of_a_scan(kept: Path, tmp_path: Path) -> None:
    found = export(kept, "cloud", "scan_01", out=tmp_path / "a.ply")
    ply, measured = read_ply(found.path), np.isfinite(seen()[..., 2])
    assert np.array_equal(ply.points, seen()[measured]) and found.bytes == found.path.stat().st_size
    assert list(ply.scalars) == ["sigma_noise", "sigma_calibration", "sigma"]
    np.testing.assert_allclose(ply.scalars["sigma"], 0.02 * np.sqrt(1.25), rtol=1e-5)
    assert ply.colours is not None and ply.normals is not None and np.isfinite(ply.normals).any()
    head = found.path.read_bytes()[:400]
    assert b"units mm" in head and b"calibration pixelwise" in head and b"scan scan_01" in head

    found = export(kept, "mesh", "scan_01", out=tmp_path / "a.glb")
    mesh = trimesh.load(found.path, force="mesh", process=False)
    assert not missing_facts(found.text(), "triangles", "metres")
    centre = np.array([1, -1, -1]) * SPHERE[0]
    away = 1000 * mesh.vertices - centre
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), SPHERE[1], rtol=1e-4)
    assert ((mesh.vertex_normals * away).sum(1) > 0).all()  # outwards, and none is left out
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)


@pytest.mark.computes
def test_a_merge_and_one_surface_through_it(kept: Path, tmp_path: Path) -> None:
    points = export(kept, "merge", out=tmp_path, file_format="xyz")
    assert points.path.name == "merged_1.xyz"
    numbers = np.loadtxt(points.path)
    assert numbers.shape == (np.isfinite(seen()[..., 2]).sum(), 3)
    surface = export(kept, "merged-mesh", out=tmp_path / "s.stl")
    found = trimesh.load(surface.path)
    assert len(found.faces) > 100
    off = np.abs(np.linalg.norm(found.vertices - SPHERE[0], axis=1) - SPHERE[1])
    # beyond the limb, which so few pixels show, it is cut a little late
    assert np.median(off) < 0.3 and off.max() < 10


@pytest.mark.process  # which reads a storage of OpenCV
@pytest.mark.parametrize("suffix", formats("calibration"))
def test_a_calibration_comes_back(kept: Path, tmp_path: Path, suffix: str) -> None:
    path = export(kept, "calibration", out=tmp_path / f"c.{suffix}").path
    read = opencv_calibration.read_matrices(read_storage(path))
    np.testing.assert_allclose(read["R"], RIG.R, atol=1e-12)
    np.testing.assert_allclose(read["T"], RIG.t, atol=1e-12)
    np.testing.assert_allclose(read["D_camera"], RIG.camera.D, atol=1e-12)
    text = path.read_text()
    assert not missing_facts(
        text, "reprojection_rms_px_projector", "projector_size", "k1 k2 p1 p2 k3", "OpenCV", "mm"
    )


def test_poses_chain(kept: Path, tmp_path: Path) -> None:
    poses = json.loads(export(kept, "poses", out=tmp_path / "p.json").path.read_text())
    assert [target["name"] for target in poses["targets"]] == ["pose_02", "pose_10"]
    assert (
        poses["targets"][0]["camera_rms_px"] == 0.1
        and poses["targets"][1]["T_camera_board"][2][3] == 610
    )
    T_reference_projector = np.array(poses["projector"]["T_reference_projector"])
    np.testing.assert_allclose(T_reference_projector[:3, 3], [180, 5, 8], atol=1e-9)
    (merge,) = poses["merges"]
    assert merge["reference"] == "scan_01" and [scan["name"] for scan in merge["scans"]] == [
        "scan_01",
        "scan_02",
    ]
    first, second = merge["scans"]
    assert np.array_equal(first["T_reference_scan"], np.eye(4))
    np.testing.assert_allclose(
        second["T_reference_projector"], T_REFERENCE_SCAN @ T_reference_projector, atol=1e-9
    )
    storage = cv2.FileStorage(
        str(export(kept, "poses", out=tmp_path / "p.yaml").path), cv2.FILE_STORAGE_READ
    )
    scan = storage.getNode("merges").at(0).getNode("scans").at(1)
    np.testing.assert_allclose(scan.getNode("T_reference_scan").mat(), T_REFERENCE_SCAN, atol=1e-12)
    storage.release()


@pytest.mark.computes
def test_coefficients_say_how_they_are_used(kept: Path, tmp_path: Path) -> None:
    path = export(kept, "coefficients", out=tmp_path / "k.npz").path
    held, model = np.load(path), pixelwise()
    phi = np.full((H, W), 40.0, np.float32)
    c0, c1, c2, c3, c4 = held["x_coefficients"]
    z = (c0 + c1 * phi) / (1 + c2 * phi) * held["scale_factor"]
    ones = np.ones((H, W), np.float32)
    phase = PhaseMap(
        "x",
        float(held["x_period_px"]),
        phi,
        phi,
        ones,
        ones,
        np.zeros((H, W), np.uint8),
        (1.0, 0.0),
        18,
    )
    np.testing.assert_allclose(np.stack([c3 * z, c4 * z, z], -1), model.points(phase), rtol=1e-5)
    assert "z = (c0 + c1 phi)/(1 + c2 phi)" in str(held["about"])
    with raises(InputError, "pixelwise", "splined"):
        export(kept, "coefficients", "stereo", out=path)


def test_the_table_of_figures(kept: Path, tmp_path: Path) -> None:
    rows = list(csv.DictReader(export(kept, "table", out=tmp_path / "t.csv").path.open()))
    found = [
        (row["record"], row["label"], row["RMS mm"]) for row in rows if row["kind"] == "verify"
    ]
    assert found == [("scan_02", "'=1+1", "0.05")] and {row["up to date"] for row in rows} == {
        "yes"
    }


@pytest.mark.computes
def test_the_command_says_what_it_wrote(kept: Path, run: Run, tmp_path: Path) -> None:
    status, said, _ = run("export", kept, "mesh", "scan_02", "--out", tmp_path, "--format", "obj")
    assert status == 0 and not missing_facts(said, "scan_02_mesh.obj", "mm", "colours")
    assert "# calibration pixelwise" in (tmp_path / "scan_02_mesh.obj").read_text()
    for arguments, facts in (
        (("cloud", "scan_01", "--out", tmp_path / "a.stl"), (".stl", ".ply", ".xyz", ".glb")),
        (("cloud", "--out", tmp_path), ("scan_01", "scan_02")),
        (("mesh", "scan_09", "--out", tmp_path), ("'scan_09'",)),
        (("merge", "7", "--out", tmp_path), ("7", "1")),
        (("calibration", "--out", tmp_path / "c.txt"), (".txt", ".yml", ".xml", ".json")),
    ):
        status, _, error = run("export", kept, *arguments)
        assert status == 1 and not missing_facts(error, *facts), error
    assert [entry.name for entry in tmp_path.iterdir()] == ["scan_02_mesh.obj"]


@pytest.mark.computes
def test_a_mesh_is_made_as_planned_and_says_what_that_did(
    kept: Path, run: Run, tmp_path: Path
) -> None:
    planned = ("--triangles", 500, "--smooth", 2, "--fill-holes", 0)
    status, said, _ = run("export", kept, "mesh", "scan_01", "--out", tmp_path / "m.ply", *planned)
    assert status == 0 and "smoothing" in said and "thinning" in said
    assert 100 < len(trimesh.load(tmp_path / "m.ply").faces) <= 500
    assert b"smoothing" in (tmp_path / "m.ply").read_bytes()[:1500]
    status, _, error = run(
        "export", kept, "mesh", "scan_01", "--out", tmp_path / "w.stl", "--watertight"
    )
    assert status == 1 and error
    assert not (tmp_path / "w.stl").exists()


def test_a_file_that_cannot_be_written_is_told_before_the_work(tmp_path: Path) -> None:
    with raises(InputError, ".step"):
        mesh(tmp_path / "nowhere", ["a", "b"], tmp_path / "m.step")
    with raises(UsageError, ".ply", "d.stl"):
        compare(tmp_path / "nowhere", "a", tmp_path / "nominal.stl", out=tmp_path / "d.stl")


@pytest.mark.computes
def test_a_cancelled_export_leaves_nothing(kept: Path, tmp_path: Path) -> None:
    def stop(done: float, doing: str) -> None:
        if done > 0.5:
            raise Cancelled("cancelled")

    with raises(Cancelled):
        export(kept, "mesh", "scan_01", out=tmp_path / "a.ply", progress=stop)
    assert not list(tmp_path.iterdir())
