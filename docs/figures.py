"""Write or check the figures in README and docs: the output of the commands that the pages name.

    python docs/figures.py [--check] [--slow] [PAGE ...]

A page names a command in a comment, and its output follows up to the end mark:

    <!-- figures: slviewer plan-rig webcam-1080p pocket-720p 500 -->
    <!-- end of figures -->

``slow figures:`` marks commands of minutes, which run with ``--slow``. ``--check`` changes nothing, and ends with
status 1 where a number is off by more than 2 % and more than its last digit.
"""

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(
    r"<!-- (?P<slow>slow )?figures: (?P<command>[^\n]+) -->\n(?P<body>.*?)<!-- end of figures -->", re.DOTALL
)
NUMBER = re.compile(r"\d+(?:\.\d+)?")
TOLERANCE = 0.02


def find_pages() -> list[Path]:
    """Return all pages that may hold figures."""
    docs = [page for page in (ROOT / "docs").rglob("*.md") if "_build" not in page.parts]
    return [ROOT / "README.md", *sorted(docs)]


def run(command: str) -> str:
    """Return what a command of slviewer prints, as a block of text."""
    name, *arguments = shlex.split(command)
    if name != "slviewer":
        raise SystemExit(f"{command}: figures come from commands of slviewer")
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-m", "slviewer.cli", *arguments],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(ROOT), "NO_COLOR": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        raise SystemExit(f"{command} failed: {done.stderr}")
    return f"\n```text\n{done.stdout.rstrip()}\n```\n\n"


def agree(written: str, printed: str) -> bool:
    """Whether two texts are equal but for small differences of their numbers."""
    if NUMBER.sub("#", written) != NUMBER.sub("#", printed):
        return False
    pairs = zip(NUMBER.findall(written), NUMBER.findall(printed), strict=True)
    return all(abs(float(a) - float(b)) <= max(TOLERANCE * float(b), _last_digit(a)) for a, b in pairs)


def _last_digit(number: str) -> float:
    """Return one unit of the last digit of a number."""
    return 1.01 * 10.0 ** -len(number.partition(".")[2])


def update(page: Path, check: bool, slow: bool) -> bool:
    """Write the figures of a page, or check them; returns whether they were right."""
    text = page.read_text(encoding="utf-8")
    right = True

    def replace(match: re.Match[str]) -> str:
        """Return the block with the command's output."""
        nonlocal right
        if match["slow"] and not slow:
            return match[0]
        printed = run(match["command"])
        if agree(match["body"], printed):
            return match[0]
        right = False
        print(f"{page.name}: {match['command']}\n--- written{match['body']}--- printed{printed}")
        return f"<!-- {match['slow'] or ''}figures: {match['command']} -->\n{printed}<!-- end of figures -->"

    changed = BLOCK.sub(replace, text)
    if not check and changed != text:
        page.write_text(changed, encoding="utf-8")
    return right


def main() -> int:
    """Run the commands of the pages; returns the exit status."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("pages", nargs="*", type=Path, help="by default README and all of docs")
    parser.add_argument("--check", action="store_true", help="compare, and change nothing")
    parser.add_argument("--slow", action="store_true", help="also commands that take minutes")
    given = parser.parse_args()
    right = [update(page.resolve(), given.check, given.slow) for page in given.pages or find_pages()]
    return int(given.check and not all(right))


if __name__ == "__main__":
    sys.exit(main())
