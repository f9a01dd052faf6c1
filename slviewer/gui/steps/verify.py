"""Step 5: measure a plane or a sphere by each model, and compare with the noise floor of the
capture."""

from functools import partial

import numpy as np

from slviewer.gui.capture_inputs import SimulatedObject
from slviewer.gui.colouring import in_view, shade
from slviewer.gui.panel import Form, StepPanel, display_name, scan_options
from slviewer.gui.widgets import (
    PLOT_PX,
    Html,
    LiveImage,
    Plot,
    Text,
    colour_bar,
    colours,
    records_html,
)
from slviewer.pipeline.operation import Stored, load_arrays
from slviewer.pipeline.reconstruct import VerifySettings
from slviewer.reconstruction.reconstruct import cloud_normals
from slviewer.records.verification import Shape, Verification
from slviewer.report.maps import SIGN, error_limit, verification_maps
from slviewer.report.page import Figure
from slviewer.wizard import result_views
from slviewer.wizard.snapshot import PreviewView

_Painted = tuple[result_views.ScanCloud, np.ndarray, Html]
"""A cloud, its colours, and their legend."""
_ICONS: dict[Shape, str] = {"plane": "square", "sphere": "sphere"}
TABLE = "figures.csv"
MUCH_MASKED = 0.2
"""Share of a scan that is reported as a warning."""


class VerifyPanel(StepPanel):
    """Panel of the step Verify."""

    key = "verify"

    def build(self) -> None:
        """Create the inputs of capture, results and recorded captures."""
        gui, operator = self._gui, self._operator
        self._waiting: dict[Shape, list[str]] = {}
        with gui.add_folder("Result") as self._result_folder:
            self._result = self.choice(
                "Result",
                follow=lambda session: [row.name for row in session.list_records(Verification)],
            )
            self._figures = Text(gui)
            self._model = self.choice("3D colours", "The model whose errors colour the cloud")
            self._legend = Text(gui)
            self._maps = Plot(gui)
        with gui.add_folder("Capture") as self._capture_folder:
            self._picture = LiveImage(gui)
            self._captures = [
                self.button(
                    "Capture plane",
                    lambda: operator.capture_scan(label.value, "plane", anyway=self._anyway.value),
                    "square",
                    None,
                ),
                self.button(
                    "Capture sphere",
                    lambda: operator.capture_scan(label.value, "sphere", anyway=self._anyway.value),
                    "sphere",
                ),
            ]
            self._anyway = self.checkbox(
                "Capture with board in view", "For a plate or sphere that stands before the board"
            )
            self._anyway.visible = False
            label = gui.add_text("Name", "", hint="Optional; numbered by default")
            SimulatedObject(self, *_ICONS)
        with gui.add_folder("All results") as self._table_folder:
            self._table = Text(gui)
            self.button("Write CSV", lambda: operator.export("table"), "table-export")
            self._file = Text(gui)
        with gui.add_folder("Recorded captures") as self._recorded_folder:
            self._recorded = self.choice("Capture")
            self._inputs = Form(self, VerifySettings)
            for shape, icon in _ICONS.items():
                self.button(f"Measure {shape}", partial(self._request, shape), icon)
            self._all = {
                shape: self.button(
                    f"Measure all {shape}s", partial(self._request, shape, every=True), icon
                )
                for shape, icon in _ICONS.items()
            }

    def draw(self) -> None:
        """Show the verifications, and the chosen one."""
        session, rig, ready = self.session, self.snapshot.rig, not self.is_blocked
        self._capture_folder.visible = rig.state != "none"
        self._picture.is_large = self.is_ready
        for button in self._captures:
            button.disabled = not (ready and rig.is_idle)
        rows = session.list_records(Verification)
        self._recorded_folder.visible = ready and bool(session.scans)
        self._result_folder.visible = self._table_folder.visible = ready and bool(rows)
        if not ready:
            return
        # those without an up-to-date verification first
        measured = {row.name for row in rows if not row.stale}
        waiting = [scan for scan in session.scans if scan.name not in measured]
        self._recorded.offer(
            scan_options(waiting)
            | {
                f"{text}, measured": name
                for text, name in scan_options(session.scans).items()
                if name in measured
            }
        )
        for shape, button in self._all.items():
            self._waiting[shape] = [scan.name for scan in waiting if scan.shape == shape]
            n = len(self._waiting[shape])
            button.visible, button.label = n > 1, f"Measure all {n} {shape}s"
        results = {row.name: row for row in rows}
        titles = {display_name(row.name, row.label): row.name for row in rows}
        self._result.offer(titles)
        self._table.set(records_html(rows))
        self._file.set(self.context.links_html(session.exports, TABLE))
        if rows:
            self._draw_result(results[self._result.value])

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the live image, and offer to capture with the board in view."""
        self._picture.draw(preview)
        self._anyway.visible = preview.board is not None
        if self._anyway.value and not self._anyway.visible:
            self._anyway.value = False

    # drawing

    def _draw_result(self, chosen: Stored[Verification]) -> None:
        """Show a result, and request its error maps and its cloud."""
        context, name, record = self.context, chosen.name, chosen.record
        self._model.offer_names(record.models, [*record.models][-1])
        self._figures.set(records_html([chosen], named=False))
        key = (name, record.summary())

        def draw_maps() -> Figure:
            """Draw the error maps of the capture by model."""
            arrays = load_arrays(context.session, f"{Verification.kind}/{name}")
            return verification_maps(display_name(name, chosen.label), record, arrays, PLOT_PX)

        self.painter.request(self._maps.set, key, draw_maps)
        model = self._model.value

        def paint_cloud() -> _Painted:
            """Load the capture's cloud, and colour it by the error of the model."""
            cloud = result_views.whole_cloud(context.session, name)
            limit = error_limit(list(cloud.errors.values()))
            painted = colours(cloud.errors[model], -limit, limit, "error")
            title = f"error of {model}; {SIGN[record.shape]}; grey: not evaluated"
            bar = colour_bar(f"−{limit:g} mm", f"+{limit:g} mm", "error", title)
            return cloud, shade(painted, cloud_normals(cloud)), in_view(bar)

        self.painter.request(self._draw_cloud, (key, model), paint_cloud)

    def _draw_cloud(self, made: _Painted) -> None:
        """Draw a cloud in its colours, with their legend."""
        cloud, painted, bar = made
        self.show_cloud(cloud.name, cloud.points, painted)
        self._legend.set(bar)

    # requests

    def _request(self, shape: Shape, every: bool = False) -> None:
        """Request the verification of the chosen capture as a plane or sphere, or of every capture
        of the shape that has none yet."""
        names = self._waiting[shape] if every else [self._recorded.value]
        if any(names):
            self._operator.verify(names, shape, **self._inputs.values())
