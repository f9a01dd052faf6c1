"""One operation, one record: the terminal, Python and the wizard store the same results of the same
session."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clocks import HANG_S
from copies import copy_session

import slviewer as sl
from slviewer.cli import main
from slviewer.errors import SessionError
from slviewer.pipeline import operation
from slviewer.pipeline.accept import validate
from slviewer.pipeline.certificate import make_certificate
from slviewer.pipeline.measure import relate
from slviewer.pipeline.operations import OPERATIONS as ALL_OPERATIONS
from slviewer.pipeline.reconstruct import ReconstructSettings
from slviewer.session.store import Session
from slviewer.simulation.assets import asset
from slviewer.wizard.operator import Operator

pytestmark = pytest.mark.computes


@dataclass(frozen=True)
class Operation:
    """An operation in the words of the terminal, of Python and of the wizard, and the results that
    it stores."""

    terminal: tuple[str, ...]
    python: Callable[[Path], object]
    wizard: Callable[[Operator], bool]
    stored: tuple[str, ...]
    capture: str


BOARD = "circles:21x16:9"
BALL = """kind = "sphere"
name = "ball"
certificate = "K 1"
calibrated = {diameter_mm = 196.0, diameter_U_mm = 0.01, form_mm = 0.01, form_U_mm = 0.01, \
temperature_C = 20.0, \
expansion_ppm_K = 0.0, expansion_U_ppm_K = 0.0}
measured = {temperature_C = 20.0, temperature_U_K = 0.1, captures = ["sphere_3"]}
limits = {form_mm = 5.0}
""".replace("\\\n", "")


PLAN = """version = 1
name = "plane"
[[feature]]
name = "middle"
kind = "plane"
region = {kind = "ball", centre = [0.0, 0.0, 600.0], size = [400.0]}
filled = 5.0
[[characteristic]]
name = "flatness"
kind = "flatness"
features = ["middle"]
upper = 5.0
"""


def find_plan(session: Path) -> str:
    """Path of the inspection plan, beside the session."""
    return str(session.parent / "plan.toml")


def find_poses(session: Path | str) -> str:
    """Path of a machine's pose of one scan, beside the session."""
    return str(Path(session).parent / "poses.csv")


def find_ball(session: Path) -> str:
    """Path of the file of the ball's certificate, beside the session."""
    return str(session.parent / "ball.toml")


def find_part(session: Path) -> str:
    """Path of the file of the object's nominal model."""
    return str(asset("objects/ammonite.ply"))


def save_picked_points(session: Path) -> None:
    """Measure two points of the object."""
    for name, shift in (("one", 0), ("other", 20)):
        u, v = AT[0] + shift, AT[1]
        sl.measure(session, "object_r1", "point", at=(u, v), name=name)


AT = (190, 150, 210, 150)
AT_PLACES = [(190, 150), (210, 150)]
OPERATIONS = {
    "accept": Operation(
        ("accept", "SESSION", "--artefact", "BALL"),
        lambda session: sl.accept(session, find_ball(session)),
        lambda operator: operator.run("accept", artefact=find_ball(operator.session.folder)),
        # type: ignore[union-attr]
        ("acceptance/1",),
        "sphere_3",
    ),
    "run_plan": Operation(
        ("run-plan", "SESSION", "PLAN", "--scan", "plane_03"),
        lambda session: sl.run_plan(session, find_plan(session), ["plane_03"]),
        lambda operator: operator.run(
            "run-plan", plan=find_plan(operator.session.folder), scans=["plane_03"]
        ),  # type: ignore[union-attr]
        ("inspection/1",),
        "plane_03",
    ),
    "reconstruct": Operation(
        ("reconstruct", "SESSION", "object_r1"),
        lambda session: sl.reconstruct(session, "object_r1"),
        lambda operator: operator.reconstruct("object_r1"),
        ("clouds/object_r1",),
        "object_r1",
    ),
    "calibrate": Operation(
        ("calibrate", "SESSION", "--target", BOARD, "--models", "stereo"),
        lambda session: sl.calibrate(session, BOARD, ["stereo"]),
        lambda operator: operator.run("calibrate", target=BOARD, models=["stereo"]),
        ("calibration/stereo",),
        "pose_03",
    ),
    "validate": Operation(
        ("validate", "SESSION", "--models", "stereo"),
        lambda session: validate(session, ["stereo"]),
        lambda operator: operator.run("validate", models=["stereo"]),
        ("validation/1",),
        "pose_03",
    ),
    "verify": Operation(
        ("verify", "SESSION", "plane_03", "--shape", "plane"),
        lambda session: sl.verify(session, ["plane_03"], "plane"),
        lambda operator: operator.verify(["plane_03"], "plane"),
        ("verify/plane_03", "clouds/plane_03"),
        "plane_03",
    ),
    "align": Operation(
        ("align", "SESSION", "object_r1", "object_r2"),
        lambda session: sl.align(session, ["object_r1", "object_r2"]),
        lambda operator: operator.run("align", captures=["object_r1", "object_r2"]),
        ("placement/object_r1", "placement/object_r2"),
        "object_r1",
    ),
    "check": Operation(
        ("check", "SESSION", "later"),
        lambda session: sl.check(session, "later"),
        lambda operator: operator.run("check", capture="later"),
        ("drift/1",),
        "later",
    ),
    "compare": Operation(
        ("compare", "SESSION", "object_r1", "PART", "--tolerance", "1.5"),
        lambda session: sl.compare(session, "object_r1", find_part(session), tolerance=1.5),
        lambda operator: operator.run(
            "compare", scan="object_r1", nominal=find_part(Path()), tolerance=1.5
        ),
        ("measurements/m1",),
        "object_r1",
    ),
    "measure": Operation(
        ("measure", "SESSION", "object_r1", "distance", "--at", *map(str, AT)),
        lambda session: sl.measure(session, "object_r1", "distance", AT),
        lambda operator: (
            operator.reconstruct("object_r1")
            and operator.measure("object_r1", "distance", AT_PLACES)
        ),
        ("measurements/m1",),
        "object_r1",
    ),
    "relate": Operation(
        ("measurements", "SESSION", "--relate", "m1", "m2"),
        lambda session: relate(session, "m1", "m2"),
        lambda operator: operator.measure_between("m1", "m2"),
        ("measurements/m3",),
        "object_r1",
    ),
    "merge": Operation(
        ("merge", "SESSION", "object_r1", "object_r2", "--reference", "object_r2"),
        lambda session: sl.merge(session, ["object_r1", "object_r2"], "object_r2"),
        lambda operator: operator.merge(["object_r1", "object_r2"], "object_r2"),
        ("merge/1",),
        "object_r1",
    ),
    "show_on_part": Operation(
        ("show-on-part", "SESSION", "object_r1", "--of", "measure"),
        lambda session: sl.show_on_part(session, "object_r1", "measure"),
        lambda operator: operator.run("show-on-part", scan="object_r1", of="measure"),
        ("part-image/1",),
        "object_r1",
    ),
    "import_poses": Operation(
        ("import", "poses", "SESSION", "POSES", "--of", "scan"),
        lambda session: sl.import_poses(session, find_poses(session), of="scan"),
        lambda operator: operator.run(
            "import-poses", file=find_poses(operator.session.folder), of="scan"
        ),
        ("machine-pose/object_r1",),
        "object_r1",
    ),
}


def by_terminal(operation: Operation, session: Path) -> None:
    places = {"SESSION": str(session), "BALL": find_ball(session)}
    places |= {"POSES": find_poses(session), "PLAN": find_plan(session), "PART": find_part(session)}
    assert main([places.get(word, word) for word in operation.terminal]) == 0


def by_wizard(operation: Operation, session: Path) -> None:
    with Operator(session) as operator:
        assert operation.wizard(operator)
        operator.wait_until_idle(HANG_S)
        assert [
            notice.text for notice in operator.snapshot().notices if notice.level == "error"
        ] == []


DOORS = {
    "terminal": by_terminal,
    "python": lambda operation, session: operation.python(session),
    "wizard": by_wizard,
}


def records(
    session: Path, names: tuple[str, ...]
) -> dict[str, tuple[dict[str, Any], dict[str, np.ndarray]]]:
    with Session.open(session) as store:
        assert {store.state_of(name) for name in names} == {"fresh"}
        return {name: store.load_result(name) for name in names}


SLOW = {"accept", "calibrate", "check", "compare", "run_plan", "validate"}
"""Operations whose results every door takes seconds for."""


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in OPERATIONS
    ],
)
def done(
    request: pytest.FixtureRequest, recorded: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Operation, dict[str, Path]]:
    """An operation, and a session for each door by which it was asked for; all were equal
    before."""
    folder, operation = tmp_path_factory.mktemp("contract"), OPERATIONS[request.param]
    first = copy_session(recorded / "session", folder / "first")
    with Session.open(first, write=True) as store:
        board = store.load_capture("pose_03")
        store.save_capture("later", "scan", board.sequence, board.frames, source="simulated")
    if request.param in ("relate", "show_on_part"):
        save_picked_points(first)
    sessions = {door: copy_session(first, folder / door) for door in DOORS}
    (folder / "ball.toml").write_text(BALL)
    (folder / "plan.toml").write_text(PLAN)
    (folder / "poses.csv").write_text("capture,x,y,z,qw,qx,qy,qz\nobject_r1,10,20,30,1,0,0,0\n")
    for door, session in sessions.items():
        DOORS[door](operation, session)
    return operation, sessions


def assert_same(found: Any, wanted: Any, place: str) -> None:
    """Assert that values of a record are the same; ICP sums in parallel, so that its last digits
    vary."""
    assert type(found) is type(wanted), place
    if isinstance(wanted, dict):
        assert found.keys() == wanted.keys(), place
        for key in wanted:
            assert_same(found[key], wanted[key], f"{place}.{key}")
    elif isinstance(wanted, list):
        assert len(found) == len(wanted), place
        for k, each in enumerate(wanted):
            assert_same(found[k], each, f"{place}[{k}]")
    elif isinstance(wanted, float):
        assert found == pytest.approx(wanted, rel=1e-3, abs=1e-5), place
    else:
        assert found == wanted, place


TOLERANCE = {"calibration/stereo": 1e-6, "measurements/m1": 1e-5}
"""By how much arrays may differ: bundle adjustment and best fit sum in parallel."""


def test_every_door_stores_the_same_record(done: tuple[Operation, dict[str, Path]]) -> None:
    operation, sessions = done
    terminal, *others = (records(session, operation.stored) for session in sessions.values())
    for other in others:
        for name, (meta, arrays) in terminal.items():
            own = () if name.startswith(("clouds/", "verify/")) else ("hash", "time")
            own += ("checksums",) if name in TOLERANCE else ()
            assert_same(
                *(
                    {k: v for k, v in each.items() if k not in own}
                    for each in (other[name][0], meta)
                ),
                name,
            )
            assert arrays.keys() == other[name][1].keys()
            for key, array in arrays.items():
                tolerance = TOLERANCE.get(name, 0)
                np.testing.assert_allclose(
                    array, other[name][1][key], tolerance, tolerance, err_msg=f"{name}, {key}"
                )


def test_what_the_terminal_made_is_done_in_the_wizard_and_certified(
    done: tuple[Operation, dict[str, Path]],
) -> None:
    operation, sessions = done
    with Operator(sessions["terminal"]) as operator:
        view = operator.wait_until_idle(HANG_S).session
        assert view is not None
        shown = {f"{each.record.kind}/{each.name}" for each in view.records if not each.stale}
        assert set(operation.stored) <= shown
    with Session.open(sessions["terminal"]) as store:
        certificate = make_certificate(store)
    assert set(operation.stored) <= set(certificate.results)
    assert {
        name
        for name in operation.stored
        if not name.startswith(("placement/", "acceptance/", "validation/", "machine-pose/"))
    } <= set(certificate.figures)


def test_verify_stores_the_cloud_that_reconstruct_does(recorded: Path, tmp_path: Path) -> None:
    first, second = (
        copy_session(recorded / "session", tmp_path / name)
        for name in ("verified", "reconstructed")
    )
    sl.verify(first, ["plane_03"], "plane")
    sl.reconstruct(second, "plane_03")
    (verified,), (made,) = (
        records(session, ("clouds/plane_03",)).values() for session in (first, second)
    )
    assert verified[0] == made[0]  # with the checksums of the arrays


def test_a_changed_capture_makes_the_record_stale(
    done: tuple[Operation, dict[str, Path]], tmp_path: Path
) -> None:
    operation, sessions = done
    folder = copy_session(sessions["python"], tmp_path / "session")
    with Session.open(folder, write=True) as store:
        capture = store.load_capture(operation.capture)
        frames = np.maximum(capture.frames, 1)
        store.save_capture(
            operation.capture, "scan", capture.sequence, frames, source="simulated", force=True
        )
        assert {store.state_of(name) for name in operation.stored} == {"stale"}


def test_a_session_in_use_is_read_and_the_result_is_not_stored(
    recorded: Path, tmp_path: Path
) -> None:
    session, warnings = copy_session(recorded / "session", tmp_path / "session"), list[str]()
    with Session.open(session, write=True) as store:
        settings = ReconstructSettings("object_r1", out=tmp_path / "cloud.ply")
        made = sl.reconstruct.run(session, settings, warn=warnings.append)
        assert made.only.points > 10_000 and made.files[0].is_file()
        assert store.state_of("clouds/object_r1") == "absent"
    (warning,) = warnings
    assert "not stored" in warning and str(session) in warning


@pytest.mark.parametrize("name", ["reconstruct", "merge"])
def test_no_file_appears_whose_record_could_not_be_stored(
    name: str, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = copy_session(recorded / "session", tmp_path / "session")

    def refuse(*_: object) -> None:
        raise SessionError("the disk is full")

    monkeypatch.setattr(operation, "save_record", refuse)
    with pytest.raises(SessionError):
        OPERATIONS[name].python(session)
    assert not list((session / "exports").glob("*")) and not list((session / "results").glob("m*"))


def test_every_operation_is_bound_by_the_contract() -> None:
    # a robot and other rigs are needed by these: test_robot_session, test_robot_panel
    others = {"hand_eye", "relate_rigs"}
    assert {name.replace("-", "_") for name in ALL_OPERATIONS} - others == set(OPERATIONS)
