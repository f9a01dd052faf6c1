"""A small simulated wizard for a browser to open."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from wizard_page import CALM, PATIENCE_MS, PATIENCE_S, RIG, Opened, browse

from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.wizard.operator import Operator

expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture
def operator(tmp_path: Path) -> Iterator[Operator]:
    with Operator(tmp_path / "session", RIG, timing=CALM) as engine:
        assert engine.wait_for(lambda s: s.rig.state == "open", PATIENCE_S) is not None
        yield engine


@pytest.fixture
def app(operator: Operator) -> Iterator[App]:
    wizard = App(operator, Serving(port=0))
    yield wizard
    wizard.close()


@pytest.fixture
def opened(browser: Browser, app: App) -> Iterator[Opened]:
    """The operator's page, ready."""
    with browse(browser, app) as found:
        yield found
