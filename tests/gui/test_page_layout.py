"""Nothing on the page is cut or covered at the usual sizes of a screen."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest
import trimesh
from chromium import launched
from copies import copy_session
from playwright.sync_api import Browser, Page, ViewportSize, expect
from test_accessibility import STEPS, find_violations
from wizard_page import CALM, PATIENCE_S, Opened, browse, click, field, wait_until_still

from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.wizard.operator import Operator

pytestmark = [pytest.mark.slow, pytest.mark.computes]

SIZES: list[ViewportSize] = [
    {"width": 820, "height": 1180},
    {"width": 1024, "height": 768},
    {"width": 1280, "height": 800},
    {"width": 1920, "height": 1080},
]
NAME = "object_with_a_long_name_that_a_person_chose"
FIND_FAULTS = """() => {
  const shown = e => e.checkVisibility({ visibilityProperty: true }) && e.getClientRects().length;
  const faults = new Set(), range = document.createRange(), placed = [];
  const overlap = (p, q) => [Math.min(p.right, q.right) - Math.max(p.left, q.left),
    Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top)];
  const meet = (p, q) => Math.min(...overlap(p, q)) > 1;
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode, element = node.parentElement, words = node.data.trim();
    if (!words || !shown(element) || element.closest("svg, style, script")) continue;
    range.selectNodeContents(node);
    for (const text of range.getClientRects()) {
      if (text.width < 1) continue; // for screen readers alone
      const name = words.slice(0, 40);
      if (text.right > innerWidth + 1 || text.left < -1) faults.add(`${name}: beyond the page`);
      let { left, right, top, bottom } = text; // what of it is in view
      for (let box = element; box && box !== document.body; box = box.parentElement) {
        const { overflowX, overflowY, position } = getComputedStyle(box);
        const frame = box.getBoundingClientRect(), scrolls = /auto|scroll/;
        const isBeside = left < frame.left - 1 || right > frame.right + 1;
        const isOutside = top < frame.top - 2 || bottom > frame.bottom + 2;
        if (isBeside && overflowX !== "visible" && !scrolls.test(overflowX))
          faults.add(`${name}: cut at a side`);
        if (isOutside && overflowY !== "visible" && !scrolls.test(overflowY))
          faults.add(`${name}: cut above or below`);
        if (scrolls.test(overflowX))
          [left, right] = [Math.max(left, frame.left), Math.min(right, frame.right)];
        if (scrolls.test(overflowY))
          [top, bottom] = [Math.max(top, frame.top), Math.min(bottom, frame.bottom)];
        if (right - left < 1 || bottom - top < 1 || position === "fixed") break;
      }
      if (right - left > 1 && bottom - top > 1)
        placed.push({ name, box: { left, right, top, bottom } });
    }
  }
  for (const [i, a] of placed.entries())
    for (const b of placed.slice(i + 1)) {
      const [width, height] = overlap(a.box, b.box);
      if (width > 1 && height > 3) faults.add(`${a.name} over ${b.name}`); // 3: lines of tight text
    }
  for (const input of document.querySelectorAll("input:not([type=file], [type=checkbox])"))
    if (shown(input) && input.scrollWidth > input.clientWidth + 1
        && getComputedStyle(input).textOverflow !== "ellipsis") faults.add(`${input.value} cut`);
  const parts = ["#view-bar", "#view-scale", "[data-legend]", "div:has(> [data-live]) + div",
    "[data-live-legend]", "body > [role=status]", "[data-testid=floating-panel]",
    "[data-activity]"];
  const boxes = parts.flatMap(part => [...document.querySelectorAll(part)].filter(shown)
    .map(e => [part, e.getBoundingClientRect()])).filter(([, b]) => b.width > 2 && b.height > 2);
  boxes.forEach(([a, p], i) => boxes.slice(i + 1).forEach(([b, q]) => {
    if (meet(p, q)) faults.add(`${a} over ${b}`);
  }));
  return [...faults];
}"""
"""Returns texts that a box cuts or that lie over each other, and parts of the 3D view that do."""


@pytest.fixture
def app(recorded: Path, tmp_path: Path) -> Iterator[App]:
    """The wizard of a session with results in every step."""
    folder = copy_session(recorded / "session", tmp_path / "session")
    with Operator(folder, {"driver": "simulated", "scale": 0.25}, timing=CALM) as operator:
        operator.verify(["plane_03"], "plane")
        operator.verify(["sphere_3"], "sphere")
        operator.reconstruct("object_r3")
        operator.reconstruct("object_r2")
        operator.rename("object_r3", NAME)
        operator.wait_until_idle(PATIENCE_S)
        operator.merge(["object_r2"], "object_r3")
        assert operator.wait_until_idle(PATIENCE_S).content.merge
        operator.measure("merge/1", "distance", [(0,), (5000,)])
        assert operator.wait_until_idle(PATIENCE_S).content.measurements
        served = App(operator, Serving(port=0))
        yield served
        served.close()


@pytest.fixture
def opened(app: App, browser: Browser) -> Iterator[Opened]:
    """Its page."""
    with browse(browser, app) as found:
        yield found


def list_faults(page: Page) -> list[str]:
    """Return what is wrong with the boxes of the page, and serious faults of accessibility."""
    return [*page.evaluate(FIND_FAULTS), *map(str, find_violations(page).items())]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_text_is_cut_nothing_overlaps_and_all_is_accessible(
    opened: Opened, scheme: Literal["light", "dark"]
) -> None:
    page, faults = opened.page, {}
    page.emulate_media(color_scheme=scheme)
    page.locator(f"html[data-mantine-color-scheme={scheme}]").wait_for()
    for size in SIZES:
        page.set_viewport_size(size)
        for number, step in enumerate(STEPS, 1):
            click(page, f"{number}. {step}")
            expect(page.get_by_text(re.compile(rf"^{number}\s{step}")).first).to_be_visible()
            wait_until_still(page)
            if found := list_faults(page):
                page.wait_for_timeout(2000)  # for what follows a change of size or content
                found = list_faults(page)
            if found:
                faults[size["width"], step] = found
    assert faults == {}
    click(page, "7. Merge")
    field(page, "Reference").hover()
    expect(field(page, "Reference")).to_have_attribute("title", re.compile(NAME))


def test_every_step_and_exports_work_without_webgl(
    app: App, browser: Browser, tmp_path: Path
) -> None:
    without = launched(browser.browser_type, "--disable-gpu", "--disable-3d-apis")
    with browse(without, app) as opened:
        page = opened.page
        assert page.evaluate("document.documentElement.dataset.drawing") == "none"
        expect(page.get_by_role("status").filter(has_text="WebGL")).to_have_count(1)
        for number, step in enumerate(STEPS, 1):
            click(page, f"{number}. {step}")
            heading = page.get_by_text(re.compile(rf"^{number}\s{step}"))
            expect(heading.filter(visible=True).first).to_be_visible()
        click(page, "Write STL")
        with page.expect_download() as download:
            page.get_by_role("link", name=re.compile(r"Download .*\.stl")).click()
        download.value.save_as(tmp_path / "part.stl")
        merge = app.operator.snapshot().content.merge
        assert merge is not None
        mesh = trimesh.load(tmp_path / "part.stl", force="mesh")
        assert 1000 < len(mesh.faces) <= 2 * merge.record.points
        expect(page.get_by_text("Dev Settings").filter(visible=True)).to_have_count(0)
    without.close()


def test_coordinates_of_the_point_below_the_pointer_stay_in_the_view(opened: Opened) -> None:
    page = opened.page
    page.set_viewport_size(SIZES[0])
    click(page, "8. Measure")
    wait_until_still(page)
    page.get_by_role("button", name="Distance", exact=True).click()
    view = page.locator("canvas").first.bounding_box()
    assert view is not None
    seen = list[float]()
    for x in range(10, int(view["width"]), 20):
        page.mouse.move(view["x"] + view["width"] - x, view["y"] + view["height"] / 2)
        page.wait_for_timeout(300)
        if (label := page.locator("#point-readout span").bounding_box()) is not None:
            seen.append(label["x"] + label["width"])
        if len(seen) > 5:
            break
    assert seen and max(seen) <= view["x"] + view["width"] + 1
    page.mouse.move(view["x"] + view["width"] + 50, view["y"] + 200)
    expect(page.locator("#point-readout")).to_be_hidden()
