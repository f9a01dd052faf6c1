"""One HTML file that holds everything it shows: text, tables, and figures as embedded images,
without script or network; and what all figures share: a canvas without global state, the palette,
the styles of axes.

matplotlib is used through its objects alone (no pyplot, no rcParams), so that reports may be
written by any thread."""

import base64
import hashlib
import html
import io
import os
import re
import threading
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
from slviewer.records.record import Mark, Table
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


FULL = 1080
"""CSS px: a figure as wide as the page's text column."""
HALF = 528
"""CSS px: two figures side by side."""
DENSITY = 2
"""Device pixels drawn for each CSS px."""

INK, SOFT, RULE, EMPTY = "#1b2733", "#5a6877", "#e3e8ed", "#d5d9de"
MODELS = {"stereo": "#d9692b", "pixelwise": "#2270b8", "splined": "#1f9673"}
REGIONS = {"R1": "#7b5cc4", "R2": "#4f6375", "R3": "#b8436d"}
BAND = "#e8eef4"
_OTHERS = ("#6f7d8c", "#a04f9e")
TEXT_PT, SMALL_PT, TITLE_PT = 9.0, 8.2, 10.0

# Agg's text layout shares one font cache
_drawing = threading.Lock()


def model_colour(model: str) -> str:
    """The colour that represents a model in every figure."""
    return MODELS.get(model) or _OTHERS[sum(model.encode()) % len(_OTHERS)]


def new_figure(width: int, height: int) -> Any:
    """A matplotlib figure of ``width`` x ``height`` CSS px."""
    from matplotlib.figure import Figure as Drawing

    return Drawing(
        figsize=(width / 100, height / 100),
        dpi=100 * DENSITY,
        facecolor="white",
        layout="constrained",
    )


def finish_figure(drawing: Any, caption: str, alt: str) -> Figure:
    """Draw a matplotlib figure, and return it as a figure of a report."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with _drawing:
        canvas = FigureCanvasAgg(drawing)
        canvas.draw()
        rgb = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
    return Figure(rgb, caption, alt, rgb.shape[1] // DENSITY)


def style_axes(
    axes: Any, title: str, x: str = "", y: str = "", *, grid: bool = True, colour: str = INK
) -> None:
    """Style axes plainly: a light grid, two spines, labels in the page's sizes; ``x`` and ``y``
    name the axes."""
    axes.set_title(title, fontsize=TITLE_PT, color=colour, loc="left", fontweight="bold", pad=7)
    axes.set_xlabel(x, fontsize=TEXT_PT, color=SOFT)
    axes.set_ylabel(y, fontsize=TEXT_PT, color=SOFT)
    axes.tick_params(labelsize=SMALL_PT, colors=SOFT, length=3, width=0.7)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#b9c2cb")
        spine.set_linewidth(0.8)
    if grid:
        axes.grid(True, color=RULE, linewidth=0.7)
        axes.set_axisbelow(True)


def style_image_axes(axes: Any, title: str = "", colour: str = INK) -> None:
    """Style the axes of an image: a title, no ticks and no frame."""
    style_axes(axes, title, grid=False, colour=colour)
    axes.set_xticks([])
    axes.yaxis.set_visible(False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def add_legend(axes: Any, **options: Any) -> None:
    """Add a legend of the labelled artists to the axes, in the page's type."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(**{"fontsize": SMALL_PT, "labelcolor": INK, "frameon": False, **options})


def add_legend_above(axes: Any, columns: int, **options: Any) -> None:
    """Add a legend in one line above the axes, at their left."""
    place = {"loc": "lower left", "bbox_to_anchor": (0, 1.0), "borderaxespad": 0.2}
    add_legend(axes, ncols=columns, **{**place, **options})


def label_point(
    axes: Any, text: str, place: Any, offset: tuple[float, float] = (0, 2), **style: Any
) -> None:
    """Write text beside a point of the axes, ``offset`` typographic points away."""
    axes.annotate(text, place, offset, textcoords="offset points", **style)


def add_colour_bar(drawing: Any, image: Any, axes: Any, label: str, **options: Any) -> None:
    """Add a colour bar beside ``axes``, in the page's type."""
    bar = drawing.colorbar(image, ax=axes, **{"shrink": 0.9, "aspect": 24, "pad": 0.02, **options})
    bar.ax.tick_params(labelsize=SMALL_PT, colors=SOFT, length=3, width=0.7)
    bar.set_label(label, fontsize=TEXT_PT, color=SOFT)
    bar.outline.set_visible(False)


def draw_map(
    axes: Any, image: NDArray[np.floating], colours: str, levels: int, low: float, high: float
) -> Any:
    """Draw a map (h, w), grey where NaN, with ``levels`` levels of a colour map ``low`` to
    ``high``; returns the image.

    Maps that are finer than the figure are averaged.
    """
    from matplotlib import colormaps

    return axes.imshow(
        np.ma.masked_invalid(image),
        cmap=colormaps[colours].resampled(levels).with_extremes(bad=EMPTY),
        vmin=low,
        vmax=high,
        interpolation="auto",
        interpolation_stage="rgba",
    )


def round_up(value: float) -> float:
    """The value rounded up to 1, 1.5, 2, 3, 4, 5, 6, 8 or 10 times a power of ten; 1 unless finite
    and positive."""
    if not (np.isfinite(value) and value > 0):
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(
        next(s for s in (1, 1.5, 2, 3, 4, 5, 6, 8, 10, 15) if s * power >= value * (1 - 1e-9))
        * power
    )


def percentile(values: np.ndarray, share: float) -> float:
    """A percentile of the finite values; NaN where there is none."""
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, share)) if finite.size else float("nan")
