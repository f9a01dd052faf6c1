"""The page: one file that needs nothing, shows text as typed, and is never half written."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError, SessionError
from slviewer.records.record import Cell, Column, Table
from slviewer.report.page import Figure, Headline, PageNotice, Section, TitlePage, write_page

PIXELS = np.zeros((4, 300, 3), np.uint8)
EVIL = "<script>alert('x')</script> \"quoted\" & <img src=y onerror=z>"


def table(caption: str = "table") -> Table:
    columns = [
        Column("pose"),
        Column("RMS", "mm", "stereo"),
        Column("RMS", "mm", "pixelwise"),
    ]
    return Table(
        columns,
        [["1", 0.2, Cell(0.1, "better")]],
        caption,
        ["a note"],
        [["mean", 0.2, 0.1]],
    )


def write(path: Path, text: str = "words") -> str:
    figure = Figure(PIXELS, f"caption {text}", f"alt {text}", 300)
    items = [figure, table(text), PageNotice(text), PageNotice(text, "good")]
    write_page(
        path,
        text,
        text,
        [Headline(text, text, text), Headline("1 mm", "size")],
        [Section(text, [text, text], items)],
    )
    return path.read_text(encoding="utf-8")


def test_a_page_needs_nothing_but_itself(tmp_path: Path) -> None:
    page = write(tmp_path / "report.html")
    assert "http" not in page.replace("http-equiv", "")
    assert re.findall(r'src="([^:"]*):', page) == ["data"]
    assert not re.search(r"<(script|link|iframe|object|embed)|url\(|@import", page)
    assert "default-src 'none'" in page


def test_texts_are_shown_and_never_run(tmp_path: Path) -> None:
    page = write(tmp_path / "report.html", EVIL + "\u202e\x1b[2J")
    assert page.count("\\u202e\\x1b[2J") >= 12 and not {"\u202e", "\x1b"} & set(page)
    assert "<script" not in page and "<img src=y" not in page
    assert page.count("&lt;script&gt;alert(&#39;x&#39;)&lt;/script&gt;") >= 12
    assert not re.search(r'="[^"]*"quoted"', page)  # no attribute is broken out of


def test_the_title_page_comes_first_and_the_annex_last(tmp_path: Path) -> None:
    figure = Figure(PIXELS, "the part", "the part", 300)
    hostile = f"{EVIL}</style>\n}} \u202e"
    details = {"Customer": hostile, "Order": hostile}
    title_page = TitlePage(details, "pass", "good", [hostile], [figure], "QUJD")
    sections = [Section("Results", "", [table()]), Section("Scans", "", is_annex=True)]
    path = tmp_path / "report.html"
    write_page(path, hostile, "s", [], sections, title_page=title_page)
    page = path.read_text(encoding="utf-8")
    places = [page.index(text) for text in ("PASS", 'alt="the part"', ">Results<", ">Scans<")]
    assert places == sorted(places) and "data:image/webp;base64,QUJD" in page
    assert page.count("</style>") == 1 and "<script" not in page and "\u202e" not in page
    assert page.count("&lt;script&gt;") == 5  # in title, heading, details and reason
    (running,) = re.findall(r"@top-left \{ content: (.*); \} \} \}", page)
    assert re.fullmatch(r'"([0-9A-Za-z]|\\[0-9a-f]+ )+"', running)
    for rule in (
        "break-before: page",
        "break-inside: avoid",
        "table-header-group",
        "counter(page)",
    ):
        assert rule in page
    assert re.findall(r'<section id="[^"]+"( class="annex")?>', page) == ["", ' class="annex"']


def test_anchors_lead_to_their_sections(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_page(
        path, "t", "s", [], [Section("Two words", ""), Section("Two words", ""), Section("?", "")]
    )
    page = path.read_text(encoding="utf-8")
    targets = re.findall(r'href="#([^"]+)"', page)
    assert len(set(targets)) == 3
    assert targets == re.findall(r'<section id="([^"]+)"', page)


def test_who_wins_is_marked_and_groups_span_their_columns(tmp_path: Path) -> None:
    page = write(tmp_path / "report.html")
    assert re.search(r'class="right better">0\.100<', page)
    assert table().groups == [("", 1), ("stereo", 1), ("pixelwise", 1)]
    assert Table([Column("a", group="g"), Column("b", group="g")], [], "c").groups == [("g", 2)]
    assert Table([Column("a")], [], "c").groups == []


def test_a_row_of_another_length_is_refused() -> None:
    with raises(InputError, 2, 1):
        Table([Column("a")], [["1", "2"]], "t")


def test_a_page_is_complete_or_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "new folder" / "report.html"
    before = write(path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SessionError):
        write(path, "other")
    assert path.read_text(encoding="utf-8") == before
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]


def test_a_place_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SessionError):
        write(tmp_path / "file" / "report.html")
