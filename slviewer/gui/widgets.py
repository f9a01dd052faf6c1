"""HTML for panels: coloured text, alerts, tables, pictures with a legend, colour scales, links to
the help; and the live image, with saturated pixels, the detected board, and where to hold it next.

HTML uses viser's own colours, so that it is readable in the light and in the dark theme. Texts
given to `to_html`, `table` and `Text.write` are escaped here; a `Html` is used as it is.
"""

import base64
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
import viser
from numpy.typing import NDArray
from scipy.io import wavfile

from slviewer.errors import hide_passwords
from slviewer.geometry.vectors import thin_out
from slviewer.pipeline.operation import Stored, name_records
from slviewer.printable import capitalize
from slviewer.records.record import Column, Mark, Table, relabel
from slviewer.report.page import Figure
from slviewer.server.help_pages import PREFIX
from slviewer.server.text import escape
from slviewer.target.board import Board
from slviewer.wizard.snapshot import Level, PreviewView

NO_BREAK_HYPHEN = "\u2011"
PICTURE_PX = 720
"""Width at which pictures are sent: viser shrinks a picture to its panel but never enlarges it."""
PLOT_PX = 440
"""CSS px: as wide as the page's panel, so that letters in a figure are as large as the panel's
own."""
STEPS_PAGE, FINDINGS_PAGE = "howto/wizard.md", "explanation/findings.md"

_UNIT = re.compile(
    r"(?<=\d) (?=(?:mm|px|ms|µm|rad|ppm|kB|MB|GB|s|x"
    r" \d|&#37;|&#176;|&#215;|&#181;m)(?![a-z]))|(?<=&#177;) (?=\d)"
)
"""The space between a figure and its unit, in escaped text."""

_STANDARD = re.compile(r"(?<=ISO \d{5})-(?=\d)")  # the hyphen in its number
Tone = Literal["plain", "dim", "info", "good", "warning", "error"]
TONES = {  # by `page_style.css`
    "plain": "var(--mantine-color-text)",
    "dim": "var(--mantine-color-dimmed)",
    "info": "var(--slv-info)",
    "good": "var(--slv-good)",
    "warning": "var(--slv-warning)",
    "error": "var(--slv-error)",
}
_BOXES = {
    "plain": "var(--mantine-color-gray-light)",
    "dim": "transparent",
    "info": "var(--mantine-color-blue-light)",
    "good": "var(--mantine-color-green-light)",
    "warning": "var(--mantine-color-orange-light)",
    "error": "var(--mantine-color-red-light)",
}
DECISION_TONES: dict[str, Tone] = {"pass": "good", "fail": "error", "undecided": "warning"}
NOTICES: dict[Level, tuple[str, Any, float, Tone]] = {
    "info": ("Note", "blue", 5.0, "plain"),
    "good": ("Done", "green", 5.0, "good"),
    "warning": ("Warning", "orange", 12.0, "warning"),
    "error": ("Error", "red", 20.0, "error"),
}
"""{level: title, colour and duration s of a notification, tone in the panel}."""


class Html(str):
    """HTML made from escaped parts; adding text to it gives HTML."""

    def __add__(self, other: str) -> "Html":
        """Return the concatenation as HTML."""
        return Html(str(self) + other)


def to_html(text: object) -> Html:
    """Escape any text as HTML, without line breaks between a figure and its unit; HTML stays as it
    is.

    Passwords in addresses are hidden: whoever watches reads this too.
    """
    if isinstance(text, Html):
        return text
    whole = _STANDARD.sub(NO_BREAK_HYPHEN, hide_passwords(str(text)))
    return Html(_UNIT.sub("&#160;", escape(whole)))


def coloured(text: object, tone: Tone, *, bold: bool = False) -> Html:
    """Return text in a tone's colour; empty where the text is."""
    if text == "":
        return Html("")
    weight = ";font-weight:600" if bold else ""
    return Html(f'<span style="color:{TONES[tone]}{weight}">{to_html(text)}</span>')


def paragraph(content: object) -> Html:
    """Return HTML with the margins of viser's inputs; empty where the content is."""
    if not content:
        return Html("")
    return Html(
        '<div style="padding:0 0.75em'
        f' 0.5em;font-size:0.875em;line-height:1.45">{to_html(content)}</div>'
    )


def note(text: object, tone: Tone = "dim") -> Html:
    """Return a paragraph of text in a tone's colour."""
    return paragraph(coloured(text, tone))


def alert(content: object, tone: Tone) -> Html:
    """Return a box in a tone's colour, for a message that must not be overlooked; empty where the
    content is."""
    if not content:
        return Html("")
    style = (
        f"background:{_BOXES[tone]};border-left:3px solid"
        f" {TONES[tone]};border-radius:4px;padding:0.5em 0.7em"
    )
    return paragraph(Html(f'<div style="{style}">{to_html(content)}</div>'))


def table(
    titles: Sequence[object], rows: Sequence[Sequence[object]], aligned: Sequence[str] = ()
) -> Html:
    """Return a table: by default the first column left-aligned, the others right-aligned. Lines
    break between words alone, where the panel is too narrow. A row of one cell spans the table."""

    is_wide = len(titles) > _ROOMY_COLUMNS
    gap = 0.35 if is_wide else 0.6

    def line(tag: str, cells: Sequence[object], style: str) -> str:
        """Return one row of cells with this HTML tag and style."""
        sides = aligned or ["left", *["right"] * (len(cells) - 1)]
        span = f' colspan="{len(titles)}"' if len(cells) == 1 else ""
        return "".join(
            f'<{tag}{span} style="text-align:{side};padding:0.2em 0 0.2em'
            f' {gap * (k > 0):g}em;{style}">{_break_names(c)}</{tag}>'
            for k, (side, c) in enumerate(zip(sides, cells, strict=bool(cells[1:])))
        )

    head = line("th", titles, f"color:{TONES['dim']};font-weight:600;vertical-align:bottom")
    under = "font-variant-numeric:tabular-nums"
    rule = f"border-top:1px solid var(--mantine-color-default-border);{under}"
    body = "".join(
        # what follows a row that spans the table belongs to it
        f"<tr>{line('td', row, rule if k == 0 or len(rows[k - 1]) > 1 else under)}</tr>"
        for k, row in enumerate(rows)
    )
    style = "width:100%;border-collapse:collapse"
    if is_wide:
        style += ";font-size:0.9em"
    return paragraph(
        Html(f'<div style="overflow-x:auto"><table style="{style}">'
             f"<tr>{head}</tr>{body}</table></div>")
    )  # fmt: skip


_ROOMY_COLUMNS = 5
"""Of a table, in letters as large as the text's; more are drawn smaller and closer."""


def properties_table(title: object, properties: Mapping[str, object]) -> Html:
    """Return a table of properties with a title, without those that are None."""
    rows = [(name, value) for name, value in properties.items() if value is not None]
    return table((title, ""), rows)


def record_properties(title: object, shown: Table) -> Html:
    """Return the only row of a table but its name as properties, and its first note."""
    (row,) = shown.format(shown.rows)
    listed = {_format_title(column): text for column, text, _ in row[1:]}
    return properties_table(title, listed) + note(shown.notes[0])


def _format_title(column: Column) -> str:
    """Return a column's title with its unit."""
    return capitalize(column.title) + (column.unit and f", {column.unit}")


def report_table(shown: Table) -> Html:
    """Return a table of figures without its details, with its notes. Names in front of other names
    and many columns stand in rows of their own."""
    tones: dict[Mark, Tone] = {"better": "good", "worse": "warning", "muted": "dim"}
    shown = shown.without_details()
    # a line ends between words, in any font
    titles = [_format_title(each).replace("-", NO_BREAK_HYPHEN) for each in shown.columns]
    rows = [
        [
            coloured(
                _break_names(text), tones.get(mark, "plain"), bold=mark in ("better", "strong")
            )
            for _, text, mark in line
        ]
        for line in shown.format([*shown.rows, *shown.footer])
    ]
    is_named_twice = [column.align for column in shown.columns[:2]] == ["left", "left"]
    if len(titles) >= _ROOMY_COLUMNS and is_named_twice:
        titles = [f"{titles[0]} / {titles[1][:1].lower()}{titles[1][1:]}", *titles[2:]]
        rows = [
            each
            for name, *rest in rows
            for each in (*([[Html(f"<b>{name}</b>")]] if to_html(name) else []), rest)
        ]
    caption = paragraph(coloured(shown.caption, "plain", bold=True))
    aligned = [column.align for column in shown.columns][-len(titles) :]
    return caption + table(titles, rows, aligned) + "".join(map(note, shown.notes))


def _break_names(text: object) -> Html:
    """Return text whose lines may break behind the underscores of names; HTML stays as it is."""
    return text if isinstance(text, Html) else Html(to_html(text).replace("&#95;", "&#95;<wbr>"))


def records_html(
    found: Sequence[Stored[Any]],
    labels: Mapping[str, str] = MappingProxyType({}),
    *,
    named: bool = True,
) -> Html:
    """Return the tables of records of one kind, with the operator's ``labels`` for names of
    captures; a warning names those that are stale. Not ``named``: of one record, whose name stands
    above."""
    if not found:
        return Html("")
    tables = type(found[0].record).tables(name_records(found))
    if found[0].record.is_number(found[0].name):  # captures are named inside
        tables = [relabel(each, labels) for each in tables]
    if not named:
        tables = [replace(each.without_constant(), caption="") for each in tables]
    html = "".join(map(report_table, tables))
    if stale := ", ".join(each.label for each in found if each.stale):
        html += note(f"Out of date, made from what has changed since: {stale}.", "warning")
    return Html(html)


def link(address: str, text: str) -> Html:
    """Return a button-like link that downloads the file at this address of the server."""
    style = (
        "display:inline-block;padding:0.35em"
        " 0.9em;border-radius:4px;text-decoration:none;font-weight:600;"
        "background:var(--mantine-primary-color-filled);color:#fff"
    )
    return Html(f'<a href="{to_html(address)}" download style="{style}">{to_html(text)}</a>')


def help_link(anchor: str, page: str = FINDINGS_PAGE, style: str = "") -> Html:
    """Return a link that opens a section of a page of the help in another tab: of a step, or of a
    finding, which is named after its key: the cause of a diagnosis, the name of a check, the reason
    of a refusal.

    Its address is relative to the wizard's own, which differs between the operator and those who
    watch.
    """
    address = to_html(f"{PREFIX}{page}#{anchor}")
    colour = "color:var(--mantine-color-anchor);font-weight:400;white-space:nowrap"
    return Html(
        f'<a href="{address}" target="_blank" rel="noopener" style="{colour};{style}">Help</a>'
    )


def thumbnail(jpeg: bytes, width_px: int, alt: str, frame: str = "") -> Html:
    """Return a small picture inside HTML; an empty box until there is a JPEG. ``frame``: the
    attributes by which the page reads the pixels of the whole frame."""
    height = round(0.75 * width_px)
    if not jpeg:
        style = (
            f"width:{width_px}px;height:{height}px;border-radius:4px;"
            "background:var(--mantine-color-gray-light)"
        )
        return Html(f'<div style="{style}"></div>')
    data = base64.b64encode(jpeg).decode()
    style = f"width:{width_px}px;height:{height}px;object-fit:cover;border-radius:4px;display:block"
    source = f"data:image/jpeg;base64,{data}"
    # enlarged by `image_lens.js`
    return Html(f'<img alt="{to_html(alt)}" data-zoom="" {frame} src="{source}" style="{style}">')


def meter(share: float) -> Html:
    """Return a bar that is filled to `share`, 0 ... 1."""
    width = 100 * min(max(share, 0.0), 1.0)
    return Html(
        '<div style="height:6px;border-radius:3px;background:var(--mantine-color-gray-light)">'
        f'<div style="height:6px;border-radius:3px;width:{width:.0f}%;background:{TONES["info"]}">'
        "</div></div>"
    )


class Text:
    """A piece of HTML in a panel, sent only when it changes, hidden while it is empty."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._handle = gui.add_html("", visible=False)

    def set(self, content: str) -> None:
        """Show HTML, as `paragraph`, `alert`, `table` and the like return it."""
        self._handle.content = str(content)  # an Html would not be sent
        self._handle.visible = bool(content)

    def write(self, text: str, tone: Tone = "plain") -> None:
        """Show a sentence, in a box where its tone requires attention; hide it where it is
        empty."""
        self.set((note if tone in ("plain", "dim") else alert)(text, tone))


class Picture:
    """An image in a panel with a legend below, hidden until there is one."""

    def __init__(
        self, gui: viser.GuiApi, label: str | None = None, *, width_px: int = PICTURE_PX
    ) -> None:
        self._width = width_px
        empty = np.full((3 * width_px // 4, width_px, 3), 128, np.uint8)
        self._image = gui.add_image(
            empty, label=label, format="jpeg", jpeg_quality=80, visible=False
        )
        self._legend = Text(gui)

    def set(self, image: np.ndarray, legend: str = "") -> None:
        """Show an image (h, w) or (h, w, 3) uint8 RGB, scaled to the panel, and the legend (HTML,
        empty: none)."""
        self._image.image = fitted(image, self._width)
        self._image.visible = True
        self._legend.set(legend)

    def hide(self) -> None:
        """Hide image and legend."""
        self._image.visible = False
        self._legend.set("")


class Plot:
    """A figure in a panel with its caption below; hidden while there is none. The figures are those
    of the report, drawn narrower."""

    def __init__(self, gui: viser.GuiApi) -> None:
        blank = np.full((8, 2 * PLOT_PX, 3), 255, np.uint8)
        self._image = gui.add_image(blank, format="png", visible=False)
        self._caption = Text(gui)

    def set(self, figure: Figure | None) -> None:
        """Show a figure with its caption; None: hide both."""
        if figure:
            self._image.image = figure.pixels
        self._image.visible = figure is not None
        # in the dark theme, `page_style.css` exchanges light and dark
        self._caption.set(f"<div data-figure>{note(figure.caption)}</div>" if figure else "")


class Sound:
    """Plays short tones in the browsers that show the page; silent until someone has clicked in
    them."""

    _TONES_HZ: ClassVar[dict[str, tuple[float, ...]]] = {
        "tick": (880.0,),
        "captured": (1320.0, 1760.0),
        "good": (880.0, 1320.0),
        "bad": (330.0, 220.0),
    }

    def __init__(self, gui: viser.GuiApi) -> None:
        self._handle = gui.add_html("")
        self._count = 0

    def play(self, name: Literal["tick", "captured", "good", "bad"]) -> None:
        """Play a tone once in every browser."""
        self._count += 1
        data = base64.b64encode(_encode_wav(self._TONES_HZ[name])).decode()
        self._handle.content = (
            f'<audio autoplay data-n="{self._count}" src="data:audio/wav;base64,{data}"></audio>'
        )


def _encode_wav(tones_hz: Sequence[float]) -> bytes:
    """Return a WAV file, 8-bit mono, of tones in Hz that each last 0.12 s."""
    rate, seconds = 8000, 0.12
    t = np.arange(int(rate * seconds)) / rate
    envelope = np.minimum(1, np.minimum(t, seconds - t) / 0.01)  # without it, tones click
    samples = np.concatenate([envelope * np.sin(2 * np.pi * f * t) for f in tones_hz])
    file = io.BytesIO()
    wavfile.write(file, rate, (128 + 90 * samples).astype(np.uint8))
    return file.getvalue()


def fitted(image: np.ndarray, width_px: int = PICTURE_PX) -> np.ndarray:
    """Resize an image (h, w) or (h, w, 3) uint8 to (h', width_px, 3) RGB, for `add_image`."""
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    height, width = image.shape[:2]
    how = cv2.INTER_AREA if width > width_px else cv2.INTER_LINEAR
    return cv2.resize(
        image, (width_px, max(1, round(height * width_px / width))), interpolation=how
    )


ColourScale = Literal["value", "amount", "error"]
# an error's: blue below, red above; an amount's is light where there is none
_COLOUR_MAPS: dict[ColourScale, str] = {"value": "viridis", "amount": "YlOrRd", "error": "RdBu_r"}


def colours(
    values: NDArray[np.floating],
    low: float,
    high: float,
    scale: ColourScale = "value",
) -> NDArray[np.uint8]:
    """Map values (...) to colours (..., 3) uint8 RGB over low ... high; middle grey where NaN."""
    from matplotlib import colormaps

    share = (np.asarray(values, float) - low) / max(high - low, 1e-12)
    painter = colormaps[_COLOUR_MAPS[scale]].with_extremes(bad=(128 / 255,) * 3)
    return np.asarray(painter(np.ma.masked_invalid(np.clip(share, 0, 1)), bytes=True)[..., :3])


def colour_bar(low: str, high: str, scale: ColourScale | NDArray[np.uint8], title: str) -> Html:
    """Return the legend of a colour scale, that of `colours` or colours (n, 3), from `low` to
    `high` with units."""
    palette = colours(np.linspace(0, 1, 9), 0, 1, scale) if isinstance(scale, str) else scale
    stops = ",".join("rgb({},{},{})".format(*colour) for colour in palette)
    return paragraph(
        Html(
            f'<div style="display:flex;gap:0.6em;align-items:center"><span>{to_html(low)}</span>'
            '<div style="flex:1;height:10px;border-radius:3px;'
            f'background:linear-gradient(90deg,{stops})"></div>'
            f"<span>{to_html(high)}</span></div>"
            f'<div style="text-align:center">{to_html(title)}</div>'
        )
    )


def paint(
    values: NDArray[np.floating],
    unit: str,
    digits: int,
    title: str,
    scale: ColourScale = "value",
) -> tuple[NDArray[np.uint8], Html]:
    """Return (colours (..., 3) of values (...), their legend), from the 1st to the 99th percentile;
    grey where NaN."""
    low, high = colour_range(values)
    bar = colour_bar(f"{low:.{digits}f} {unit}", f"{high:.{digits}f} {unit}", scale, title)
    return colours(values, low, high, scale), bar


def colour_range(values: NDArray[np.floating]) -> tuple[float, float]:
    """Return the limits of a colour scale: 1st and 99th percentile of the finite values; (0, 1)
    without any."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(thin_out(finite, 300_000), [1, 99])
    return float(low), float(high)


_DETECTED, _GHOST, _CLIPPED = (60, 220, 90), (40, 190, 255), (255, 0, 80)
_UNCHANGING = (128, 128, 128)
_STRIPE_PX = 6


class LiveImage(Picture):
    """The live image in a corner of the view, by `page_style.css`, with what is to be seen in it;
    large where `is_large`, until a click changes it."""

    is_large = False
    _camera_px = 0
    _numbers = count()

    def __init__(self, gui: viser.GuiApi) -> None:
        self._marker, self._number = Text(gui), next(self._numbers)
        super().__init__(gui)

    def set(self, image: np.ndarray, legend: str = "") -> None:
        """Show an image and its legend."""
        size = "large" if self.is_large else "small"
        known = f'data-image="{self._number}" data-camera-px="{self._camera_px}"'
        self._marker.set(f'<div data-live="{size}" {known}></div>')
        ratio = image.shape[0] / image.shape[1]
        below = f'<div data-live-legend style="--ratio:{ratio:.4f}">{legend}</div>'
        super().set(image, below)

    def hide(self) -> None:
        """Hide image and legend."""
        self._marker.set("")
        super().hide()

    def draw(self, preview: PreviewView) -> None:
        """Show a frame and its exposure."""
        self._show(preview, draw_preview(preview), exposure_html(preview))

    def draw_board(
        self,
        preview: PreviewView,
        board: Board | None,
        ghost_px: np.ndarray | None = None,
        image: np.ndarray | None = None,
        *,
        is_wanted: bool = True,
    ) -> None:
        """Show a frame with the detected board, where to hold it next, and the pixels outside
        `image`; a board that is not `is_wanted` is not missed."""
        hint = "" if ghost_px is None else "Dashed blue: hold the board here"
        found = board_html(preview, board, is_wanted)
        hidden = "" if image is None or image.all() else "Striped: no light changes these pixels"
        lines = found, exposure_html(preview), coloured(hint, "info"), coloured(hidden, "info")
        self._show(preview, draw_preview(preview, board, ghost_px, image), *lines)

    def _show(self, preview: PreviewView, picture: np.ndarray, *lines: Html) -> None:
        """Show the picture of a frame, with lines below; what is drawn states the camera's width
        to `image_lens.js`."""
        wide = 1 if preview.second is None else 2
        self._camera_px = round(wide * preview.image.shape[1] / preview.scale)
        self.set(picture, legend(preview, *lines))


def _fit_mask(mask: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Return a mask of a frame (h, w) at the size of its picture."""
    size = picture.shape[1::-1]
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def draw_preview(
    preview: PreviewView,
    board: Board | None = None,
    ghost_px: np.ndarray | None = None,
    image: np.ndarray | None = None,
) -> np.ndarray:
    """Draw the frame (h, w, 3) uint8 with saturated pixels, the detected board and the suggested
    outline marked; a second camera's frame beside it.

    The board's features are joined row by row; `ghost_px` is the outline (4, 2) of the suggested
    pose, in camera px; what light never changes, outside ``image`` (h, w) bool, is hatched.
    """
    picture = fitted(preview.image)
    clipped = preview.image >= 255
    if clipped.any():
        picture[_fit_mask(clipped, picture)] = _CLIPPED
    if image is not None and not image.all():
        rows, columns = map(np.arange, picture.shape[:2])
        stripes = np.add.outer(rows, columns) // _STRIPE_PX % 2 > 0
        picture[_fit_mask(~image, picture) & stripes] = _UNCHANGING
    to_picture = preview.scale * PICTURE_PX / preview.image.shape[1]
    if ghost_px is not None and np.isfinite(ghost_px).all():
        _draw_dashed_outline(picture, ghost_px * to_picture)
    if preview.board:
        _draw_features(picture, preview.board.pixels * to_picture, board)
        corners = np.round(preview.board.outline * to_picture * 16).astype(np.int32)
        cv2.polylines(picture, [corners], True, _DETECTED, 2, cv2.LINE_AA, shift=4)
    if preview.second is None:
        return picture
    beside = cv2.resize(fitted(preview.second), picture.shape[1::-1], interpolation=cv2.INTER_AREA)
    beside[:, :2] = 255  # a line between both
    return np.hstack([picture, beside])


def exposure_html(preview: PreviewView) -> Html:
    """Describe whether the frame is well exposed, and what to do."""
    if preview.brightness == "saturated":
        share = 100 * preview.saturated
        return coloured(f"{share:.1f} % saturated (red): lower the exposure", "error", bold=True)
    if preview.brightness == "dim":
        return coloured(
            f"Dim, peak at {100 * preview.brightest:.0f} %: raise the exposure", "warning"
        )
    return coloured(f"Well exposed, peak at {100 * preview.brightest:.0f} %", "good")


def board_html(preview: PreviewView, board: Board | None, is_wanted: bool) -> Html:
    """Describe whether the board is detected, or why not, as a fault while it `is_wanted`."""
    if board is None:
        return coloured("No board is chosen", "dim")
    if preview.board is None and not is_wanted:
        return coloured("No board in view", "dim")
    if preview.board is None:
        missing = preview.missing or "searching for the board …"
        return coloured(capitalize(missing), "warning")
    detected, total = len(preview.board.pixels), len(board.points)
    return coloured(f"Board detected: {detected} of {total} features", "good")


def legend(preview: PreviewView, *lines: Html) -> Html:
    """Return lines below the image, the frame rate beside the first."""
    per_s = preview.frames_per_s
    # a still image is not grabbed again
    rate = coloured(f"{per_s:.0f} frames/s", "dim") if per_s >= 1 else Html("")
    first = (
        '<div style="display:flex;justify-content:space-between;gap:1em">'
        f'<span>{lines[0]}</span><span style="white-space:nowrap">{rate}</span></div>'
    )
    return paragraph(Html(first + "".join(f"<div>{line}</div>" for line in lines[1:])))


def histogram_chart(preview: PreviewView) -> Html:
    """Return a bar chart of the grey levels; the last bar is red: saturated pixels."""
    # the few bright pixels matter most
    shares = np.sqrt(preview.histogram / max(float(preview.histogram.max()), 1e-9))
    bars = "".join(
        f'<rect x="{4 * k}" y="{40 - 40 * share:.1f}" width="3.4" height="{40 * share:.1f}" '
        f'fill="var(--mantine-color-{"red-6" if k == len(shares) - 1 else "blue-5"})"/>'
        for k, share in enumerate(shares)
    )
    axis = "".join(
        f'<span style="color:var(--mantine-color-dimmed);font-size:0.75rem">{to_html(text)}</span>'
        for text in ("dark", "grey level", "saturated")
    )
    return paragraph(
        Html(
            f'<svg viewBox="0 0 {4 * len(shares)} 40" preserveAspectRatio="none"'
            ' style="width:100%;height:48px;display:block;border-bottom:1px solid'
            f' var(--mantine-color-dimmed)">{bars}</svg><div'
            f' style="display:flex;justify-content:space-between">{axis}</div>'
        )
    )


def _draw_features(picture: np.ndarray, pixels: np.ndarray, board: Board | None) -> None:
    """Draw the detected features (n, 2) px, joined row by row where all were detected."""
    at = np.round(pixels * 16).astype(np.int32)
    if board and len(pixels) == len(board.points):
        columns = board.features[0]
        for row in at.reshape(-1, columns, 2):
            cv2.polylines(picture, [row], False, _DETECTED, 1, cv2.LINE_AA, shift=4)
    for point in at:
        cv2.circle(picture, (int(point[0]), int(point[1])), 40, _DETECTED, -1, cv2.LINE_AA, shift=4)


def _draw_dashed_outline(picture: np.ndarray, corners: np.ndarray) -> None:
    """Draw a closed dashed outline through corners (n, 2) px."""
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        dashes = max(2, int(np.linalg.norm(end - start) / 14))
        for k in range(dashes):
            a, b = (start + (end - start) * (k + part) / dashes for part in (0.0, 0.6))
            ends = [tuple(int(v) for v in np.round(p * 16)) for p in (a, b)]
            cv2.line(picture, ends[0], ends[1], _GHOST, 3, cv2.LINE_AA, shift=4)
