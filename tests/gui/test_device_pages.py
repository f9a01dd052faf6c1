"""The pages of projector and camera beside the wizard."""

import base64
from functools import partial

import cv2
import msgspec
import numpy as np
import pytest
from playwright.sync_api import Browser, expect
from wizard_page import CALM, PATIENCE_S, choose, click, new_page

from slviewer.devices.browser import BrowserProjector, PageChannels, ProjectorChannel, Video
from slviewer.fringe.presets import gray
from slviewer.gui.app import App
from slviewer.gui.shell import encode_qr_code
from slviewer.pipeline.rig_choice import set_up
from slviewer.server.secure import Serving
from slviewer.wizard.operator import Operator

VIDEO = Video((1920, 1080), "", "Back camera", (), 10.0, True)


def test_wizard_serves_projector_page(browser: Browser) -> None:
    channel = ProjectorChannel()
    with Operator(timing=CALM) as operator:
        app = App(operator, Serving(port=0), pages=PageChannels(channel))
        page = new_page(browser, {"width": 320, "height": 240})
        try:
            page.goto(app.server.link("project"))
            assert channel.wait_ready(PATIENCE_S).words == "ready 320 x 240"
            projector = BrowserProjector(page=channel)
            projector.open()
            projector.load(gray((320, 240)))
            projector.show(0)
            projector.close()
        finally:
            page.context.close()
            app.close()


@pytest.mark.slow
def test_wizard_without_page_channel_has_no_projector_page(browser: Browser) -> None:
    with Operator(timing=CALM) as operator:
        app = App(operator, Serving(port=0))
        page = new_page(browser)
        try:
            page.goto(app.server.link("project"))
            expect(page.get_by_text("There is no such page here")).to_be_visible()
        finally:
            page.context.close()
            app.close()


def test_qr_code_decodes_to_its_link() -> None:
    link = "https://192.168.1.20:8080/#oCRs5MUmmGxbcJl_PG-zfGJufRe80kDD"
    png = base64.b64decode(encode_qr_code(link).partition(",")[2])
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    scaled = cv2.resize(picture, None, fx=6, fy=6, interpolation=cv2.INTER_NEAREST)
    assert cv2.QRCodeDetector().detectAndDecode(scaled)[0] == link
    assert (picture[:4] == 255).all() and (picture[:, -4:] == 255).all(), "the quiet zone"


@pytest.mark.slow
def test_operator_sees_state_of_camera_page(browser: Browser) -> None:
    pages = PageChannels()
    with Operator(set_up=partial(set_up, pages=pages), timing=CALM) as operator:
        app = App(operator, Serving(port=0), pages=pages)
        page = new_page(browser)
        try:
            page.goto(app.server.link())
            click(page, "1. Rig")
            choose(page, "Rig", "Custom …")
            choose(page, "Camera", "browser: a page on a screen, phone or laptop")
            expect(page.get_by_text("Camera page: waiting for the page")).to_be_visible()
            hello = {"op": "hello", "window": "a", "take": False, "facts": VIDEO}
            pages.camera.connect(msgspec.json.encode(hello), lambda _: None)
            expect(page.get_by_text("Camera page: ready 1920 x 1080")).to_be_visible()
            click(page, "Use these devices")
            expect(page.get_by_text("the projector's size is unknown").first).to_be_visible()
        finally:
            page.context.close()
            app.close()
