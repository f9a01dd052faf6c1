"""Measurements of a session, and a scan against its nominal model, from the command line too."""

import csv
import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts, raises
from operations import loaded
from sound_checks import save_sound_checks
from trimesh.creation import box

import slviewer as sl
from slviewer.errors import InputError, SessionError, UsageError
from slviewer.evaluation.fit import ShapeSearch
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.inspection.regions import Region
from slviewer.pipeline.measure import (
    MeasuredSurface,
    describe_measurement,
    export_measurements,
    format_measurements,
    relate,
    rename_measurement,
    restore_measurement,
    section_lines,
    trash_measurement,
)
from slviewer.pipeline.operation import Stored, list_records, load_stored, opened, save_record
from slviewer.pipeline.report import report
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.records.measurement import MeasuredRegion, Measurement, Quantity
from slviewer.records.merge import Merge
from slviewer.records.record import from_plain, to_plain
from slviewer.session.ply import read_ply, write_ply
from slviewer.session.store import Session
from slviewer.simulation.assets import asset
from slviewer.simulation.boards import Pose
from slviewer.simulation.mesh import demo_object
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import Spheres

pytestmark = pytest.mark.computes

Run = Callable[..., tuple[int, str, str]]
CENTRES = np.array([[-38.0, 0.0, 560.0], [42.0, 6.0, 570.0]])
RADIUS = 25.0


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A session whose imported calibration is the truth, with a scan of the demo object and one of
    two balls."""
    folder = tmp_path_factory.mktemp("measuring") / "session"
    rig = letter(0.2, seed=2, local_distortion_px=0)
    sequence = one_axis(p18(rig.projector.size), "x")
    scenes = {
        "object": demo_object(Pose(np.eye(3), np.array([0.0, 0.0, 520.0]))),
        "balls": Spheres(CENTRES, RADIUS),
    }
    with Session.create(folder) as store:
        save_true_stereo(store, rig)
        for i, (name, scene) in enumerate(scenes.items()):
            frames = Renderer(rig, scene).capture(sequence, i)
            store.save_capture(name, "scan", sequence, frames, source="simulated")
        save_sound_checks(store)
    return folder


@pytest.fixture(scope="module")
def balls(made) -> MeasuredSurface:
    return loaded(made, "balls")


@pytest.fixture
def folder(made, tmp_path) -> Path:
    shutil.copytree(made, tmp_path / "session", symlinks=True)
    return tmp_path / "session"


@pytest.fixture(scope="module")
def regions(balls) -> list[np.ndarray]:
    """The pixels of each ball, from left to right."""
    search = ShapeSearch("sphere", balls.points, balls.sigma_mm, RADIUS)
    return [region for _, region in search.find_several(2)]


def ball_about(on: MeasuredSurface, region: np.ndarray) -> Region:
    """The ball that holds the points of some pixels."""
    points = on.points[region & on.measured]
    centre = points.mean(axis=0)
    return Region.ball(centre, 1e-3 + float(np.linalg.norm(points - centre, axis=1).max()))


@pytest.fixture(scope="module")
def tops(balls, regions) -> list[tuple[int, int]]:
    """The pixel of each ball that is nearest to the camera."""
    on, found = balls, []
    for region in regions:
        z = np.where(region & on.measured, on.points[..., 2], np.inf)
        v, u = np.unravel_index(np.argmin(z), z.shape)
        found.append((int(u), int(v)))
    return found


def measure(
    folder: Path | Session,
    on: MeasuredSurface,
    what: str,
    *at: tuple[int, int] | int,
    **settings: object,
) -> Stored[Measurement]:
    """Measure on a surface that is there already."""
    places = [int(number) for number in np.ravel(at)]
    (name,) = sl.measure(folder, on.source, what, at=places, load=lambda _: on, **settings)  # type: ignore[arg-type]
    return load(folder, name)


def fit(
    folder: Path, on: MeasuredSurface, what: str, region: Region, name: str = ""
) -> Stored[Measurement]:
    """Fit a shape to a region of a surface."""
    return measure(
        folder, on, what, name=name, **from_plain(to_plain(region), MeasuredRegion).to_settings()
    )


def related(folder: Path, a: Stored[Measurement], b: Stored[Measurement]) -> Stored[Measurement]:
    """Relate two"""
    (name,) = relate(folder, a.name, b.name)
    return load(folder, name)


def load_measurements(folder: Path | Session) -> list[Stored[Measurement]]:
    """All measurements, in the order in which they were made."""
    with opened(folder) as store:
        return list_records(store, Measurement)


def load(folder: Path | Session, name: str) -> Stored[Measurement]:
    """The measurement of that id."""
    with opened(folder) as store:
        return load_stored(store, Measurement, name)


def test_what_is_measured_is_kept_listed_and_true(
    folder, balls, run: Run, tmp_path, regions, tops
) -> None:
    a, b = tops
    first, second = (
        fit(folder, balls, "sphere", ball_about(balls, r), n)
        for r, n in zip(regions, "LR", strict=True)
    )
    apart = related(folder, first, second)
    width = measure(folder, balls, "distance", a, b, name="width")
    cut = measure(folder, balls, "section", a, b)
    point = measure(folder, balls, "point", a)
    over = related(folder, point, first)

    radius = first.record["radius"]
    assert (
        abs(radius.value - RADIUS) < max(3 * radius.sigma, 0.02)
        and 0 < radius.sigma < 0.1
        and not radius.whole
    )
    true = np.linalg.norm(CENTRES[1] - CENTRES[0])
    distance = apart.record.quantities[0]
    assert abs(distance.value - true) < max(3 * distance.sigma, 0.02) and apart.record.of == (
        first.name,
        second.name,
    )
    assert abs(width.record.quantities[0].value - true) < 3 and width.record.quantities[0].sigma > 0
    assert abs(over.record.quantities[1].value) < 0.3  # the point lies on the ball's surface
    plane, lines = section_lines(folder, cut.name)
    assert len(lines) >= 2 and max(np.ptp(line[:, 0]) for line in lines) < 2 * RADIUS
    assert np.allclose(plane.drawn(balls.points[a[1], a[0]][None].astype(float)), 0, atol=1e-3)

    listed = load_measurements(folder)
    assert [each.name for each in listed] == ["m1", "m2", "m3", "m4", "m5", "m6", "m7"]
    assert not any(each.stale for each in listed) and listed[2].label == "L – R"
    status, said, _ = run("inspect", folder)
    assert (
        status == 0
        and not missing_facts(said, "7 measurements", "L: sphere on balls")
        and "radius 25.0" in said
    )
    with opened(folder) as store:
        assert export_measurements(store, tmp_path / "m.csv") == 7
    rows = list(csv.DictReader(io.StringIO((tmp_path / "m.csv").read_text("utf-8-sig"))))
    assert (
        rows[0]["name"] == "L" and rows[0]["unit"] == "mm" and rows[0]["calibration in U"] == "no"
    )
    assert float(rows[0]["U (k = 2)"]) == pytest.approx(2 * radius.sigma, rel=1e-4)


def test_measurements_are_renamed_deleted_and_brought_back(folder, balls, tops) -> None:
    a, b = tops
    one = measure(folder, balls, "distance", a, b)
    assert one.label == "distance 1"
    with Session.open(folder, write=True) as store:
        assert rename_measurement(store, one.name, "=width").label == "=width"
        # no formula in a table
        assert ",'=width," in format_measurements(load_measurements(store)).replace("m1,'", "m1,'")
        assert rename_measurement(store, one.name, "").label == "distance 1"
        two = measure(store, balls, "distance", b, a, name="back")
        trash_measurement(store, two.name)
        three = measure(store, balls, "distance", a, b)
        # an id that was deleted can come back; names count without gaps, each kind for itself
        assert three.name == "m3" and three.label == "distance 2"
        assert measure(store, balls, "point", a).label == "point 1"
        assert restore_measurement(store).label == "back"
        assert [each.name for each in load_measurements(store)] == ["m1", "m2", "m3", "m4"]
        with raises(InputError):
            restore_measurement(store)
        with raises(InputError, "'m9'", "m1", "m2", "m3"):
            rename_measurement(store, "m9", "x")


@pytest.mark.slow
def test_a_measurement_is_stale_when_its_scan_or_what_it_was_made_from_changed(
    folder, balls, regions
) -> None:
    fits = [fit(folder, balls, "sphere", ball_about(balls, region)) for region in regions]
    related(folder, *fits)
    with Session.open(folder, write=True) as store:
        trash_measurement(store, fits[1].name)
    assert [each.stale for each in load_measurements(folder)] == [False, True]
    with Session.open(folder, write=True) as store:
        restore_measurement(store)
    assert not any(each.stale for each in load_measurements(folder))
    with Session.open(folder, write=True) as store:
        other = store.load_capture("object")
        store.save_capture(
            "balls", "scan", other.sequence, other.frames[::1], source="again", force=True
        )
    assert all(each.stale for each in load_measurements(folder))
    assert "[stale" in describe_measurement(load_measurements(folder)[0])
    with raises(InputError, "stale"):
        related(folder, *fits)


def test_what_cannot_be_measured_is_refused_and_nothing_is_kept(
    folder, balls, regions, tops
) -> None:
    with raises(InputError):
        measure(folder, balls, "distance", (0, 0), tops[0])
    with raises(UsageError, "-1"):
        measure(folder, balls, "point", (-1, 5))
    with raises(UsageError, "pixel"):
        measure(folder, balls, "point", 7)
    with raises(InputError):
        fit(folder, balls, "plane", ball_about(balls, regions[0]))
    with raises(InputError, 0):
        fit(folder, balls, "sphere", Region.ball([0, 0, 0], 5.0))
    one = measure(folder, balls, "distance", *tops)
    with raises(InputError, "point", "plane", "sphere"):
        point = measure(folder, balls, "point", tops[0])
        related(folder, one, point)
    assert len(load_measurements(folder)) == 2


@pytest.mark.slow
def test_a_scan_is_compared_with_its_nominal_from_the_command_line(
    folder, run: Run, tmp_path, balls, tops
) -> None:
    ammonite = asset("objects/ammonite.ply")
    arguments = (
        "compare",
        folder,
        "object",
        ammonite,
        "--tolerance",
        1.5,
        "--json",
        tmp_path / "c.json",
    )
    status, said, wrong = run(*arguments, "--out", tmp_path / "d.ply")
    assert status == 0, wrong
    assert not missing_facts(said, "pass", "1.5 mm", "d.ply")
    found = json.loads((tmp_path / "c.json").read_text())["measurements"]["m1"]["deviation"]
    assert found["noise_mm"] < found["statistics_mm"]["rms"] < 2.5 * found["noise_mm"]
    assert found["verdict"]["decision"] == "pass" and 0.3 < found["coverage"] < 0.7
    assert found["nominal"]["triangles"] > 1000 and not found["nominal"]["notes"]
    written = read_ply(tmp_path / "d.ply")
    assert written.faces is not None and len(written.faces) and written.colours is not None
    assert len(written.points) == found["statistics_mm"]["points"]
    assert np.sqrt(np.mean(written.scalars["deviation"] ** 2)) == pytest.approx(
        found["statistics_mm"]["rms"], rel=1e-3
    )

    measure(folder, balls, "section", *tops, name="across")
    measure(folder, balls, "distance", *tops)
    status, said, _ = run("inspect", folder)
    assert not missing_facts(said, "object", "ammonite.ply", "deviation", "mean")
    report(folder, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert not missing_facts(
        page, "Measurements", "Section across", "Deviation from nominal", "ammonite.ply"
    )

    box((5.6, 5.0, 1.6)).export(tmp_path / "inch.stl")
    status, _, wrong = run("compare", folder, "object", tmp_path / "inch.stl")
    assert status == 1 and not missing_facts(wrong, "--units inch") and "Traceback" not in wrong
    (tmp_path / "broken.stl").write_bytes(b"\0" * 300)
    status, _, wrong = run("compare", folder, "object", tmp_path / "broken.stl")
    assert status == 1 and "broken.stl" in wrong
    assert len(load_measurements(folder)) == 3


def test_a_damaged_measurement_is_told_not_guessed(folder, balls, tops) -> None:
    one = measure(folder, balls, "section", *tops)
    next((folder / "results" / "measurements" / one.name).rglob("lines.npy")).write_bytes(b"x")
    with raises(SessionError):
        section_lines(folder, one.name)


def test_figures_show_two_digits_of_their_uncertainty() -> None:
    small = Quantity("radius", 0.98765432, "mm", 0.0002)
    large = Quantity("radius", 98.765432, "mm", 0.02)
    assert [each.format() for each in (small, large)] == [
        "0.98765 ± 0.00040 mm",
        "98.765 ± 0.040 mm",
    ]


@pytest.mark.slow
def test_the_terminal_measures_relates_names_and_writes_a_table(
    folder, balls, run: Run, tmp_path, tops
) -> None:
    (u, v), (x, y) = tops
    for centre, name in zip(CENTRES, ("left", "right"), strict=True):
        top = centre - [0, 0, RADIUS]
        status, said, wrong = run(
            "measure", folder, "balls", "sphere", "--ball", *top, 14, "--name", name
        )
        assert status == 0 and not missing_facts(said, name, "sphere", "balls"), wrong
        assert re.search(r"radius +2[45]\.\d{3,6} ", said)
        (note,) = [line for line in said.splitlines() if line.startswith("U is too small")]
        assert not missing_facts(note, "calibration", "stereo", "splined")
    status, said, _ = run("measure", folder, "balls", "distance", "--at", u, v, x, y)
    assert status == 0 and "m3 " in said and re.search(r"distance +8\d\.", said)
    status, said, wrong = run(
        "measurements",
        folder,
        "--relate",
        "m1",
        "m2",
        "--name",
        "m3",
        "tops",
        "--csv",
        tmp_path / "m.csv",
    )
    assert not missing_facts(wrong, "U", "calibration", "stereo")
    assert status == 0 and not missing_facts(
        said, "left – right", "tops", "distance", "4 measurements"
    )
    assert (tmp_path / "m.csv").read_text("utf-8-sig").startswith("id,name,kind")
    assert "m4" not in run("measurements", folder, "--delete", "m4")[1]
    assert "m4" in run("measurements", folder, "--bring-back")[1]
    for wrong_use in (
        ("plane",),
        ("plane", "--ball", 1, 2),
        ("distance", "--at", 3, 4),
        ("point",),
    ):
        status, _, wrong = run("measure", folder, "balls", *wrong_use)
        option = "--ball" if wrong_use[0] == "plane" else "--at"
        assert status == 2 and not missing_facts(wrong, option), wrong


@pytest.mark.slow
def test_a_merge_is_measured_on_too(folder, balls, regions) -> None:
    chosen = balls.measured
    with Session.open(folder, write=True) as store:
        points = balls.points[chosen]
        sigma = np.full(len(points), 0.05, np.float32)
        write_ply(
            store.exports / "merged_1.ply",
            points,
            normals=balls.normals[chosen],
            scalars={"sigma": sigma},
        )
        inputs = store.input_hashes("balls")
        made = Merge(
            reference="balls",
            scans=["balls"],
            pairs={},
            ply="merged_1.ply",
            model="stereo",
            inputs=inputs,
        )
        save_record(store, "1", made, {})
    on = loaded(folder, "merge/1")
    region = regions[0]
    one = fit(folder, on, "sphere", ball_about(balls, region))
    assert abs(one.record["radius"].value - RADIUS) < 0.05 and one.record.source == "merge/1"
    assert measure(folder, on, "distance", 0, 5).record.quantities[0].sigma > 0
    ends = [
        int(np.argmin(np.linalg.norm(on.points - c - [dx, 0, -20.0], axis=1)))
        for c in CENTRES[:1]
        for dx in (-15, 15)
    ]
    cut = measure(folder, on, "section", *ends)
    plane, lines = section_lines(folder, cut.name)
    (middle,) = plane.drawn(CENTRES[:1])
    radii = np.concatenate([np.linalg.norm(line - middle, axis=1) for line in lines])
    apart = abs(float((CENTRES[0] - plane.origin) @ plane.normal))
    on_ball = radii[radii < RADIUS + 2]
    assert len(on_ball) > 50 and np.median(on_ball) == pytest.approx(
        np.sqrt(RADIUS**2 - apart**2), abs=0.1
    )
    with raises(UsageError, "index"):
        measure(folder, on, "point", (3, 4))
    other = fit(folder, balls, "sphere", ball_about(balls, region))
    with raises(InputError, "frame"):
        related(folder, one, other)


@pytest.mark.slow
def test_measurements_are_repeated_by_a_plan(made: Path, run: Run, tmp_path: Path) -> None:
    session = tmp_path / "parts" / "one"
    shutil.copytree(made, session)
    for centre in CENTRES:
        x, y, z = centre - [0, 0, RADIUS]
        assert run("measure", session, "balls", "sphere", "--ball", x, y, z, 15)[0] == 0
    run("measurements", session, "--relate", "m1", "m2")
    plan = tmp_path / "plan.toml"
    for tolerance in (0, -1, 1e-320, 1e6):
        status, _, wrong = run("plan", session, f"--out={plan}", f"--tolerance={tolerance}")
        assert status == 2 and not missing_facts(wrong, "0.001", "1000 mm") and not plan.exists()
    status, text, _ = run("plan", session, "--out", plan, "--tolerance", 0.5)
    assert status == 0 and not missing_facts(text, "6 characteristics", "2 features")
    results = tmp_path / "results"
    status, text, _ = run(
        "inspect-parts", plan, tmp_path / "parts", "--scan", "balls", "--out", results
    )
    assert status == 0, text
    data = json.loads((results / "parts.json").read_text())
    assert [each["decision"] for each in data["parts"]] == ["pass"]
    true = float(np.linalg.norm(CENTRES[1] - CENTRES[0]))
    values = {each["name"]: each["value"] for each in data["parts"][0]["results"]}
    apart = next(
        value for name, value in values.items() if name.endswith("distance of the centres")
    )
    assert apart == pytest.approx(true, abs=0.1)
    # the other scan shows no balls there: it is named, and the status says so
    status, text, error = run("inspect-parts", plan, session, "--out", results)
    parts = {
        each["part"]: each for each in json.loads((results / "parts.json").read_text())["parts"]
    }
    reasons = {each["reason"] for each in parts["object"]["results"]}
    assert status == 1 and not missing_facts(error, "object")
    assert all(reasons) and not missing_facts(text, *reasons)
