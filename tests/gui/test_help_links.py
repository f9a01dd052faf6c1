"""Every step and every finding has its section in the help, and every section of a finding is
one's."""

import posixpath
import re
from pathlib import Path
from typing import get_args

from slviewer import wizard
from slviewer.fringe.phase import Reason as PixelReason
from slviewer.gui.merge_views import merge_failure_html
from slviewer.gui.shell import STAGES
from slviewer.gui.steps.calibrate import verdict_html
from slviewer.gui.steps.rig import checks_table
from slviewer.gui.widgets import FINDINGS_PAGE, STEPS_PAGE, help_link
from slviewer.pipeline.examination import Check, CheckName, Preflight
from slviewer.records.verdict import CAUSES, Finding, Verdict
from slviewer.registration.refusal import Reason as Refusal
from slviewer.server.help_pages import HelpPages, docs_folder
from slviewer.wizard.steps import STEPS

CHECK_NAMES: tuple[CheckName, ...] = get_args(CheckName)
FINDINGS = {
    *(f"pixel-{reason.name.lower()}" for reason in PixelReason if reason != PixelReason.VALID),
    *(f"check-{name}" for name in CHECK_NAMES),
    *CAUSES,
    *(f"merge-{reason}" for reason in get_args(Refusal)),
}
"""Anchors of the findings, one section each."""


def hrefs(html: str) -> list[str]:
    """Addresses of the links in HTML, each of which must open another tab."""
    links = re.findall(r'<a href="([^"]*)" target="_blank" rel="noopener"', html)
    assert len(links) == html.count("<a ")
    return [re.sub(r"&#(\d+);", lambda m: chr(int(m[1])), link) for link in links]


def test_every_finding_has_a_section_and_every_section_a_finding() -> None:
    folder = docs_folder()
    assert folder is not None
    text = (folder / FINDINGS_PAGE).read_text("utf-8")
    sections = [title.lower().replace(" ", "-") for title in re.findall(r"(?m)^### (.*)$", text)]
    assert sorted(sections) == sorted(FINDINGS)
    assert {*FINDINGS, *STAGES.values()} <= {*HelpPages().anchors(FINDINGS_PAGE)}


def test_every_section_that_notices_name_exists() -> None:
    sources = [path.read_text("utf-8") for path in (Path(wizard.__path__[0])).glob("*.py")]
    pattern = r'(?:_warner\(|_(?:run|work)\([^()]*, |notices\.add\("warning", .*, )"([a-z-]+)"'
    named = re.findall(pattern, "".join(sources))
    assert len(named) > 10 and {*named} <= {*HelpPages().anchors(FINDINGS_PAGE)}


def test_every_step_has_a_section() -> None:
    keys = list(STEPS)
    assert list(STAGES) == keys
    assert [anchor for anchor in HelpPages().anchors(STEPS_PAGE) if anchor in keys] == keys
    assert hrefs(help_link("rig", STEPS_PAGE)) == ["help/howto/wizard.md#rig"]


def test_links_between_pages_lead_to_pages_and_headings() -> None:
    pages = HelpPages()
    for name in pages.names:
        html = pages.file(name).content.decode()
        main = html[html.index("<main>") : html.index("</main>")]
        for address in re.findall(r'href="([^":]*)"', main):
            path, _, anchor = address.partition("#")
            target = (
                posixpath.normpath(posixpath.join(posixpath.dirname(name), path)) if path else name
            )
            assert pages.file(target), (name, address)
            assert not anchor or anchor in pages.anchors(target), (name, address)


def test_findings_checks_and_refusals_link_to_their_sections() -> None:
    findings = [
        Finding(cause, "note" if i % 2 else "doubtful", "it is so", "do this")
        for i, cause in enumerate(CAUSES)
    ]
    linked = hrefs(verdict_html(Verdict.of(findings), True, None))
    assert sorted(linked) == sorted(f"help/{FINDINGS_PAGE}#{cause}" for cause in CAUSES)
    checks = tuple(
        Check(name, "good" if name == "noise" else "bad", "So.", "Do.", {}) for name in CHECK_NAMES
    )
    linked = hrefs(checks_table(Preflight(checks, None, None, None, 1.0)))
    assert linked == [
        f"help/{FINDINGS_PAGE}#check-{name}" for name in CHECK_NAMES if name != "noise"
    ]
    assert hrefs(merge_failure_html("no", {}, None, "plane")) == [
        f"help/{FINDINGS_PAGE}#merge-plane"
    ]
    assert hrefs(merge_failure_html("no", {})) == hrefs(help_link("merge"))
