"""The panel of several rigs in one frame: a folder in the step Merge."""

from typing import get_args

from slviewer.gui.panel import Form, PanelPlugin
from slviewer.gui.widgets import Text, records_html
from slviewer.inputs import read_hint
from slviewer.operations.relate_rigs import RelatedBy, RelateRigsSettings
from slviewer.records.machine import RigRelation


class RelateRigsPanel(PanelPlugin):
    """Other rigs' places in the frame of this one, and their scans."""

    name, step, title = "relate-rigs", "merge", "Other rigs"

    def build(self) -> None:
        """Create the inputs."""
        titles = {
            "others": "Sessions of other rigs",
            "captures": "Captures in common",
            "scans": "Their scans to take",
        }
        self._lists = {
            name: self._gui.add_text(
                title, "", hint=f"{read_hint(RelateRigsSettings, name)} Separated by commas."
            )
            for name, title in titles.items()
        }
        self._by = self.dropdown(
            "They show", get_args(RelatedBy), read_hint(RelateRigsSettings, "by")
        )
        self._form = Form(self, RelateRigsSettings)
        self._found = Text(self._gui)
        self.button(
            "Relate rigs",
            self._relate,
            hint="Puts the other rigs into the frame of this session",
        )

    def draw(self) -> None:
        """Show the latest record."""
        self._found.set(records_html(self.panel.session.list_records(RigRelation)[-1:]))

    def _relate(self) -> None:
        """Run the operation in the wizard's queue of jobs."""
        lists = {
            name: [each.strip() for each in handle.value.split(",") if each.strip()]
            for name, handle in self._lists.items()
        }
        self._operator.run("relate-rigs", by=self._by.value, **lists, **self._form.values())
