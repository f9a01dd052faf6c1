"""Inputs to scan all round on the rig's turntable."""

from typing import Any

import viser

from slviewer.gui.inputs import change
from slviewer.gui.panel import PanelContext
from slviewer.gui.widgets import Text
from slviewer.pipeline.turn import FULL_TURN_DEG, STEPS
from slviewer.registration.multiway import MOST_SCANS
from slviewer.wizard.snapshot import SessionView, Snapshot


class TurnInputs:
    """Number of steps, range, and the buttons to begin and to resume a turn; hidden without a
    turntable."""

    def __init__(self, context: PanelContext) -> None:
        gui, operator = context.gui, context.operator
        with gui.add_folder("Turntable", visible=False) as self._folder:
            self._steps: Any = gui.add_number(
                "Steps", STEPS, min=2, max=MOST_SCANS, step=1, hint="Scans of a turn"
            )
            self._range: Any = gui.add_number(
                "Range, °", FULL_TURN_DEG, min=-FULL_TURN_DEG, max=FULL_TURN_DEG, step=5.0,
                hint="360 for a full turn; negative turns the other way",
            )  # fmt: skip
            self._then_merge: Any = gui.add_checkbox(
                "Merge and mesh",
                True,
                hint="At the end; the mesh is closed, also where the part stands",
            )
            self._scan = context.button(
                "Scan all round",
                lambda: operator.scan_all_round(
                    int(self._steps.value),
                    float(self._range.value),
                    then_merge=bool(self._then_merge.value),
                ),
                viser.Icon.ROTATE_360,
                None,
            )
            self._resume = context.button(
                "Resume turn",
                lambda: operator.resume_turn(then_merge=bool(self._then_merge.value)),
                viser.Icon.PLAYER_TRACK_NEXT,
                hint="Captures the missing steps. Leave part and table as they are.",
                visible=False,
            )
            self._note = Text(gui)

    def draw(self, snapshot: Snapshot, ready: bool) -> None:
        """Show the inputs where the rig has a turntable, and what the last turn lacks."""
        change(self._folder, visible=bool(snapshot.rig.turntable))
        turn, captured, steps = _describe_last_turn(snapshot.session)
        unfinished = 0 < captured < steps
        change(self._scan, disabled=not ready)
        change(
            self._resume,
            visible=unfinished,
            disabled=not ready,
            label=f"Resume {turn}" if turn else "Resume turn",
        )
        self._note.write(
            f"{turn}: {captured} of {steps} steps captured." if unfinished else "", "warning"
        )


def _describe_last_turn(session: SessionView | None) -> tuple[str, int, int]:
    """Return the name of the last turn, how many of its steps are captured, and how many it has."""
    scans = (
        [(scan.created, scan.turn_step) for scan in session.scans if scan.turn_step]
        if session
        else []
    )
    if not scans:
        return "", 0, 0
    last = max(scans, key=lambda scan: scan[0])[1]
    assert last is not None
    return (
        last.turn,
        sum(step is not None and step.turn == last.turn for _, step in scans),
        last.steps,
    )
