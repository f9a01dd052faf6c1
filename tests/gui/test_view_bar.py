"""The bar over the 3D view: standard views, fit, orthographic, and the scale bar."""

import re
from collections.abc import Iterator

import numpy as np
import pytest
import viser
from playwright.sync_api import Browser, Page, expect
from wizard_page import PATIENCE_S, new_page, wait_until

from slviewer.gui.scene import FIELD_OF_VIEW, Click, ViewerScene
from slviewer.server.secure import SafeServer, Serving, serve

MIDDLE, SIZE = np.array([40.0, -25.0, 600.0]), np.array([160.0, 90.0, 30.0])
"""Of the box, mm, whose sides are shown."""


@pytest.fixture
def server() -> Iterator[SafeServer]:
    server = serve(Serving(port=0))
    yield server
    server.stop()


@pytest.fixture
def clicks(server: SafeServer) -> list[Click]:
    """The clicks into a scene with one cloud."""
    server.viser.initial_camera.fov = FIELD_OF_VIEW
    scene, clicks = ViewerScene(server.viser, lambda do: do()), list[Click]()
    corners = MIDDLE + SIZE * (np.random.default_rng(1).random((4000, 3)) - 0.5)
    layer = scene.layer("scan")
    server.viser.gui.add_html(layer.hover_html("cloud"))
    layer.cloud("cloud", corners.astype(np.float32), (90, 140, 200))
    scene.on_click(clicks.append)
    return clicks


@pytest.fixture
def page(browser: Browser, server: SafeServer, clicks: list[Click]) -> Iterator[Page]:
    page = new_page(browser)
    page.goto(server.link())
    expect(page.get_by_role("button", name="Fit")).to_be_visible(timeout=1000 * PATIENCE_S)
    yield page
    page.context.close()


def press(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def view(server: SafeServer) -> viser.CameraHandle:
    return next(iter(server.viser.get_clients().values())).camera


@pytest.mark.slow
def test_standard_views_fit_and_orthographic(
    page: Page, server: SafeServer, clicks: list[Click]
) -> None:
    wait_until(page, lambda: server.viser.get_clients())
    for name, axis, side in (("Front", 2, -1), ("Right", 0, 1), ("Top", 1, -1), ("Back", 2, 1)):
        press(page, name)

        def is_seen(axis: int = axis, side: int = side) -> bool:
            way = side * np.eye(3)[axis]
            offset = view(server).position - MIDDLE
            return bool(offset @ way > 0.999 * np.linalg.norm(offset) > 50)

        wait_until(page, is_seen)
    press(page, "Front")
    wait_until(page, lambda: view(server).position[2] < MIDDLE[2] - 100)
    wide = view(server).position[2]
    bar = page.locator("#view-scale span")
    length = bar.inner_text()
    assert length.endswith(" mm")

    press(page, "Ortho")
    wait_until(page, lambda: view(server).fov < 0.01)
    wait_until(page, lambda: view(server).position[2] < -20 * wide)
    expect(bar).to_have_text(length)  # what is in the middle keeps its size
    press(page, "Fit")  # the same frame, but for the depth that no longer matters
    canvas = page.locator("canvas").first.bounding_box()
    assert canvas is not None
    x, y = canvas["x"] + canvas["width"] / 2, canvas["y"] + canvas["height"] / 2
    page.mouse.move(x, y)
    readout = page.locator("#point-readout span")
    expect(readout).to_have_text(re.compile(r"^x [34]\d\.\d\d, y -2\d\.\d\d, z \d+\.\d\d mm$"))
    page.mouse.click(x, y)
    wait_until(page, lambda: clicks)
    near = clicks[0].origin  # as if from the wide view: a share of its depth is as many pixels
    assert np.linalg.norm(near - MIDDLE) < 3 * abs(wide - MIDDLE[2])
    page.keyboard.press("o")
    wait_until(page, lambda: abs(view(server).fov - FIELD_OF_VIEW) < 1e-3)
