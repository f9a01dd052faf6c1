"""Files and folders that are dropped on the page are imported."""

from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Page, expect
from test_import import PROJECTOR
from wizard_page import PATIENCE_S, Opened, button

from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import gray
from slviewer.wizard.operator import Operator


def drop(page: Page, *paths: Path) -> None:
    """Drop files and folders of this computer on the 3D view."""
    client = page.context.new_cdp_session(page)
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        client.send("Input.dispatchDragEvent", {"type": kind, "x": 500, "y": 400, "data": data})


GONE = """() => {
  const input = document.querySelector("input[type=file]"), accepted = input.accept;
  input.accept = "";
  setTimeout(() => (input.accept = accepted), 1000);
}"""
"""Hides the page's input from what looks for it, as while the page draws it anew."""


def test_dropped_folder_and_clouds_are_imported(
    opened: Opened, operator: Operator, tmp_path: Path
) -> None:
    page, sequence = opened.page, gray(PROJECTOR)
    expect(button(page, "Import files")).to_be_visible()
    points = np.random.default_rng(0).normal((0, 0, 500), 20, (500, 3))
    for name in ("first", "second"):
        np.savetxt(tmp_path / f"{name}.xyz", points)
    folder = tmp_path / "capture_0"
    folder.mkdir()
    for i in range(len(sequence.frames)):
        frame = (render_pattern(sequence, i) * 0.5 + 40).round().astype(np.uint8)
        content = cv2.imencode(".png", frame)[1].tobytes()
        (folder / f"graycode_{i:02d}.png").write_bytes(content)
    page.evaluate(GONE)
    drop(page, tmp_path / "first.xyz", tmp_path / "second.xyz")
    both = operator.wait_for(lambda s: s.scan("first") and s.scan("second"), PATIENCE_S)  # type: ignore[arg-type, return-value]
    assert both, (operator.snapshot().notices, opened.errors)
    (tmp_path / "notes.md").write_text("x")
    drop(page, tmp_path / "notes.md")
    expect(page.get_by_text("notes.md cannot be imported").first).to_be_visible()
    operator.import_folder(folder, projector="120x90")  # which states the projector's size
    operator.wait_until_idle(PATIENCE_S)
    folder.rename(folder.with_name("pose_ä"))
    drop(page, folder.with_name("pose_ä"))
    assert operator.wait_for(lambda s: len(s.content.poses) == 2, PATIENCE_S)
    assert opened.errors == []
