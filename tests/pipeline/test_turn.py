"""A turn: planned, resumed where it was left, named where it fails, and closed to a watertight mesh
by one command."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from facts import missing_facts, raises
from faulty_rig import breakable

from slviewer.errors import Cancelled, DeviceError, InputError, TurntableError, UsageError
from slviewer.pipeline.capture import (
    capture_turn,
    merge_turn,
    missing_steps,
    next_turn,
    plan_turn,
    recorded_steps,
    turn,
)
from slviewer.pipeline.merge import MergeSettings, merge
from slviewer.pipeline.operation import ignore_progress
from slviewer.pipeline.rig_choice import Choice, RigSetup, set_up
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.registration.open3d_loader import open3d
from slviewer.registration.refusal import Refused
from slviewer.session.capture import TurnStep
from slviewer.session.store import Session
from slviewer.session.toml import to_toml
from slviewer.simulation.rig import letter
from slviewer.simulation.turning import stone, turning

SCALE = 0.15
RIG = {"driver": "simulated", "scale": SCALE, "turntable": {"driver": "simulated"}}
TINY = {**RIG, "scale": 0.05}


def calibrated(folder: Path, scale: float = SCALE) -> Path:
    """A session whose calibration is the truth, but for the lenses' local distortion."""
    rig = letter(scale)
    with Session.create(folder) as store:
        save_true_stereo(store, rig)
    return folder


@pytest.mark.computes
@pytest.mark.slow
def test_one_command_makes_a_watertight_mesh_of_a_turned_object(
    tmp_path: Path, run: Callable[..., Any]
) -> None:
    session, rig, out = (
        calibrated(tmp_path / "session"),
        tmp_path / "rig.toml",
        tmp_path / "stone.ply",
    )
    rig.write_text(to_toml(RIG))
    status, text, error = run(
        "turn", session, "--rig", rig, "--mesh", out, "--json", tmp_path / "turn.json"
    )
    assert status == 0, error
    assert not missing_facts(text, "12 scans", "watertight") and "features" not in error
    record = json.loads((tmp_path / "turn.json").read_text())
    assert record["captures"] == {f"turn1_{k + 1:02d}": 30.0 * k for k in range(12)}
    assert "turntable" in {pair["start"] for pair in record["merge"]["merge"]["1"]["registered"]}
    mesh = trimesh.load(out, process=False)
    assert mesh.is_watertight
    vertices, triangles = stone()
    first = turning()["turn_01"].pose
    truth = trimesh.Trimesh(first.to_camera(vertices), triangles, process=False)
    assert mesh.volume == pytest.approx(truth.volume, rel=0.08)
    error_mm = distances(truth, np.asarray(mesh.vertices)[::40])
    rms_mm = float(np.sqrt(np.mean(error_mm**2)))
    assert 0.03 < rms_mm < 0.5 and np.percentile(error_mm, 95) < 0.9, rms_mm
    # what is in the shade above the foot is closed flat: not left open, and not bulging
    foot = truth.vertices[vertices[:, 2] < vertices[:, 2].min() + 1e-6].mean(axis=0)
    assert 0.1 < distances(mesh, foot[None])[0] < 5.0


def distances(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """mm (n,) from points (n, 3) to a surface."""
    core, scene = open3d().core, open3d().t.geometry.RaycastingScene()
    scene.add_triangles(
        core.Tensor(mesh.vertices.astype(np.float32)), core.Tensor(mesh.faces.astype(np.uint32))
    )
    return scene.compute_distance(core.Tensor(points.astype(np.float32))).numpy()


def test_a_plan_is_a_full_turn_or_a_range() -> None:
    full = plan_turn("turn1", 12)
    assert [step.deg for step in full] == [30.0 * k for k in range(12)] and full[
        4
    ].name == "turn1_05"
    assert [step.deg for step in plan_turn("a", 4, -90.0)] == [0.0, -30.0, -60.0, -90.0]
    assert plan_turn("a", 3, -360.0)[-1].deg == -240.0
    for steps, range_deg in ((1, 360.0), (300, 360.0), (12, 0.0), (12, 361.0), (12, float("nan"))):
        with raises(InputError):
            plan_turn("a", steps, range_deg)
    with raises(InputError, "../a_12"):
        plan_turn("../a")


class Turned:
    """Turns with a rig that can be broken, in a session of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.warnings = folder, list[str]()
        self.bench = set_up(TINY, None)
        self.rig, self.faults = breakable(self.bench.rig)

    def set_up(self, choice: Choice, board: object) -> RigSetup:
        # without its world, where the board stays in view: it is quick to render
        return RigSetup(self.rig)

    def __call__(
        self, progress: Callable[[float, str], None] = lambda share, doing: None, **options: Any
    ) -> Any:
        return turn(
            self.folder,
            TINY,
            merge=False,
            set_up=self.set_up,
            progress=progress,
            warn=self.warnings.append,
            **options,
        )

    def angles(self) -> dict[str, float]:
        with Session.open(self.folder) as store:
            return {
                c.name: c.turn_step.deg for c in store.captures("scan") if c.turn_step is not None
            }


@pytest.fixture
def turned(tmp_path: Path) -> Turned:
    return Turned(tmp_path / "session")


FOUR = {"turn1_01": 0.0, "turn1_02": 90.0, "turn1_03": 180.0, "turn1_04": 270.0}


@pytest.mark.computes
def test_a_fault_names_its_step_and_the_turn_goes_on_from_there(turned: Turned) -> None:
    turned.faults.plan("turntable", 180)
    with raises(TurntableError, "step 3 of 4", "180 degrees", "alarm 1", "2 scans", "resume"):
        turned(steps=4)
    assert list(turned.angles()) == ["turn1_01", "turn1_02"]
    turned.faults.plan("timeout", 3)
    with raises(DeviceError, "step 3 of 4", "frame", "2 scans"):
        turned(resume=True)
    assert not missing_facts(turned(resume=True).text(), "4 scans", "turn1_01", "turn1_04")
    assert turned.angles() == FOUR
    # the back of the board is dark
    assert {warning.partition(":")[0] for warning in turned.warnings} == {"turn1_03", "turn1_04"}
    with raises(InputError, "turn1", 4):
        turned(resume=True)
    with raises(InputError, "'turn1_01'"):
        turned(name="turn1")
    turned(steps=2)
    assert {"turn2_01", "turn2_02"} <= set(turned.angles())
    # a scan that was deleted is a missing step
    with Session.open(turned.folder, write=True) as store:
        store.exchange({"turn1_02": None})
        assert [step.name for step in missing_steps(store, "turn1")] == ["turn1_02"] and next_turn(
            store
        ) == "turn3"


@pytest.mark.computes
def test_a_cancelled_turn_keeps_what_was_captured(turned: Turned) -> None:
    seen: list[str] = []

    def cancel(share: float, doing: str) -> None:
        seen.append(doing)
        if "step 3 of 4: frame 2" in doing:
            raise Cancelled("cancelled")

    with raises(Cancelled):
        turned(cancel, steps=4)
    assert (
        list(turned.angles()) == ["turn1_01", "turn1_02"]
        and "step 2 of 4: turning to 90 degrees" in seen
    )
    turned(resume=True)
    assert turned.angles() == FOUR


class Counting:
    """A turntable that forgets its angle when it is switched off."""

    name, limits_deg, is_absolute = "the counting table", None, False

    def __init__(self, stands_at: float = 0.0) -> None:
        self.counts, self.turned_to = stands_at, list[float]()

    def open(self) -> None: ...

    def close(self) -> None: ...

    def position_deg(self) -> float:
        return self.counts

    def turn_to(self, deg: float, check: Callable[[], None] = lambda: None) -> None:
        self.counts = deg
        self.turned_to.append(deg)


@pytest.mark.parametrize(
    ("counts", "targets", "warned"),
    [(107.0, [137.0, 167.0], 0), (77.0, [137.0, 167.0], 0), (0.0, [30.0, 60.0], 1)],
)
def test_a_resumed_turn_goes_on_at_the_angle_where_it_stopped(
    counts: float, targets: list[float], warned: int
) -> None:
    """It began where the table counted 47 degrees; the last scan is that at 60 degrees."""
    table, warnings, steps = Counting(counts), list[str](), plan_turn("turn1", 5, 120.0)
    recorded = [TurnStep(s.turn, s.step, s.steps, s.step_deg, 47.0 + s.deg) for s in steps[:3]]
    bench = set_up(TINY, None)
    rig = type(bench.rig)("rig", bench.rig.camera, bench.rig.projector, turntable=table)
    saved: list[TurnStep] = []
    capture_turn(rig, steps[3:], lambda step, _: saved.append(step), recorded, warn=warnings.append)
    assert table.turned_to == targets and len(warnings) == warned
    assert [step.deg for step in saved] == [90.0, 120.0] and [
        step.position_deg for step in saved
    ] == targets


def test_angles_that_do_not_fit_the_scans_are_not_insisted_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    warnings: list[str] = []

    def attempt(store: Session, settings: MergeSettings, *_: object) -> str:
        if settings.start == "turntable":
            raise Refused("overlap", "they do not overlap")
        return settings.start

    monkeypatch.setattr(merge, "run", attempt)
    with Session.create(tmp_path / "session") as store:
        settings = MergeSettings(["two"], "one")
        merged = merge_turn(store, settings, ignore_progress, warnings.append)
    assert merged == "features" and "they do not overlap" in warnings[0]


@pytest.mark.computes
def test_merging_starts_from_stored_angles_of_one_turn_only(turned: Turned) -> None:
    turned(steps=2)
    turned(steps=2)
    with Session.open(turned.folder, write=True) as store:
        assert [step.deg for step in recorded_steps(store, "turn2")] == [0.0, 180.0]
        capture = store.load_capture("turn1_01")
        store.save_capture("plain", "scan", capture.sequence, capture.frames, source="x")
        with raises(UsageError, "plain"):
            merge(store, ["turn1_01", "plain"], "turn1_01", start="turntable")
        with raises(UsageError, "turn1", "turn2"):
            merge(store, ["turn1_01", "turn2_02"], "turn1_01", start="turntable")
        with raises(UsageError, "turntable"):
            merge(store, ["turn1_01", "turn1_02"], "turn1_01", angle=30.0)


def test_what_cannot_be_turned_is_refused_before_anything_moves(tmp_path: Path) -> None:
    plain = {"driver": "simulated", "scale": 0.05}
    for rig, options, fact in (
        (plain, {"merge": False}, "turntable"),
        (TINY, {}, "calibration"),
        (TINY, {"merge": False, "resume": True}, "turn"),
        ({"driver": "replay", "source": "x"}, {"merge": False}, "recording"),
        (TINY, {"merge": False, "exposure_ms": 1.0, "exposures_ms": (1.0, 2.0)}, "exposure"),
    ):
        with raises(InputError, fact):
            turn(tmp_path / "session", rig, **options)
    with raises(UsageError, "--mesh"):
        turn(tmp_path / "session", TINY, merge=False, mesh=tmp_path / "a.ply")
    assert not (tmp_path / "session").exists()
