"""Region of interest and edits of scans, from the commands to the files that they change."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts, raises
from operations import loaded, merged, reconstructed
from sound_checks import save_sound_checks

from slviewer.cli import main
from slviewer.errors import DamagedError, InputError, UsageError
from slviewer.pipeline.certificate import verify_report
from slviewer.pipeline.cloud_corrections import parse_region
from slviewer.pipeline.edit import edit_scan, set_region
from slviewer.pipeline.export import export
from slviewer.pipeline.measure import measure
from slviewer.pipeline.merge import merge
from slviewer.pipeline.mesh import mesh
from slviewer.pipeline.report import report
from slviewer.session.ply import read_ply
from slviewer.session.scan_edits import load_edits, load_region
from slviewer.session.store import Session
from slviewer.simulation.rig import letter
from slviewer.surface.selection import EditHistory
from tests.rendered_calibration import true_calibration

pytestmark = pytest.mark.computes


@pytest.fixture(scope="module")
def made(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose calibration is the truth, with the recorded scan of an object, twice in
    different noise."""
    folder = tmp_path_factory.mktemp("editing") / "session"
    true_calibration(folder, letter(0.25))
    with Session.open(recorded / "session") as store:
        scan = store.load_capture("object_r1")
        frames = scan.frames
    noise = np.random.default_rng(0).integers(0, 2, frames.shape, np.uint8)
    with Session.open(folder, write=True) as store:
        store.save_capture("one", "scan", scan.sequence, frames, source="recorded")
        store.save_capture(
            "two", "scan", scan.sequence, np.maximum(frames, noise) - noise, source="recorded"
        )
        save_sound_checks(store)
    return folder


@pytest.fixture
def session(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "session"))


@pytest.fixture
def cloud(session: Path, tmp_path: Path) -> np.ndarray:
    """The whole cloud of `one`, (h, w, 3) mm."""
    return reconstructed(session, "one", out=tmp_path / "whole.ply").cloud.points


def middle_half(points: np.ndarray) -> str:
    """Six numbers of the box around the middle half of the points along x."""
    flat = points[np.isfinite(points[..., 2])]
    low, high = flat.min(axis=0) - 1, flat.max(axis=0) + 1
    low[0], high[0] = np.percentile(flat[:, 0], [25, 75])
    return ",".join(f"{value:.3f}" for pair in zip(low, high, strict=True) for value in pair)


def left_half(points: np.ndarray) -> list[float]:
    """The polygon, u v of its corners, of the camera's columns up to the middle one of what was
    measured."""
    u = float(np.median(np.argwhere(np.isfinite(points[..., 2]))[:, 1]))
    return [-1, -1, u, -1, u, len(points), -1, len(points)]


def count(points: np.ndarray) -> int:
    return int(np.isfinite(points).all(axis=-1).sum())


@pytest.mark.slow
def test_every_command_uses_the_region_of_the_session(
    session: Path, cloud: np.ndarray, tmp_path: Path
) -> None:
    total = count(cloud)
    text = set_region(session, roi=middle_half(cloud))
    assert "(on)" in text
    with Session.open(session) as store:
        region = load_region(store)
    assert region is not None
    wanted = int(region.contains(cloud).sum())
    assert 0.4 * total < wanted < 0.6 * total
    made = reconstructed(session, "one", out=tmp_path / "cut.ply", grid=tmp_path / "cut.npy")
    assert made.points == wanted == len(read_ply(tmp_path / "cut.ply").points)
    assert count(np.load(tmp_path / "cut.npy")) == wanted
    assert region.text() in " ".join(made.found.notes)
    assert len(read_ply(export(session, "cloud", "one").path).points) == wanted
    assert count(loaded(session, "one").points) == wanted
    vertices = read_ply(mesh(session, ["one"], tmp_path / "cut_mesh.ply").out).points
    assert region.contains(np.asarray(vertices, float)).mean() > 0.999
    cut = merged(session, ["two"], "one", out=tmp_path / "merged.ply", start="identity")
    assert max(count(each.points) for each in cut.clouds.values()) < 0.65 * total
    assert reconstructed(session, "one", out=tmp_path / "all.ply", roi="off").points == total
    assert "off" in set_region(session, roi="off")
    assert reconstructed(session, "one", out=tmp_path / "all.ply").points == total
    assert (
        reconstructed(session, "one", out=tmp_path / "all.ply", roi=middle_half(cloud)).points
        == wanted
    )
    set_region(session, roi="on")
    assert reconstructed(session, "one", out=tmp_path / "all.ply").points == wanted
    assert "(on)" in set_region(session, around="one")
    assert reconstructed(session, "one", out=tmp_path / "all.ply").points > 0.995 * total


def test_a_region_of_a_file_may_be_turned(session: Path, cloud: np.ndarray, tmp_path: Path) -> None:
    centre = np.nanmedian(cloud, axis=(0, 1))
    file = tmp_path / "box.toml"
    file.write_text(
        f"centre_mm = {centre.tolist()}\nsize_mm = [60.0, 30.0, 400.0]\nrotation_deg = [0.0, 0.0,"
        " 45.0]\n"
    )
    region = parse_region(str(file))
    made = reconstructed(session, "one", out=tmp_path / "cut.ply", roi=str(file))
    assert made.points == int(region.contains(cloud).sum()) > 100
    file.write_text("centre_mm = [1.0, 2.0]\n")
    with raises(InputError, "centre_mm"):
        parse_region(str(file))


@pytest.mark.slow
def test_a_region_beside_the_scan_is_refused_with_numbers(
    session: Path, tmp_path: Path, capfd
) -> None:
    facts = {}
    for name in ("one", "two"):
        cloud = loaded(session, name).points
        depths = cloud[..., 2][np.isfinite(cloud[..., 2])]
        facts[name] = (
            name,
            f"{count(cloud)} points",
            f"z {depths.min():.0f} to {depths.max():.0f} mm",
        )
    box = "0,1,0,1,10,20"
    for name, compute in (
        ("one", lambda: reconstructed(session, "one", roi=box)),
        (
            "two",
            lambda: merged(
                session, ["two"], "one", out=tmp_path / "m.ply", start="identity", roi=box
            ),
        ),
        ("one", lambda: measure(session, "one", "plane", ball=(0, 0, 500, 20), roi=box)),
    ):
        with raises(InputError, *facts[name]):
            compute()
    for wrong, fact in (
        ("1,2,3", "3 numbers"),
        ("0,1,5,4,1,2", "0,1,5,4,1,2"),
        ("nan,1,0,1,0,1", "--roi"),
        (str(tmp_path / "none.toml"), "none.toml"),
    ):
        with raises(UsageError, fact):
            reconstructed(session, "one", roi=wrong)
    assert main(["reconstruct", str(session), "one", "--roi=-1,1,-1,1,10,20"]) == 1
    assert not missing_facts(capfd.readouterr().err, *facts["one"])
    assert main(["region", str(session), "--roi=-500,500,-500,500,10,2000"]) == 0
    assert "1000.0 x 1000.0 x 1990.0 mm" in capfd.readouterr().out


def test_edits_are_stored_undone_and_redone(
    session: Path, cloud: np.ndarray, tmp_path: Path, capfd
) -> None:
    total = count(cloud)
    h, w = cloud.shape[:2]
    half = left_half(cloud)
    edited = edit_scan(session, "one", polygon=half)
    left = count(cloud[:, : int(half[2]) + 1])
    assert 0.4 * total < left < 0.6 * total
    assert edited.remaining == total - left
    assert reconstructed(session, "one", out=tmp_path / "cut.ply").points == total - left
    assert len(edited.edits) == 1 and f"{left:,}" in edited.edits[0]
    rows, columns = np.nonzero(np.isfinite(cloud[..., 2]) & (np.arange(w) > half[2]))
    part = (int(columns[500]), int(rows[500]))
    edit_scan(session, "one", part=part, invert=True)  # what is not connected with it
    with raises(InputError, "no point"):
        edit_scan(session, "one", part=part, invert=True)
    assert edit_scan(session, "one", undo=1).undone == 1
    edit_scan(session, "one", polygon=[0, -1, w, -1, w, rows[500], 0, rows[500]], invert=True)
    assert len(load(session).active) == 2
    assert edit_scan(session, "one", undo=2).undone == 2
    assert reconstructed(session, "one", out=tmp_path / "cut.ply").points == total
    assert edit_scan(session, "one", redo=1).undone == 1
    assert reconstructed(session, "one", out=tmp_path / "cut.ply").points == total - left
    assert main(["edit", str(session), "one"]) == 0
    assert "1. polygon" in capfd.readouterr().out
    with raises(InputError, "undone"):
        edit_scan(session, "one", undo=2)
    with raises(InputError, "all", "one"):
        edit_scan(session, "one", polygon=[0, 0, w, 0, w, h, 0, h])
    for wrong in (
        {"polygon": [1, 2]},
        {"part": [1]},
        {"undo": 1, "redo": 1},
        {"invert": True},
        {"margin": 1.0},
    ):
        with raises(UsageError):
            edit_scan(session, "one", **wrong)


def load(session: Path) -> EditHistory:
    with Session.open(session) as store:
        return load_edits(store, "one")


@pytest.mark.slow
def test_the_report_and_the_files_list_region_and_edits(
    session: Path, cloud: np.ndarray, tmp_path: Path
) -> None:
    report(session, tmp_path / "before.html")
    assert "Region and edits" not in (tmp_path / "before.html").read_text()
    edited = edit_scan(session, "one", polygon=left_half(cloud))
    text = set_region(session, roi="-500,500,-500,500,10,2000")
    report(session, tmp_path / "after.html")
    page = (tmp_path / "after.html").read_text()
    assert (
        "Region and edits" in page
        and edited.edits[0] in page
        and "1000.0 x 1000.0 x 1990.0 mm" in page + text
    )
    written = mesh(session, ["one"], tmp_path / "mesh.ply").out.read_bytes()[:3000]
    assert edited.edits[0].encode() in written
    header = (
        export(session, "cloud", "one").path.read_bytes()[:3000].split(b"end_header")[0].decode()
    )
    assert edited.edits[0] in header and "1000.0 x 1000.0 x 1990.0 mm" in header


@pytest.mark.slow
def test_results_are_stale_once_edits_or_region_change(session: Path, cloud: np.ndarray) -> None:
    merge(session, ["two"], "one", start="identity")
    u, v = (int(i) for i in np.argwhere(np.isfinite(cloud[..., 2]))[2000][::-1])
    measure(session, "one", "point", at=(u, v))
    results = ("merge/1", "measurements/m1")

    def states() -> list[str]:
        with Session.open(session) as store:
            return [store.state_of(result) for result in results]

    assert states() == ["fresh", "fresh"]
    edit_scan(session, "one", polygon=left_half(cloud))
    assert states() == ["stale", "stale"]
    edit_scan(session, "one", undo=1)
    assert states() == ["fresh", "fresh"]
    set_region(session, roi="-500,500,-500,500,10,2000")
    assert states() == ["stale", "stale"]
    set_region(session, roi="off")
    assert states() == ["fresh", "fresh"]


@pytest.mark.slow
def test_a_report_is_checked_with_the_edits_it_was_made_with(
    session: Path, cloud: np.ndarray, tmp_path: Path
) -> None:
    edit_scan(session, "one", polygon=left_half(cloud))
    set_region(session, roi="-500,500,-40,500,10,2000")
    v, u = np.argwhere(
        np.isfinite(cloud[..., 2]) & (np.arange(cloud.shape[1]) > left_half(cloud)[2] + 1)
    )[5000]
    measure(session, "one", "point", at=(int(u), int(v)))
    measure(session, "one", "point", at=(int(u), int(v)), roi="off")
    page = tmp_path / "report.html"
    report(session, page)
    states = {check.what: check for check in verify_report(session, page).checks}
    assert states["measurements/m1"].state == states["measurements/m2"].state == "same"
    edit_scan(session, "one", undo=1)
    states = {check.what: check for check in verify_report(session, page).checks}
    assert states["measurements/m1"].state == "not recomputed"
    assert "edits" in states["measurements/m1"].detail


def test_edits_of_another_capture_or_damaged_ones_are_not_applied(
    session: Path, cloud: np.ndarray
) -> None:
    edit_scan(session, "one", polygon=left_half(cloud))
    with Session.open(session, write=True) as store:
        one, other = store.load_capture("one"), store.load_capture("two")
        frames = other.stack(list(range(len(other.sequence.frames))))
        store.save_capture("one", "scan", one.sequence, frames, source="again", force=True)
        assert not load_edits(store, "one").active
    edit_scan(session, "two", polygon=left_half(cloud))
    file = next((session / "results/edits/two/arrays").glob("*.npy"))
    file.write_bytes(file.read_bytes()[:-3])
    with raises(DamagedError):
        reconstructed(session, "two")
