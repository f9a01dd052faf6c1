"""Motion is reported where it can be seen, and nothing is claimed where it cannot."""

import numpy as np
import pytest
from facts import missing_facts

from slviewer.devices.simulated import preset_rig
from slviewer.pipeline.examination import Check
from slviewer.preflight.light import Burst
from slviewer.preflight.rig_under_test import RigUnderTest
from slviewer.preflight.stillness import check_motion


def check(scene: np.ndarray, last: np.ndarray | None = None, noise: float = 0.8) -> Check:
    """Check white images of a scene (h, w), the last of which shows another one."""
    rng = np.random.default_rng(0)
    bench = RigUnderTest(preset_rig(scale=0.1), lambda doing: None)

    def grab(scene: np.ndarray) -> np.ndarray:
        return np.rint(scene + rng.normal(0, noise, scene.shape)).astype(np.float32)

    bench.white, bench.illuminated = grab(scene), np.ones(scene.shape, bool)
    white = np.stack([grab(scene) for _ in range(6)])
    times = np.arange(6.0)
    return check_motion(
        bench, Burst(white, 0 * white, times, times), grab(scene if last is None else last)
    )


EVEN = np.full((120, 160), 180.0)
PRINTED = EVEN.copy()
PRINTED[40:80, 40:120] = 60


@pytest.mark.parametrize("noise", [0.0, 0.8])
def test_a_scene_without_contrast_proves_nothing(noise: float) -> None:
    shaded = EVEN + np.linspace(-30, 30, 160)
    for scene in (EVEN, shaded):
        motion = check(scene, noise=noise)
        assert motion.verdict == "unknown" and not missing_facts(motion.observation, "contrast")
        assert not missing_facts(motion.remedy, "board")


def test_what_can_be_seen_is_judged() -> None:
    assert check(PRINTED).verdict == "good"
    assert check(PRINTED, np.roll(PRINTED, 6, axis=1)).verdict == "warning"
    assert check(EVEN, PRINTED).verdict == "bad"  # something came into view
