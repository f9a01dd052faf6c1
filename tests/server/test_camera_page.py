"""The camera page in a real browser, whose camera films what a simulated projector shows."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from chromium import launched
from clocks import HANG_S, until
from facts import missing_facts
from playwright.sync_api import Browser, Page, expect

from slviewer.devices.browser import BrowserCamera, CameraChannel, PageChannels
from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.devices.simulated import SimulatedCamera, SimulatedProjector, simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import DeviceError
from slviewer.pipeline.capture import capture
from slviewer.pipeline.reconstruct import reconstruct
from slviewer.pipeline.rig_choice import RigSetup
from slviewer.server.device_pages import serve_device_pages
from slviewer.server.secure import SafeServer, Serving, serve
from slviewer.simulation.rig import letter
from tests.rendered_calibration import true_calibration

SCALE = 0.25
SIZE = (400, 300)
BLACK, RANGE = 16, 219
"""Of the luminance of a video (ITU-R BT.601)."""


class Film:
    """A video file of one picture, which the browser plays as its camera; the picture may be
    replaced while it runs."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.show(np.full(SIZE[::-1], 90, np.uint8))

    def show(self, grey: np.ndarray) -> None:
        """Replace the picture (h, w) in place."""
        luminance = np.rint(BLACK + grey.astype(float) * RANGE / 255).astype(np.uint8)
        colour = np.full(SIZE[0] * SIZE[1] // 2, 128, np.uint8)
        header = f"YUV4MPEG2 W{SIZE[0]} H{SIZE[1]} F30:1 Ip A1:1 C420jpeg\nFRAME\n".encode()
        data = header + luminance.tobytes() + colour.tobytes()
        with self.path.open("r+b" if self.path.exists() else "wb") as file:
            file.write(data)


class FilmedProjector(SimulatedProjector):
    """The simulated projector, filmed by the simulated camera."""

    def __init__(self, world: SimulatedWorld, film: Film) -> None:
        super().__init__(world)
        self._eye, self._film = SimulatedCamera(world), film

    def open(self) -> None:
        self._eye.open()
        super().open()

    def close(self) -> None:
        super().close()
        self._eye.close()

    def show(self, index: int) -> None:
        super().show(index)
        self._take()

    def show_level(self, grey: int | None) -> None:
        super().show_level(grey)
        self._take()

    def _take(self) -> None:
        grey = np.empty(SIZE[::-1], np.uint8)
        self._eye.grab(grey)
        self._film.show(grey)


Opens = Callable[..., Page]


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Film:
    return Film(tmp_path_factory.mktemp("film") / "film.y4m")


@pytest.fixture(scope="module")
def phone(browser: Browser, film: Film) -> Iterator[Browser]:
    flags = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
    found = launched(browser.browser_type, *flags, f"--use-file-for-fake-video-capture={film.path}")
    yield found
    found.close()


@pytest.fixture
def channel(server: SafeServer) -> Iterator[CameraChannel]:
    # a film does not change by itself
    pages = PageChannels(camera=CameraChannel(HANG_S, settling_ms=0.0))
    serve_device_pages(server, pages)
    yield pages.camera
    server.device_pages.clear()


@pytest.fixture
def opens(server: SafeServer) -> Iterator[Opens]:
    """Opens the camera page in a browser."""
    contexts = []

    def opened(phone: Browser) -> Page:
        contexts.append(phone.new_context(viewport={"width": 390, "height": 844}))
        page = contexts[-1].new_page()
        page.goto(server.link("camera"))
        page.wait_for_url("**/camera-*/")  # the token does not stay in the address
        return page

    yield opened
    for context in contexts:
        context.close()


def test_pictures_are_those_after_the_request(phone, film, opens, channel):
    page = opens(phone)
    assert channel.wait_ready(HANG_S).size == SIZE, channel.page_state()
    expect(page.get_by_role("heading", name="Ready")).to_be_visible()
    camera = BrowserCamera(page=channel)
    camera.open()
    expect(page.get_by_role("heading", name="In use")).to_be_visible()
    rng, out = np.random.default_rng(0), np.empty(SIZE[::-1], np.uint8)
    off = []
    for _ in range(5):
        grey = rng.integers(0, 256, SIZE[::-1], np.uint8)
        film.show(grey)
        camera.grab(out)
        off.append(out.astype(int) - grey)
    assert np.abs(off).max() <= 2 and 0.1 < np.std(off) < 1.0, (
        "the luminance of a video has 219 levels"
    )
    colour = camera.grab_colour()
    assert (
        colour.shape == (*SIZE[::-1], 3) and np.abs(colour.astype(int) - grey[..., None]).max() <= 3
    )
    assert any("exposure" in note for note in camera.notes), (
        "this camera reports no exposure that could be locked"
    )
    assert camera.apply(CameraSettings(5.0)) == CameraSettings()
    camera.close()
    expect(page.get_by_role("heading", name="Ready")).to_be_visible()


def test_a_page_that_is_closed_is_missed(phone, opens, channel):
    page = opens(phone)
    assert channel.wait_ready(HANG_S).state == "ready"
    camera = BrowserCamera(page=channel)
    camera.open()
    page.close()
    errors: list[str] = []

    def fails() -> bool:
        try:
            camera.grab(np.empty(SIZE[::-1], np.uint8))
        except DeviceError as error:
            errors.append(str(error))
        return bool(errors)

    assert until(fails)
    assert not missing_facts(errors[0], "connection", "lost") or not missing_facts(
        errors[0], "hidden"
    )


def test_a_browser_without_permission_says_so(browser, opens, channel):
    page = opens(browser)  # without a camera
    expect(page.get_by_role("heading", name="cannot be used yet")).to_be_visible()
    state = channel.page_state()
    assert state.state == "refused" and not missing_facts(state.words, "camera")


@pytest.mark.computes
def test_a_scan_by_a_phone_measures_the_plane(phone, film, opens, channel, tmp_path):
    """From the page's pictures to a cloud, with the calibration of the true lenses."""
    true_calibration(tmp_path / "session", letter(SCALE))
    opens(phone)
    assert channel.wait_ready(HANG_S).state == "ready"
    world = SimulatedWorld(letter(SCALE))
    world.place("plane")

    rigs = {"phone": Rig("phone", BrowserCamera(page=channel), FilmedProjector(world, film))}
    rigs["simulated"] = simulated_rig(world)
    normal, origin = world.pose.R[:, 2], world.pose.t
    rms_mm = {}
    for name, rig in rigs.items():
        made = RigSetup(rig)
        capture(
            tmp_path / "session",
            name,
            {},
            role="scan",
            patterns="gray",
            set_up=lambda *_, made=made: made,
        )
        found = reconstruct(
            tmp_path / "session", name, out=tmp_path / "cloud.ply", grid=tmp_path / "grid.npy"
        )
        off = (np.load(tmp_path / "grid.npy") - origin) @ normal
        rms_mm[name] = 1.4826 * np.nanmedian(np.abs(off))
        assert (
            found.only.points > 0.8 * world.renderer(False).truth().mask.sum()
            and abs(np.nanmedian(off)) < 0.05
        )
    assert 0.3 < rms_mm["simulated"] < 0.8, "mm, of 4 steps at a quarter of the resolution"
    assert 0.97 < rms_mm["phone"] / rms_mm["simulated"] < 1.2, rms_mm


def test_the_page_works_encrypted_by_the_certificate_made_here(phone, film, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    server, pages = (
        serve(Serving(port=0, tls=True)),
        PageChannels(camera=CameraChannel(HANG_S, settling_ms=0.0)),
    )
    serve_device_pages(server, pages)
    # as a person who has compared the fingerprint
    context = phone.new_context(ignore_https_errors=True)
    try:
        context.new_page().goto(server.link("camera"))
        assert (
            server.link("camera").startswith("https:")
            and pages.camera.wait_ready(HANG_S).size == SIZE
        )
        camera, out = BrowserCamera(page=pages.camera), np.empty(SIZE[::-1], np.uint8)
        camera.open()
        film.show(np.full(SIZE[::-1], 200, np.uint8))
        camera.grab(out)
        camera.close()
        assert np.abs(out.astype(int) - 200).max() <= 2
    finally:
        context.close()
        server.stop()
