"""Figures in README and docs are what their commands print."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.computes
def test_the_quick_figures_are_right():
    done = subprocess.run(
        [sys.executable, str(ROOT / "docs" / "figures.py"), "--check"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_wrong_figure_is_found_and_corrected(tmp_path):
    page = tmp_path / "page.md"
    command = "slviewer plan-rig webcam-1080p pocket-720p 500"
    page.write_text(f"<!-- figures: {command} -->\ncamera sees 1 x 2 mm\n<!-- end of figures -->\nText\n")

    def run(*options: str) -> int:
        script = [sys.executable, str(ROOT / "docs" / "figures.py"), *options, str(page)]
        return subprocess.run(script, capture_output=True, check=False).returncode

    assert run("--check") == 1 and "1 x 2" in page.read_text()
    assert run() == 0 and "700 x 394 mm" in page.read_text() and page.read_text().endswith("-->\nText\n")
    assert run("--check") == 0
    page.write_text(page.read_text().replace("43 %", "63 %"))
    assert run("--check") == 1


def test_every_single_number_has_a_source_and_stands_inside_its_line():
    spec = importlib.util.spec_from_file_location("figures", ROOT / "docs" / "figures.py")
    assert spec is not None and spec.loader is not None
    figures = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(figures)
    for page in figures.find_pages():
        text = page.read_text(encoding="utf-8")
        assert text.count("<!-- = ") == len(figures.VALUE.findall(text)) == text.count("<!-- . -->"), page
        assert "\n<!-- = " not in text, f"{page}: a comment at the start of a line ends the paragraph"
