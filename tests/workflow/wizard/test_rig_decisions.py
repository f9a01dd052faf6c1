"""What the operator decides of a rig: several exposures, a name, and what its choice says of its camera."""

from pathlib import Path

import pytest
from test_operator import TARGET, last, opened, states

from slviewer.workflow.rig_presets import load_rig
from slviewer.workflow.wizard.operator import Operator

RIG = {"driver": "simulated", "scale": 0.25, "seed": 0, "exposure_ms": 0.8}


@pytest.fixture
def operator(tmp_path: Path):
    with Operator(tmp_path / "session", RIG) as operator:
        operator.choose_target(TARGET)
        opened(operator)
        yield operator


def test_poses_in_several_exposures_are_judged_as_others_are(operator: Operator) -> None:
    once = operator.settle()
    assert once.rig.exposure_ms == 0.8 and once.session is not None and once.session.exposures_ms == ()
    assert operator.set_exposures((4.0, 0.5))
    before = operator.settle()
    assert before.session is not None and before.session.exposures_ms == (0.5, 4.0)
    assert before.space is not None and once.space is not None and once.space.capture_bytes is not None
    assert before.space.capture_bytes == 2 * once.space.capture_bytes
    assert operator.capture_pose()
    after = operator.settle()
    assert states(after) == {"pose_01": "good"} and after.session is not None and after.session.poses[0].thumbnail
    assert operator.session is not None and operator.session.load_capture("pose_01").exposures_ms == (0.5, 4.0)
    assert operator.settle().rig.exposure_ms == 0.8
    assert operator.set_exposures((4.0, 4.0)) is False and "each once" in last(operator.settle())
    assert operator.set_exposures(())
    assert operator.capture_pose()
    operator.settle()
    assert operator.session.load_capture("pose_02").exposures_ms == ()


def test_a_rig_is_kept_under_a_name_with_its_exposure(operator: Operator) -> None:
    assert operator.set_exposure(2.5)
    assert operator.wait_for(lambda s: s.rig.exposure_ms == 2.5, 5.0)
    assert operator.set_exposures((1.0, 8.0))
    assert operator.save_rig("mine", "With a longer exposure.")
    assert operator.session is not None
    assert load_rig("mine", operator.session) == {**RIG, "exposure_ms": 2.5, "gain": 1.0}
    assert operator.save_rig("../mine") is False and "cannot be a name" in last(operator.settle())
    assert operator.choose_rig({**RIG, "exposure_ms": 1.5})
    now = operator.wait_for(lambda s: s.rig.exposure_ms == 1.5, 5.0)
    assert now is not None and now.session is not None and now.session.exposures_ms == ()
