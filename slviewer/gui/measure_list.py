"""The measurements: drawn in 3D, listed, shown one by one, renamed, deleted, restored, written as a
table; a section with cursors to measure in it; and plans that repeat them on other scans."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.gui.panel import PanelPart, scan_labels
from slviewer.gui.widgets import (
    DECISION_TONES,
    PLOT_PX,
    Html,
    Plot,
    Text,
    alert,
    coloured,
    note,
    paragraph,
    properties_table,
    records_html,
    report_table,
    table,
    to_html,
)
from slviewer.inspection.deviation import colour_limit
from slviewer.inspection.features import Feature, perpendicular_axes
from slviewer.inspection.section import (
    CutPlane,
    measure_cursors,
    nearest_on_section,
    radius_through,
)
from slviewer.pipeline.inspect_parts import FILES
from slviewer.pipeline.measure import section_lines
from slviewer.pipeline.operation import Stored, load_arrays, name_records
from slviewer.records.inspection import RULE, Characteristic, CharacteristicResult, Inspection
from slviewer.records.measurement import Measurement, list_quantities
from slviewer.records.record import from_plain, relabel, to_plain
from slviewer.report.page import Figure, finish_figure, new_figure, style_axes
from slviewer.report.surfaces import draw_deviations, section_plot
from slviewer.session.inspection_plan import OWN_PLAN
from slviewer.wizard.result_requests import PLAN, TABLE

_ROUND = 48
_OFF = 0.01
"""Lines on the surface are drawn above it by this share of its size, so as to be visible."""
_LEG, _SHORTEST_LEG_MM = 0.15, 5.0
"""Length of a dimension's legs, as a share of the dimension and at least."""
_EXTENT_MM = 15.0
"""Half size of a plane or a cylinder whose region has none."""


def label(measured: Stored[Measurement]) -> str:
    """Return a measurement's label in 3D: the name, and the first quantity."""
    what, first = measured.record.what, measured.record.quantities[0]
    if what in ("point", "section", "deviation"):
        return measured.label
    named = "" if what in ("distance", "relation") else f"{first.name} "
    return f"{measured.label}: {named}{first.format()}" + (" (stale)" if measured.stale else "")


def drawn(
    measured: Measurement, others: Mapping[str, Measurement], lines: Sequence[np.ndarray] = ()
) -> tuple[np.ndarray, np.ndarray] | None:
    """Draw a measurement: ((n, 2, 3) segments, (3,) position of its label) mm; None where nothing
    can be drawn.

    ``others``: all measurements by id; ``lines`` (k, 2) mm: of a section.
    """
    if measured.ends:
        a, b = (np.array(end) for end in measured.ends)
        return _draw_dimension(a, b)
    if measured.plane:
        return _draw_section(from_plain(to_plain(measured.plane), CutPlane), lines)
    if measured.what == "relation":
        return _draw_relation([feature_of(others[each]) for each in measured.of if each in others])
    feature = feature_of(measured)
    if feature is None:
        return None
    extent = _EXTENT_MM if measured.region is None else max(measured.region.size)
    return _draw_outline(feature, extent), feature.place


def feature_of(measured: Measurement) -> Feature | None:
    """Return the point, plane, sphere or cylinder of a measurement; None for other kinds."""
    return None if measured.feature is None else from_plain(to_plain(measured.feature), Feature)


def lifted(plane: CutPlane, points: np.ndarray) -> np.ndarray:
    """Convert points (n, 2) mm of a section's drawing to points (n, 3) in space."""
    return np.asarray(plane.origin + points[..., :1] * plane.along + points[..., 1:] * plane.up)


def _draw_section(plane: CutPlane, lines: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Draw the lines (k, 2) mm of a section, and return them as `drawn` does."""
    if not lines:
        return np.empty((0, 2, 3)), plane.origin
    off = _OFF * float(np.ptp(np.concatenate(lines)[:, 0]))
    cut = [lifted(plane, line + np.array([0.0, off])) for line in lines]
    return (
        np.concatenate([_join_segments(each) for each in cut]),
        cut[0][np.argmax(cut[0] @ plane.up)],
    )


def _draw_relation(features: Sequence[Feature | None]) -> tuple[np.ndarray, np.ndarray] | None:
    """Draw the dimension line between two features; None unless there are two."""
    ends = [feature for feature in features if feature]
    if len(ends) != 2:
        return None
    # outside of both; a point is on the surface already
    clear = (
        0.0
        if any(end.kind == "point" for end in ends)
        else 1.2 * max(end.radius or 0.0 for end in ends)
    )
    return _draw_dimension(ends[0].place, ends[1].place, clear)


def _draw_outline(feature: Feature, extent: float) -> np.ndarray:
    """Draw a feature as segments (n, 2, 3) mm: great circles, a disc with its normal, a cylinder's
    rings and axis."""
    if feature.kind == "point":
        return _draw_cross(feature.place, 2.5)
    if feature.kind == "sphere":
        assert feature.radius is not None
        circles = [
            _draw_circle(feature.place, axis, (1 + _OFF) * feature.radius) for axis in np.eye(3)
        ]
        return np.concatenate([*circles, _draw_cross(feature.place, 0.1 * feature.radius)])
    assert feature.direction is not None
    along = extent * feature.direction
    if feature.kind == "plane":
        normal = np.array([[feature.place, feature.place + 0.4 * along]])
        return np.concatenate(
            [_draw_circle(feature.place + _OFF * along, feature.direction, extent), normal]
        )
    assert feature.radius is not None
    ends = [feature.place - along, feature.place + along]
    rings = [_draw_circle(end, feature.direction, (1 + _OFF) * feature.radius) for end in ends]
    return np.concatenate([*rings, np.array([ends])])


def _draw_dimension(
    a: np.ndarray, b: np.ndarray, clear_mm: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a dimension line from `a` to `b`, offset towards the camera, with a leg to either end.

    Returns ((3, 2, 3) segments, (3,) position of the label) mm; the legs are at least `clear_mm`
    long.
    """
    middle = (a + b) / 2
    leg = max(_LEG * float(np.linalg.norm(b - a)), _SHORTEST_LEG_MM, clear_mm)
    up = -leg * middle / max(float(np.linalg.norm(middle)), 1e-9)
    return np.array([[a, a + up], [a + up, b + up], [b + up, b]]), middle + up


def _draw_circle(centre: np.ndarray, axis: np.ndarray, radius: float) -> np.ndarray:
    """Draw a circle as segments (n, 2, 3) mm around a centre (3,), perpendicular to an axis
    (3,)."""
    first, second = perpendicular_axes(axis)
    t = np.linspace(0, 2 * np.pi, _ROUND + 1)[:, None]
    return _join_segments(centre + radius * (np.cos(t) * first + np.sin(t) * second))


def _draw_cross(centre: np.ndarray, half: float) -> np.ndarray:
    """Draw a cross along the axes as segments (3, 2, 3) mm, `half` mm to either side of its
    centre."""
    return np.stack([centre - half * np.eye(3), centre + half * np.eye(3)], axis=1)


def _join_segments(points: np.ndarray) -> np.ndarray:
    """Join consecutive points (n, 3) to segments (n - 1, 2, 3)."""
    return np.stack([points[:-1], points[1:]], axis=1)


CHOSEN, OTHER, STALE = (200, 40, 40), (30, 90, 160), (140, 140, 140)
CURSORS = ("A", "B", "C")
_AT = (0.15, 0.85, 0.5)
"""Initial positions of the cursors, as shares of the section's length."""
_STEPS = 400
_MARKS = tuple(f"cursor {cursor}" for cursor in CURSORS)
"""Of the cursors in 3D."""
_HISTOGRAM_PX = 230
Lines = dict[str, tuple[CutPlane, list[np.ndarray]]]
"""{section: its plane, and its lines (k, 2) mm in it}."""
Looks = dict[str, tuple[Any, ...]]
"""{id: label, whether it is stale, and chosen, and the values}."""
Drawings = tuple[Sequence[Stored[Measurement]], Looks, Lines]
"""The measurements, the looks of those that are drawn, and the sections."""


class MeasurementList(PanelPart):
    """List of measurements, of which one is ``chosen``; ``is_other``: another one than in the last
    drawing."""

    chosen: Stored[Measurement] | None = None
    is_other = False
    _folder: Path | None = None
    _section_id = ""

    def build(self) -> None:
        """Create the inputs."""
        self._known: dict[str, list[float]] = {}
        self._drawn: dict[str, Any] = {}
        self._lines: Lines = {}
        gui, operator = self._gui, self._operator
        with gui.add_folder("Result") as self._chosen_folder:
            self._choice = choice = self.choice(
                "Result", follow=lambda session: [each.name for each in session.measurements]
            )
            self._histogram = Plot(gui)
            self._section = Plot(gui)
            self._cursors: list[Any] = [
                gui.add_slider(f"{name}, mm", 0.0, 1.0, 0.01, 0.0, hint=f"Cursor {name}")
                for name in CURSORS
            ]
            for slider in self._cursors:
                self.react(slider.on_update)
            self._values = Text(gui)
            self._details = Text(gui)
            self._new_name: Any = gui.add_text("New name", "", hint="Of the result")
            self.button("Rename", self._request_rename, "pencil")
            self.button(
                "Delete result",
                lambda: operator.delete_measurement(choice.value),
                "trash",
                hint="Moves it to the session's trash",
            )
        self._restore = self.button("Restore deleted", operator.undo_delete, "arrow-back-up")
        with gui.add_folder("All results") as self._table_folder:
            self._table = Text(gui)
            self.button("Write CSV", operator.export_measurements_table, "table-export")
            self.button(
                "Make plan",
                operator.make_inspection_plan,
                "repeat",
                hint="To repeat the fits on other scans",
            )
            self._file = Text(gui)

    def update(self, surface: str) -> list[Stored[Measurement]]:
        """Show the session's measurements, in 3D those on the ``surface``; returns the new ones."""
        session, measured = self.panel.session, self.panel.session.measurements
        values = {each.name: [q.value for q in each.record.quantities] for each in measured}
        previous = self.chosen and self.chosen.name
        if session.folder != self._folder:
            self._open_session(session.folder, values)
            previous = None
        new = [each for each in measured if each.name not in self._known]
        self._remember(values)
        self.chosen = self._offer(measured)
        # at the opening nothing is new, and nothing was chosen: the surface stays as it is
        was_opened = previous is None and not new
        self.is_other = (self.chosen and self.chosen.name) != previous and not was_opened
        self._restore.visible = session.deleted_measurements > 0
        self._file.set(self.context.links_html(session.exports, TABLE, PLAN))
        labels = scan_labels(session)
        if merge := session.merge:
            labels[f"merge/{merge.name}"] = f"merge of {len(merge.record.scans)} scans"
        self._table.set(measurements_table(measured, labels) if measured else "")
        self._details.set(measurement_html(self.chosen, labels) if self.chosen else "")
        self._draw_deviation(self.chosen)
        self._draw_section(self.chosen, surface)
        self._request_drawings(measured, self.chosen, surface)
        return new

    # inside

    def _open_session(self, folder: Path | None, values: dict[str, list[float]]) -> None:
        """Forget the measurements of another session, which have the same ids."""
        self._folder, self._known = folder, values
        self._layer.remove(*self._drawn)
        self._drawn, self._lines = {}, {}
        for show in (self._show_drawings, self._histogram.set, self._show_section):
            self._painter.cancel(show)

    def _offer(self, measured: Sequence[Stored[Measurement]]) -> Stored[Measurement] | None:
        """Offer the measurements, the latest first, by their names, by their ids too where names
        occur twice; returns the chosen one."""
        titles = list(name_records(measured))
        names = [each.name for each in measured]
        self._choice.offer(dict(zip(titles[::-1], names[::-1], strict=True)))
        self._chosen_folder.visible = self._table_folder.visible = bool(measured)
        return next((each for each in measured if each.name == self._choice.value), None)

    def _remember(self, values: dict[str, list[float]]) -> None:
        """Remember the values of all measurements, and forget the lines of sections that have
        changed: a point of them was moved."""
        changed = {name for name, known in self._known.items() if known != values.get(name)}
        self._lines = {name: each for name, each in self._lines.items() if name not in changed}
        self._known = values

    def _request_rename(self) -> None:
        """Request the entered name for the chosen measurement."""
        if self._choice.value:
            self._operator.relabel_measurement(self._choice.value, self._new_name.value)
            self._new_name.value = ""

    def _draw_deviation(self, measured: Stored[Measurement] | None) -> None:
        """Show the histogram of a deviation; hide it for others."""
        if measured is None or measured.record.deviation is None:
            self._painter.cancel(self._histogram.set)
            self._histogram.set(None)
            return
        tolerance = measured.record.deviation.tolerance_mm

        def make() -> Figure:
            """Plot the histogram of the deviation."""
            arrays = load_arrays(self.context.session, f"{Measurement.kind}/{measured.name}")
            return deviation_figure(measured.label, arrays, tolerance)

        key = (measured.name, measured.label)
        self._painter.request(self._histogram.set, key, make)

    def _draw_section(self, measured: Stored[Measurement] | None, on: str) -> None:
        """Show the plot of a section with its cursors, once its lines are read; None: hide it."""
        loaded = self._lines.get(measured.name) if measured else None
        for slider in self._cursors:
            slider.visible = loaded is not None
        if measured is None or loaded is None:
            self._section_id = ""
            self._painter.cancel(self._show_section)
            self._section.set(None)
            self._values.set("")
            self._layer.remove(*_MARKS)
            return
        plane, lines = loaded
        if measured.name != self._section_id:  # on the same section they keep their positions
            self._section_id = measured.name
            low, high, step = _round_range(np.concatenate(lines)[:, 0])
            for slider, share in zip(self._cursors, _AT, strict=True):
                slider.min, slider.max, slider.step = low, high, step
                slider.value = round(low + round(share * (high - low) / step) * step, 6)
        at = tuple(float(slider.value) for slider in self._cursors)
        space = plane if on == measured.record.source else None

        def make() -> tuple[Figure, np.ndarray, CutPlane | None]:
            """Plot the section; returns (figure, cursors (3, 2) mm, their plane in 3D)."""
            cursors = cursor_points(lines, at)
            named = dict(zip(CURSORS, cursors, strict=True))
            return section_plot(measured.label, lines, named, width=PLOT_PX), cursors, space

        self._painter.request(self._show_section, (measured.name, measured.label, at, on), make)

    def _show_section(self, made: tuple[Figure, np.ndarray, CutPlane | None]) -> None:
        """Show the plot with the values at the cursors, and mark these in 3D if the section's
        surface is shown."""
        figure, cursors, plane = made
        self._section.set(figure)
        self._values.set(cursor_html(cursors))
        self._layer.remove(*_MARKS)
        if plane:
            for cursor, mark, point in zip(CURSORS, _MARKS, lifted(plane, cursors), strict=True):
                self._layer.mark(mark, point, cursor)

    def _request_drawings(
        self, measured: Sequence[Stored[Measurement]], chosen: Stored[Measurement] | None, on: str
    ) -> None:
        """Request the 3D drawings of all measurements on this surface; the lines of sections are
        read from disk."""
        on_surface = {each.name for each in measured if each.record.source == on}
        looks = {
            each.name: (each.label, each.stale, each is chosen, *self._known[each.name])
            for each in measured
            if on_surface & {each.name, *each.record.of}
        }
        sections = [each.name for each in measured if each.record.plane]

        def make() -> Drawings:
            """Load the plane and the lines of each section that is not loaded yet."""
            store = self.context.session
            lines = {name: self._lines.get(name) or section_lines(store, name) for name in sections}
            return measured, looks, lines

        key = (on, tuple(looks.items()), tuple(sections))
        self._painter.request(self._show_drawings, key, make)

    def _show_drawings(self, made: Drawings) -> None:
        """Draw what has changed, coloured by whether it is stale, chosen or neither, and remove
        what is no longer there."""
        measured, looks, lines = made
        records = {each.name: each.record for each in measured}
        is_loaded = self._lines.keys() != lines.keys()
        self._lines = lines
        self._layer.remove(*(self._drawn.keys() - looks.keys()))
        for each in measured:
            look = looks.get(each.name)
            if look is None or look == self._drawn.get(each.name):
                continue
            cut = lines[each.name][1] if each.name in lines else ()
            if drawing := drawn(each.record, records, cut):
                segments, place = drawing
                colour = STALE if each.stale else CHOSEN if look[2] else OTHER
                self._layer.lines(each.name, segments, colour, label=(label(each), place))
        self._drawn = looks
        if is_loaded:
            self.redraw()


def _round_range(along: np.ndarray) -> tuple[float, float, float]:
    """Return (lowest, highest, step) of positions (n,) mm as round numbers."""
    low, high = float(along.min()), float(along.max())
    digits = int(np.clip(-np.floor(np.log10(max(high - low, 1e-6) / _STEPS)), 0, 5))
    step = 10.0**-digits
    return (
        round(np.ceil(low / step) * step, digits),
        round(np.floor(high / step) * step, digits),
        step,
    )


def cursor_points(lines: list[np.ndarray], at: tuple[float, ...]) -> np.ndarray:
    """Return the section's points (3, 2) mm at the cursors."""
    return np.array([nearest_on_section(lines, x) for x in at])


def cursor_html(cursors: np.ndarray) -> Html:
    """Return a table of distances and radius at the cursors (3, 2) mm."""
    a, b, c = cursors
    values = {
        f"{q.name.capitalize()} A – B": f"{q.value:.3f} {q.unit}".replace("-", "−")
        for q in measure_cursors(a, b)
    }
    try:
        radius = f"{radius_through(a, c, b).value:.3f} mm"
    except InputError:
        radius = "none: straight line"
    return properties_table("Cursors", {**values, "Radius through A, C, B": radius})


def measurements_table(measured: Sequence[Stored[Measurement]], labels: Mapping[str, str]) -> Html:
    """Return a table of all measurements, the latest first; ``labels``: {scan: the operator's
    name}."""
    named = {
        f"{each.label} ({each.name}{', stale' if each.stale else ''})": each.record
        for each in reversed(measured)
    }
    listed = relabel(list_quantities(named), labels)
    # a panel is too narrow for a column of scans
    rows = [[f"{name} on {scan}", what, scan, *rest] for name, what, scan, *rest in listed.rows]
    shown = [column for column in listed.columns if column.title != "scan"]
    notes = listed.notes if len(named) > 1 else []  # else they stand beside the only result
    return report_table(replace(listed, rows=rows, notes=notes).select(shown))


def measurement_html(measured: Stored[Measurement], labels: Mapping[str, str]) -> Html:
    """Return all figures of one measurement, with its source and warnings."""
    record = measured.record
    about = f"{record.what} on {labels.get(record.source, record.source)}, by {record.model}"
    about += f"; {record.where}." if record.where else "."
    if record.deviation is None:
        listed = list_quantities({measured.label: record})
        own = [each for each in listed.columns if each.title not in ("measurement", "scan")]
        html = report_table(replace(listed, caption="").select(own))
    else:
        html = records_html([measured], labels, named=False)
    html += note(about)
    if record.deviation and (verdict := record.deviation.verdict) is not None:
        html = (
            alert(Html(f"<b>{to_html(verdict.text())}</b>"), DECISION_TONES[verdict.decision])
            + html
        )
    if measured.stale:
        stale = "Out of date: the measured surface has changed; measure again."
        html = alert(stale, "warning") + html
    return html


def deviation_figure(
    name: str, arrays: Mapping[str, np.ndarray], tolerance: float | None
) -> Figure:
    """Plot the histogram of a stored deviation: ``edges`` (n + 1,) mm, ``counts`` (n,), and
    ``signed`` (m,) mm, by whose range it is coloured."""
    drawing = new_figure(PLOT_PX, _HISTOGRAM_PX)
    axes = drawing.subplots()
    style_axes(axes, "", "deviation, mm", "points, %")
    edges, limit = arrays["edges"], colour_limit(arrays["signed"], tolerance)
    draw_deviations(axes, edges, arrays["counts"], limit, tolerance)
    if tolerance is not None:
        far = max(float(edges[-1]), 1.15 * tolerance)
        axes.set_xlim(-far, far)
    return finish_figure(drawing, "Histogram of the deviations.", name)


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
            raise InputError("there is no plan yet", "press Make plan, or upload one")
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
    """Return a value with its uncertainty and unit, and the evidence; a dash where it was not
    measured."""
    if result.value is None:
        return coloured("–", "dim")
    uncertainty = "" if result.U is None else f" ± {result.U:.3f}"
    value = coloured(f"{result.value:.3f}{uncertainty} {wanted.unit}", "plain")
    evidence = result.evidence
    return Html(f"{value}<br>{coloured(evidence, 'dim')}") if evidence else value


def format_limits(wanted: Characteristic) -> Html:
    """Return the limits of a characteristic in words."""
    low, high = wanted.lower, wanted.upper
    if low is None:
        return coloured("none" if high is None else f"≤ {high:g}", "dim")
    return coloured(f"≥ {low:g}" if high is None else f"{low:g} to {high:g}", "dim")
