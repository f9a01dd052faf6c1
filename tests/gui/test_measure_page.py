"""The step Measure in a browser: it opens on the merge, and picked points are dragged over it."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect
from wizard_page import CALM, PATIENCE_S, Opened, browse, button, click, field, wait_until

from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.gui.app import App
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.server.secure import Serving
from slviewer.session.store import Session
from slviewer.simulation.boards import Pose
from slviewer.simulation.mesh import demo_object
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.wizard.operator import Operator

A, B, C = (480, 440), (590, 420), (560, 450)
"""Places on the object in the view, px."""


@pytest.fixture
def page_of_merge(tmp_path: Path, browser: Browser) -> Iterator[tuple[Opened, Operator]]:
    """The page over a session in which two scans of one object are merged."""
    rig = letter(0.2, seed=2, local_distortion_px=0)
    sequence = one_axis(p18(rig.projector.size), "x")
    with Session.create(tmp_path / "session") as store:
        save_true_stereo(store, rig)
        for i, turn in enumerate((0.0, 0.3)):
            R = np.array(
                [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
            )
            scene = demo_object(Pose(R, np.array([0.0, 0.0, 520.0])))
            frames = Renderer(rig, scene).capture(sequence, i)
            store.save_capture(f"scan_{i + 1:02d}", "scan", sequence, frames, source="simulated")
    with Operator(tmp_path / "session", timing=CALM) as operator:
        for name in ("scan_01", "scan_02"):
            assert operator.reconstruct(name)
        operator.wait_until_idle(PATIENCE_S)
        assert operator.merge(["scan_01", "scan_02"], "scan_01")
        assert operator.wait_until_idle(PATIENCE_S).content.merge is not None
        app = App(operator, Serving(port=0))
        with browse(browser, app) as opened:
            yield opened, operator
        app.close()


@pytest.mark.computes
def test_points_are_picked_and_dragged_on_the_merge(
    page_of_merge: tuple[Opened, Operator],
) -> None:
    opened, operator = page_of_merge
    page, on = opened.page, operator.surface("merge/1")
    click(page, "8. Measure")
    expect(field(page, "Surface")).to_have_value("Merge of 2 scans")
    page.get_by_role("button", name="Distance", exact=True).click()
    wait_until(page, lambda: click_at(opened, A, "Click the second point."))
    page.mouse.click(*B)

    def ends() -> tuple[tuple[float, ...], ...]:
        measured = operator.snapshot().content.measurements
        return measured[0].record.ends or () if measured else ()

    wait_until(page, ends)
    assert operator.wait_until_idle(PATIENCE_S).content.measurements[0].label == "distance 1"
    before = ends()

    reach_mark(page, B)
    page.mouse.down()
    page.mouse.move(*C, steps=4)
    page.wait_for_timeout(1000)  # it follows the pointer
    marker = page.locator("#point-readout")
    expect(marker).to_have_text(re.compile(r"^x -?\d+\.\d\d, y -?\d+\.\d\d, z \d+\.\d\d mm$"))
    shown = np.array([float(each) for each in re.findall(r"-?\d+\.\d\d", marker.inner_text())])
    page.mouse.up()
    wait_until(page, lambda: ends() != before)
    after = ends()
    assert after[0] == before[0] and np.abs(np.subtract(after[1], shown)).max() < 0.01
    off = np.linalg.norm(on.points - after[1], axis=-1)
    assert off.min() < 1e-3  # it lies on the surface
    assert len(operator.snapshot().content.measurements) == 1
    expect(button(page, "Undo: move a point of distance 1")).to_be_visible()
    page.keyboard.press("Control+z")
    wait_until(page, lambda: ends() == before)
    # a click on a mark, without a drag, picks the point that is under it
    reach_mark(page, B)
    page.mouse.click(*B)
    expect(page.get_by_text("Click the second point.")).to_be_visible()
    reach_mark(page, B)
    page.mouse.down()
    page.mouse.move(*C, steps=4)
    page.mouse.up()
    reach_mark(page, C)
    page.mouse.click(*A)
    wait_until(page, lambda: len(operator.snapshot().content.measurements) == 2)
    latest = operator.snapshot().content.measurements[1]
    assert latest.record.ends == (after[1], before[0]) and latest.label == "distance 2"
    assert opened.errors == []


def reach_mark(page: Page, place: tuple[int, int]) -> None:
    """Move the pointer to a mark, once it is drawn there."""

    def is_reached() -> bool:
        for step in (1, 0):
            page.mouse.move(place[0] + step, place[1])
            page.wait_for_timeout(200)
        canvas = page.locator("canvas[data-engine]")
        return bool(canvas.evaluate("canvas => canvas.style.cursor") == "grab")

    wait_until(page, is_reached)


def click_at(opened: Opened, place: tuple[int, int], answer: str) -> bool:
    """Click on the surface; returns whether the page answered."""
    opened.page.mouse.click(*place)
    opened.page.wait_for_timeout(3000)
    return opened.page.get_by_text(answer).is_visible()
