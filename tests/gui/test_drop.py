"""Files and folders that are dropped on the page, or chosen in its dialogs, are imported."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page, expect
from test_import import PROJECTOR
from wizard_page import PATIENCE_S, Opened, button, click, wait_until_still

from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import gray
from slviewer.wizard.operator import Operator


def drop(page: Page, *paths: Path) -> None:
    """Drop files and folders of this computer on the 3D view."""
    client = page.context.new_cdp_session(page)
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "dragOver", "drop"):  # as a hand that moves on
        client.send("Input.dispatchDragEvent", {"type": kind, "x": 500, "y": 400, "data": data})


GONE = """() => {
  const input = document.querySelector("input[type=file]"), accepted = input.accept;
  input.accept = "";
  setTimeout(() => (input.accept = accepted), 1000);
}"""
"""Hides the page's input from what looks for it, as while the page draws it anew."""


def make_files(tmp_path: Path) -> Path:
    """Write two clouds, and return the folder of a capture."""
    sequence = gray(PROJECTOR)
    points = np.random.default_rng(0).normal((0, 0, 500), 20, (500, 3))
    for name in ("first", "second"):
        np.savetxt(tmp_path / f"{name}.xyz", points)
    folder = tmp_path / "capture_0"
    folder.mkdir()
    for i in range(len(sequence.frames)):
        frame = (render_pattern(sequence, i) * 0.5 + 40).round().astype(np.uint8)
        content = cv2.imencode(".png", frame)[1].tobytes()
        (folder / f"graycode_{i:02d}.png").write_bytes(content)
    return folder


def choose_files(page: Page, label: str, *paths: Path) -> None:
    """Choose files, or a folder, in the dialog of a button."""
    with page.expect_file_chooser() as chooser:
        click(page, label)
    chooser.value.set_files(paths if len(paths) > 1 else paths[0])


def test_chosen_files_and_folder_are_imported(
    opened: Opened, operator: Operator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("platformdirs.user_documents_path", lambda: tmp_path / "documents")
    page, folder = opened.page, make_files(tmp_path)
    operator.import_folder(folder, projector="120x90")  # which states the projector's size
    operator.wait_until_idle(PATIENCE_S)
    folder = folder.rename(folder.with_name("pose_ä"))
    choose_files(page, "Import files", tmp_path / "first.xyz", tmp_path / "second.xyz")
    assert operator.wait_for(lambda s: s.scan("first") and s.scan("second"), PATIENCE_S)  # type: ignore[arg-type, return-value]
    choose_files(page, "Import a folder", folder)
    assert operator.wait_for(lambda s: len(s.content.poses) == 2, PATIENCE_S)
    images = sorted(folder.glob("*.png"))
    choose_files(page, "Import files", *images)
    assert operator.wait_for(lambda s: len(s.content.poses) == 3, PATIENCE_S)
    before = operator.session
    click(page, "Sessions", exact=True)
    choose_files(page, "From files", tmp_path / "first.xyz")
    assert operator.wait_for(lambda s: s.scan("first") and not s.content.poses, PATIENCE_S)  # type: ignore[arg-type, return-value]
    assert operator.session is not before and opened.errors == []
    before = operator.session
    click(page, "Sessions", exact=True)
    expect(button(page, "Import files")).to_be_hidden()
    drop(page, tmp_path / "second.xyz")
    assert operator.wait_for(lambda s: s.scan("second") and not s.scan("first"), PATIENCE_S)  # type: ignore[arg-type, return-value]
    assert operator.session is not before and opened.errors == []


def test_dropped_folder_and_clouds_are_imported(
    opened: Opened, operator: Operator, tmp_path: Path
) -> None:
    page = opened.page
    expect(button(page, "Import files")).to_be_visible()
    folder = make_files(tmp_path)
    wait_until_still(page)
    page.evaluate(GONE)
    drop(page, tmp_path / "first.xyz", tmp_path / "second.xyz")
    both = operator.wait_for(lambda s: s.scan("first") and s.scan("second"), PATIENCE_S)  # type: ignore[arg-type, return-value]
    assert both, (operator.snapshot().notices, opened.errors, page.inner_text("body"))
    (tmp_path / "notes.md").write_text("x")
    drop(page, tmp_path / "notes.md")
    expect(page.get_by_text("notes.md cannot be imported").first).to_be_visible()
    operator.import_folder(folder, projector="120x90")  # which states the projector's size
    operator.wait_until_idle(PATIENCE_S)
    folder.rename(folder.with_name("pose_ä"))
    drop(page, folder.with_name("pose_ä"))
    assert operator.wait_for(lambda s: len(s.content.poses) == 2, PATIENCE_S)
    assert opened.errors == []


def test_files_that_cannot_be_read_are_said_to(opened: Opened, tmp_path: Path) -> None:
    page = opened.page
    make_files(tmp_path)
    expect(button(page, "Import files")).to_be_visible()
    page.evaluate("() => { Blob.prototype.stream = () => { throw Error('gone since') } }")
    drop(page, tmp_path / "first.xyz", tmp_path / "second.xyz")
    said = page.get_by_text("The files could not be read: gone since. Nothing was imported")
    expect(said).to_be_visible()
    expect(said).to_be_hidden()  # after some seconds
    choose_files(page, "Import files", tmp_path / "first.xyz", tmp_path / "second.xyz")
    expect(said).to_be_visible()
