"""A panel of the wizard: it runs the operation on the chosen capture, and shows what it found."""

from slviewer.plugins import Form, PanelPlugin
from slviewer_example.brightness import Brightness, BrightnessSettings


class BrightnessPanel(PanelPlugin):
    """A folder in the step Scan."""

    name, step, title = "brightness", "scan", "Brightness"

    def build(self) -> None:
        """Create the inputs."""
        self._capture = self.choice("Capture")
        self._form = Form(self, BrightnessSettings)
        self._found = self._gui.add_markdown("")
        self.button("Measure brightness", self._measure)

    def draw(self) -> None:
        """Offer the scans, and show the records."""
        session = self.panel.session
        self._capture.offer({scan.name: scan.name for scan in session.scans})
        lines = [
            f"{found.label}: {found.record.mean_percent:.1f} %"
            for found in session.list_records(Brightness)
        ]
        self._found.content = "\n\n".join(lines)

    def _measure(self) -> None:
        """Run the operation in the wizard's queue of jobs."""
        self._operator.run("brightness", capture=self._capture.value, **self._form.values())
