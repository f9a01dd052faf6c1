"""A plan on synthesised parts: those out of tolerance are found, and no others."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from facts import missing_facts, raises

from slviewer.errors import InputError
from slviewer.geometry.rigid import move_points, transform_from_rvec
from slviewer.inspection.regions import Region
from slviewer.pipeline.inspect_parts import (
    FILES,
    inspect_surfaces,
    process_capability,
    write_inspection,
)
from slviewer.pipeline.measure import MeasuredSurface
from slviewer.records.inspection import Characteristic, CharacteristicResult, Inspection
from slviewer.records.record import from_plain, to_plain
from slviewer.session.inspection_plan import (
    Alignment,
    Plan,
    PlanFeature,
    plan_toml,
    read_plan,
    write_plan,
)

NOISE, SIGMA, TOLERANCE = 0.01, 0.01, 0.06
POSE = transform_from_rvec([2.9, 0.1, 0.2], [5.0, -3.0, 500.0])
"""Of the part in the camera's frame: it is seen from above."""

CORNER = transform_from_rvec([0.0, 0.0, 0.0], [40.0, 40.0, 0.0])


def synthesised_part(
    seed: int, diameter: float = 20.0, motion: np.ndarray | None = None
) -> MeasuredSurface:
    """A table (z = 0, x and y from -40 to 40) with two side walls and a sphere on it, centred at 0,
    0, 10."""
    rng = np.random.default_rng(seed)
    n = 2500
    flat = np.stack([*rng.uniform(-40, 40, (2, n)), np.zeros(n)], 1)
    flat = flat[np.linalg.norm(flat[:, :2], axis=1) > 15]
    wall_x = np.stack([np.full(n, -40.0), rng.uniform(-40, 40, n), rng.uniform(1, 20, n)], 1)
    wall_y = wall_x[:, [1, 0, 2]]
    c, t = rng.uniform(0.2, 1, n), rng.uniform(0, 2 * np.pi, n)
    q = np.sqrt(1 - c * c)
    out = np.stack([q * np.cos(t), q * np.sin(t), c], 1)
    flat[:, 2] += NOISE * rng.normal(size=len(flat))
    wall_x[:, 0] += NOISE * rng.normal(size=n)
    wall_y[:, 1] += NOISE * rng.normal(size=n)
    ball = (diameter / 2 + NOISE * rng.normal(size=(n, 1))) * out + [0, 0, 10]
    points = np.concatenate([flat, wall_x, wall_y, ball])
    points = move_points(POSE if motion is None else motion @ POSE, points).astype(np.float32)
    return MeasuredSurface(
        points, np.full(len(points), NOISE, np.float32), f"part {seed}", "splined", {}
    )


def make_plan(limit: float = TOLERANCE) -> Plan:
    features = (
        PlanFeature(
            "table",
            "plane",
            Region.box((56, 2, -3), (78, 78, 3)),
            (67.0, 40.0, 0.0),
            (0.0, 0.0, 1.0),
        ),
        PlanFeature(
            "left", "plane", Region.box((-3, 2, 3), (3, 78, 18)), (0.0, 40.0, 10.0), (1.0, 0.0, 0.0)
        ),
        PlanFeature(
            "front",
            "plane",
            Region.box((2, -3, 3), (78, 3, 18)),
            (40.0, 0.0, 10.0),
            (0.0, 1.0, 0.0),
        ),
        PlanFeature(
            "ball",
            "sphere",
            Region.ball((40.0, 40.0, 10.0), 12.0),
            (40.0, 40.0, 10.0),
            None,
            10.0,
        ),
        PlanFeature("nothing", "plane", Region.ball((0.0, 0.0, 300.0), 5.0)),
    )
    characteristics = (
        Characteristic("diameter", "diameter", ("ball",), 20.0, 20.0 - limit, 20.0 + limit),
        Characteristic("height", "height of the centre", ("table", "ball"), 10.0, 9.95, 10.05),
        Characteristic("flatness", "flatness", ("table",), upper=0.05),
        Characteristic("square", "perpendicularity", ("left", "table"), upper=0.05),
    )
    start = CORNER @ np.linalg.inv(POSE)
    alignment = Alignment(
        "3-2-1", None, ("table", "left", "front"), tuple(map(tuple, start.tolist()))
    )  # type: ignore[arg-type]
    return Plan("ball on a table", features, characteristics, alignment)


def test_a_plan_survives_its_file(tmp_path: Path) -> None:
    plan = make_plan()
    write_plan(plan, tmp_path / "plan.toml")
    again = read_plan(tmp_path / "plan.toml")
    assert plan_toml(read_plan(tmp_path / "plan.toml")) == (tmp_path / "plan.toml").read_text()
    assert again.characteristic == plan.characteristic


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("version = 1", "version = 9", "version 9"),
        ('kind = "flatness"', 'kind = "flatnes"', "flatnes"),
        ('features = ["ball"]', 'features = ["bal"]', "bal"),
        ("lower = 9.95", "lower = 19.95", "19.95"),
        ('name = "ball on a table"', "tolerances = 1", "tolerances"),
    ],
)
def test_a_wrong_plan_is_refused_by_name(tmp_path: Path, old: str, new: str, named: str) -> None:
    text = plan_toml(make_plan())
    assert old in text
    (tmp_path / "plan.toml").write_text(text.replace(old, new, 1))
    with raises(InputError, named):
        read_plan(tmp_path / "plan.toml")


def write_files(found: Inspection, folder: Path) -> list[str]:
    """The texts of the page, the table and the record."""
    files = [folder / name for name in FILES]
    write_inspection(found, files)
    return [path.read_text("utf-8-sig") for path in files]


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize(
    ("count", "wrong"),
    [(6, {1: 1, 4: -1}), pytest.param(20, {3: 1, 8: -1, 13: 1, 17: -1}, marks=pytest.mark.slow)],
)
def test_exactly_the_parts_out_of_tolerance_fail(
    tmp_path: Path, count: int, wrong: dict[int, int]
) -> None:
    rng = np.random.default_rng(7)
    sources = []
    for k in range(count):
        off = (
            wrong[k] * (TOLERANCE + 3 * SIGMA)
            if k in wrong
            else np.clip(SIGMA * rng.normal(), -0.04, 0.04)
        )
        # parts lie a little differently each time
        motion = transform_from_rvec(0.001 * rng.normal(size=3), 0.3 * rng.normal(size=3))
        sources.append(
            (f"part {k}", lambda report, k=k, off=off, m=motion: synthesised_part(k, 20 + off, m))
        )
    inspection = inspect_surfaces(make_plan(), sources)
    assert [each.part for each in inspection.parts if each.decision == "fail"] == [
        f"part {k}" for k in wrong
    ]
    assert inspection.count_parts() == {
        "pass": count - len(wrong),
        "fail": len(wrong),
        "undecided": 0,
    }
    assert not missing_facts(inspection.failure, len(wrong)) and not inspection.is_good
    values = np.array([each.results[1].value for each in inspection.parts])
    assert 0 < np.abs(values - 10).max() < 0.01
    capability = inspection.capability[0]
    assert capability is not None and capability.cp is not None
    assert capability.cpk[1] < capability.cpk[0] <= capability.cp[0] < 1
    page, table, _ = write_files(inspection, tmp_path)
    assert (
        page.count("data:image/webp") == 4
        and "http://" not in page
        and f"part {max(wrong)}" in page
    )
    rows = list(csv.DictReader(table.splitlines()))
    assert len(rows) == 4 * count
    assert [row["part"] for row in rows if row["decision"] == "fail"] == [
        f"part {k}" for k in wrong
    ]


@pytest.mark.slow
@pytest.mark.computes
def test_what_cannot_be_measured_is_named_and_takes_nothing_with_it(tmp_path: Path) -> None:
    plan = make_plan()
    missing = Characteristic("missing", "flatness", ("nothing",), upper=0.1)
    plan = Plan(plan.name, plan.feature, (*plan.characteristic, missing), plan.alignment)

    def broken(report: object) -> MeasuredSurface:
        raise InputError("no such scan")

    inspection = inspect_surfaces(
        plan, [("good", lambda report: synthesised_part(1)), ("broken", broken)]
    )
    good, bad = inspection.parts
    assert [each.decision for each in good.results] == ["pass"] * 4 + ["undecided"]
    assert not missing_facts(good.results[-1].reason, 0, "points")
    assert all(each.reason == "no such scan" for each in bad.results)
    assert all("no such scan" in text for text in write_files(inspection, tmp_path))


def test_result_without_evidence_loads_and_one_with_it_tells_it() -> None:
    old = from_plain(
        {"name": "a", "value": 1.0, "U": 0.1, "decision": "pass"}, CharacteristicResult
    )
    assert old.measured is None and old.evidence == ""
    new = CharacteristicResult("a", 1.0, 0.1, "pass", "", True, 91.0, 2.5, "isolated", 0.02)
    assert not missing_facts(new.evidence, 91, 2.5, "isolated", 0.02)
    assert from_plain(to_plain(new), CharacteristicResult) == new


@pytest.mark.computes
@pytest.mark.parametrize("fault", ["missing", "elsewhere", "hardly measured"])
def test_feature_that_is_not_shown_is_undecided(fault: str) -> None:
    """A ball that is missing, that lies elsewhere in its region, and a table of which hardly any
    points are left."""
    surface, plan = synthesised_part(1), make_plan(2.0)
    part = move_points(np.linalg.inv(POSE), surface.points.astype(np.float64))
    is_ball = np.hypot(*part[:, :2].T) < 15
    if fault == "missing":
        kept = ~is_ball
    elif fault == "elsewhere":
        kept = ~is_ball | (np.linalg.norm(part - [0, 0, 10], axis=1) < 11)
        part[is_ball] += [5.0, 0.0, 0.0]
    else:
        kept = is_ball | (part[:, 0] < 20) | (part[:, 1] < -20)
    points = move_points(POSE, part[kept]).astype(np.float32)
    shown = replace(surface, points=points, sigma_mm=surface.sigma_mm[kept])
    results = {r.name: r for r in inspect_surfaces(plan, [("p", lambda _: shown)]).parts[0].results}
    judged = results["flatness" if fault == "hardly measured" else "diameter"]
    assert judged.decision == "undecided" and judged.reason
    assert "smaller" not in judged.reason


def test_capability_of_known_spread() -> None:
    values = 10 + 0.1 * np.random.default_rng(0).normal(size=400)
    c = process_capability(values.tolist(), 9.5, 10.4)
    assert c is not None and c.cp is not None
    assert c.cp[1] < 1.5 < c.cp[2] and c.cpk[1] < 4 / 3 < c.cpk[2]
    assert 0.9 * 1.5 < c.cp[0] < 1.1 * 1.5
    assert process_capability([1.0, 1.0, 1.0], 0.0, 2.0) is None
    assert process_capability([1.0, 2.0], 0.0, 2.0) is None


@pytest.mark.slow
@pytest.mark.computes
def test_a_plan_by_best_fit_measures_profiles_from_the_nominal_model(tmp_path: Path) -> None:
    """The nominal is a block with one sloping side; the part lies elsewhere, with a dent of 0.2 mm
    in its top."""
    mesh = trimesh.creation.box((80.0, 60.0, 40.0))
    low = mesh.vertices[:, 2] < 0
    mesh.vertices[low] += np.column_stack(
        [np.where(mesh.vertices[low, 0] > 0, 25.0, 0.0), *np.zeros((2, low.sum()))]
    )
    mesh.export(tmp_path / "box.stl")
    features = (
        PlanFeature(
            "top",
            "plane",
            Region("box", (20.0, 0.0, 20.0), (17.0, 27.0, 3.0)),
            (20.0, 0.0, 20.0),
            (0, 0, 1),
        ),
        PlanFeature("sound", "surface", Region("box", (20.0, 0.0, 20.0), (17.0, 27.0, 3.0))),
        PlanFeature("dented", "surface", Region("box", (-20.0, 0.0, 20.0), (17.0, 27.0, 3.0))),
    )
    characteristics = (
        Characteristic("sound profile", "profile", ("sound",), upper=0.1),
        Characteristic("dented profile", "profile", ("dented",), upper=0.1),
        Characteristic("top position", "position", ("top",), upper=0.1),
    )
    plan = Plan("box", features, characteristics, Alignment("best fit", "box.stl"))
    write_plan(plan, tmp_path / "plan.toml")
    read = read_plan(tmp_path / "plan.toml")

    def load(report: object) -> MeasuredSurface:
        rng = np.random.default_rng(5)
        points, faces = trimesh.sample.sample_surface(mesh, 16000, seed=5)
        seen = mesh.face_normals[faces][:, 2] > -0.5
        points, normals = np.array(points)[seen], mesh.face_normals[faces][seen]
        dent = (
            0.2
            * np.exp(-((points[:, 0] + 20) ** 2 + points[:, 1] ** 2) / 60)
            * (normals[:, 2] > 0.9)
        )
        points += (NOISE * rng.normal(size=len(points)) - dent)[:, None] * normals
        points = move_points(POSE, points).astype(np.float32)
        return MeasuredSurface(
            points, np.full(len(points), NOISE, np.float32), "box", "splined", {}
        )

    result = inspect_surfaces(read, [("one", load)])
    sound, dented, top = result.parts[0].results
    assert [each.reason for each in (sound, dented, top)] == ["", "", ""]
    assert [each.decision for each in (sound, dented)] == ["pass", "fail"]
    # the smooth part flattens a dent this narrow, and the best fit takes a little of it
    assert dented.value is not None and 0.25 < dented.value < 0.45
    assert top.value is not None and top.U is not None and top.value < 0.05 + top.U
    page = write_files(result, tmp_path)[0]
    assert "in part coordinates.</footer>" in page and "camera&#39;s frame.</footer>" not in page
