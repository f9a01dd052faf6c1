"""The remedies of a wrong exposure and of what no check can see are sentences that can be acted
on."""

import numpy as np
import pytest
from facts import missing_facts

from slviewer.devices.protocols import CameraSettings
from slviewer.devices.simulated import preset_rig
from slviewer.preflight.light import check_exposure
from slviewer.preflight.rig_under_test import RigUnderTest
from slviewer.preflight.screen import check_pixels


@pytest.mark.parametrize(
    ("level", "exposure_ms", "remedy"),
    [
        (255, None, ("exposure", "0.5")),
        (255, 8.0, ("exposure", "8 ms", "4 ms")),
        (25, None, ("exposure", "8.7", "aperture")),
    ],
)
def test_the_remedy_of_an_exposure(
    monkeypatch: pytest.MonkeyPatch,
    level: float,
    exposure_ms: float | None,
    remedy: tuple[str, ...],
) -> None:
    bench = RigUnderTest(preset_rig(scale=0.1), lambda doing: None)
    monkeypatch.setattr(bench.rig.camera, "settings", lambda: CameraSettings(exposure_ms))
    bench.white[:], bench.illuminated[:] = level, True
    assert not missing_facts(check_exposure(bench)[0].remedy, *remedy)


def test_what_cannot_be_seen_of_the_pixels_has_a_remedy() -> None:
    check = check_pixels(RigUnderTest(preset_rig(scale=0.1), lambda doing: None), 0.5)
    assert check.verdict == "unknown" and not missing_facts(check.remedy, "native resolution")
    assert np.isclose(check.figures["middle_grey"], 0.5)
