"""Sphinx configuration of the site: ``python -m sphinx -W -b html docs docs/_build``.

Sphinx, as NumPy, Open3D, napari and scikit-image use it: it reads the docstrings. The command
line's reference is written by the build, from the commands themselves. Neither building nor reading
needs a network: a page that loads something from one is a warning. Links between pages are checked
by a test.
"""

import ast
import contextlib
import html
import inspect
import io
import json
import os
import re
import sys
import textwrap
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util import logging

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))
os.environ["COLUMNS"] = "88"  # tyro formats the help for this width
os.environ["NO_COLOR"] = "1"

import slviewer  # noqa: E402
from slviewer import cli  # noqa: E402
from slviewer.server.help_pages import draw_equation  # noqa: E402

project = "slviewer"
copyright = "the authors of slviewer"
version = release = slviewer.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "examples/slviewer-example-plugin"]
suppress_warnings = ["myst.xref_missing"]  # links to files of the repository that are no pages
autodoc_typehints = "description"
autodoc_member_order = "bysource"
myst_heading_anchors = 3
myst_fence_as_directive = ["math"]  # as GitHub and the program's own help read it
html_math_renderer = "svg"
MIN_PAGES = 16
"""Fewer mean that a folder of pages is missing."""
LOADED = re.compile(
    r"""<(?:script|img|iframe|source)\b[^>]*?\bsrc=["']?(?:https?:)?//[^>]*|<link\b[^>]*?href=["']?https?:[^>]*"""
)
"""What a page loads from a network."""
default_role = "code"  # names in docstrings stand in single backticks
html_theme = "pydata_sphinx_theme"
html_title = "slviewer"
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
# these have no pages beside them
html_sidebars = {page: [] for page in ("index", "quickstart", "architecture")}
html_context = {"default_mode": "auto"}
html_theme_options = {
    "navbar_align": "left",
    "header_links_before_dropdown": 8,
    "show_prev_next": True,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}


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
    lines = re.sub(r"\x1b\[[0-9;]*m", "", printed.getvalue()).rstrip().splitlines()
    return "\n".join(
        textwrap.fill(line, 88, break_on_hyphens=False) if line[:1].strip() else line
        for line in lines
    )


def list_options() -> str:
    """Return the page of the command line: the help of each command, and of each layout of
    `import`."""
    lines = [
        "# Command line",
        "",
        "What `slviewer COMMAND --help` prints, made from the program when this site is built.",
        "",
    ]
    for name in cli.find_commands():
        lines += [f"## {name}", "", "```text", read_help(name), "```", ""]
        for layout in (
            re.findall(r"\{([\w,-]+)\}", read_help(name).splitlines()[0])[:1]
            if name == "import"
            else []
        ):
            for each in layout.split(","):
                lines += [f"### import {each}", "", "```text", read_help(name, each), "```", ""]
    return "\n".join(lines)


TOPICS: dict[str, tuple[str, str]] = {
    "python-sessions": (
        "Sessions",
        "Session import_captures import_cloud calibrate reconstruct verify align merge mesh measure"
        " compare show_on_part run_plan check accept capture batch report export simulate"
        " import_poses hand_eye relate_rigs load_calibration load_arrays CalibrationResult"
        " Measurement Quantity Verification",
    ),
    "python-patterns": (
        "Patterns and decoding",
        "Frame PatternSequence one_axis complementary gray micro multifrequency p18 read_captures"
        " decode PhaseMap Reason texture examine",
    ),
    "python-calibration": (
        "Boards and calibration",
        "Board detect_board calibrate_frames save_calibration evaluate_plane evaluate_sphere"
        " draw_error_maps",
    ),
    "python-clouds": (
        "Clouds and meshes",
        "Cloud reconstruct_cloud align_clouds fuse_clouds mesh_cloud MeshingPlan show read_ply"
        " write_ply projection_image",
    ),
    "python-simulation": (
        "Simulated and own devices",
        "SimulatedWorld simulated_rig letter_rig Pose capture_frames datasets plugins"
        " SlviewerError",
    ),
}
"""The pages of the Python interface: title, and the public names in the order of their use."""


def list_functions() -> dict[str, str]:
    """Return the pages of the Python interface by name: one that lists all names with what they do,
    and one a topic with their docstrings. Raises ValueError for a name without a topic."""
    names = [name for _, listed in TOPICS.values() for name in listed.split()]
    if sorted(names) != sorted(slviewer.__all__):
        raise ValueError(f"TOPICS of docs/conf.py: {set(names) ^ set(slviewer.__all__)}")
    overview = ["# Python", "", "```{eval-rst}", ".. automodule:: slviewer", "```", ""]
    pages = {}
    for page, (title, listed) in TOPICS.items():
        overview += [f"## [{title}]({page}.md)", "", "| name | what it does |", "|---|---|"]
        lines = [f"# {title}", "", "```{eval-rst}"]
        for name in listed.split():
            public = getattr(slviewer, name)
            first = (inspect.getdoc(public) or "").partition("\n\n")[0].replace("\n", " ")
            sentence = re.split(r"(?<=[.:])\s|;", first.replace("|", "\\|"))[0].rstrip(".:")
            target = public.__name__ if inspect.ismodule(public) else f"slviewer.{name}"
            anchor = f"module-{target}" if inspect.ismodule(public) else target
            sentence = re.sub(r"`+", "`", sentence)
            overview.append(
                f'| <a href="{page}.html#{anchor}"><code>{name}</code></a> | {sentence} |'
            )
            lines += _document(public, target)
        overview.append("")
        pages[f"reference/{page}"] = "\n".join([*lines, "```", ""])
    overview += ["```{toctree}", ":hidden:", "", *TOPICS, "```", ""]
    return {"reference/python": "\n".join(overview), **pages}


def _document(public: Any, target: str) -> list[str]:
    """Return the directive that writes the docstring of a public name."""
    if not inspect.ismodule(public):
        return [f".. {'autoclass' if isinstance(public, type) else 'autofunction'}:: {target}", ""]
    # once is enough for what slviewer exports itself
    again = ", ".join(sorted(set(slviewer.__all__) & set(getattr(public, "__all__", ()))))
    return [f".. automodule:: {target}", "   :members:", f"   :exclude-members: {again}", ""]


def write_references(app: Sphinx) -> None:
    """Write the pages that are made from the program, where they changed."""
    gallery = list_gallery()
    pages = {f"gallery/{name}": text for name, text in gallery.items()} | {
        "gallery/index": list_gallery_index(gallery)
    }
    for page, text in {
        "reference/cli": list_options(),
        **list_functions(),
        **pages,
    }.items():
        path = DOCS / f"{page}.md"
        path.parent.mkdir(exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def list_gallery() -> dict[str, str]:
    """Return the pages of the gallery by name: each script and notebook of docs/examples with its
    pictures."""
    pages = {}
    for script in sorted((DOCS / "examples").glob("*.py")):
        text = script.read_text(encoding="utf-8")
        doc = ast.get_docstring(ast.parse(text)) or ""
        title, _, more = doc.partition(": " if ": " in doc.split("\n")[0] else "\n")
        picture = _show_picture(f"{script.stem}.png")
        code = text.partition('"""\n')[2] if text.startswith('"""') else text
        more = more.strip()
        pages[script.stem] = (
            f"# {title.strip('.')}\n\n{more[:1].upper()}{more[1:]}\n\n{picture}"
            f"```python\n{code.strip()}\n```\n\n"
            f"{{download}}`{script.name} <../examples/{script.name}>`\n"
        )
    for notebook in sorted((DOCS / "examples").glob("*.ipynb")):
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        parts = []
        for k, cell in enumerate(cells):
            source = "".join(cell["source"])
            parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
            parts.append(_show_picture(f"{notebook.stem}_{k}.png"))
        parts.append(f"{{download}}`{notebook.name} <../examples/{notebook.name}>`")
        pages[notebook.stem] = "\n\n".join(part for part in parts if part) + "\n"
    return pages


def _show_picture(name: str) -> str:
    """Return the lines that show a picture of the gallery; empty where there is none."""
    return (
        f"![{name}](../images/gallery/{name})\n\n"
        if (DOCS / "images" / "gallery" / name).exists()
        else ""
    )


SIMILAR_PICTURES = {
    "live_cloud": "wizard_scan.png",
    "session": "wizard_calibrate.png",
}
"""Of examples without a picture of their own: another one's, or the wizard doing the same."""


def _describe_card(name: str, page: str) -> str:
    """Return the HTML of a gallery page's entry: its last picture above its title. Raises KeyError
    where there is no picture."""
    pictures = re.findall(r"!\[\S+\]\(\.\./images/gallery/(\S+)\)", page)
    picture = pictures[-1] if pictures else SIMILAR_PICTURES[name]
    shown = f'<img src="../_images/{picture}" alt="">'
    return (
        '<a class="entry"'
        f' href="{name}.html">{shown}<span>{html.escape(page[2:].splitlines()[0])}</span></a>'
    )


def list_gallery_index(pages: dict[str, str]) -> str:
    """Return the gallery's first page, which lists the others."""
    lines = [
        "# Gallery",
        "",
        (
            "Scripts and notebooks of `docs/examples`. The tests run them, and `python"
            " docs/figures.py --pictures` draws"
        ),
        "their pictures. A script takes the path of its picture.",
        "",
        '<div class="gallery">',
        *(_describe_card(name, text) for name, text in pages.items()),
        "</div>",
        "",
        "```{toctree}",
        ":hidden:",
        "",
        *pages,
        "```",
    ]
    return "\n".join(lines) + "\n"


def write_equation(writer: Any, node: nodes.math_block) -> None:
    """Write an equation as SVG: MathJax, the usual way, is loaded from a network."""
    writer.body.append(draw_equation(node.astext()))
    raise nodes.SkipNode


def check_pages(app: Sphinx, exception: Exception | None) -> None:
    """Warn where the finished site has too few pages, or a page loads something from a network."""
    if exception is not None or app.builder.format != "html":
        return
    warn = logging.getLogger(__name__).warning
    pages = sorted(Path(app.outdir).rglob("*.html"))
    if len(pages) < MIN_PAGES:
        warn(f"the site has {len(pages)} pages, at least {MIN_PAGES} are expected")
    for page in pages:
        if loaded := LOADED.search(page.read_text(encoding="utf-8")):
            warn(f"{page.relative_to(app.outdir)} loads something from a network: {loaded[0]}")


def setup(app: Sphinx) -> None:
    """Write the pages that are made from the program before all are read, and check the finished
    site."""
    app.connect("builder-inited", write_references)
    app.connect("build-finished", check_pages)
    app.add_html_math_renderer("svg", (write_equation, None), (write_equation, None))
