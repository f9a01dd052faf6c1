"""Sphinx configuration of the site: ``python -m sphinx -W -b html docs docs/_build``.

Sphinx, as NumPy, Open3D, napari and scikit-image use it: it reads the docstrings. The command line's reference is
written by the build, from the commands themselves. Neither building nor reading needs a network. Links between pages
are checked by a test.
"""

import contextlib
import inspect
import io
import os
import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))
os.environ["COLUMNS"] = "110"  # tyro formats the help for this width
os.environ["NO_COLOR"] = "1"

import slviewer  # noqa: E402
from slviewer import cli  # noqa: E402

project = "slviewer"
copyright = "the authors of slviewer"
version = release = slviewer.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "examples/slviewer-example-plugin"]
suppress_warnings = ["myst.xref_missing"]  # links to files of the repository that are no pages
autodoc_typehints = "description"
autodoc_member_order = "bysource"
myst_heading_anchors = 3
html_theme = "pydata_sphinx_theme"
html_title = "slviewer"
html_show_sourcelink = False
html_theme_options = {"navbar_align": "left", "show_prev_next": True, "secondary_sidebar_items": ["page-toc"]}


def read_help(*arguments: str) -> str:
    """Return what ``slviewer ARGUMENTS --help`` prints, without colours."""
    printed = io.StringIO()
    saved = sys.argv
    sys.argv = ["slviewer", *arguments, "--help"]
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            cli.main()
    finally:
        sys.argv = saved
    return re.sub(r"\x1b\[[0-9;]*m", "", printed.getvalue()).rstrip()


def list_options() -> str:
    """Return the page of the command line: the help of each command, and of each layout of `import`."""
    lines = [
        "# Command line",
        "",
        "What `slviewer COMMAND --help` prints, made from the program when this site is built.",
        "",
    ]
    for name in cli.COMMANDS:
        lines += [f"## {name}", "", "```text", read_help(name), "```", ""]
        for layout in re.findall(r"\{([\w,-]+)\}", read_help(name).splitlines()[0])[:1] if name == "import" else []:
            for each in layout.split(","):
                lines += [f"### import {each}", "", "```text", read_help(name, each), "```", ""]
    return "\n".join(lines)


def list_functions() -> str:
    """Return the page of the Python interface: every public name of slviewer with its docstring."""
    lines = ["# Python", "", "```{eval-rst}", ".. automodule:: slviewer", ""]
    for name in slviewer.__all__:
        public = getattr(slviewer, name)
        if inspect.ismodule(public):
            # once is enough for what slviewer exports itself
            again = ", ".join(sorted(set(slviewer.__all__) & set(getattr(public, "__all__", ()))))
            lines += [f".. automodule:: {public.__name__}", "   :members:", f"   :exclude-members: {again}", ""]
            continue
        lines += [f".. {'autoclass' if isinstance(public, type) else 'autofunction'}:: slviewer.{name}", ""]
    return "\n".join([*lines, "```", ""])


def write_references(app: Sphinx) -> None:
    """Write the pages that are made from the program, where they changed."""
    for page, text in (("cli", list_options()), ("python", list_functions())):
        path = DOCS / "reference" / f"{page}.md"
        path.parent.mkdir(exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def drop_empty_globs(app: Sphinx, page: str, source: list[str]) -> None:
    """Remove from the index the patterns that no page matches: each would be a warning."""
    if page == "index":
        lines = source[0].split("\n")
        source[0] = "\n".join(line for line in lines if not line.endswith("*") or any(DOCS.glob(f"{line}.md")))


def setup(app: Sphinx) -> None:
    """Connect what is done before the pages are read."""
    app.connect("builder-inited", write_references)
    app.connect("source-read", drop_empty_globs)
