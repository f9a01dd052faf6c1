"""One HTML file that holds everything it shows: text, tables, and figures as embedded images. No
script, no network."""

import base64
import hashlib
import html
import io
import os
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slviewer import __version__
from slviewer.printable import escape_controls
from slviewer.records.table import Mark, Table
from slviewer.session.atomic import replace_file

CERTIFICATE = '<template id="certificate">', "</template>"
"""What stands before and after a page's certificate: what it was made from, as escaped JSON;
browsers neither show nor run it."""
_WRITTEN = "<footer>", "</footer>"


@dataclass(frozen=True, eq=False)
class Figure:
    """A picture: ``pixels`` (h, w, 3) uint8 RGB, a caption, a text ``alt`` that describes it;
    ``width`` in CSS px."""

    pixels: NDArray[np.uint8]
    caption: str
    alt: str
    width: int

    @property
    def png(self) -> bytes:
        """The picture as a PNG file."""
        return _encode_image(self.pixels, format="PNG")


def _encode_webp(figure: Figure) -> str:
    """The picture in 64 levels a channel as base64 of a lossless WebP file, two thirds of the PNG's
    size."""
    levels = np.asarray(figure.pixels & 0xFC | figure.pixels >> 6, np.uint8)
    return base64.b64encode(
        _encode_image(levels, format="WEBP", lossless=True, method=1, quality=0)
    ).decode()


def _encode_image(pixels: NDArray[np.uint8], **options: Any) -> bytes:
    """An image file of pixels (h, w, 3) uint8 RGB, by Pillow's options."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, **options)
    return buffer.getvalue()


@dataclass(frozen=True)
class PageNotice:
    """A sentence that must not be overlooked."""

    text: str
    kind: Literal["warning", "good", "plain"] = "warning"


Item = Figure | Table | PageNotice


@dataclass(frozen=True)
class Section:
    """A titled part of a page: paragraphs, then its figures, tables and notices in order. Sections
    of the annex follow the others, and are lettered."""

    title: str
    text: str | Sequence[str]
    items: Sequence[Item] = ()
    is_annex: bool = False

    @property
    def paragraphs(self) -> tuple[str, ...]:
        """The text as a tuple of paragraphs; empty without text."""
        return (
            ((self.text,) if self.text else ()) if isinstance(self.text, str) else tuple(self.text)
        )

    @property
    def anchor(self) -> str:
        """The title as an address within the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "section"


class Headline(NamedTuple):
    """A key number with its unit, its label, and a note with a value for comparison."""

    value: str
    label: str
    note: str = ""
    mark: Mark = ""


@dataclass(frozen=True, eq=False)
class TitlePage:
    """What a report begins with: ``details`` by name, a ``logo`` (WebP as base64), the ``verdict``
    in a word, what it rests on, and pictures side by side."""

    details: Mapping[str, str]
    verdict: str
    kind: Literal["good", "bad", "warning", "plain"]
    reasons: Sequence[str]
    figures: Sequence[Figure] = ()
    logo: str = ""


def write_page(
    path: Path | str,
    title: str,
    subtitle: str,
    headlines: Sequence[Headline],
    sections: Sequence[Section],
    certify: Callable[[str], str] | None = None,
    frame: str = "in the camera's frame",
    title_page: TitlePage | None = None,
) -> None:
    """Write the page to ``path``, complete or not at all; every text is shown as typed, never run.

    ``frame``: in what coordinates places are; ``certify``: returns the text of the certificate that
    the page keeps, given its digest. Raises SessionError where the file cannot be written.
    """
    page = _render(title, subtitle, headlines, sections, frame, title_page)
    if certify is not None:
        kept = html.escape(certify(page_digest(page))).join(CERTIFICATE)
        page = page.replace("</body>", f"{kept}</body>")
    replace_file(Path(path), page.encode())


def split_page(page: str, marks: tuple[str, str]) -> tuple[str, str | None, str]:
    """Return what stands before the first pair of marks in a page, between them (None without
    them), and after."""
    before, _, rest = page.partition(marks[0])
    content, end, after = rest.partition(marks[1])
    return before, content if end else None, after


def page_digest(page: str) -> str:
    """Return the digest of a page without its certificate, and without the line that says when it
    was written."""
    body = page
    for marks in (CERTIFICATE, _WRITTEN):
        before, content, after = split_page(body, marks)
        body = before + after if content is not None else body
    return hashlib.blake2b(body.encode(), digest_size=20).hexdigest()


def _render(
    title: str,
    subtitle: str,
    headlines: Sequence[Headline],
    sections: Sequence[Section],
    frame: str,
    title_page: TitlePage | None,
) -> str:
    """The page as HTML, from the template."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    figures = [item for section in sections for item in section.items if isinstance(item, Figure)]
    figures += title_page.figures if title_page else ()
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # the encoder releases the GIL
        pictures = dict(zip(figures, pool.map(_encode_webp, figures), strict=True))
    here = Path(__file__).parent
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        # not of Markup
        finalize=lambda value: escape_controls(value) if type(value) is str else value,
    )
    environment.tests["figure"] = lambda item: isinstance(item, Figure)
    environment.tests["table"] = lambda item: isinstance(item, Table)
    environment.filters["webp"] = pictures.__getitem__
    template = environment.from_string((here / "page.html.j2").read_text(encoding="utf-8"))
    order = title_page.details.get("Order") if title_page else None
    running = " · ".join(filter(None, (title, order)))
    return template.render(
        title=title,
        title_page=title_page,
        subtitle=subtitle,
        headlines=headlines,
        sections=sections,
        style=Markup((here / "page.css").read_text(encoding="utf-8")),  # noqa: S704, ours, not a user's
        running=Markup(_format_css_string(running)),  # noqa: S704, escaped
        version=__version__,
        frame=frame,
        written=datetime.now().strftime("%Y-%m-%d %H:%M"),
    )


def _format_css_string(text: str) -> str:
    """A text as a string of a style sheet, which nothing in it can end."""
    plain = escape_controls(text)
    escaped = (c if c.isascii() and c.isalnum() else f"\\{ord(c):x} " for c in plain)
    return f'"{"".join(escaped)}"'
