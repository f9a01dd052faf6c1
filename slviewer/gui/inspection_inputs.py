"""Inspection plans in the step Measure: uploaded or made, run on scans, with the table of what
passes."""

from slviewer.errors import InputError
from slviewer.gui.panel import PanelPart
from slviewer.gui.widgets import DECISION_TONES, Html, Text, alert, coloured, note, paragraph, table
from slviewer.pipeline.inspect_parts import FILES
from slviewer.pipeline.stored_records import Stored
from slviewer.records.inspection import RULE, Characteristic, CharacteristicResult, Inspection
from slviewer.session.inspection_plan import OWN_PLAN

ALL = "all"
TABLE_PX = 320
"""Greatest height of the table."""


class InspectionInputs(PanelPart):
    """Inputs that run an inspection plan on the surface that is shown, or on every scan, and what
    came of it."""

    _surface = ""

    def build(self) -> None:
        """Create the inputs."""
        gui = self._gui
        with gui.add_folder("Inspection plan", expand_by_default=False) as self._folder:
            self._plan = self.choice("Plan", "Make one from the results above, or upload one")
            self.upload_button("Upload plan", self._operator.upload_plan, ".toml")
            self._parts = self.choice("Parts")
            self._run = self.button("Run plan", self._request_run, "list-check", None)
            self._result = Text(gui)
            self._files = Text(gui)

    def offer(self, surface: str) -> None:
        """Offer the session's plans for the shown surface and for all scans, and show the latest
        results."""
        session = self.panel.session
        self._surface = surface
        self._folder.visible = bool(surface)
        self._plan.offer(
            {
                "made here" if plan == OWN_PLAN else plan.partition("/")[2]: plan
                for plan in session.plans
            }
        )
        self._scans = [scan.name for scan in session.scans if scan.cloud == "fresh"]
        every = {f"all {len(self._scans)} scans": ALL} if len(self._scans) > 1 else {}
        self._parts.offer({"the surface shown": ""} | every)
        self._run.disabled = self.panel.snapshot.is_busy or not session.plans
        runs = session.list_records(Inspection)
        self._result.set(inspection_html(runs[-1]) if runs else "")
        self._files.set(self.context.links_html(session.exports, *FILES) if runs else "")

    def _request_run(self) -> None:
        """Request that the chosen plan be run."""
        if not self._plan.value:
            raise InputError("there is no plan yet: press Make plan, or upload one")
        parts = self._scans if self._parts.value == ALL else [self._surface]
        self._operator.run_plan(self._plan.value, *parts)


def inspection_html(run: Stored[Inspection]) -> Html:
    """Return how many parts pass, and a table of their characteristics with limits and
    decisions."""
    seen, counts = run.record, run.record.count_parts()
    said = ", ".join(
        coloured(f"{n} {decision}", DECISION_TONES[decision], bold=True)
        for decision, n in counts.items()
        if n
    )
    html = paragraph(Html(f"{coloured(seen.plan, 'plain', bold=True)}: {said}"))
    if run.stale:
        html += alert("Out of date: a scan has changed since; run the plan again.", "warning")
    rows: list[tuple[object, ...]] = []
    for part in seen.parts:
        for i, (wanted, result) in enumerate(zip(seen.characteristic, part.results, strict=True)):
            title = coloured(part.part, "dim") if i == 0 and len(seen.parts) > 1 else Html("")
            name = Html(f"{title}{'<br>' if title else ''}{coloured(result.name, 'plain')}")
            mark = coloured(result.decision, DECISION_TONES[result.decision], bold=True)
            rows.append(
                (name, format_result(wanted, result), Html(f"{format_limits(wanted)}<br>{mark}"))
            )
    scrolled = (
        f'<div style="max-height:{TABLE_PX}px;overflow-y:auto">'
        f"{table(('', 'Value ± U', 'Limits'), rows)}</div>"
    )
    reasons = {
        f"{result.name}: {result.reason}"
        for part in seen.parts
        for result in part.results
        if result.reason
    }
    notes = "".join(note(f"Not measured: {reason}", "warning") for reason in sorted(reasons))
    if not all(result.whole for part in seen.parts for result in part.results):
        notes += note("Some U hold no part of the calibration's uncertainty: it is unknown.")
    return html + scrolled + notes + note(RULE)


def format_result(wanted: Characteristic, result: CharacteristicResult) -> Html:
    """Return a value with its uncertainty and unit; a dash where it was not measured."""
    if result.value is None:
        return coloured("–", "dim")
    uncertainty = "" if result.U is None else f" ± {result.U:.3f}"
    return coloured(f"{result.value:.3f}{uncertainty} {wanted.unit}", "plain")


def format_limits(wanted: Characteristic) -> Html:
    """Return the limits of a characteristic in words."""
    low, high = wanted.lower, wanted.upper
    if low is None:
        return coloured("none" if high is None else f"≤ {high:g}", "dim")
    return coloured(f"≥ {low:g}" if high is None else f"{low:g} to {high:g}", "dim")
