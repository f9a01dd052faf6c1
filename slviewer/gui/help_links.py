"""Links from panels to the help: a section for each step, and one for each finding.

A finding's section is named after its key: the cause of a diagnosis, the name of a check, the
reason of a refusal.
"""

from slviewer.gui.widgets import Html, to_html
from slviewer.server.help_pages import PREFIX

STEPS_PAGE, FINDINGS_PAGE = "howto/wizard.md", "explanation/findings.md"
STAGES = {
    "rig": "check-of-the-rig",
    "target": "target-poses",
    "poses": "target-poses",
    "calibrate": "calibration",
    "verify": "scans",
    "scan": "scans",
    "merge": "merge",
    "measure": "measurements",
    "export": "measurements",
}
"""{step: anchor of the findings of its stage}."""


def help_link(anchor: str, page: str = FINDINGS_PAGE, style: str = "") -> Html:
    """Return a link that opens a section of a page of the help in another tab.

    Its address is relative to the wizard's own, which differs between the operator and those who
    watch.
    """
    address = to_html(f"{PREFIX}{page}#{anchor}")
    colour = "color:var(--mantine-color-anchor);font-weight:400;white-space:nowrap"
    return Html(
        f'<a href="{address}" target="_blank" rel="noopener" style="{colour};{style}">Help</a>'
    )


def step_help_link(step: str) -> Html:
    """Return the link to the section of a step, for the right end of its heading."""
    return help_link(step, STEPS_PAGE, "float:right;font-size:0.875rem;line-height:1.9rem")
