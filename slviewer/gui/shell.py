"""The frame of the page: the steps on the left, the current step on the right, and what is visible
in every step.

All browsers show the same step: an assistant sees the operator's step.
"""

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import viser

from slviewer.calibration.next_pose import nominal_lens
from slviewer.errors import hide_passwords
from slviewer.evaluation.render import format_count
from slviewer.gui.help_links import STAGES, help_link, step_help_link
from slviewer.gui.inputs import change
from slviewer.gui.panel import PanelContext, StepPanel
from slviewer.gui.scene import CAMERA, PROJECTOR, ViewerScene
from slviewer.gui.widgets import Html, Text, Tone, alert, coloured, meter, paragraph, to_html
from slviewer.session.atomic import format_bytes
from slviewer.wizard.autopilot import Autopilot
from slviewer.wizard.snapshot import (
    CalibrationView,
    Level,
    Notice,
    PreviewView,
    SessionView,
    Snapshot,
    StepView,
)

STEPS_PX, STEP_PX = 236, 452
"""Widths of the two panels: at 1280 px of page, the scene is as wide as the step."""

_ICONS = {
    "done": viser.Icon.CIRCLE_CHECK,
    "ready": viser.Icon.CIRCLE_DOTTED,
    "blocked": viser.Icon.LOCK,
}
_STEP_COLOURS = {"done": (211, 249, 216), "ready": (208, 235, 255), "blocked": (233, 236, 239)}
_STEPS_WITH_RIG = ("rig", "target", "poses", "calibrate")  # in which the devices matter in 3D
_NOTICES: dict[Level, tuple[str, Any, float, Tone]] = {
    "info": ("Note", "blue", 5.0, "plain"),
    "good": ("Done", "green", 5.0, "good"),
    "warning": ("Warning", "orange", 12.0, "warning"),
    "error": ("Error", "red", 20.0, "error"),
}
"""{level: title, colour and duration s of a notification, tone in the panel}."""
_SCROLL_BAR_MARGIN = "<style>.mantine-ScrollArea-content{padding-right:10px}</style>"
_MOST_NOTICES = 12  # of the latest, in the panel
_MOST_FAULTS = 3  # of the session's files, in the panel
DEVICES = "devices"


class DeviceLayer:
    """Draws the frusta of camera and projector."""

    def __init__(self, scene: ViewerScene) -> None:
        self._scene = scene
        self._drawn: tuple[CalibrationView | None, tuple[int, int] | None] = (None, None)

    def draw(self, snapshot: Snapshot) -> None:
        """Draw the devices of a snapshot, if they have changed."""
        calibration = snapshot.calibration
        camera, projector = snapshot.rig.camera, snapshot.rig.projector
        if (calibration, camera) == self._drawn:
            return
        self._drawn = (calibration, camera)
        self._scene.clear(DEVICES)
        rig = calibration.stereo.rig if calibration else None
        if camera is not None:
            K = (rig.camera if rig else nominal_lens(camera)).K
            self._scene.device(DEVICES, "camera", K, camera, np.eye(4), CAMERA)
        if projector is not None and rig is not None:
            T_camera_projector = np.eye(4)  # the inverse of X_p = R X_c + t
            T_camera_projector[:3, :3], T_camera_projector[:3, 3] = rig.R.T, -rig.R.T @ rig.t
            self._scene.device(
                DEVICES, "projector", rig.projector.K, projector, T_camera_projector, PROJECTOR
            )


class Shell:
    """The page: builds it once; `draw` and `draw_preview` update it, from one thread."""

    def __init__(self, context: PanelContext, steps: Sequence[StepView]) -> None:
        self._gui, self._context = context.gui, context
        self._devices = DeviceLayer(context.scene)
        self._panels: dict[str, StepPanel] = {
            key: getattr(
                importlib.import_module(f"slviewer.gui.steps.{key}"), f"{key.title()}Panel"
            )(context)
            for key in (step.key for step in steps)
        }
        self._shown_key = self._autopilot_key = ""
        self.current = next((s.key for s in steps if s.state != "done"), steps[0].key)
        """The step that is shown, or will be with the next drawing."""
        self._gui.set_panel_label("slviewer")
        self._build_left(steps)
        self._build_right()

    def go(self, key: str) -> None:
        """Show another step at the next drawing; may be called from any thread."""
        if key in self._panels:
            self.current = key

    # building

    def _build_left(self, steps: Sequence[StepView]) -> None:
        """Build the left panel: buttons of the steps, autopilot, session and messages."""
        gui, context = self._gui, self._context
        gui.main_panel.dock_left()
        gui.main_panel.set_width(STEPS_PX)
        self._step_buttons = {
            step.key: context.button(
                f"{number}. {step.title}", partial(self.go, step.key), _ICONS[step.state]
            )
            for number, step in enumerate(steps, 1)
        }
        gui.add_divider()
        self._autopilot = context.button(
            "Autopilot",
            self._toggle_autopilot,
            viser.Icon.PLAYER_PLAY,
            "teal",
            visible=False,
            at_once=True,
        )
        self._autopilot_status = Text(gui)
        with gui.add_folder("Session", expand_by_default=True):
            self._session = Text(gui)
            self._path = gui.add_text(
                "Folder", "", hint="Of another session; created if it does not exist"
            )
            context.button(
                "Open session",
                lambda: context.operator.open_session(self._path.value),
                viser.Icon.FOLDER_OPEN,
            )
        links = gui.add_button(
            "Links", icon=viser.Icon.LINK, color="gray", hint="For watching and for the projector"
        )
        links.on_click(
            lambda event: context.callback(partial(context.show_links, event.client), at_once=True)(
                event
            )
        )
        with gui.add_folder("Messages", expand_by_default=True):
            self._busy = Text(gui)
            self._latest = Text(gui)

    def _build_right(self) -> None:
        """Build the right panel: heading, problems, progress, and the panels of all steps."""
        gui, context = self._gui, self._context
        panel = gui.add_panel()
        panel.dock_right()
        panel.set_width(STEP_PX)
        with panel.add_tab("Step", viser.Icon.HAND_FINGER):
            Text(gui).set(_SCROLL_BAR_MARGIN)
            self._heading = Text(gui)
            self._problems = Text(gui)
            self._progress = Text(gui)
            self._cancel = context.button(
                "Cancel",
                context.operator.cancel,
                viser.Icon.PLAYER_STOP,
                "red",
                visible=False,
                at_once=True,
            )
            self._next = context.button(
                "Continue", self._show_next_step, viser.Icon.ARROW_RIGHT, "green", visible=False
            )
            self._folders: dict[str, viser.GuiFolderHandle] = {}
            for key, step_panel in self._panels.items():
                self._folders[key] = folder = gui.add_folder(None, visible=False)
                with folder:
                    step_panel.build()

    # drawing

    def draw(self, snapshot: Snapshot) -> None:
        """Update the page from a snapshot."""
        self._follow_autopilot(snapshot)
        key = self.current
        if key != self._shown_key:
            self._switch_panel(key)
        for step in snapshot.steps:
            colour = None if step.key == key else _STEP_COLOURS[step.state]
            change(self._step_buttons[step.key], icon=_ICONS[step.state], color=colour)
        self._draw_heading(snapshot)
        self._draw_progress(snapshot)
        self._draw_session(snapshot)
        self._devices.draw(snapshot)
        self._panels[key].draw(snapshot)

    def draw_preview(self, preview: PreviewView) -> None:
        """Show a preview, if the current step shows one."""
        if self._shown_key:
            self._panels[self._shown_key].draw_preview(preview)

    @property
    def needs_drawing(self) -> bool:
        """Whether another step was requested since the last drawing."""
        return self.current != self._shown_key

    def _follow_autopilot(self, snapshot: Snapshot) -> None:
        """Show the autopilot's step when it advances to another one."""
        key, keys = autopilot_step(snapshot), ["", *self._panels]
        # between two of its acts it may seem to step back
        onward = keys.index(key) > keys.index(self._autopilot_key)
        if key != self._autopilot_key and (onward or not key):
            self._autopilot_key = key
            self.go(key)

    def _switch_panel(self, key: str) -> None:
        """Hide the shown step and show another one."""
        if self._shown_key:
            self._folders[self._shown_key].visible = False
            self._panels[self._shown_key].show(False)
        self._shown_key = key
        if key in _STEPS_WITH_RIG:
            self._context.viewpoints.overview()
        self._panels[key].show(True)
        self._folders[key].visible = True

    def _draw_heading(self, snapshot: Snapshot) -> None:
        """Show the step's title, state, instruction and problems, and the button to continue."""
        steps = list(snapshot.steps)
        at = next(i for i, step in enumerate(steps) if step.key == self._shown_key)
        step = steps[at]
        state = {
            "done": coloured("done", "good"),
            "ready": "",
            "blocked": coloured("blocked", "warning"),
        }[step.state]
        title = (
            f'<div style="font-size:1.25rem;font-weight:600">{at + 1}&ensp;{to_html(step.title)}'
            f'&ensp;<span style="font-size:0.8rem">{state}</span>{step_help_link(step.key)}</div>'
        )
        self._heading.set(
            paragraph(
                Html(f"{title}<div style='margin-top:0.2em'>{to_html(step.instruction)}</div>")
            )
        )
        blocked = alert(step.blocked_by, "warning") if step.blocked_by else ""
        self._problems.set(
            blocked + "".join(_problem_html(step.key, sentence) for sentence in step.problems)
        )
        following = steps[at + 1] if at + 1 < len(steps) else None
        ready = step.state == "done" and following is not None and following.state != "blocked"
        if ready and following is not None:
            change(self._next, label=f"Continue to {following.title}")
        change(self._next, visible=ready)

    def _draw_progress(self, snapshot: Snapshot) -> None:
        """Show the progress of capture and job, and whether it can be cancelled."""
        work = _running_work(snapshot)
        bars = "".join(
            f'<div style="margin-bottom:0.3em">{to_html(text)}{meter(share, "info")}</div>'
            for text, share in work
        )
        self._progress.set(paragraph(Html(bars)) if bars else "")
        job = snapshot.job
        can_cancel = snapshot.rig.capture is not None or bool(job and job.can_cancel)
        change(self._cancel, visible=bool(work) and can_cancel)
        # repeated beside every step: it must not scroll out of view, nor move what is about to be
        # clicked
        if bars:
            self._busy.set(paragraph(Html(bars)))
        else:
            self._busy.write(f"{job.stage or job.name} …" if job is not None else "Idle", "dim")

    def _draw_session(self, snapshot: Snapshot) -> None:
        """Show the session's folder, contents and free space, the autopilot and the latest
        notices."""
        session, space = snapshot.session, snapshot.space
        if session is None:
            self._session.set(
                alert("No session is open: enter a folder.", "warning") + _fault_alerts(snapshot)
            )
        else:
            lines = [
                f"<b>{to_html(session.folder.name)}</b>",
                f'<span style="overflow-wrap:anywhere">{coloured(session.folder, "dim")}</span>',
                (
                    f"{format_count(len(session.poses), 'pose')},"
                    f" {format_count(len(session.scans), 'scan')}"
                ),
            ]
            if space is not None:
                needs = (
                    f"; a capture needs {format_bytes(space.capture_bytes)}"
                    if space.capture_bytes
                    else ""
                )
                lines.append(
                    coloured(
                        f"{format_bytes(space.free_bytes)} free{needs}",
                        "dim" if space.enough else "error",
                    )
                )
            self._session.set(paragraph(Html("<br>".join(lines))) + _fault_alerts(snapshot))
        change(
            self._autopilot,
            visible=snapshot.rig.simulated,
            label="Stop autopilot" if snapshot.autopilot else "Autopilot",
            color="red" if snapshot.autopilot else "teal",
        )
        self._autopilot_status.set(alert(snapshot.autopilot, "info") if snapshot.autopilot else "")
        latest = "".join(
            _notice_html(notice) for notice in reversed(snapshot.notices[-_MOST_NOTICES:])
        )
        # as high as a small screen leaves, so that the panel itself does not scroll
        style = "max-height:max(6em, calc(100vh - 665px));overflow-y:auto;overflow-wrap:anywhere"
        self._latest.set(
            f'<div style="{style}">{latest or paragraph(coloured("No messages.", "dim"))}</div>'
        )

    # requests

    def _show_next_step(self) -> None:
        """Show the next step."""
        keys = list(self._panels)
        self.go(keys[min(keys.index(self._shown_key) + 1, len(keys) - 1)])

    def _toggle_autopilot(self) -> None:
        """Start the autopilot, or stop it where it runs."""
        operator = self._context.operator
        if operator.snapshot().autopilot:
            operator.cancel()
        else:
            operator.start_autopilot(Autopilot(operator, pause_s=0.5))


def autopilot_step(snapshot: Snapshot) -> str:
    """Return the key of the autopilot's step, from what it has done so far; empty while it is
    off."""
    session, world = snapshot.session, snapshot.world
    if not snapshot.autopilot or session is None or world is None:
        return ""
    job = snapshot.job.name if snapshot.job is not None else ""
    if not session.target:
        return "target"
    if job == "Calibrating":
        return "calibrate"
    if world.standing == "object":
        return "merge" if job.startswith("Merg") else _object_step(session)
    if world.standing != "board":
        return "verify"
    return "poses" if session.calibration is None or session.calibration.stale else "calibrate"


def _object_step(session: SessionView) -> str:
    """Return the key of the autopilot's step once an object is in place: scan, export or
    measure."""
    latest = next((scan.name for scan in reversed(session.scans) if scan.purpose == "scan"), "")
    if session.merge is None or latest not in session.merge.record.scans:
        return "scan"
    return (
        "export"
        if any(measured.record.source == latest for measured in session.measurements)
        else "measure"
    )


def notify(client: viser.ClientHandle, level: Level, text: str) -> None:
    """Show a notification in one browser."""
    title, colour, seconds, _ = _NOTICES[level]
    client.add_notification(title, hide_passwords(text), color=colour, auto_close_seconds=seconds)


def _problem_html(step: str, sentence: str) -> Html:
    """Return a problem of a step, with a link to what the help says on those of its stage."""
    return alert(Html(f"{to_html(sentence)} {help_link(STAGES[step])}"), "error")


def greet_viewer(client: viser.ClientHandle) -> None:
    """Show a view-only browser that it cannot change anything."""
    with client.atomic():
        client.gui.add_html(str(alert("View only: this link changes nothing.", "info")), order=-1.0)


def _running_work(snapshot: Snapshot) -> list[tuple[str, float]]:
    """List (description, share done) of the running capture and of the requested job."""
    job, capture, work = snapshot.job, snapshot.rig.capture, []
    if capture is not None:
        waiting = f", {capture.waiting} waiting" if capture.waiting else ""
        text = f"Capturing {capture.name}: frame {capture.frame} of {capture.frames}{waiting}"
        if capture.stage:
            text = f"{capture.name}: {capture.stage}{waiting}"
        work.append((text, capture.frame / max(capture.frames, 1)))
    if job is not None and not job.background:
        waiting = f", {job.waiting} waiting" if job.waiting else ""
        work.append(
            (f"{job.name}: {job.stage or 'starting'}{waiting} ({job.seconds:.0f} s)", job.share)
        )
    if snapshot.preparing is not None:
        text = (
            f"Preparing, {100 * snapshot.preparing:.0f} %: first steps may take longer until then"
        )
        work.append((text, snapshot.preparing))
    return work


def _fault_alerts(snapshot: Snapshot) -> str:
    """Return the HTML of what could not be read of the session, as alerts."""
    faults = list(snapshot.session.faults) if snapshot.session is not None else []
    if len(faults) > _MOST_FAULTS:
        faults[_MOST_FAULTS:] = [
            f"{len(faults) - _MOST_FAULTS} more files are damaged: `slviewer inspect` lists them."
        ]
    stated = [snapshot.read_failure, *faults] if snapshot.read_failure else faults
    return "".join(alert(fault, "error") for fault in stated)


def _notice_html(notice: Notice) -> str:
    """Return the HTML of a notice: its time, and the text in its tone."""
    time = coloured(f"{notice.time:%H:%M}", "dim")
    link = f" {help_link(notice.section)}" if notice.section else ""
    return paragraph(Html(f"{time} {coloured(notice.text, _NOTICES[notice.level][3])}{link}"))
