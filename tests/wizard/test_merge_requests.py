"""Merging as an operator asks for it: from each start, and refused in words that stay."""

from collections.abc import Iterator

import numpy as np
import pytest
from facts import missing_facts
from scipy.spatial.transform import Rotation
from wizard_events import HANG_S

from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.pipeline.merge import load_placements, view_places
from slviewer.pipeline.operation import Stored, read_record
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.records.merge import Merge
from slviewer.session.ply import read_ply
from slviewer.session.store import Session
from slviewer.simulation.boards import Pose
from slviewer.simulation.mesh import demo_object
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import Spheres
from slviewer.wizard import result_views
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import Snapshot

pytestmark = pytest.mark.computes

STEP_DEG = 12.0
MIDDLE = np.array([0.0, 0.0, 520.0])
NAMES = ("first", "second", "third")


def turned(k: int) -> Pose:
    """The object on a table that stands upright, after so many steps."""
    R = Rotation.from_euler("y", k * STEP_DEG, degrees=True).as_matrix()
    return Pose(R, MIDDLE)


@pytest.fixture(scope="module")
def operator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Operator]:
    """Over a session whose calibration is the truth, with three turned scans of the demo object,
    and two of a ball."""
    folder = tmp_path_factory.mktemp("merging") / "session"
    rig = letter(0.2, seed=2, local_distortion_px=0)
    sequence = one_axis(p18(rig.projector.size), "x")
    balls = {f"ball_{k}": Spheres(MIDDLE[None] + [[8.0 * k, 0, 0]], 60.0) for k in range(2)}
    scenes = {name: demo_object(turned(k)) for k, name in enumerate(NAMES)} | balls
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
        yield engine


def settled(operator: Operator) -> tuple[Snapshot, Stored[Merge] | None]:
    snapshot = operator.wait_until_idle(HANG_S)
    assert snapshot.session is not None
    return snapshot, snapshot.session.merge


def name_of(merge: Stored[Merge] | None) -> str:
    """Return the name of a merge; empty where there is none."""
    return "" if merge is None else merge.name


def truth(name: str) -> np.ndarray:
    """T_first_scan."""
    first, scan = np.eye(4), np.eye(4)
    first[:3, :3], first[:3, 3] = turned(0).R, turned(0).t
    scan[:3, :3], scan[:3, 3] = turned(NAMES.index(name)).R, turned(NAMES.index(name)).t
    return np.asarray(first @ np.linalg.inv(scan))


def off_mm(merge: Stored[Merge], name: str) -> float:
    """How far the object's middle lies from where it should."""
    D = np.array(merge.record.pairs[name].T_reference_scan) @ np.linalg.inv(truth(name))
    return float(np.linalg.norm(D[:3, :3] @ MIDDLE + D[:3, 3] - MIDDLE))


@pytest.mark.slow
def test_three_scans_close_a_loop_and_say_how_sure_they_are(operator: Operator) -> None:
    assert operator.merge(NAMES, "first")
    snapshot, merge = settled(operator)
    assert merge is not None and snapshot.merge_failure == "" and merge.record.reference == "first"
    assert {(pair.scan, pair.onto) for pair in merge.record.registered} == {
        ("second", "first"), ("third", "first"), ("third", "second"),
    }  # fmt: skip
    for pair in merge.record.registered:
        assert (
            0.01 < pair.rms_mm < 0.5
            and 0.4 < pair.overlap <= 1
            and pair.point_to_point_rms_mm > pair.rms_mm
        )  # type: ignore[operator]
        assert 0 < pair.sigma_shift_mm < 0.05 and 0 < pair.sigma_turn_deg < 0.1  # type: ignore[operator]
        steps = NAMES.index(pair.scan) - NAMES.index(pair.onto)
        assert pair.turned_deg == pytest.approx(steps * STEP_DEG, abs=0.1)
        assert 0.5 < pair.moved_mm < 30  # type: ignore[operator]  # the middle of what both see, not the camera's
    (loop,) = merge.record.loops
    assert loop.error_mm < 0.3 and loop.left_mm <= loop.error_mm and set(loop.scans) == set(NAMES)
    record = merge.record
    assert record.dropped == record.refused == [] and record.excluded.total() > 0
    assert record.shared is not None and 0.5 < record.shared <= 1
    assert all(off_mm(merge, name) < 0.1 for name in NAMES[1:])
    assert operator.session is not None
    kept = read_ply(operator.session.exports / f"merged_{merge.name}.ply")
    assert (
        set(np.unique(kept.scalars["source"])) == {0, 1, 2}
        and len(kept.points) == merge.record.points
    )
    assert not [notice for notice in snapshot.notices if notice.level == "error"]


@pytest.mark.slow
def test_a_turntable_is_told_by_its_angle_and_a_wrong_one_is_refused_until_the_next_try(
    operator: Operator,
) -> None:
    before = settled(operator)[1]
    assert operator.merge(NAMES[:2], "first", start="turntable", angle=40.0)
    snapshot, merge = settled(operator)
    assert name_of(merge) == name_of(before)
    assert missing_facts(snapshot.merge_failure, "12.0 degrees", 40, "turntable") == []
    assert snapshot.notices[-1].text == snapshot.merge_failure
    assert operator.merge(NAMES[:2], "first", start="turntable", angle=STEP_DEG)
    snapshot, merge = settled(operator)
    assert merge is not None and snapshot.merge_failure == "" and merge.name != name_of(before)
    assert off_mm(merge, "second") < 0.1


@pytest.mark.slow
def test_picked_pairs_start_a_merge(operator: Operator) -> None:
    before = settled(operator)[1]  # of the tests above
    assert operator.reconstruct("third") and operator.session is not None
    operator.wait_until_idle(HANG_S)
    cloud = result_views.load_scan_cloud(operator.session, "third")
    v, u = np.nonzero(np.isfinite(cloud.points[..., 2]))
    chosen = [int(np.argmin(u)), int(np.argmax(u)), int(np.argmin(v)), int(np.argmax(v))]
    there = cloud.points[v[chosen], u[chosen]].astype(float)
    T = truth("third")
    here = there @ T[:3, :3].T + T[:3, 3] + np.random.default_rng(0).normal(0, 1.5, there.shape)
    assert operator.merge(["first", "third"], "first", picked={("third", "first"): (there, here)})
    snapshot, merge = settled(operator)
    assert (
        merge is not None
        and merge.record.scans == ["first", "third"]
        and off_mm(merge, "third") < 0.1
    )
    assert any(
        not missing_facts(notice.text, "third", "first", "picked points")
        for notice in snapshot.notices
    )
    ply = operator.session.exports / f"merged_{merge.name}.ply"
    content = ply.read_bytes()
    assert snapshot.next_undo == f"merge {merge.name}" and operator.undo()
    assert name_of(settled(operator)[1]) == name_of(before) and not ply.exists()
    assert operator.redo() and name_of(settled(operator)[1]) == merge.name
    assert ply.read_bytes() == content
    line = np.outer([0, 1, 2], [10.0, 0, 0]) + MIDDLE
    assert operator.merge(["first", "third"], "first", picked={("third", "first"): (line, line)})
    assert missing_facts(settled(operator)[0].merge_failure, "one line") == []


@pytest.mark.slow
def test_scans_as_they_lie_need_no_search_and_a_ball_holds_nothing(operator: Operator) -> None:
    assert operator.merge(["first", "first"], "second", start="identity")
    merge = settled(operator)[1]
    assert merge is not None and off_mm_between(merge) < 0.1
    assert operator.merge(["ball_0", "ball_1"], "ball_0", start="identity")
    snapshot, after = settled(operator)
    assert after is not None and after.name == merge.name
    assert missing_facts(snapshot.merge_failure, "sphere", "coded markers") == []


def off_mm_between(merge: Stored[Merge]) -> float:
    """How far the middle of the first scan's object lies from where it should on the second."""
    D = np.array(merge.record.pairs["first"].T_reference_scan) @ truth("second")
    return float(np.linalg.norm(D[:3, :3] @ MIDDLE + D[:3, 3] - MIDDLE))


def test_a_merge_of_before_that_kept_less_is_shown() -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", 5, degrees=True).as_matrix()
    pair = {"rms_mm": 0.2, "overlap": 0.8, "T_reference_scan": T.tolist()}
    meta = {"reference": "a", "scans": ["a", "b"], "points": 10, "pairs": {"b": pair}}
    merge = read_record(Merge, meta)
    (shown,) = merge.registered
    assert (shown.scan, shown.onto, shown.sigma_shift_mm, shown.moved_mm) == ("b", "a", None, None)
    assert shown.turned_deg == pytest.approx(5) and merge.loops == [] and merge.shared is None


@pytest.mark.slow
def test_scans_are_aligned_as_they_come_and_merged_from_there(operator: Operator) -> None:
    store = operator.session
    assert store is not None
    chosen = ("first", "ball_0", "second", "third")  # the ball has no place on the object
    for name in chosen:
        assert operator.reconstruct(name)
    assert operator.align(*chosen)
    assert operator.set_align_scans(True)  # nothing that was tried is tried again
    snapshot, _ = settled(operator)
    assert snapshot.session is not None and snapshot.session.aligns_scans
    placed = {
        scan.name: scan.placement for scan in snapshot.session.scans if scan.placement is not None
    }
    assert set(placed) == set(chosen)
    assert missing_facts(placed["first"].summary(), "first") == []
    assert placed["ball_0"].T_first_scan is None
    assert missing_facts(placed["ball_0"].summary(), placed["ball_0"].why) == []
    for name in ("second", "third"):
        T = placed[name].T_first_scan
        assert T is not None and 0.003 < (placed[name].rms_mm or 0) < 0.3
        D = np.array(T) @ np.linalg.inv(truth(name))
        assert 1e-5 < np.linalg.norm(D[:3, :3] @ MIDDLE + D[:3, 3] - MIDDLE) < 0.3
    together = view_places(load_placements(store), {}, store)
    assert together.names == ("first", "second", "third") and 0.6 < together.share_seen_again < 1
    assert 1 == together.seen_by.min() < together.seen_by.max() == 3

    assert operator.merge(NAMES, "first", start="placed")
    _, merge = settled(operator)
    assert merge is not None and max(off_mm(merge, name) for name in NAMES[1:]) < 0.1

    assert operator.undo_alignment("third")
    snapshot, _ = settled(operator)
    assert snapshot.session is not None and snapshot.scan("third").placement is None  # type: ignore[union-attr]
    assert operator.merge(NAMES, "first", start="placed")
    assert missing_facts(settled(operator)[0].merge_failure, "third", "aligned") == []
    assert operator.align("third") and settled(operator)[0].scan("third").placement.onto == "second"  # type: ignore[union-attr]
    assert operator.snapshot().next_undo == "align third" and operator.undo()
    assert settled(operator)[0].scan("third").placement is None  # type: ignore[union-attr]
    assert operator.redo() and settled(operator)[0].scan("third").placement.onto == "second"  # type: ignore[union-attr]
    assert operator.delete("third") and operator.undelete("third")
    assert store.result_names().count("placement/third") == 0
    assert operator.set_align_scans(False)
