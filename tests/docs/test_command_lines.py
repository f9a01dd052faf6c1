"""Command lines in the Markdown files are ones that slviewer accepts: the command exists, and so
does every option."""

import contextlib
import io
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

from slviewer.cli import find_commands, main

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])


@cache
def help_of(*command: str) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main([*command, "--help"]) == 0, command
    return printed.getvalue()


def command_lines(page: Path) -> list[str]:
    """The lines of code blocks that begin with slviewer, without comments and prompts."""
    blocks = re.findall(
        r"^ *```bash\n(.*?)^ *```", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL
    )
    lines = [line.strip() for block in blocks for line in re.sub(r"\\\n", " ", block).splitlines()]
    return [line for line in lines if line.startswith("slviewer ")]


@pytest.mark.parametrize(
    "page", [p for p in PAGES if command_lines(p)], ids=lambda page: str(page.relative_to(ROOT))
)
def test_the_commands_of_a_page_exist_with_their_options(page: Path) -> None:
    for line in command_lines(page):
        _, *words = shlex.split(line, comments=True)
        if words[0].startswith("--"):
            continue  # the wizard's own options
        assert words[0] in find_commands() or words[0] == "wizard", line
        layout = words[1:2] if words[0] == "import" and not words[1].startswith("-") else []
        known = help_of(words[0], *layout)
        for option in (word.partition("=")[0] for word in words if word.startswith("--")):
            assert re.search(rf"(?<![\w-]){re.escape(option)}(?![\w-])", known), (
                f"{line}: no {option}"
            )


def test_the_page_of_commands_names_every_command() -> None:
    page = (ROOT / "docs" / "reference" / "commands.md").read_text("utf-8")
    named = {
        word
        for row in re.findall(r"^\| (.+?) \|", page, re.MULTILINE)
        for word in re.findall(r"`([\w-]+)", row)
    }
    assert not set(find_commands()) - named
