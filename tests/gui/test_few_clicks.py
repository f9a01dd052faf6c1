"""How much an operator has to choose: from the start page to an STL, every click is counted."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
import trimesh
from browser_windows import BOX, ChromiumWindow, Hand, Window, firefox_window, webkit_window
from chromium import launched
from playwright.sync_api import Browser
from test_editing import OUTLINE, Views, place_in_view
from wizard_page import CALM, PATIENCE_S, RIG

from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.wizard.operator import Operator
from slviewer.wizard.result_views import whole_cloud
from slviewer.wizard.snapshot import Snapshot

pytestmark = [pytest.mark.computes, pytest.mark.slow]

MOST_CHOICES = 22
POSES = 8
MOST_SILENCE_S = 6.0
"""Of the line of state while something runs, on a busy machine; 1 s is usual. Only of the first
browser: it measures the server, and the others take more of the machine."""
WATCH_STATE = """() => {
  let text = "", since = performance.now();
  window.longestSilence = 0;
  setInterval(() => {
    const line = document.querySelector("[data-activity]"), now = performance.now();
    const isBusy = line?.dataset.activity === "busy";
    if (!isBusy || line.textContent !== text) since = now;
    text = line?.textContent;
    window.longestSilence = Math.max(window.longestSilence, now - since);
  }, 100);
}"""


@pytest.fixture
def operator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Operator]:
    """A simulated rig, and no session yet."""
    monkeypatch.setattr("platformdirs.user_documents_path", lambda: tmp_path)
    with Operator(rig=RIG, timing=CALM) as engine:
        assert engine.wait_for(lambda s: s.rig.state == "open", PATIENCE_S)
        yield engine


def wait(operator: Operator, holds: Callable[[Snapshot], object]) -> None:
    """Wait for what the operator sees on the page."""
    assert operator.wait_for(lambda s: bool(holds(s)), PATIENCE_S)


@contextmanager
def chromium_window(browser: Browser, folder: Path) -> Iterator[Window]:
    """A window of the browser that all tests share."""
    with closing(ChromiumWindow(browser, folder / "downloads")) as window:
        yield window


@contextmanager
def window_without_webgl(browser: Browser, folder: Path) -> Iterator[Window]:
    """A window of a Chromium that draws nothing in 3D."""
    without = launched(browser.browser_type, "--disable-gpu", "--disable-3d-apis")
    with chromium_window(without, folder) as window:
        window.has_webgl = False
        yield window
    without.close()


OPENERS: dict[str, Callable[[Browser, Path], AbstractContextManager[Window]]] = {
    "chromium": chromium_window,
    "chromium without WebGL": window_without_webgl,
    "firefox": lambda _, folder: firefox_window(folder),
    "webkit": lambda _, folder: webkit_window(folder),
}


@pytest.fixture(params=OPENERS)
def window(request: pytest.FixtureRequest, browser: Browser, tmp_path: Path) -> Iterator[Window]:
    """A window of each browser."""
    folder = tmp_path / "browser"
    (folder / "downloads").mkdir(parents=True)
    with OPENERS[request.param](browser, folder) as opened:
        yield opened


def test_new_session_reaches_stl_in_few_choices(
    operator: Operator, window: Window, tmp_path: Path
) -> None:
    app = App(operator, Serving(port=0))
    views, hand = Views(app), Hand(window)
    try:
        window.open(app.server.link())
        window.evaluate(WATCH_STATE)
        hand.click("New session")
        hand.see("[data-activity]")
        hand.click("Use this board")
        hand.click("Continue to Poses")
        take_poses(hand)
        hand.click("Continue to Calibrate")
        hand.click("Calibrate")
        wait(operator, lambda s: s.calibration and not s.calibration.stale)

        hand.click("6. Scan")
        hand.choose("Object", "object")
        for name in ("scan_01", "scan_02"):
            if name == "scan_02":
                hand.click("Turn by 30°")
            hand.click("Capture scan")
            wait(operator, lambda s, n=name: (v := s.scan(n)) and v.cloud == "fresh")  # type: ignore[misc]
        if window.has_webgl:
            lasso(hand, app, views)

        hand.click("7. Merge")
        hand.click("Merge 2 scans")
        wait(operator, lambda s: s.content.merge)
        hand.click("9. Export")
        hand.click("Write STL")
        hand.click(r"Download .*\.stl", "link")
        mesh = trimesh.load_mesh(hand.wait_for_download("*.stl"))
        assert len(mesh.faces) > 1000 and mesh.extents == pytest.approx([126, 126, 78], abs=5)
        print(f"{len(hand.choices)} choices: {hand.choices}")
        silent_s = window.evaluate("() => window.longestSilence") / 1000
        print(f"longest silence of the line of state: {silent_s:.1f} s")
        is_usual = isinstance(window, ChromiumWindow) and window.has_webgl
        assert silent_s < MOST_SILENCE_S or not is_usual
        assert len(hand.choices) <= MOST_CHOICES, hand.choices

        for step in ("1. Rig", "5. Verify", "8. Measure"):
            hand.click(step)
            hand.read(step.replace(". ", r"\s"))
        drop_cloud(hand, tmp_path / "dropped.xyz")
        wait(operator, lambda s: s.scan("dropped"))
        hand.read("dropped" if window.has_webgl else "No 3D view: .* WebGL")
        assert [n.text for n in operator.snapshot().notices if n.level == "error"] == []
        drawing = "^" if window.has_webgl else "THREE"  # what draws reports that it cannot
        assert [e for e in window.list_errors() if not e.startswith(drawing)] == []
    finally:
        app.close()


def take_poses(hand: Hand) -> None:
    """Capture poses hands-free: the simulated board moves on by itself."""
    hand.click("Hands-free", "checkbox")
    for number in range(1, POSES + 1):
        hand.read(rf"pose_{number:02d}\s+good")


def drop_cloud(hand: Hand, path: Path) -> None:
    """Drop a file of points on the page."""
    np.savetxt(path, np.random.default_rng(0).normal((0, 0, 500), 20, (500, 3)))
    hand.drop(path)


def lasso(hand: Hand, app: App, views: Views) -> None:
    """Delete points of the last scan with a lasso."""
    session = app.operator.session
    assert session is not None
    cloud = whole_cloud(session, "scan_02")
    points = cloud.points[np.isfinite(cloud.points[..., 2])]
    hand.unfold("Edit points")
    hand.choose("Select by", "lasso")
    hand.read("Drag a line around")
    hand.wait_for(lambda: views.show(cloud.points))
    middle = points[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]
    box = hand.window.evaluate(BOX, "canvas")
    places = np.array(place_in_view(app, middle, box)) + OUTLINE / 2
    hand.act("lasso", lambda: hand.window.drag(places.tolist()))
    hand.read(r"^[1-9][\d,]* of [\d,]+ points selected")
    hand.click("Delete selected")
    wait(app.operator, lambda s: (scan := s.scan("scan_02")) and scan.edits)
