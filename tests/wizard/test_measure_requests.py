"""Measuring as an operator asks for it: by the worker, kept, listed, refused in words."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from facts import missing_facts, raises
from wizard_events import HANG_S

from slviewer.errors import InputError
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.inspection.regions import Region
from slviewer.pipeline.operation import list_records
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.records.measurement import Measurement
from slviewer.session.inspection_plan import read_plan
from slviewer.session.names import plain_name
from slviewer.session.store import Session
from slviewer.simulation.assets import asset
from slviewer.simulation.boards import Pose
from slviewer.simulation.mesh import demo_object
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import Spheres
from slviewer.wizard.operator import Operator
from slviewer.wizard.result_views import place_at, point_at, snap, surface_to_measure
from slviewer.wizard.snapshot import SessionView

pytestmark = pytest.mark.computes

CENTRES = np.array([[-38.0, 0.0, 560.0], [42.0, 6.0, 570.0]])
RADIUS = 25.0


@pytest.fixture(scope="module")
def operator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Operator]:
    """Over a session whose calibration is the truth, with two balls and the demo object
    reconstructed."""
    folder = tmp_path_factory.mktemp("measuring") / "session"
    rig = letter(0.2, seed=2, local_distortion_px=0)
    sequence = one_axis(p18(rig.projector.size), "x")
    scenes = {
        "balls": Spheres(CENTRES, RADIUS),
        "object": demo_object(Pose(np.eye(3), np.array([0.0, 0.0, 520.0]))),
    }
    with Session.create(folder) as store:
        save_true_stereo(store, rig)
        for i, (name, scene) in enumerate(scenes.items()):
            store.save_capture(
                name,
                "scan",
                sequence,
                Renderer(rig, scene).capture(sequence, i),
                source="simulated",
            )
    with Operator(folder) as engine:
        for name in scenes:
            assert engine.reconstruct(name)
        engine.wait_until_idle(HANG_S)
        yield engine


def now(operator: Operator) -> SessionView:
    """The session, once all is done; what it says of measurements is what `measurements` says."""
    session = operator.wait_until_idle(HANG_S).session
    assert session is not None and operator.session is not None
    assert list(session.measurements) == list_records(operator.session, Measurement)
    return session


def last(operator: Operator) -> str:
    operator.wait_until_idle(HANG_S)
    return operator.snapshot().notices[-1].text


def lacks(operator: Operator, *facts: object) -> list[str]:
    """Return the facts that the latest notice lacks."""
    return missing_facts(last(operator), *facts)


@pytest.mark.slow
def test_what_is_clicked_is_measured_and_true(operator: Operator) -> None:
    assert operator.snapshot().step("measure").state == "ready"
    on = operator.surface("balls")
    assert operator.surface("balls") is on  # it is not read with every click
    tops = [place_at(on, np.zeros(3), centre - [0, 0, RADIUS]) for centre in CENTRES]
    a, b = (place for place in tops if place is not None)
    np.testing.assert_allclose(point_at(on, a), CENTRES[0] - [0, 0, RADIUS], atol=1.0)
    assert place_at(on, np.zeros(3), np.array([0.0, 1.0, 0.1])) is None
    for place in (a, b):
        assert operator.measure("balls", "sphere", region=Region.ball(point_at(on, place), 15.0))
    assert operator.measure("balls", "distance", [a, b]) and operator.measure(
        "balls", "section", [a, b]
    )
    assert operator.measure("balls", "point", [a])
    left, right, width, cut, point = now(operator).measurements
    assert operator.measure_between(left.name, right.name)
    apart = now(operator).measurements[-1]
    assert operator.undo() and len(now(operator).measurements) == 5
    assert operator.redo() and now(operator).measurements[-1] == apart
    radius, true = left.record["radius"], float(np.linalg.norm(CENTRES[1] - CENTRES[0]))
    assert abs(radius.value - RADIUS) < max(3 * (radius.sigma or 0), 0.05)
    assert apart.record.quantities[0].value == pytest.approx(true, abs=0.1)
    assert width.record.quantities[0].value == pytest.approx(true, abs=2.0)
    assert [each.record.what for each in (cut, point, apart)] == ["section", "point", "relation"]
    assert operator.snapshot().step("measure").state == "done"

    assert operator.relabel_measurement(width.name, "Width <b>") and operator.delete_measurement(
        right.name
    )
    session = now(operator)
    assert [each.stale for each in session.measurements if each.name == apart.name] == [True]
    assert session.deleted_measurements == 1
    assert missing_facts(operator.snapshot().step("measure").problems[0], apart.label) == []
    assert operator.undo() and now(operator).deleted_measurements == 0
    assert (
        operator.redo()
        and operator.undo_delete()
        and not any(each.stale for each in now(operator).measurements)
    )
    assert operator.export_measurements_table()
    made = next(each for each in now(operator).exports if each.name == "measurements.csv")
    rows = list(csv.DictReader(made.path.read_text("utf-8-sig").splitlines()))
    assert {row["name"] for row in rows} >= {"Width <b>", left.label}
    assert operator.make_inspection_plan()
    made = next(each for each in now(operator).exports if each.name == "plan.toml")
    assert {each.kind for each in read_plan(made.path).characteristic} >= {
        "diameter",
        "distance of the centres",
    }


@pytest.mark.slow
def test_a_point_is_moved_under_the_names_of_its_measurement(operator: Operator) -> None:
    on = operator.surface("balls")
    a, b, c = (place_at(on, np.zeros(3), CENTRES[i] + [x, 0, -RADIUS]) for i, x in
               ((0, 0), (1, 0), (1, 8)))  # fmt: skip
    assert a and b and c
    assert operator.measure("balls", "distance", [a, b]) and operator.measure("balls", "point", [b])
    *_, width, point = now(operator).measurements
    assert operator.measure_between(point.name, point.name)  # refused; nothing to undo is added
    assert operator.relabel_measurement(width.name, "Width")
    before = {each.name: each.record for each in now(operator).measurements}

    assert snap(on, point_at(on, c) + 0.01) == c
    assert operator.move_point(width.name, 1, c)
    after = {each.name: each.record for each in now(operator).measurements}
    moved = after.pop(width.name)
    assert operator.snapshot().next_undo == "move a point of Width"
    assert moved.ends is not None and moved.places() == [a, c]
    np.testing.assert_allclose(moved.ends[1], point_at(on, c))
    apart = float(np.linalg.norm(point_at(on, a) - point_at(on, c)))
    assert moved.quantities[0].value == pytest.approx(apart, abs=1e-3)
    assert {**after, width.name: before[width.name]} == before
    assert next(e for e in now(operator).measurements if e.name == width.name).label == "Width"
    assert operator.undo()
    assert {each.name: each.record for each in now(operator).measurements} == before
    assert operator.redo()
    assert {each.name: each.record for each in now(operator).measurements}[width.name] == moved
    assert not operator.move_point("m77", 0, a)


def test_what_cannot_be_measured_is_said_and_nothing_kept(operator: Operator) -> None:
    place = place_at(operator.surface("balls"), np.zeros(3), CENTRES[0] - [0, 0, RADIUS])
    assert operator.measure("balls", "point", [place])
    before = now(operator).measurements
    assert operator.measure("balls", "plane", region=Region.ball(CENTRES[0] - [0, 0, RADIUS], 15.0))
    assert lacks(operator, "bends") == []
    assert (
        operator.measure("balls", "distance", [(0, 0), (1, 1)]) and lacks(operator, "(0, 0)") == []
    )
    assert (
        operator.measure("nothing", "point", [(0, 0)])
        and lacks(operator, "nothing", "reconstructed") == []
    )
    assert operator.measure_between("m1", "m1") and lacks(operator, "twice") == []
    assert not operator.delete_measurement("m77") and not operator.compare_nominal(
        "object", "../../etc/passwd"
    )
    assert now(operator).measurements == before


def test_a_surface_of_what_has_changed_is_not_measured(operator: Operator) -> None:
    store = operator.session
    assert store is not None
    meta, arrays = store.load_result("clouds/balls")
    kept = {key: value for key, value in meta.items() if key not in ("hash", "arrays", "checksums")}
    store.save_result(
        "clouds/balls", {**kept, "inputs": {**kept["inputs"], "balls": "other"}}, arrays
    )
    with raises(InputError, "balls"):
        surface_to_measure(store, "balls")
    store.save_result("clouds/balls", kept, arrays)
    assert surface_to_measure(store, "balls").organised


@pytest.mark.slow
def test_a_nominal_model_is_looked_at_kept_and_compared_with(
    operator: Operator, tmp_path: Path
) -> None:
    content = asset("objects/ammonite.ply").read_bytes()
    assert operator.upload_nominal("../My ammonite.ply", content)
    assert lacks(operator, "My_ammonite.ply", "triangles") == []
    assert (
        operator.upload_nominal("broken.stl", b"\0" * 300) and lacks(operator, "broken.stl") == []
    )
    trimesh.creation.box((5.6, 5.0, 1.6)).export(tmp_path / "inch.stl")
    assert operator.upload_nominal("inch.stl", (tmp_path / "inch.stl").read_bytes())
    session = now(operator)
    assert session.nominals == ("My_ammonite.ply", "inch.stl")
    assert sorted(each.name for each in (session.folder / "nominal").iterdir()) == list(
        session.nominals
    )
    assert operator.compare_nominal("object", "inch.stl")
    assert lacks(operator, "inch", "mm") == []

    assert operator.compare_nominal("object", "My_ammonite.ply", tolerance=1.5)
    assert lacks(operator, "± 1.5 mm", "pass") == []
    session = now(operator)
    assert session.measurements[-1].record.what == "deviation"
    assert "object_My_ammonite_deviation.ply" in [each.name for each in session.exports]


def test_names_of_uploaded_files_are_harmless() -> None:
    assert plain_name("a b<c>.stl", "model") == "a_b_c_.stl"
    assert plain_name("...", "model") == "model"
    assert len(plain_name("x" * 500 + ".stl", "")) == 100 and plain_name("é.stl", "") == "_.stl"
