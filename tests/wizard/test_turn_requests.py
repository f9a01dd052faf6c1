"""Scanning all round as an operator asks for it: one request, then merge and mesh; cancelled,
broken and resumed."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import trimesh
from facts import missing_facts
from faulty_rig import FaultyRigs
from wizard_events import HANG_S, SPARING, list_texts, wait_until_open

from slviewer.pipeline.simulate import save_true_stereo
from slviewer.session.store import Session
from slviewer.simulation.rig import letter
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import Snapshot

pytestmark = pytest.mark.computes

SCALE = 0.12
RIG = {"driver": "simulated", "scale": SCALE, "turntable": {"driver": "simulated"}}


@pytest.fixture
def rigs() -> FaultyRigs:
    return FaultyRigs()


@pytest.fixture
def operator(tmp_path: Path, rigs: FaultyRigs) -> Iterator[Operator]:
    """With a calibration that is the truth, but for the lenses' local distortion."""
    rig = letter(SCALE)
    with Session.create(tmp_path / "session") as store:
        save_true_stereo(store, rig)
    with Operator(tmp_path / "session", RIG, set_up=rigs, timing=SPARING) as operator:
        wait_until_open(operator)
        yield operator


def turned(snapshot: Snapshot | None) -> list[tuple[str, float, str]]:
    assert snapshot is not None and snapshot.session is not None
    return [
        (s.name, s.turn_step.deg, s.cloud)
        for s in snapshot.session.scans
        if s.turn_step is not None
    ]


@pytest.mark.slow
def test_one_request_ends_in_a_watertight_mesh(operator: Operator) -> None:
    assert operator.snapshot().rig.turntable == "the simulated turntable"
    stages: set[str] = set()
    operator.subscribe(lambda s: stages.add(s.rig.capture.stage if s.rig.capture else ""))
    assert operator.scan_all_round()
    done = operator.wait_until_idle(HANG_S)
    assert turned(done) == [(f"turn1_{k + 1:02d}", 30.0 * k, "fresh") for k in range(12)]
    assert any(not missing_facts(stage, "3 of 12", "frame") for stage in stages)
    assert done.session is not None and done.session.merge is not None and done.merge_failure == ""
    assert len(done.session.merge.record.scans) == 12 and operator.session is not None
    (path,) = (operator.session.folder / "exports").glob("merged*mesh*.ply")
    mesh = trimesh.load(path, process=False)
    assert mesh.is_watertight and mesh.volume > 3e5
    assert any(not missing_facts(text, "watertight") for text in list_texts(done, "good")), (
        done.notices
    )


@pytest.mark.slow
def test_a_turn_that_fails_or_is_cancelled_is_resumed(operator: Operator, rigs: FaultyRigs) -> None:
    rigs.faults.plan("turntable", 240)
    assert operator.scan_all_round(3, then_merge=False)
    failed = operator.wait_until_idle(HANG_S)
    assert [name for name, *_ in turned(failed)] == ["turn1_01", "turn1_02"]
    (error,) = list_texts(failed, "error")
    assert missing_facts(error, "step 3 of 3", 240, "alarm 1", "2 scans") == []
    assert failed.rig.state == "open" and failed.rig.fault == ""  # the camera goes on
    assert operator.resume_turn(then_merge=False)
    assert [deg for _, deg, _ in turned(operator.wait_until_idle(HANG_S))] == [0.0, 120.0, 240.0]
    assert (
        not operator.resume_turn() and missing_facts(operator.notices()[-1].text, 3, "turn1") == []
    )
    assert operator.scan_all_round(12, then_merge=False)
    assert operator.wait_for(
        lambda s: s.rig.capture is not None and "step 2 of 12" in s.rig.capture.stage, HANG_S
    )
    assert operator.cancel()
    cancelled = operator.wait_until_idle(HANG_S)
    names = [name for name, *_ in turned(cancelled) if name.startswith("turn2")]
    assert 1 <= len(names) < 12 and any(
        "cancelled" in text for text in list_texts(cancelled, "info")
    )
    assert cancelled.session is not None and cancelled.session.merge is None


def test_a_rig_without_a_turntable_says_so(operator: Operator) -> None:
    assert operator.choose_rig({"driver": "simulated", "scale": SCALE})
    assert operator.wait_for(lambda s: s.rig.state == "open" and not s.rig.turntable, HANG_S)
    assert (
        not operator.scan_all_round()
        and missing_facts(operator.notices()[-1].text, "[turntable]") == []
    )
