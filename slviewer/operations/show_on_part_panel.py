"""The panel of images for the projector: a folder in the step Measure."""

from pathlib import Path

from slviewer.errors import InputError
from slviewer.gui.panel import Form, PanelPlugin, scan_options
from slviewer.gui.widgets import Text, records_html
from slviewer.inputs import read_hint
from slviewer.operations.show_on_part import ShowOnPartSettings, dim_image
from slviewer.pipeline.operation import load_arrays
from slviewer.records.part_image import PartImage

SHOWN = {
    "deviations in colours": "compare",
    "pass and fail": "verdict",
    "what is not measured yet": "missing",
    "features of the plan": "plan",
    "measurements with their values": "measure",
}


class ShowOnPartPanel(PanelPlugin):
    """What was measured, for the projector to show on the part."""

    name, step, title = "show-on-part", "measure", "Show on the part"

    def build(self) -> None:
        """Create the inputs."""
        self._scan = self.choice("Scan", read_hint(ShowOnPartSettings, "scan"))
        self._of = self.dropdown("Show", tuple(SHOWN), read_hint(ShowOnPartSettings, "of"))
        self._frame = self._gui.add_text(
            "Current picture",
            "",
            hint=f"File on this computer. {read_hint(ShowOnPartSettings, 'frame')}",
        )
        self._form = Form(self, ShowOnPartSettings)
        self._found = Text(self._gui)
        self.button(
            "Make image for projector",
            self._show,
            hint="Writes the picture that the projector has to show pixel by pixel",
        )
        self._light = self.number(
            "Light", 100.0, 1.0, 100.0, 1.0, hint="Percent of the light that the image was made for"
        )
        self.react(self._light.on_update, self._project_again)
        self.button(
            "Show with the projector",
            self._project,
            "bulb",
            hint="The last image, with this rig's projector, until the next capture's patterns or"
            " Off",
        )
        self.button("Off", self._end, hint="Back to white light")

    def draw(self) -> None:
        """Offer the scans, and show the latest record."""
        session = self.panel.session
        self._scan.offer(scan_options(session.scans))
        self._found.set(records_html(session.list_records(PartImage)[-1:]))

    def _project(self) -> None:
        """Show the last image with the rig's projector."""
        made = self.panel.session.list_records(PartImage)
        if not made:
            raise InputError("no image has been made", "make the image for the projector first")
        name, settings = made[-1].name, made[-1].record.settings
        image = load_arrays(self.context.session, f"{PartImage.kind}/{name}")["image"]
        gamma = settings.get("gamma", ShowOnPartSettings.gamma)
        self._operator.show_image(dim_image(image, self._light.value / 100, gamma))

    def _project_again(self) -> None:
        """Show the image in the light that is chosen now, while it is shown."""
        if self.panel.snapshot.rig.light == "image":
            self._project()

    def _end(self) -> None:
        """Show white light again."""
        self._operator.set_light("white")

    def _show(self) -> None:
        """Run the operation in the wizard's queue of jobs."""
        frame = Path(self._frame.value) if self._frame.value else None
        self._operator.run(
            "show-on-part",
            scan=self._scan.value,
            of=SHOWN[self._of.value],
            frame=frame,
            **self._form.values(),
        )
