"""The projector page beside the wizard."""

from playwright.sync_api import Browser, expect

from slviewer.devices.browser import browser_projector
from slviewer.devices.channel import Channel
from slviewer.fringe.presets import gray
from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.wizard.operator import Operator


def test_the_wizard_serves_the_projector_page(browser: Browser) -> None:
    channel = Channel()
    with Operator() as operator:
        app = App(operator, Serving(port=0), channel=channel)
        page = browser.new_page(viewport={"width": 320, "height": 240})
        try:
            page.goto(app.server.link("project"))
            assert channel.wait_ready(10.0).words == "ready 320 x 240"
            projector = browser_projector(channel=channel)
            projector.open()
            projector.load(gray((320, 240)))
            projector.show(0)
            projector.close()
        finally:
            page.close()
            app.close()


def test_a_wizard_without_a_channel_has_no_such_page(browser: Browser) -> None:
    with Operator() as operator:
        app = App(operator, Serving(port=0))
        page = browser.new_page()
        try:
            page.goto(app.server.link("project"))
            expect(page.get_by_text("There is no projector page here")).to_be_visible()
        finally:
            page.close()
            app.close()
