"""A running server, and browsers of those who may reach it and of those who may not."""

from collections.abc import Iterator

import pytest
from server_client import Browser

from slviewer.server.secure import SafeServer, Serving, serve


@pytest.fixture(scope="module")
def server() -> Iterator[SafeServer]:
    server = serve(Serving(port=0), upload_limit=3_000_000)
    yield server
    server.stop()


@pytest.fixture
def operator(server: SafeServer) -> Iterator[Browser]:
    browser = Browser(server, "operate")
    yield browser
    browser.close()
    server.viser.gui.reset()
    server.viser.scene.reset()


@pytest.fixture
def watcher(server: SafeServer) -> Iterator[Browser]:
    browser = Browser(server, "watch")
    yield browser
    browser.close()


@pytest.fixture
def projector_page(server: SafeServer) -> Browser:
    return Browser(server, "project")


@pytest.fixture
def stranger(server: SafeServer) -> Browser:
    return Browser(server, None)


@pytest.fixture
def gui(server):
    return server.viser.gui
