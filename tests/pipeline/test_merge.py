"""What `merge` is told of where scans lie, before it computes anything; the whole way is in
test_commands."""

from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts, raises
from operations import merged

from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import InputError, UsageError
from slviewer.geometry.rigid import move_points, rigid_transform
from slviewer.pipeline.capture import capture
from slviewer.pipeline.merge import merge
from slviewer.pipeline.rig_choice import RigSetup
from slviewer.records.merge import Merge
from slviewer.registration.refusal import Refused
from slviewer.simulation.boards import Pose
from slviewer.simulation.plans import rotation
from slviewer.simulation.rig import letter
from tests.rendered_calibration import true_calibration


@pytest.mark.process  # which Open3D starts while it is imported
def test_starts_that_do_not_fit_together_are_refused_at_once(tmp_path) -> None:
    out = tmp_path / "merged.ply"
    with raises(UsageError, "angle"):
        merge(tmp_path / "nowhere", ["a"], "b", out=out, angle=30.0)
    points = np.eye(3)
    with raises(UsageError, "c"):
        merge(tmp_path / "nowhere", ["a"], "b", out=out, picked={("a", "c"): (points, points)})
    with raises(Refused, "line"):
        line = np.outer([0, 1, 2], [1.0, 0, 0])
        merge(tmp_path / "nowhere", ["a"], "b", out=out, picked={("a", "b"): (line, line)})
    with raises(UsageError, "b"):
        merge(tmp_path / "nowhere", ["b"], "b", out=out)
    with raises(UsageError, ".ply", "merged.stl"):
        merge(tmp_path / "nowhere", ["a"], "b", out=out.with_suffix(".stl"))


@pytest.mark.slow
@pytest.mark.computes
def test_a_plate_is_merged_by_its_markers(tmp_path: Path) -> None:
    """Two scans of the simulated rig's marked plate, which slides on itself without them."""
    session = tmp_path / "session"
    rig = letter(0.5, local_distortion_px=0.0)  # which the stereo model would leave in the shape
    true_calibration(session, rig)
    world = SimulatedWorld(rig)
    poses = [
        Pose(rotation(np.radians(turns)), np.array(place))
        for turns, place in (
            ((4.0, -6.0, 2.0), (0.0, 0.0, 620.0)),
            ((-5.0, 8.0, 16.0), (6.0, -4.0, 640.0)),
        )
    ]
    for name, pose in zip(("one", "two"), poses, strict=True):
        world.place("marked", pose)
        bench = RigSetup(simulated_rig(world))
        capture(
            session,
            name,
            {},
            role="scan",
            patterns="complementary",
            set_up=lambda *_, bench=bench: bench,
        )
    with raises(Refused, "markers"):
        merge(session, ["two"], "one")
    made = merged(session, ["two"], "one", start="markers")
    T = [rigid_transform(pose.R, pose.t) for pose in poses]
    points = made.clouds["two"].measured[::50].astype(float)
    gap = move_points(np.array(made.record.pairs["two"].T_reference_scan), points)
    gap -= move_points(T[0] @ np.linalg.inv(T[1]), points)
    assert 0.001 < np.linalg.norm(gap, axis=1).max() < 0.08
    (pair,) = made.record.markers
    assert pair.ids == [0, 1, 2, 3, 4, 5] and pair.moved == [] and 0.001 < pair.rms_mm < 0.05
    assert made.record.pairs["two"].start == "markers" and (pair.scan, pair.onto) == ("two", "one")
    table, *_ = Merge.tables({"1": made.record})
    (row,) = table.rows
    assert (
        dict(zip([c.heading for c in table.columns], table.values(row), strict=True))[
            "common markers"
        ]
        == 6
    )


@pytest.mark.slow
@pytest.mark.computes
def test_scans_without_markers_are_refused_with_what_to_do(tmp_path: Path) -> None:
    session = tmp_path / "session"
    true_calibration(session, letter(0.25))
    world = SimulatedWorld(letter(0.25))
    for name, depth in (("one", 600.0), ("two", 640.0)):
        world.place("plane")
        world.move(distance_mm=depth)
        bench = RigSetup(simulated_rig(world))
        capture(
            session, name, {}, role="scan", patterns="gray", set_up=lambda *_, bench=bench: bench
        )
    warnings: list[str] = []
    with raises(InputError, "slviewer target markers"):
        merged(session, ["two"], "one", start="markers", warn=warnings.append)
    assert any(not missing_facts(warning, "one", "marker") for warning in warnings)


@pytest.mark.computes
@pytest.mark.slow
def test_the_mat_on_a_turntable_gives_its_axis(tmp_path: Path) -> None:
    """A plate with markers, turned in steps that are stated 1 degree too small."""
    session = tmp_path / "session"
    rig = letter(0.5, local_distortion_px=0.0)
    true_calibration(session, rig)
    world = SimulatedWorld(rig)
    world.place("marked")
    names, poses = ["one", "two", "three"], []
    for k, name in enumerate(names):
        world.turn_table(12.0 * (k - 1))
        poses.append(rigid_transform(world.pose.R, world.pose.t))
        bench = RigSetup(simulated_rig(world))
        capture(
            session,
            name,
            {},
            role="scan",
            patterns="complementary",
            set_up=lambda *_, bench=bench: bench,
        )
    made = merged(session, names, "one", start="turntable", angle=11.0, out=tmp_path / "merged.ply")
    for k, name in enumerate(names[1:], 1):
        points = made.clouds[name].measured[::50].astype(float)
        gap = move_points(np.array(made.record.pairs[name].T_reference_scan), points)
        gap -= move_points(poses[0] @ np.linalg.inv(poses[k]), points)
        assert 0.001 < np.linalg.norm(gap, axis=1).max() < 0.1
    warnings: list[str] = []
    with raises(Refused):
        merged(
            session,
            names,
            "one",
            start="turntable",
            angle=30.0,
            out=tmp_path / "m.ply",
            warn=warnings.append,
        )
    assert any(not missing_facts(warning, "markers", "18.0 degrees") for warning in warnings)
