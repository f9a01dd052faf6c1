"""Every command of the command line, on a small simulated rig: from nothing to a merged cloud."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from copies import copy_session
from facts import missing_facts, raises
from small_fields import fit_few_cells

from slviewer.commands.runs import CalibrateOptions, run_calibrate
from slviewer.errors import InputError
from slviewer.pipeline.models import load_stereo
from slviewer.pipeline.operation import Findings
from slviewer.records.calibration import ModelCalibration, StereoFit
from slviewer.records.verdict import Finding, Verdict
from slviewer.session.exporters import write_calibration
from slviewer.session.ply import read_ply
from slviewer.session.store import Session
from slviewer.validation.reproduce import reproduce

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def session(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what `simulate` and `calibrate` made."""
    return copy_session(recorded / "session", tmp_path_factory.mktemp("commands") / "session")


@pytest.fixture(scope="module")
def calibrated(recorded: Path) -> dict:
    return json.loads((recorded / "calibration.json").read_text())


def test_calibrate_reports_what_its_contract_says(calibrated: dict) -> None:
    models = calibrated["calibration"]
    fit, rig = models["stereo"]["fit"], models["stereo"]["model"]["rig"]
    assert 0.01 < fit["reprojection_rms_px"]["stereo"] < 0.3
    assert np.linalg.norm(rig["t"]) == pytest.approx(180, abs=1.5) == fit["baseline_mm"]
    K = rig["projector"]["K"]
    assert K[1][1] / K[0][0] == pytest.approx(2, abs=0.02)
    assert set(models["pixelwise"]["fit"]["axes"]["x"]) == {
        "fitted",
        "poses",
        "z_mm",
        "x_mm",
        "y_mm",
    }
    assert models["splined"]["fit"]["noise_px"]["camera"] < 0.03
    assert len(fit["poses"]) == 8 and fit["excluded"] == {}


def test_calibrate_prints_its_verdict_first_and_figures_on_request(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blurred = Finding("blur", "doubtful", "pose_03 is blurred", "focus, and capture it again")
    errors = {"camera": 0.05, "projector": 0.07, "stereo": 0.061}
    fit = StereoFit(("pose_01",), {"pose_02": "moved"}, errors, {}, {}, 180.0)
    record = ModelCalibration(fit=fit, verdict=Verdict.of([blurred]))
    monkeypatch.setattr("slviewer.pipeline.models.describe_default_model", lambda _: "default")
    printed = []
    for options in (CalibrateOptions(), CalibrateOptions(verbose=True)):
        arguments = {"session": "here", "json": None, **vars(options)}
        run_calibrate(lambda session: Findings(ModelCalibration, {"stereo": record}), arguments)
        printed.append(capsys.readouterr().out)
    short, full = printed
    assert short.startswith("verdict: doubtful") and len(short.splitlines()) == 6
    assert not missing_facts(short, "pose_03 is blurred", "0.061", "pose_02: moved")
    assert "180.00" in full and "180.00" not in short


def test_verify_a_plane_inside_and_a_sphere(
    calibrated: dict, session: Path, run: Run, tmp_path: Path
) -> None:
    out = tmp_path / "planes.json"
    status, text, _ = run(
        "verify",
        session,
        "plane_03",
        "plane_07",
        "--shape",
        "plane",
        "--range",
        500,
        700,
        "--json",
        out,
    )
    assert status == 0 and "plane_03" in text
    captures = json.loads(out.read_text())["verify"]
    inside = captures["plane_03"]
    assert inside["incidence"]["R2"] == pytest.approx(100)
    assert captures["plane_07"]["incidence"]["R3"] == pytest.approx(100)
    stereo, pixelwise = inside["models"]["stereo"], inside["models"]["pixelwise"]
    assert pixelwise["noise_floor_mm"] < pixelwise["rms_mm"] < stereo["rms_mm"] < 0.5
    assert stereo["coverage"] > 0.97 and stereo["excluded"] < 0.02 * stereo["points"]
    status, text, _ = run(
        "verify", session, "sphere_3", "--shape", "sphere", "--model", "stereo", "--json", out
    )
    sphere = json.loads(out.read_text())["verify"]["sphere_3"]["models"]
    assert list(sphere) == ["stereo"] and 97.0 < sphere["stereo"]["radius_mm"] < 99.0


def test_reconstruct_a_board_pose_and_a_scan(
    calibrated: dict, session: Path, run: Run, tmp_path: Path
) -> None:
    ply, grid = tmp_path / "board.ply", tmp_path / "board.npy"
    status, text, _ = run("reconstruct", session, "pose_01", "--out", ply, "--grid", grid)
    assert (
        status == 0
        and "axis" in text
        and "coverage" in text
        and "stereo" in text
        and "pixelwise" in text
    )
    points = np.load(grid)
    assert points.shape == (300, 400, 3) and points.dtype == np.float32
    cloud = trimesh.load(ply)
    assert 1000 < len(cloud.vertices) <= np.isfinite(points[..., 2]).sum()
    normals = read_ply(ply).normals
    assert normals is not None and np.nanmedian(normals[:, 2]) < -0.7  # the board faces the camera
    status, text, _ = run("reconstruct", session, "object_r2", "--model", "stereo", "--axis", "x")
    assert status == 0 and (session / "exports" / "object_r2_stereo.ply").exists()
    status, _, error = run("reconstruct", session, "object_r2", "--axis", "y")
    assert status == 1 and "axis" in error


@pytest.mark.slow
def test_a_mesh_with_a_texture(calibrated: dict, session: Path, run: Run, tmp_path: Path) -> None:
    out = tmp_path / "part.glb"
    status, text, _ = run(
        "mesh", session, "object_r2", "--texture", "512", "--model", "stereo", "--out", out
    )
    assert status == 0 and "texture of 512x512 px" in text
    part = trimesh.load(out, force="mesh")
    image, uv = (
        np.asarray(part.visual.material.baseColorTexture)[..., 0].astype(float),
        np.asarray(part.visual.uv),
    )
    at = (
        ((1 - uv[:, 1]) * 512).astype(int).clip(0, 511),
        (uv[:, 0] * 512).astype(int).clip(0, 511),
    )
    grey = image[at]  # of the object, whose reflectance is the same everywhere
    middle = np.abs(grey / np.median(grey) - 1)
    assert 0.005 < np.median(middle) < 0.05
    status, _, error = run(
        "mesh", session, "object_r2", "--texture", "512", "--out", tmp_path / "part.stl"
    )
    assert status == 2 and not missing_facts(error, ".glb", ".obj")


@pytest.mark.slow
def test_merge_the_object(calibrated: dict, session: Path, run: Run, tmp_path: Path) -> None:
    ply, out = session / "exports" / "merged_1.ply", tmp_path / "merge.json"
    status, text, _ = run(
        "merge", session, "object_r1", "object_r2", "--reference", "object_r3", "--json", out
    )
    assert status == 0 and "merge/1" in text
    (merged,) = json.loads(out.read_text())["merge"].values()
    pairs = merged["pairs"]
    assert set(pairs) == {"object_r1", "object_r2"}
    for pair in pairs.values():
        assert 0.01 < pair["rms_mm"] < 0.5 and 0.5 < pair["overlap"] <= 1
        assert np.shape(pair["T_reference_scan"]) == (4, 4)
    assert len(trimesh.load(ply).vertices) > 10_000
    status, text, _ = run("measure", session, "merge/1", "distance", "--at", 0, 5000)
    assert status == 0 and not missing_facts(text, "distance", "merge/1")
    for k, named in enumerate(
        (["merge/1"], ["merge", 1], ["merge", "merge/1"], ["cloud", "merge/1"])
    ):
        assert run("export", session, *named, "--out", tmp_path / f"same_{k}.ply")[0] == 0, named
    assert len({path.read_bytes() for path in tmp_path.glob("same_*.ply")}) == 1
    status, text, _ = run("export", session, "merge", "--out", tmp_path / "all.xyz")
    assert status == 0 and len(np.loadtxt(tmp_path / "all.xyz")) == merged["points"]


@pytest.mark.slow
def test_mesh_of_one_scan_and_of_scans_merged_on_the_way(
    calibrated: dict, session: Path, run: Run, tmp_path: Path
) -> None:
    stl, out = tmp_path / "object.stl", tmp_path / "mesh.json"
    thinned = ("--method", "volume", "--triangles", 20_000, "--smooth", 2)
    status, text, _ = run(
        "mesh", session, "object_r3", "object_r2", *thinned, "--out", stl, "--json", out
    )
    assert status == 0 and "smoothing" in text and "watertight" in text
    found = json.loads(out.read_text())
    (merged,) = found["merge"]["merge"].values()
    assert (
        found["method"] == "volume"
        and 0.1 < found["cell_mm"] < 1.0
        and set(merged["pairs"]) == {"object_r2"}
    )
    assert 0 < found["smoothed"]["rms_mm"] < found["smoothed"]["max_mm"] < 2.0
    assert (
        19_000 < found["triangles"] <= 20_000 and len(trimesh.load(stl).faces) == found["triangles"]
    )
    assert trimesh.load(tmp_path / "object_points.ply").vertices.shape[0] > 10_000
    status, text, _ = run("mesh", session, "object_r3")
    assert status == 0 and "grid" in text
    assert len(trimesh.load(session / "exports" / "object_r3_mesh.ply").faces) > 10_000
    status, _, error = run("mesh", session, "object_r3", "--watertight")
    assert status == 1 and error
    status, _, error = run("mesh", session, "merge/9")
    assert status == 1 and "merge" in error
    assert run("mesh", session, "object_r3", "object_r2", "--method", "grid")[0] == 2
    assert run("mesh", session, "merge/1", "object_r1")[0] == 2


def test_report_and_inspect(calibrated: dict, session: Path, run: Run, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    assert run("report", session, "--out", page)[0] == 0
    html = page.read_text()
    assert "pose_01" in html and 'src="http' not in html
    status, text, _ = run("inspect", session)
    assert status == 0 and ": 27 captures" in text.splitlines()[0]
    assert "calibration pixelwise: from 8 poses, fresh" in text


@pytest.mark.slow
def test_reproduce_remakes_the_letters_tables_and_figures(
    session: Path, run: Run, tmp_path: Path
) -> None:
    out = session.parent  # whose session is what reproduce would simulate, but for fewer poses
    with fit_few_cells():
        status, text, _ = run(
            "reproduce", "--scale", "0.25", "--out", out, "--json", tmp_path / "figures.json"
        )
    assert status == 0
    found = json.loads((tmp_path / "figures.json").read_text())
    assert len(found["planes"]) == 10 and len(found["spheres"]) == 6
    assert 1.3 < found["in_range_ratio"] < 10
    assert 0.001 < found["spacing_rms_mm"]["pixelwise"] < 1.0
    assert "0.184" in text and "0.087" in text and "2.13" in text  # the Letter's own means
    page = (out / "report.html").read_text()
    assert page.count("data:image/webp;base64") >= 14 and "http://" not in page.replace(
        "http://www.w3.org", ""
    )


def test_reproduce_says_how_much_disk_it_takes_and_cleans_it(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Started(Exception):
        """Raised in place of the simulation."""

    def stop(*_: object, **__: object) -> None:
        raise Started

    monkeypatch.setattr("slviewer.validation.reproduce._simulate", stop)
    said: list[str] = []
    with pytest.raises(Started):
        reproduce(tmp_path / "rep", quick=True, say=said.append)
    assert not missing_facts(said[0], "1.1 GB", tmp_path / "rep", "--clean")
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1e9))
    with raises(InputError, "4.2 GB", "1.0 GB", "--quick"):
        reproduce(tmp_path / "rep")
    session, report = tmp_path / "rep" / "session", tmp_path / "rep" / "report.html"
    session.mkdir(parents=True)
    (tmp_path / "rep" / "merged.ply").write_bytes(bytes(10**8))
    report.touch()
    status, _, _ = run("reproduce", "--clean", "--out", tmp_path / "rep")
    assert status == 1 and session.exists()  # nothing shows that this program made it
    (session / "truth.json").write_text('{"scale": 0.5}')
    status, text, _ = run("reproduce", "--clean", "--out", tmp_path / "rep")
    assert status == 0 and "0.1 GB" in text and list(report.parent.iterdir()) == [report]


@pytest.mark.slow
def test_calibrate_names_an_excluded_pose_and_does_not_use_it(
    recorded: Path, run: Run, tmp_path: Path
) -> None:
    session = copy_session(recorded / "session", tmp_path / "session")
    with Session.open(session, write=True) as store:
        store.exclude("pose_02", "blurred")
    status, text, _ = run("calibrate", session, "--target", "circles:21x16:9", "--models", "stereo")
    assert status == 0 and not missing_facts(text, "pose_02: ", "blurred")
    with Session.open(session) as store:
        assert "pose_02" not in load_stereo(store).poses


@pytest.mark.slow
def test_a_calibration_made_elsewhere_reconstructs_the_same(
    calibrated: dict, session: Path, run: Run, tmp_path: Path
) -> None:
    rig = calibrated["calibration"]["stereo"]["model"]["rig"]
    lenses = {
        f"my_{key}_{device}": rig[device][key] for device in ("camera", "projector") for key in "KD"
    }
    matrices = {**lenses, "my_R": rig["R"], "my_T": rig["t"]}
    write_calibration(
        tmp_path / "rig.yml", {name: np.array(values) for name, values in matrices.items()}
    )
    frames = Session.open(session).load_capture("object_r2").frames
    with Session.create(tmp_path / "other") as other:
        sequence = Session.open(session).load_capture("object_r2").sequence
        other.save_capture("part", "scan", sequence, frames, source="test")
    keys = list(matrices)
    status, _, error = run(
        "import", "opencv-calibration", tmp_path / "rig.yml", tmp_path / "other", "--keys", *keys
    )
    assert status == 0 and "not checked" in error
    assert run("reconstruct", tmp_path / "other", "part", "--grid", tmp_path / "other.npy")[0] == 0
    assert (
        run(
            "reconstruct", session, "object_r2", "--model", "stereo", "--grid", tmp_path / "own.npy"
        )[0]
        == 0
    )
    difference = np.abs(np.load(tmp_path / "other.npy") - np.load(tmp_path / "own.npy"))
    assert np.nanmax(difference) < 1e-3 and np.isfinite(difference[..., 2]).sum() > 10_000
    status, _, error = run(
        "import",
        "opencv-calibration",
        tmp_path / "rig.yml",
        tmp_path / "other",
        "--keys",
        *(key.removeprefix("my_") for key in keys),
    )
    assert status == 1 and "my_K_camera" in error


@pytest.mark.computes
def test_patterns_come_back_as_the_columns_themselves(run: Run, tmp_path: Path) -> None:
    folder, session = tmp_path / "patterns", tmp_path / "session"
    assert run("patterns", "--preset", "p18", "--projector", "160x120", "--out", folder)[0] == 0
    toml = next(folder.glob("*.toml"))
    assert run("import", "frames", folder, session, "--sequence", toml, "--role", "scan")[0] == 0
    with Session.open(session) as store:
        from slviewer.pipeline.capture_phases import decode_capture

        phases = decode_capture(store.load_capture("patterns"))
    assert np.nanmax(np.abs(phases["x"].coordinate - np.arange(160))) < 0.05
    assert np.nanmax(np.abs(phases["y"].coordinate - np.arange(120)[:, None])) < 0.05


def test_target_draws_a_sheet(run: Run, tmp_path: Path) -> None:
    assert run("target", "circles:21x16:9", "--out", tmp_path / "board.pdf")[0] == 0
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    status, _, error = run("target", "circles:21by16", "--out", tmp_path / "board.pdf")
    assert status == 1 and "circles:21x16:9" in error


@pytest.mark.parametrize(
    ("arguments", "status", "facts"),
    [
        (["calibrate", "nowhere", "--target", "circles:21x16:9"], 1, ["nowhere", "session"]),
        (["calibrate"], 2, []),
        (["reconstruct", "SESSION", "pose_99"], 1, ["pose_99"]),
        (["verify", "SESSION", "--shape", "plane"], 2, ["capture"]),
        (
            ["calibrate", "ONE", "--target", "chessboard:9x7:30"],
            3,
            ["pose_01", 63, "chessboard:9x7:30"],
        ),
        (["simulate", "SESSION"], 1, ["session", "already"]),
        (
            ["reconstruct", "SESSION", "pose_01", "--depth-range", "nan", "3"],
            2,
            ["--depth-range", "nan"],
        ),
        (
            ["capture", "SESSION", "new", "--rig", "simulated", "--budget-s", "inf"],
            2,
            ["--budget-s", "inf"],
        ),
        (["import", "p18", "SESSION", "SESSION"], 1, ["captures"]),
    ],
)
def test_bad_input_ends_in_a_message_and_changes_nothing(
    session: Path,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    status: int,
    facts: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    before = sorted(p.name for p in (session / "captures").iterdir())
    if "ONE" in arguments:  # a board that no pose shows is looked for in one only
        shutil.copytree(session, "ONE", ignore=shutil.ignore_patterns("pose_0[2-8]", "results"))
    got, out, error = run(*[session if a == "SESSION" else a for a in arguments])
    assert (
        got == status
        and not missing_facts(error, *facts)
        and "Traceback" not in error
        and out == ""
    )
    assert sorted(p.name for p in (session / "captures").iterdir()) == before
