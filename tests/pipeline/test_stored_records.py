"""Records that version 0.2 stored are read as today's."""

import json
import shutil
from pathlib import Path

import pytest

from slviewer.calibration.stereo import StereoModel
from slviewer.errors import DamagedError
from slviewer.pipeline.calibrate import CalibrateSettings
from slviewer.pipeline.operation import Stored, load_record, load_stored, name_records
from slviewer.pipeline.operations import OPERATIONS
from slviewer.records.acceptance import Drift, ModelComparison
from slviewer.records.calibration import ModelCalibration, StereoFit
from slviewer.records.inspection import Inspection
from slviewer.records.kinds import RECORDS
from slviewer.records.measurement import MeasuredRegion, Measurement
from slviewer.records.merge import Merge, Placement, Reconstruction
from slviewer.records.record import from_plain, to_plain
from slviewer.records.verdict import Verdict
from slviewer.records.verification import Verification, centre_distances_mm
from slviewer.session.store import Session

OLD = Path(__file__).parents[1] / "session" / "version_0_2"
"""What version 0.2 stored of a simulated session at quarter resolution, without the arrays."""


def as_stored(name: str) -> dict[str, object]:
    meta: dict[str, object] = json.loads((OLD / name / "meta.json").read_text())
    return meta


@pytest.fixture
def session(tmp_path: Path) -> Session:
    with Session.create(tmp_path / "session") as store:
        shutil.copytree(OLD, store.folder / "results", dirs_exist_ok=True)
    return Session.open(tmp_path / "session")


def test_verifications_keep_their_figures_and_can_be_repeated(session: Session) -> None:
    old, found = as_stored("verify/sphere_1"), load_record(session, Verification, "sphere_1")
    models = old["models"]
    assert isinstance(models, dict) and isinstance(old["centres_mm"], dict)
    for name, fit in found.models.items():
        kept = (
            fit.points,
            fit.excluded,
            fit.rms_mm,
            fit.noise_floor_mm,
            fit.coverage,
            fit.radius_mm,
        )
        keys = ("points", "set_aside", "rms_mm", "noise_floor_mm", "coverage", "radius_mm")
        assert kept == tuple(models[name][key] for key in keys)
        assert fit.centre_mm == tuple(old["centres_mm"][name])
    assert found.models["splined"].masked == old["masked"]["splined"]  # type: ignore[index]
    assert (
        found.incidence == old["incidence"]
        and found.inputs == old["inputs"]
        and found.scales == old["scales"]
    )
    assert found.settings == {"captures": ["sphere_1"], "shape": "sphere", "models": list(models)}
    both = {name: load_record(session, Verification, name) for name in ("sphere_1", "sphere_2")}
    assert centre_distances_mm(both)["sphere_1", "sphere_2"] == pytest.approx(
        {"stereo": 24.809, "pixelwise": 24.818, "splined": 24.739}, abs=0.001
    )


def test_clouds_and_merges_keep_their_figures(session: Session) -> None:
    old, cloud = as_stored("clouds/object_r1"), load_record(session, Reconstruction, "object_r1")
    assert [cloud.points, cloud.model, cloud.noise_mm] == [
        old["points"],
        old["model"],
        old["noise_mm"],
    ]
    assert cloud.settings == {"capture": "object_r1", "model": "splined", "axis": "x"}
    old, merge = as_stored("merge/1"), load_record(session, Merge, "1")
    assert [merge.scans, merge.reference, merge.points] == [
        old["scans"],
        old["reference"],
        old["points"],
    ]
    assert len(merge.registered) == 3 and len(merge.loops) == 1 and merge.excluded["edges"] > 100
    shown = [pair.moved_mm for pair in merge.registered]
    assert all(moved is not None and 100 < moved < 400 for moved in shown)


def test_places_and_drift_checks_keep_their_figures(session: Session) -> None:
    old, place = as_stored("placement/object_r3"), load_record(session, Placement, "object_r3")
    assert [place.onto, place.rms_mm, place.overlap] == [old["onto"], old["rms_mm"], old["overlap"]]
    assert (
        place.T_first_scan is not None
        and list(map(list, place.T_first_scan)) == old["T_first_scan"]
    )
    old, drift = as_stored("drift/1"), load_record(session, Drift, "1")
    kept = old["checked"]
    assert (
        isinstance(kept, dict)
        and drift.inputs == old["inputs"]
        and drift.settings == {"capture": "later"}
    )
    plain = json.loads(json.dumps(to_plain(drift)))
    assert all(plain[key] == value for key, value in kept.items() if key != "calibration")


def test_a_comparison_of_models_keeps_its_figures_under_another_name(session: Session) -> None:
    old, found = as_stored("calibration/validation"), load_record(session, ModelComparison, "1")
    kept = old["validation"]
    assert isinstance(kept, dict) and found.inputs == old["inputs"]
    assert found.settings == {"models": ["stereo", "pixelwise", "splined"], "folds": 5}
    plain = json.loads(json.dumps(to_plain(found)))
    assert all(plain[key] == value for key, value in kept.items())


def test_a_stereo_calibration_keeps_its_figures_and_can_be_repeated(session: Session) -> None:
    old, found = as_stored("calibration/stereo"), load_record(session, ModelCalibration, "stereo")
    model, fit = old["model"], found.fit
    assert isinstance(model, dict) and isinstance(fit, StereoFit) and found.verdict == Verdict()
    assert fit == StereoModel.from_dict(model).describe() and found.inputs == old["inputs"]
    assert fit.reprojection_rms_px == model["reprojection_rms_px"] and list(fit.poses) == list(
        model["poses"]
    )
    assert CalibrateSettings(**found.settings) == CalibrateSettings(
        "circles:21x16:9", ["stereo", "pixelwise", "splined"]
    )


def test_inspections_keep_their_decisions(session: Session) -> None:
    old, found = as_stored("inspection/1"), load_record(session, Inspection, "1")
    assert [found.plan, found.inputs] == [old["plan"], old["inputs"]]
    plain = json.loads(json.dumps(to_plain(found)))
    assert plain["characteristic"] == old["characteristic"] and found.parts[0].decision == "fail"
    for part, before in zip(plain["parts"], old["parts"], strict=True):
        for new, was in zip(part["results"], before["results"], strict=True):
            assert {name: new[name] for name in was} == was
    assert found.count_parts() == {"pass": 0, "fail": 1, "undecided": 1} and not found.is_good
    assert found.figures()["object_r1 angle deg"] == 90.61


def test_measurements_keep_their_figures_and_can_be_repeated(session: Session) -> None:
    names = [f"m{k}" for k in range(1, 8)]
    old = {name: as_stored(f"measurements/{name}") for name in names}
    stored = {name: load_stored(session, Measurement, name) for name in names}
    for name, each in stored.items():
        meta, record = old[name], each.record
        assert isinstance(meta["data"], dict)
        assert json.loads(json.dumps(to_plain(record.quantities))) == meta["data"]["quantities"]
        kept = [
            record.what,
            record.source,
            record.model,
            record.time,
            list(record.of),
            record.inputs,
        ]
        assert kept == [meta[key] for key in ("kind", "source", "model", "time", "of", "inputs")]
        assert record.scales == ({} if name == "m6" else {"stereo": 1.001}) and each.stale
        settings = OPERATIONS[record.operation].settings(**record.settings)
        if record.operation == "measure":
            assert (settings.scan, settings.what, settings.model) == (
                "object_r1",
                meta["kind"],
                "stereo",
            )
        if "region" in meta["data"]:
            region = from_plain(to_plain(settings.region()), MeasuredRegion)
            expected = from_plain(meta["data"]["region"], MeasuredRegion)
            for key in ("centre", "size"):
                assert getattr(region, key) == pytest.approx(getattr(expected, key))
            assert (region.kind, region.axes) == (expected.kind, expected.axes)
    assert [stored[name].label for name in ("m1", "m4", "m6")] == [
        "point 1",
        "left",
        "left – plane 5",
    ]
    assert stored["m1"].record.settings["at"] == [180, 150]
    assert (
        stored["m2"].record.settings["at"] == [180, 150, 220, 150]
        and stored["m2"].record.ends is not None
    )
    sphere, compared = stored["m4"].record, stored["m7"].record
    assert (
        sphere.feature is not None
        and sphere.feature.radius == 25.01
        and len(sphere.feature.scatter) == 4
    )
    assert (
        "900 used" in sphere.where
        and sphere.warnings == ("points lie off",)
        and sphere["radius"].U == 0.02
    )
    assert (
        stored["m6"].record.settings == {"a": "m4", "b": "m5"}
        and stored["m3"].record.plane is not None
    )
    assert (
        compared.deviation is not None
        and compared.deviation.tolerance_mm == 1.5
        and compared.is_good
    )
    assert (
        compared.settings["content"] == "ab" * 20
        and compared.settings["nominal"] == "nominal/part.stl"
    )


def test_every_record_has_figures_a_summary_and_tables(session: Session) -> None:
    for result in session.result_names():
        kind, _, name = result.partition("/")
        record = load_record(session, RECORDS[kind], name)
        tables = RECORDS[kind].tables({name: record})
        assert record.summary() and tables[0].rows and tables[0].columns[0].title
        own = {column.heading for table in tables for column in table.columns}
        assert not own & {"kind", "record", "label", "up to date"}  # of the table of all records
        assert record.figures() or kind in ("placement", "validation")


def test_records_of_one_label_are_all_named(session: Session) -> None:
    record = load_record(session, Verification, "sphere_1")
    found = [
        Stored("sphere_1", "ball", record),
        Stored("sphere_2", "ball", record),
        Stored("plane_03", "plate", record),
    ]
    assert list(name_records(found)) == ["ball (sphere_1)", "ball (sphere_2)", "plate"]


def test_a_record_of_other_types_is_damaged(session: Session) -> None:
    path = session.folder / "results" / "verify" / "sphere_1" / "meta.json"
    path.write_text(
        json.dumps({**as_stored("verify/sphere_1"), "models": {"stereo": {"points": -1}}})
    )
    with pytest.raises(DamagedError):
        load_record(session, Verification, "sphere_1")
