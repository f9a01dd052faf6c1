"""Devices as people have them, driven by the wizard: a camera on the network looks at the projector
page."""

import re
import sys
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts
from playwright.sync_api import Browser, Page, expect
from wizard_page import CALM, PATIENCE_S, Opened, choose, click, new_page

from slviewer.devices.browser import PageChannels
from slviewer.fringe.decode import decode
from slviewer.gui.app import App
from slviewer.pipeline.rig_choice import set_up
from slviewer.server.secure import Serving
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import Snapshot

sys.path.insert(0, str(Path(__file__).parents[1] / "devices"))
from mjpeg import NetworkCamera, network_camera

SCREEN = (320, 240)


def look(page: Page, camera: NetworkCamera) -> None:
    """Let the camera see the page as it is now, neither black nor white, as under a lamp."""
    seen = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    camera.take((0.8 * seen + 10).astype(np.uint8))


def watch(operator: Operator, page: Page, camera: NetworkCamera, until: str, condition) -> Snapshot:
    """Look until the snapshot fulfils the condition."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        look(page, camera)
        snapshot = operator.snapshot()
        if condition(snapshot):
            return snapshot
    raise AssertionError(f"no {until}: {[n.text for n in operator.snapshot().notices]}")


@pytest.mark.slow
def test_network_camera_captures_projector_page(browser: Browser, tmp_path: Path) -> None:
    pages = PageChannels()
    with (
        network_camera(np.full((SCREEN[1], SCREEN[0], 3), 40, np.uint8)) as camera,
        Operator(
            tmp_path / "session", set_up=partial(set_up, pages=pages), timing=CALM
        ) as operator,
    ):
        app = App(operator, Serving(port=0), pages=pages)
        page = new_page(browser)
        projector = new_page(browser, {"width": SCREEN[0], "height": SCREEN[1]})
        opened = Opened(page)
        try:
            page.goto(app.server.link())
            click(page, "1. Rig")
            choose(page, "Rig", "Custom …")
            expect(page.get_by_text("Projector page: waiting for the page")).to_be_visible()
            content = page.content()  # whoever only watches reads this too
            grants = app.server.access.grants.values()
            assert not [
                grant
                for grant in grants
                if any(one in content for one in (grant.token, grant.value))
            ]
            projector.goto(app.server.link("project"))
            expect(page.get_by_text("Projector page: ready 320 x 240")).to_be_visible()
            opened.enter("Camera ID", camera.url)
            click(page, "Use these devices")
            watch(operator, projector, camera, "open rig", lambda s: s.rig.state == "open")
            expect(
                page.get_by_text(re.compile(r"camera 320\s×\s240\spx, projector 320\s×\s240\spx"))
            ).to_be_visible()
            expect(page.get_by_text("cannot be set from here")).to_be_visible()

            operator.choose_target("circles:7x5:10")
            operator.choose_patterns("complementary")
            operator.capture_pose()
            watch(
                operator,
                projector,
                camera,
                "capture",
                lambda s: bool(s.session and s.session.poses),
            )
            coordinates(tmp_path / "session")

            operator.capture_pose()
            watch(
                operator,
                projector,
                camera,
                "frame",
                lambda s: s.rig.capture is not None and s.rig.capture.frame > 3,
            )
            projector.reload()
            lost = watch(
                operator,
                projector,
                camera,
                "fault",
                lambda s: any(n.level == "error" for n in s.notices),
            )
            (fault,) = (n for n in lost.notices if n.level == "error")
            assert missing_facts(fault.text, "discarded") == []
            watch(operator, projector, camera, "open rig", lambda s: s.rig.state == "open")
            session = operator.snapshot().session
            assert session is not None and [pose.name for pose in session.poses] == ["pose_01"]
            assert opened.errors == []
        finally:
            projector.context.close()
            page.context.close()
            app.close()


def coordinates(folder: Path) -> None:
    """The camera looks straight at the screen, so that each pixel must read its own column and
    row."""
    capture = Session.open(folder).load_capture("pose_01")
    truth = np.meshgrid(np.arange(SCREEN[0]), np.arange(SCREEN[1]))
    for axis, own in zip(("x", "y"), truth, strict=True):
        found = decode(capture.sequence, capture.frames, axis)  # type: ignore[arg-type]
        off = found.coordinate - own
        assert np.mean(np.abs(off) < 0.5) >= 0.999  # NaN counts as wrong
        assert 0.0005 < np.sqrt(np.nanmean(off**2)) < 0.1 and abs(np.nanmean(off)) < 0.02
    assert capture.texture is not None and capture.texture.shape == (*SCREEN[::-1], 3)
