"""Region and edits as an operator requests them: granted, or refused with a notice."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts
from wizard_events import HANG_S

from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.pipeline.capture import capture
from slviewer.pipeline.edit import Selection
from slviewer.pipeline.merge import merge
from slviewer.pipeline.rig_choice import RigSetup
from slviewer.simulation.rig import letter
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.surface.selection import SupportPlane
from slviewer.wizard.operator import Operator
from slviewer.wizard.result_views import whole_cloud
from slviewer.wizard.snapshot import SessionView
from tests.rendered_calibration import true_calibration

pytestmark = pytest.mark.computes

FAR = RegionOfInterest((0.0, 0.0, 9000.0), (10.0, 10.0, 10.0))


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose calibration is the truth, with two scans, of which the first is
    reconstructed."""
    folder, rig = tmp_path_factory.mktemp("captured") / "session", letter(0.2)
    true_calibration(folder, rig)
    world = SimulatedWorld(rig)
    world.place("object")
    for name in ("one", "two"):
        capture(
            folder,
            name,
            {},
            role="scan",
            patterns="gray",
            set_up=lambda *_: RigSetup(simulated_rig(world)),
        )
    with Operator(folder) as engine:
        engine.reconstruct("one")
        engine.wait_until_idle(HANG_S)
    return folder


@pytest.fixture
def operator(captured: Path, tmp_path: Path) -> Iterator[Operator]:
    """Over a copy of the captured session."""
    shutil.copytree(captured, tmp_path / "session")
    with Operator(tmp_path / "session") as engine:
        engine.wait_until_idle(HANG_S)
        yield engine


def view(operator: Operator) -> SessionView:
    session = operator.wait_until_idle(HANG_S).session
    assert session is not None
    return session


@pytest.mark.slow
def test_edits_and_region_change_what_is_measured_and_merged(operator: Operator) -> None:
    store = operator.session
    assert store is not None
    merge(store, ["two"], "one", start="identity")
    points = whole_cloud(store, "one").points
    total = int(np.isfinite(points[..., 2]).sum())
    nearer = points[..., 2] < np.nanmedian(points[..., 2])
    assert operator.delete_points([Selection("one", points, nearer)], "the nearer half")
    session = view(operator)
    assert session.merge is not None and session.merge.stale
    assert len(session.scans[0].edits) == 1 and session.scans[0].cloud == "fresh"
    on = operator.surface("one")
    assert 0.45 * total < on.measured.sum() < 0.55 * total
    assert operator.undo_edit("one")
    session = view(operator)
    assert session.scans[0].undone_edits == 1 and not session.scans[0].edits
    assert session.merge is not None and not session.merge.stale
    assert operator.surface("one").measured.sum() == total
    plane = SupportPlane((0.0, 0.0, -1.0), -float(np.nanmedian(points[..., 2])), 0.0)
    assert operator.delete_points(
        [Selection("one", points, plane.select_below(points), plane)], "support"
    )
    assert operator.surface("one").measured.sum() < 0.6 * total
    assert operator.undo_edit("one") and not operator.undo_edit("one") and operator.redo_edit("one")
    assert operator.fit_region("one") and operator.switch_region(False)
    session = view(operator)
    assert session.region is not None and not session.region_is_on


@pytest.mark.slow
def test_what_leaves_nothing_is_refused_with_numbers(operator: Operator) -> None:
    store = operator.session
    assert store is not None
    points = whole_cloud(store, "one").points
    everything = np.ones(points.shape[:2], bool)
    assert not operator.switch_region(True)
    assert not operator.delete_points([Selection("one", points, everything)], "everything")
    assert not operator.delete_points([Selection("one", points, ~everything)], "nothing")
    assert not operator.redo_edit("one")
    assert operator.set_region(FAR)
    operator.reconstruct("two")
    session = view(operator)
    assert session.scans[1].cloud == "absent"
    assert any(
        not missing_facts(notice.text, "two", "region", "9000.0") for notice in operator.notices()
    )
    assert operator.switch_region(False)
    operator.reconstruct("two")
    assert view(operator).scans[1].cloud == "fresh"


def test_edits_of_several_scans_are_made_and_undone_together(operator: Operator) -> None:
    operator.reconstruct("two")
    view(operator)
    store = operator.session
    assert store is not None

    def counts() -> list[tuple[int, int]]:
        return [(len(scan.edits), scan.undone_edits) for scan in view(operator).scans]

    clouds = {name: whole_cloud(store, name).points for name in ("one", "two")}
    halves = {
        name: points[..., 0] < np.nanmedian(points[..., 0]) for name, points in clouds.items()
    }
    assert operator.delete_points(
        [Selection(name, clouds[name], halves[name]) for name in clouds], "left"
    )
    upper = clouds["two"][..., 1] < np.nanmedian(clouds["two"][..., 1])
    nothing = np.zeros_like(upper)
    assert operator.delete_points(
        [Selection("one", clouds["one"], nothing), Selection("two", clouds["two"], upper)], "up"
    )
    assert counts() == [(1, 0), (2, 0)]
    assert operator.undo_edit("one", "two") and counts() == [(1, 0), (1, 1)]
    assert operator.undo_edit("one", "two") and counts() == [(0, 1), (0, 2)]
    assert not operator.undo_edit("one", "two")
    assert operator.redo_edit("one", "two") and counts() == [(1, 0), (1, 1)]
    assert operator.redo_edit("one", "two") and counts() == [(1, 0), (2, 0)]
    everything = np.ones_like(upper)
    selections = [
        Selection("one", clouds["one"], upper),
        Selection("two", clouds["two"], everything),
    ]
    assert not operator.delete_points(selections, "too much") and counts() == [(1, 0), (2, 0)]


def test_all_pending_scans_are_reconstructed_and_one_that_cannot_be_is_named(
    captured: Path, tmp_path: Path
) -> None:
    shutil.copytree(captured, tmp_path / "session")
    captures = tmp_path / "session" / "captures"
    shutil.copytree(captures / "one", captures / "three")
    for chunk in (captures / "two" / "frames.zarr").glob("c.*"):
        chunk.write_bytes(b"damaged")
    with Operator(tmp_path / "session") as operator:
        before = operator.wait_until_idle(HANG_S)
        assert before.content.pending_scans == ("three", "two")
        assert operator.reconstruct_all()
        after = operator.wait_until_idle(HANG_S)
        assert after.content.pending_scans == ("two",)
        assert any("two" in each.text and each.level == "warning" for each in after.notices)
        assert any("1 of 2" in each.text for each in after.notices)
