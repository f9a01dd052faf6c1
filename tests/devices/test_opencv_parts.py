"""A webcam's controls, and the rhythm by which old pictures are known, without a webcam.

The pictures are real, of a camera of the network; only what a webcam says of its controls is made
up here.
"""

import cv2
import numpy as np
import pytest
from facts import missing_facts
from mjpeg import network_camera

from slviewer.devices import opencv as opencv_module
from slviewer.devices.opencv import (
    OpenCVCamera,
    connect_source,
    dialect_of,
    disable_automatics,
    exposure_ms,
    set_exposure,
)
from slviewer.devices.opencv_reader import Connected, Pace, StreamTiming
from slviewer.devices.protocols import CameraSettings

SIZE = (160, 120)
FPS = 200.0
"""Of a picture that does not change."""
QUICK = StreamTiming(warm_up_s=0.0)


class Webcam:
    """A capture with controls {property: value}, of which `stubborn` ones keep their values;
    exposures end at 500."""

    def __init__(self, capture, backend, controls, stubborn=()):
        self._capture, self._backend, self.controls, self._stubborn = (
            capture,
            backend,
            controls,
            stubborn,
        )

    def __getattr__(self, name):
        return getattr(self._capture, name)

    def getBackendName(self):
        return self._backend

    def get(self, control):
        return self.controls.get(control, -1.0)

    def set(self, control, value):
        if control not in self.controls:
            return False
        if control not in self._stubborn:
            self.controls[control] = min(float(round(value)), 500.0)
        return True


V4L2 = {
    cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
    cv2.CAP_PROP_EXPOSURE: 156.0,
    cv2.CAP_PROP_GAIN: 64.0,
    cv2.CAP_PROP_AUTOFOCUS: 1.0,
    cv2.CAP_PROP_FOCUS: 0.0,
    cv2.CAP_PROP_AUTO_WB: 1.0,
}


def test_exposures_are_told_in_milliseconds_whatever_the_camera_counts_in():
    for backend, raw, ms, asked, taken in (
        ("V4L2", 156, 15.6, 8.333, 8.3),
        ("DSHOW", -6, 15.625, 8.0, 7.8125),
        ("MSMF", -7, 7.8125, 31.0, 31.25),
    ):
        webcam = Webcam(None, backend, {cv2.CAP_PROP_EXPOSURE: float(raw)})
        words = dialect_of(webcam)
        assert exposure_ms(webcam, words) == pytest.approx(ms)
        said = set_exposure(webcam, words, asked)
        assert exposure_ms(webcam, words) == pytest.approx(taken)
        assert bool(said) == (abs(taken - asked) > 0.01 * asked)
    assert dialect_of(Webcam(None, "AVFOUNDATION", {})) is None
    bare = Webcam(None, "V4L2", {})
    assert exposure_ms(bare, dialect_of(bare)) is None
    assert not missing_facts(set_exposure(bare, dialect_of(bare), 5.0), "exposure")
    assert disable_automatics(bare, dialect_of(bare)) == {}


def test_windows_is_told_the_values_it_has_so_that_they_stay():
    written = []

    class Windows(Webcam):
        def set(self, control, value):
            written.append((control, value))
            return control != cv2.CAP_PROP_FOCUS

    webcam = Windows(None, "DSHOW", {cv2.CAP_PROP_EXPOSURE: -6.0, cv2.CAP_PROP_FOCUS: 20.0})
    said = disable_automatics(webcam, dialect_of(webcam))
    assert written == [(cv2.CAP_PROP_EXPOSURE, -6.0), (cv2.CAP_PROP_FOCUS, 20.0)]
    assert list(said) == ["automatic focus"]


@pytest.fixture
def plugged(monkeypatch):
    """`plugged(controls, stubborn)`: what opens next is such a webcam."""
    with network_camera(np.full((120, 160), 90, np.uint8), FPS) as seen:

        def plug(controls, stubborn=()):
            def instead(source, size, timing):
                return Connected(
                    Webcam(connect_source(seen.url, None).capture, "V4L2", controls, stubborn),
                    live=True,
                )

            monkeypatch.setattr(opencv_module, "connect_source", instead)

        yield plug


def test_a_webcam_is_set_and_read_back_and_its_automatics_are_switched_off(plugged):
    controls = dict(V4L2)
    plugged(controls)
    camera = OpenCVCamera(0, SIZE, exposure_ms=20.0, gain=32, focus=40, timing=QUICK)
    camera.open()
    try:
        assert camera.notes == () and camera.settings() == CameraSettings(20.0)
        assert controls == {
            cv2.CAP_PROP_AUTO_EXPOSURE: 1.0,
            cv2.CAP_PROP_EXPOSURE: 200.0,
            cv2.CAP_PROP_GAIN: 32.0,
            cv2.CAP_PROP_AUTOFOCUS: 0.0,
            cv2.CAP_PROP_FOCUS: 40.0,
            cv2.CAP_PROP_AUTO_WB: 0.0,
        }
        assert camera.read_lens() == {"focus": 40.0}
        assert camera.apply(CameraSettings(12.5)) == CameraSettings(12.5) and camera.notes == ()
        assert camera.apply(CameraSettings(80.0)) == CameraSettings(50.0)
        (note,) = camera.notes
        assert not missing_facts(note, "camera 0", "exposure", "50 ms", "80 ms")
        camera.apply(CameraSettings(30.0, gain=2.0))
        (note,) = camera.notes
        assert not missing_facts(note, "gain", "units")
        out = np.zeros((120, 160), np.uint8)
        camera.grab(out)
        assert abs(out.astype(int) - 90).max() < 3
    finally:
        camera.close()


def test_what_a_webcam_ignores_is_said(plugged):
    plugged(
        dict(V4L2), stubborn=(cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_FOCUS, cv2.CAP_PROP_EXPOSURE)
    )
    camera = OpenCVCamera(0, SIZE, exposure_ms=5.0, focus=40, white_balance=4600, timing=QUICK)
    camera.open()
    try:
        said = "; ".join(camera.notes)
        facts = ("automatic exposure", "15.6 ms", "5 ms", "focus", "40", "white balance")
        assert not missing_facts(said, *facts)
        assert camera.settings() == CameraSettings(15.6)
    finally:
        camera.close()


def test_a_camera_without_colour_is_read_as_it_is(monkeypatch):
    with network_camera(np.full((120, 160), 90, np.uint8), FPS) as seen:

        class Grey(Webcam):
            def retrieve(self):
                read, image = self._capture.retrieve()
                return read, image[..., 0].copy()

        monkeypatch.setattr(
            opencv_module,
            "connect_source",
            lambda *_: Connected(
                Grey(connect_source(seen.url, None).capture, "V4L2", {}), live=True
            ),
        )
        camera = OpenCVCamera(0, SIZE, timing=QUICK)
        camera.open()
        try:
            out = np.zeros((120, 160), np.uint8)
            camera.grab(out)
            assert abs(out.astype(int) - 90).max() < 3 and camera.grab_colour().shape == (
                120,
                160,
                3,
            )
        finally:
            camera.close()


def rhythm(times: list[float], busy: float = 0.0) -> tuple[list[float | None], Pace]:
    """What `Pace` says of arrivals at `times`, while the reader computes for a share `busy` of
    them."""
    pace = Pace()
    return [pace.add(now, busy * now) for now in times], pace


def test_a_flood_after_a_pause_does_not_look_like_a_rhythm():
    steady = [k / 30 for k in range(60)]
    # what 3 s of 30 pictures have left in the buffers
    flood = [steady[-1] + 3 + k / 500 for k in range(90)]
    after = [flood[-1] + (k + 1) / 30 for k in range(30)]
    periods, _ = rhythm(steady + flood + after)
    assert periods[:3] == [None] * 3
    np.testing.assert_allclose(periods[3:60], 1, atol=1e-6)
    assert periods[60] > 2 and max(periods[61:150]) < 0.5
    assert min(periods[150:]) > 0.5


def test_of_a_clump_only_the_first_counts():
    times = [0.1 * clump + 0.001 * k for clump in range(40) for k in range(3)]
    periods, _ = rhythm(times)
    counted = [p > 0.5 for p in periods[6:]]
    assert counted == [True, False, False] * (len(counted) // 3)


def test_a_source_that_becomes_faster_counts_again_within_seconds():
    slow = [k / 10 for k in range(40)]
    fast = [slow[-1] + (k + 1) / 30 for k in range(200)]
    periods, _ = rhythm(slow + fast)
    counting = next(k for k, p in enumerate(periods[40:]) if p > 0.5)
    assert counting / 30 < 4


def test_a_reader_that_never_waits_knows_it():
    times = [k / 30 for k in range(120)]
    assert rhythm(times, busy=0.99)[1].saturated
    assert not rhythm(times, busy=0.6)[1].saturated
    assert not rhythm(times[:30], busy=0.99)[1].saturated
