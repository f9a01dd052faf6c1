"""What was done last is undone and redone, whatever it was, by name; nothing else changes, and
nothing is lost."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from facts import missing_facts
from wizard_events import HANG_S

from slviewer.errors import CalibrationRejected, InputError, SessionError
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.edit import Selection
from slviewer.pipeline.operation import Findings
from slviewer.records.calibration import ModelCalibration
from slviewer.session.scan_edits import list_edits, load_edits
from slviewer.session.store import Session
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.wizard import result_requests
from slviewer.wizard.operator import Operator
from slviewer.wizard.undo import UndoHistory, decide, remove

SEQUENCE = PatternSequence((16, 12), tuple(phase_steps("x", 4, 8.0)))


def add_capture(store: Session, name: str, seed: int) -> None:
    """Save a scan of noise."""
    frames = np.random.default_rng(seed).integers(0, 255, (4, 6, 8), np.uint8)
    store.save_capture(name, "scan", SEQUENCE, frames, source="")


@pytest.fixture
def operator(tmp_path: Path) -> Iterator[Operator]:
    """A session with three captures of noise, without a rig."""
    with Session.create(tmp_path / "session") as store:
        for i in (1, 2, 3):
            add_capture(store, f"scan_{i:02d}", i)
    with Operator(tmp_path / "session") as engine:
        engine.wait_until_idle(HANG_S)
        yield engine


def opened(operator: Operator) -> Session:
    assert operator.session is not None
    return operator.session


def state(operator: Operator) -> dict[str, Any]:
    """What the session holds, apart from its trash and from what is computed again."""
    store = opened(operator)
    decisions = {what: store.decision(what) or {} for what in ("names", "excluded", "region")}
    hashes = {capture.name: capture.hash for capture in store.captures()}
    clouds = [name for name in store.result_names() if name.startswith("clouds/")]
    edits = {name: list_edits(store, name)[0] for name in hashes}
    return {"decisions": decisions, "captures": hashes, "clouds": clouds, "edits": edits}


def names(operator: Operator) -> tuple[str, str]:
    now = operator.wait_until_idle(HANG_S)
    return now.next_undo, now.next_redo


def test_a_history_moves_changes_between_undone_and_done(tmp_path: Path) -> None:
    with Session.create(tmp_path / "session") as store:
        history, values = UndoHistory(store), lambda: store.decision("model")

        def choose(value: str) -> None:
            change = partial(store.decide, "model", value)
            history.add(f"set {value}", decide(store, "model", change))

        store.decide("model", "a")
        for value in ("b", "c"):
            choose(value)
        assert history.undo() == "set c" and values() == "b" and history.next_redo == "set c"
        assert history.redo() == "set c" and values() == "c"
        assert [history.undo(), history.undo()] == ["set c", "set b"] and values() == "a"
        with pytest.raises(InputError):
            history.undo()
        assert history.redo() == "set b"
        choose("d")
        assert (history.next_undo, history.next_redo) == ("set d", "")
        assert [history.undo(), history.undo()] == ["set d", "set b"] and values() == "a"
        again = UndoHistory(store)  # as when the session is opened again
        assert (again.next_undo, again.next_redo) == ("", "set b")
        assert [again.redo(), again.redo()] == ["set b", "set d"] and values() == "d"


def test_a_change_that_cannot_be_undone_is_forgotten_one_that_failed_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Session.create(tmp_path / "session") as store:
        history = UndoHistory(store)
        history.add("first", decide(store, "model", partial(store.decide, "model", "a")))
        history.add("second", remove(["scan_01"]))  # which is not there

        def refuse(*_: object) -> None:
            raise SessionError("the disk is full")

        with monkeypatch.context() as patch, pytest.raises(SessionError):
            patch.setattr(Session, "exchange", refuse)
            history.undo()
        assert history.next_undo == "second"
        with pytest.raises(InputError, match="second"):
            history.undo()
        assert UndoHistory(store).next_undo == "first" == history.undo()


@pytest.mark.parametrize(
    "step",
    [
        {"type": "move", "source": "exports/a", "target": "../a"},
        {"type": "move", "source": "/etc/passwd", "target": "exports/a"},
        {"type": "exchange", "contents": {"scan_01": "trash/.."}},
        {"type": "exchange", "contents": {"scan_01": "trash/../../a"}},
        {"type": "unheard of"},
        7,
    ],
)
def test_a_file_of_changes_that_is_damaged_or_reaches_outside_is_forgotten_with_a_word(
    tmp_path: Path, step: object
) -> None:
    folder = tmp_path / "session"
    with Session.create(folder) as store:
        add_capture(store, "scan_01", 1)
    (folder / "trash").mkdir(exist_ok=True)
    (folder / "trash" / "changes.json").write_text(json.dumps({"done": [["evil", step]]}))
    with Operator(folder) as engine:
        assert engine.wait_until_idle(HANG_S).next_undo == ""
        warned = next(n.text for n in engine.notices() if "changes.json" in n.text)
        assert missing_facts(warned, "cannot be undone") == []


def test_changes_are_undone_after_the_session_was_opened_again(operator: Operator) -> None:
    store = opened(operator)
    before = state(operator)
    assert operator.rename("scan_01", "Part A") and operator.delete("scan_02")
    assert operator.exclude("scan_03", "blurred")
    after, folder = state(operator), store.folder
    operator.close()
    moved = folder.rename(folder.with_name("moved"))
    with Operator(moved) as again:
        assert names(again) == ("exclude scan_03", "")
        for name in ("exclude scan_03", "delete scan_02", "rename scan_01"):
            assert names(again)[0] == name and again.undo()
        assert state(again) == before and names(again) == ("", "rename scan_01")
        assert again.redo() and again.redo() and again.redo() and state(again) == after


def test_every_change_is_undone_and_redone_by_name(operator: Operator) -> None:
    store = opened(operator)
    points = np.random.default_rng(0).normal(500, 1, (6, 8, 3)).astype(np.float32)
    for name in ("scan_01", "scan_02"):
        store.save_result(f"clouds/{name}", {"inputs": {}}, {})
    selected = [
        Selection(name, points, np.arange(48).reshape(6, 8) < 7) for name in ("scan_01", "scan_02")
    ]
    region = RegionOfInterest((0.0, 0.0, 500.0), (10.0, 10.0, 10.0))
    changes = {
        "rename scan_02": partial(operator.rename, "scan_02", "Part <B>"),
        "exclude Part <B>": partial(operator.exclude, "scan_02", "blurred"),
        "delete 14 points": partial(operator.delete_points, selected, "lasso"),
        "set the region": partial(operator.set_region, region),
        "switch the region off": partial(operator.switch_region, False),
        "delete Part <B>": partial(operator.delete, "scan_02"),
        "include scan_01": partial(operator.include, "scan_01"),
        "undo the edit of scan_01": partial(operator.undo_edit, "scan_01"),
    }
    states = [state(operator)]
    for name, change in changes.items():
        assert change(), [notice.text for notice in operator.notices()]
        states.append(state(operator))
        assert names(operator) == (name, "")
    for name, before in zip(reversed(changes), states[-2::-1], strict=True):
        assert operator.snapshot().next_undo == name
        assert operator.undo() and state(operator) == before, name
        assert names(operator)[1] == name
    assert not operator.undo()
    for name, after in zip(changes, states[1:], strict=True):
        assert operator.redo() and state(operator) == after, name
    assert not operator.redo()
    assert operator.undo() and load_edits(store, "scan_01").applied == 1


def test_a_deleted_capture_comes_back_although_another_took_its_name(operator: Operator) -> None:
    store = opened(operator)
    store.save_result("clouds/scan_03", {"inputs": {}}, {})
    before = state(operator)
    assert operator.delete("scan_03")
    assert operator._next_name("scan") == "scan_04"  # that of a deleted one is not used again
    add_capture(store, "scan_03", 9)
    other = store.load_capture("scan_03").hash
    assert operator.undo() and state(operator) == before
    # the name is in use, but the other is in the trash
    assert operator.wait_until_idle(HANG_S).content.deleted_scans == ()
    (trashed,) = (each for each in store.trashed() if each.is_capture)
    assert trashed.name == "scan_03"
    store.exchange({trashed.name: trashed.place})
    assert store.load_capture("scan_03").hash == other


def test_labels_given_meanwhile_stay(operator: Operator) -> None:
    assert operator.rename("scan_01", "first")
    store = opened(operator)
    store.decide("names", {**store.decision("names"), "scan_02": "second"})
    assert operator.undo() and store.decision("names") == {"scan_02": "second"}
    assert operator.redo() and store.decision("names") == {"scan_01": "first", "scan_02": "second"}


def test_edits_that_changed_since_are_left_alone(operator: Operator) -> None:
    store = opened(operator)
    points = np.full((6, 8, 3), 500, np.float32)
    for i in range(2):
        selected = Selection("scan_01", points, np.arange(48).reshape(6, 8) == i)
        assert operator.delete_points([selected], "lasso")
        if not i:
            assert operator.undo_edit("scan_01")
    # what was undone by hand is forgotten once there is a new edit
    assert operator.undo() and load_edits(store, "scan_01").applied == 0
    before = load_edits(store, "scan_01").edits[0].made
    assert not operator.undo()
    assert missing_facts(operator.notices()[-1].text, "scan_01") == []
    assert load_edits(store, "scan_01").edits[0].made == before


def test_a_calibration_that_was_replaced_comes_back(
    operator: Operator, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = opened(operator)

    def save(into: Session, name: str, content: str) -> None:
        verdict = {"level": "good", "findings": []}
        into.save_result(name, {"inputs": {}, "content": content, "verdict": verdict}, {})

    def contents() -> dict[str, Any]:
        names = [each for each in store.result_names() if not each.startswith("trust/")]
        return {name: store.load_result(name)[0]["content"] for name in names}

    class Calibrate:
        """Stands for the operation: it replaces results, and raises for a rejected one."""

        record = ModelCalibration
        content = "new"

        def run(self, into: Session, *_: object) -> Findings[Any]:
            with into.together():
                if into.has_result("verdict/other"):
                    into.trash_result("verdict/other")
                save(into, "verdict/1", self.content)
            save(into, "evidence/1", self.content)
            if self.content == "rejected":
                raise CalibrationRejected("moved")
            return Findings(ModelCalibration, {})

    for name in ("verdict/1", "verdict/other"):
        save(store, name, "old")
    monkeypatch.setattr(result_requests, "calibrate", calibrate := Calibrate())
    assert operator.choose_target("circles:9x7:20") and operator.calibrate()
    assert names(operator) == ("calibrate", "")
    after = {"verdict/1": "new", "evidence/1": "new"}
    assert contents() == after
    calibrate.content = "rejected"
    assert operator.calibrate() and names(operator) == ("calibrate", "")
    assert contents() == dict.fromkeys(after, "rejected")
    after["evidence/1"] = "rejected"  # of other kinds stays
    assert operator.undo() and contents() == after
    assert operator.undo()
    assert contents() == {"verdict/1": "old", "verdict/other": "old", "evidence/1": "rejected"}
    assert operator.redo() and contents() == after


def test_each_session_has_a_history_of_its_own(operator: Operator, tmp_path: Path) -> None:
    assert operator.exclude("scan_01") and names(operator)[0]
    folder = opened(operator).folder
    assert operator.open_session(tmp_path / "other") and names(operator) == ("", "")
    assert operator.open_session(folder) and names(operator) == ("exclude scan_01", "")
    assert operator.undo() and "scan_01" not in opened(operator).excluded()
