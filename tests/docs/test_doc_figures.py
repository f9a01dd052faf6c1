"""Figures in README and docs are what their commands print."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def run(figures: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Run docs/figures.py with arguments; returns its exit status."""

    def script(*arguments: str) -> int:
        monkeypatch.setattr("sys.argv", ["figures.py", *arguments])
        return int(figures.main())

    return script


@pytest.mark.slow
@pytest.mark.computes
def test_the_quick_figures_are_right(
    run: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--check") == 0, capsys.readouterr().out


def test_a_wrong_figure_is_found_and_corrected(run: Callable[..., int], tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    command = "slviewer plan-rig webcam-1080p pocket-720p 500"
    page.write_text(
        f"<!-- figures: {command} -->\ncamera sees 1 x 2 mm\n<!-- end of figures -->\nText\n"
    )
    assert run("--check", str(page)) == 1 and "1 x 2" in page.read_text()
    assert (
        run(str(page)) == 0
        and "700 x 394 mm" in page.read_text()
        and page.read_text().endswith("-->\nText\n")
    )
    assert run("--check", str(page)) == 0
    page.write_text(page.read_text().replace("43 %", "63 %"))
    assert run("--check", str(page)) == 1


def test_every_single_number_has_a_source_and_stands_inside_its_line(figures: ModuleType) -> None:
    for page in figures.find_pages():
        text = page.read_text(encoding="utf-8")
        assert (
            text.count("<!-- = ") == len(figures.VALUE.findall(text)) == text.count("<!-- . -->")
        ), page
        assert "\n<!-- = " not in text, (
            f"{page}: a comment at the start of a line ends the paragraph"
        )
