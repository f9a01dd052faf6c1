"""The panel of the hand-eye calibration: a folder in the step Calibrate."""

from typing import get_args

from slviewer.calibration.hand_eye import Mounting
from slviewer.gui.panel import Form, PanelPlugin
from slviewer.gui.widgets import Text, records_html
from slviewer.inputs import read_hint
from slviewer.operations.hand_eye import HandEyeSettings
from slviewer.records.machine import HandEye
from slviewer.session.importers.pose_files import Convention


class HandEyePanel(PanelPlugin):
    """Where the camera is on a robot, from the robot's poses of the captured boards."""

    name, step, title = "hand-eye", "calibrate", "Hand-eye (robot)"

    def build(self) -> None:
        """Create the inputs."""
        self._file = self._gui.add_text(
            "File of poses",
            "",
            hint=f"File on this computer. {read_hint(HandEyeSettings, 'poses')}",
        )
        self._mounting = self.dropdown(
            "Mounting", get_args(Mounting), read_hint(HandEyeSettings, "mounting")
        )
        self._convention = self.choice(
            "Convention",
            read_hint(HandEyeSettings, "convention"),
            {"as the file states": None, **{each: each for each in get_args(Convention)}},
        )
        self._merge = self._gui.add_text("Merge", "", hint=read_hint(HandEyeSettings, "merge"))
        self._form = Form(self, HandEyeSettings)
        self._plan = self.checkbox("Plan poses", read_hint(HandEyeSettings, "plan"))
        self._found = Text(self._gui)
        self.button(
            "Calibrate hand-eye",
            self._calibrate,
            hint="Finds the camera on the robot, by these poses and the boards or the merge",
        )

    def draw(self) -> None:
        """Show the latest record."""
        self._found.set(records_html(self.panel.session.list_records(HandEye)[-1:]))

    def _calibrate(self) -> None:
        """Run the operation in the wizard's queue of jobs."""
        self._operator.run(
            "hand-eye",
            poses=self._file.value or None,
            mounting=self._mounting.value,
            merge=self._merge.value,
            convention=self._convention.value or None,
            plan=self._plan.value,
            **self._form.values(),
        )
