"""Every control of the page has a hint, which it shows under the pointer."""

from typing import Any

from slviewer.gui.app import App
from slviewer.gui.hints import HINTS


def test_every_control_has_a_hint(app: App) -> None:
    handles: list[Any] = list(app.server.viser.gui._gui_input_handle_from_uuid.values())
    props = [handle._impl.props for handle in handles]
    labels = [each.label for each in props if hasattr(each, "hint")]
    without = [each.label for each in props if hasattr(each, "hint") and not each.hint]
    assert len(labels) > 100 and without == []
    # no hint stays behind when its control goes; "Continue" is renamed with the step
    assert {label for label in HINTS if not any(each.startswith(label) for each in labels)} == set()
