"""The pages of the documentation, which the server shows to whoever may see the wizard, without a
network.

They are the Markdown files of `docs`, at addresses that end as their paths do, so that their links
to each other hold. Only files listed at the start are served: an address is looked up in that list,
and never becomes a path.
"""

import posixpath
import re
from collections import Counter
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

PREFIX = "help/"
"""Below the path of the operator and of viewers; relative to their page, so that one link serves
both."""
_PACKAGE = Path(__file__).resolve().parent.parent
_GROUPS = {
    "": "Start",
    "tutorials": "Tutorials",
    "howto": "How to",
    "hardware": "Hardware",
    "explanation": "Explanation",
    "reference": "Reference",
}
"""{folder: title}, in the order of the list; the folders whose pages are shown."""
_DEVELOPMENT = ("index.md", "architecture.md", "reference/python.md")
_PICTURES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".webp": "image/webp",
    ".svg": "image/svg+xml",
}
_HTML = "text/html; charset=utf-8"
_COMMENT = re.compile(r"<!--.*?-->\n?", re.DOTALL)
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*:|//", re.I)


@dataclass(frozen=True)
class HelpFile:
    """A served file and the type of its content."""

    content: bytes
    content_type: str


@dataclass(frozen=True)
class _Heading:
    """A heading of a page: its level, 1 the highest, its text, and the anchor that leads to it."""

    level: int
    text: str
    anchor: str


class HelpPages:
    """The pages and pictures below one folder; without the folder there are none. May be used from
    any thread."""

    def __init__(self, folder: Path | None = None) -> None:
        """``folder``: that of the documentation, by default the one that ships with the program."""
        place = folder or docs_folder()
        files = [path for path in place.rglob("*.*") if path.is_file()] if place else []
        named = {path.relative_to(place).as_posix(): path for path in files if place}
        self._files = {name: path for name, path in named.items() if _is_served(name)}
        self._rendered: dict[str, HelpFile] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pages, as "howto/exposure.md", in the order of their list."""
        folders = list(_GROUPS)
        pages = (name for name in self._files if name.endswith(".md"))
        return tuple(sorted(pages, key=lambda name: (folders.index(_top_folder(name)), name)))

    def file(self, name: str) -> HelpFile | None:
        """Return what is at this place below PREFIX: the list of pages where it is empty; None
        where nothing is."""
        path = self._files.get(name)
        if path and path.suffix in _PICTURES:
            return HelpFile(path.read_bytes(), _PICTURES[path.suffix])
        if name and path is None:
            return None
        if name not in self._rendered:
            self._rendered[name] = HelpFile(self._render(name).encode(), _HTML)
        return self._rendered[name]

    def anchors(self, name: str) -> tuple[str, ...]:
        """Return the anchors of a page, one for each heading. Raises KeyError."""
        return tuple(heading.anchor for heading in _list_headings(_parse(self._files[name])))

    def _render(self, name: str) -> str:
        """Return the HTML of a page, or of the list of pages."""
        parser = _parser()
        tokens = _parse(self._files[name]) if name else []
        headings = _list_headings(tokens)
        openings = (token for token in tokens if token.type == "heading_open")
        for token, heading in zip(openings, headings, strict=True):
            token.attrSet("id", heading.anchor)
        self._correct_links(tokens, name)
        for token in tokens:
            if token.type == "fence" and token.info.strip() == "math":
                token.type, token.content = "html_block", draw_equation(token.content)
        root = "../" * name.count("/")
        groups: dict[str, list[tuple[str, str, bool]]] = {}
        for page in self.names:
            link = root + page, self._title(page), page == name
            groups.setdefault(_GROUPS[_top_folder(page)], []).append(link)
        return str(
            _template().render(
                title=self._title(name) if name else "Help",
                body=parser.renderer.render(tokens, parser.options, {}),
                headings=[heading for heading in headings if heading.level in (2, 3)],
                groups=list(groups.items()),
                root=root or "./",
            )
        )

    def _correct_links(self, tokens: list[Any], name: str) -> None:
        """Open links to the web in another tab, and unlink what is not served (in place)."""
        for token in (child for parent in tokens for child in parent.children or ()):
            if token.type == "link_open":
                address = str(token.attrGet("href") or "")
                if _SCHEME.match(address):
                    token.attrSet("target", "_blank")
                    token.attrSet("rel", "noopener noreferrer")
                elif not address.startswith("#") and not self._is_known(
                    address.partition("#")[0], name
                ):
                    del token.attrs["href"]
            elif token.type == "image" and not self._is_known(str(token.attrs["src"]), name):
                del token.attrs["src"]  # its description is shown

    def _is_known(self, address: str, name: str) -> bool:
        """Whether a relative address on the page ``name`` is that of a page or picture."""
        target = posixpath.normpath(posixpath.join(posixpath.dirname(name), address))
        return target in self._files

    def _title(self, name: str) -> str:
        """Return the first heading of a page, else its name."""
        return _read_title(self._files[name]) or name


def docs_folder() -> Path | None:
    """Return the folder of the documentation: in the package or, in a checkout, beside it; None if
    absent."""
    return next(
        (path for path in (_PACKAGE / "docs", _PACKAGE.parent / "docs") if path.is_dir()), None
    )


def draw_equation(latex: str) -> str:
    """Return an equation as HTML: an SVG in the colour of the text, which needs neither a script
    nor a network.

    ``latex``: what matplotlib's mathtext reads of LaTeX. Raises ValueError for anything else.
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    source = " ".join(latex.split())
    path = TextPath((0, 0), f"${source}$", size=10, prop=FontProperties(math_fontfamily="stix"))
    box = path.get_extents().padded(1.0)
    letters = {1: "M", 2: "L", 3: "Q", 4: "C", 79: "Z"}
    drawn = "".join(
        letters[int(code)]
        + (
            ""
            if code == path.CLOSEPOLY
            else " ".join(f"{(-x if k % 2 else x):.2f}" for k, x in enumerate(points))
        )
        for points, code in path.iter_segments(simplify=False)
    )
    return (
        f'<p class="equation"><svg role="img" aria-label="{escape(source)}"'
        f' width="{box.width / 10:.2f}em" height="{box.height / 10:.2f}em" viewBox="{box.x0:.1f}'
        f' {-box.y1:.1f} {box.width:.1f} {box.height:.1f}" fill="currentColor"><path'
        f' d="{drawn}"/></svg></p>\n'
    )


def _top_folder(name: str) -> str:
    """Return the first folder of a name; empty where there is none."""
    return name.partition("/")[0] if "/" in name else ""


def _is_served(name: str) -> bool:
    """Whether a file of this name is one of the pages or pictures that a user of the program
    reads."""
    folder = _top_folder(name)
    if name.endswith(".md"):
        return folder in _GROUPS and name not in _DEVELOPMENT and not name.endswith("/index.md")
    hidden = any(part.startswith((".", "_")) for part in name.split("/"))
    return Path(name).suffix in _PICTURES and not hidden


@cache
def _parser() -> Any:
    """Return the Markdown parser: CommonMark with tables, and HTML shown as text."""
    from markdown_it import MarkdownIt

    return MarkdownIt("commonmark", {"html": False}).enable("table")


@cache
def _template() -> Any:
    """Return the template of a page."""
    from jinja2 import Environment

    source = resources.files("slviewer.server").joinpath("help_page.html.j2").read_text("utf-8")
    return Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(source)


@cache
def _read_title(path: Path) -> str:
    """Return the text of a page's first heading; empty without one."""
    return next((heading.text for heading in _list_headings(_parse(path))), "")


def _parse(page: Path) -> list[Any]:
    """Return the tokens of a page's Markdown, without its comments."""
    tokens: list[Any] = _parser().parse(_COMMENT.sub("", page.read_text("utf-8")))
    return tokens


def _list_headings(tokens: list[Any]) -> list[_Heading]:
    """List the headings among a page's tokens, with the anchors that GitHub and Sphinx give
    them."""
    headings, used = [], Counter[str]()
    for opening, inline in pairwise(tokens):
        if opening.type == "heading_open":
            text = "".join(c.content for c in inline.children if c.type in ("text", "code_inline"))
            anchor = re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-")
            used[anchor] += 1
            unique = anchor if used[anchor] == 1 else f"{anchor}-{used[anchor] - 1}"
            headings.append(_Heading(int(opening.tag[1]), text, unique))
    return headings
