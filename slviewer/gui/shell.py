"""The frame of the page: the steps on the left, the step at hand on the right, and what must be seen at every step.

All browsers show the same step, as they show the same session: whoever helps sees what the operator sees.
"""

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from slviewer.calibration.next_pose import nominal_lens
from slviewer.gui.inputs import change
from slviewer.gui.panel import Panel, Stage
from slviewer.gui.scene import CAMERA, PROJECTOR, ViewerScene
from slviewer.gui.widgets import Html, Words, block, boxed, cell, meter, toned
from slviewer.wizard.autopilot import Autopilot
from slviewer.wizard.snapshot import CalibrationView, Notice, PreviewView, Snapshot, StepView

STEPS_PX, STEP_PX = 236, 452
"""Widths of the two panels: at 1280 px of page, as much is left for the scene as the step takes."""

_ICONS = {
    "done": viser.Icon.CIRCLE_CHECK,
    "ready": viser.Icon.CIRCLE_DOTTED,
    "blocked": viser.Icon.LOCK,
}
_STEP_COLOURS = {"done": (211, 249, 216), "ready": (208, 235, 255), "blocked": (233, 236, 239)}
_ROUND_THE_RIG = ("rig", "target", "poses", "calibrate")  # steps in which the devices matter in 3D
_TITLES = {"info": "Note", "good": "Done", "warning": "Take care", "error": "This failed"}
_COLOURS: dict[str, Any] = {"info": "blue", "good": "green", "warning": "orange", "error": "red"}
_SECONDS = {"info": 5.0, "good": 5.0, "warning": 12.0, "error": 20.0}
_MARKS = {"info": "plain", "good": "good", "warning": "warning", "error": "error"}
_ROOM_FOR_SCROLL_BARS = "<style>.mantine-ScrollArea-content{padding-right:10px}</style>"  # they lie on what they scroll
_KEPT = 12  # of the latest notices, in the panel


DEVICES = "devices"


class DeviceLayer:
    """Keeps their pyramids up to date."""

    def __init__(self, scene: ViewerScene) -> None:
        self._scene = scene
        self._drawn: tuple[CalibrationView | None, tuple[int, int] | None] = (None, None)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the devices of this snapshot."""
        calibration = snapshot.session.calibration if snapshot.session else None
        camera, projector = snapshot.rig.camera, snapshot.rig.projector
        if (calibration, camera) == self._drawn:
            return
        self._drawn = (calibration, camera)
        self._scene.clear(DEVICES)
        if camera is not None:
            K = nominal_lens(camera).K if calibration is None else calibration.K_camera
            self._scene.device(DEVICES, "camera", K, camera, np.eye(4), CAMERA)
        if projector is not None and calibration is not None:
            T = np.eye(4)  # T_camera_projector: the inverse of X_p = R X_c + t
            T[:3, :3], T[:3, 3] = calibration.R.T, -calibration.R.T @ calibration.t
            self._scene.device(DEVICES, "projector", calibration.K_projector, projector, T, PROJECTOR)


class Shell:
    """Builds the page once; `draw` and `draw_preview` bring it up to date, from one thread."""

    def __init__(
        self, gui: viser.GuiApi, stage: Stage, steps: Sequence[StepView], ask_open: Callable[[str], Any]
    ) -> None:
        self._gui, self._stage = gui, stage
        self._devices = DeviceLayer(stage.scene)
        self._panels = {step.key: _panel(step.key)(stage) for step in steps}
        self._drawn: Snapshot | None = None
        self._shown_key = ""
        self._flown = ""
        self._wanted_key = next((s.key for s in steps if s.state != "done"), steps[0].key)
        gui.set_panel_label("slviewer")
        self._build_left(steps, ask_open)
        self._build_right()

    def go(self, key: str) -> None:
        """Bring a step to the front; callable from any thread, it is drawn next."""
        if key in self._panels:
            self._wanted_key = key

    @property
    def current(self) -> str:
        """The step that is shown, or will be with the next drawing."""
        return self._wanted_key

    # building

    def _build_left(self, steps: Sequence[StepView], ask_open: Callable[[str], Any]) -> None:
        gui, stage = self._gui, self._stage
        gui.main_panel.dock_left()
        gui.main_panel.set_width(STEPS_PX)
        self._step_buttons: dict[str, viser.GuiButtonHandle] = {}
        for number, step in enumerate(steps, 1):
            button = gui.add_button(f"{number}. {step.title}", icon=_ICONS[step.state], color="gray")
            button.on_click(stage.safely(lambda key=step.key: self.go(key)))  # type: ignore[misc]
            self._step_buttons[step.key] = button
        gui.add_divider()
        self._autopilot = gui.add_button("Autopilot", icon=viser.Icon.PLAYER_PLAY, color="teal", visible=False)
        self._autopilot.on_click(stage.safely(self._toggle_autopilot, at_once=True))
        self._autopilot_says = Words(gui)
        with gui.add_folder("Session", expand_by_default=True):
            self._session_says = Words(gui)
            self._path = gui.add_text("Folder", "", hint="Made where it does not exist")
            opens = gui.add_button("Open session", icon=viser.Icon.FOLDER_OPEN, color="gray")
            opens.on_click(stage.safely(lambda: ask_open(self._path.value)))
        with gui.add_folder("Messages", expand_by_default=True):
            self._busy = Words(gui)
            self._latest = Words(gui)

    def _build_right(self) -> None:
        gui, stage = self._gui, self._stage
        panel = gui.add_panel()
        panel.dock_right()
        panel.set_width(STEP_PX)
        with panel.add_tab("This step", viser.Icon.HAND_FINGER):
            Words(gui).set(_ROOM_FOR_SCROLL_BARS)
            self._heading = Words(gui)
            self._wrong = Words(gui)
            self._job_says = Words(gui)
            self._cancel = gui.add_button("Cancel", icon=viser.Icon.PLAYER_STOP, color="red", visible=False)
            self._cancel.on_click(stage.safely(stage.operator.cancel, at_once=True))
            self._next = gui.add_button("Continue", icon=viser.Icon.ARROW_RIGHT, color="green", visible=False)
            self._next.on_click(stage.safely(self._continue))
            self._folders: dict[str, viser.GuiFolderHandle] = {}
            for key, step_panel in self._panels.items():
                folder = gui.add_folder(None, visible=False)
                with folder:
                    step_panel.build()
                self._folders[key] = folder

    # drawing

    def draw(self, snapshot: Snapshot) -> None:
        """Show this snapshot."""
        self._follow(snapshot)
        key = self._wanted_key
        if key != self._shown_key:
            self._turn(key)
        self._draw_steps(snapshot)
        self._draw_heading(snapshot)
        self._draw_job(snapshot)
        self._draw_session(snapshot)
        self._devices.draw(snapshot)
        self._panels[key].draw(snapshot)
        self._drawn = snapshot

    def draw_preview(self, preview: PreviewView) -> None:
        """Show this frame, where the step shows one."""
        panel = self._panels.get(self._shown_key)
        if panel is not None and hasattr(panel, "draw_preview"):
            panel.draw_preview(preview)

    @property
    def due(self) -> bool:
        """Whether another step was asked for since the last drawing."""
        return self._wanted_key != self._shown_key

    def _follow(self, snapshot: Snapshot) -> None:
        """Show the step that Autopilot is at, when it comes to another one."""
        flown, keys = flown_step(snapshot), ["", *self._panels]
        onward = keys.index(flown) > keys.index(self._flown)  # between two of its acts it may seem to step back
        if flown != self._flown and (onward or not flown):
            self._flown = flown
            self.go(flown)

    def _turn(self, key: str) -> None:
        if self._shown_key:
            self._folders[self._shown_key].visible = False
            self._panels[self._shown_key].shown(False)
        self._shown_key = key
        if key in _ROUND_THE_RIG:
            self._stage.viewpoints.overview()
        self._panels[key].shown(True)
        self._folders[key].visible = True

    def _draw_steps(self, snapshot: Snapshot) -> None:
        for step in snapshot.steps:
            button = self._step_buttons[step.key]
            change(button, icon=_ICONS[step.state])
            here = step.key == self._shown_key
            change(button, color=None if here else _STEP_COLOURS[step.state])

    def _draw_heading(self, snapshot: Snapshot) -> None:
        steps = list(snapshot.steps)
        at = next(i for i, step in enumerate(steps) if step.key == self._shown_key)
        step = steps[at]
        state = {"done": toned("done", "good"), "ready": "", "blocked": toned("waiting", "warning")}[step.state]
        title = f'<div style="font-size:1.25rem;font-weight:600">{at + 1}&ensp;{cell(step.title)}&ensp;'
        title += f'<span style="font-size:0.8rem">{state}</span></div>'
        self._heading.set(block(Html(f"{title}<div style='margin-top:0.2em'>{cell(step.now)}</div>")))
        wrong = [boxed(sentence, "error") for sentence in step.wrong]
        if step.state == "blocked" and step.because:
            wrong.insert(0, boxed(step.because, "warning"))
        self._wrong.set("".join(wrong))
        onward = steps[at + 1] if at + 1 < len(steps) else None
        ready = step.state == "done" and onward is not None and onward.state != "blocked"
        if ready and onward is not None:
            change(self._next, label=f"Continue to {onward.title}")
        change(self._next, visible=ready)

    def _draw_job(self, snapshot: Snapshot) -> None:
        work = _work(snapshot)
        bars = [f'<div style="margin-bottom:0.3em">{cell(says)}{meter(share, "info")}</div>' for says, share in work]
        self._job_says.set(block(Html("".join(bars))) if bars else "")
        job = snapshot.job
        change(self._cancel, visible=bool(work) and (snapshot.rig.capture is not None or bool(job and job.can_cancel)))
        # beside every step too: it must not scroll out of view, nor move what is about to be pressed
        if work:
            self._busy.set(block(Html("".join(bars))))
        else:
            self._busy.say(f"{job.doing or job.name} …" if job is not None else "Idle", "dim")

    def _draw_session(self, snapshot: Snapshot) -> None:
        session, space = snapshot.session, snapshot.space
        if session is None:
            self._session_says.set(boxed("No session is open: name a folder.", "warning"))
        else:
            words = [f"<b>{cell(session.folder.name)}</b>", f"{_counted(len(session.poses), 'pose')}, "
                     f"{_counted(len(session.scans), 'scan')}"]  # fmt: skip
            if space is not None:
                needs = f"; a capture needs {amount(space.capture_bytes)}" if space.capture_bytes else ""
                words.append(toned(f"{amount(space.free_bytes)} free{needs}", "dim" if space.enough else "error"))
            where = f'<span style="overflow-wrap:anywhere">{toned(session.folder, "dim")}</span>'
            words.insert(1, where)
            self._session_says.set(block(Html("<br>".join(words))))
            before = self._drawn.session.folder if self._drawn is not None and self._drawn.session else None
            if session.folder != before:
                change(self._path, value=str(session.folder))
        change(self._autopilot, visible=snapshot.rig.simulated)
        change(self._autopilot, label="Stop Autopilot" if snapshot.autopilot else "Autopilot")
        change(self._autopilot, color="red" if snapshot.autopilot else "teal")
        self._autopilot_says.set(boxed(snapshot.autopilot, "info") if snapshot.autopilot else "")
        latest = "".join(_notice(notice) for notice in reversed(snapshot.notices[-_KEPT:]))
        # as high as a small screen leaves, so that the panel itself does not scroll
        style = "max-height:max(6em, calc(100vh - 625px));overflow-y:auto;overflow-wrap:anywhere"
        self._latest.set(f'<div style="{style}">{latest or block(toned("Nothing yet.", "dim"))}</div>')

    # asking

    def _continue(self) -> None:
        keys = list(self._panels)
        at = keys.index(self._shown_key)
        self.go(keys[min(at + 1, len(keys) - 1)])

    def _toggle_autopilot(self) -> None:
        operator = self._stage.operator
        if operator.snapshot().autopilot:
            operator.cancel()
        else:
            operator.start_autopilot(Autopilot(operator, pause_s=0.5))


def flown_step(snapshot: Snapshot) -> str:
    """The step that Autopilot is at, told by what it has done so far; empty while it rests."""
    session, world = snapshot.session, snapshot.world
    if not snapshot.autopilot or session is None or world is None:
        return ""
    job = snapshot.job.name if snapshot.job is not None else ""
    if not session.target:
        return "target"
    if job == "Calibrating":
        return "calibrate"
    if world.standing == "board":
        return "poses" if session.calibration is None or session.calibration.stale else "calibrate"
    if world.standing != "object":
        return "verify"
    if job.startswith("Merg"):
        return "merge"
    latest = next((scan.name for scan in reversed(session.scans) if scan.purpose == "scan"), "")
    if session.merge is None or latest not in session.merge.scans:
        return "scan"
    return "export" if any(measured.source == latest for measured in session.measurements) else "measure"


def notify(client: viser.ClientHandle, level: str, text: str) -> None:
    """Show a sentence to one browser."""
    client.add_notification(_TITLES[level], text, color=_COLOURS[level], auto_close_seconds=_SECONDS[level])


def greet_viewer(client: viser.ClientHandle) -> None:
    """Tell someone who may only watch that it is so."""
    with client.atomic():
        client.gui.add_html(str(boxed("You are watching. This link changes nothing.", "info")), order=-1.0)


def amount(n: int) -> str:
    """Bytes in words: "3.4 MB"."""
    size = float(n)
    for unit in ("bytes", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "bytes" or size >= 100 else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"


def _work(snapshot: Snapshot) -> list[tuple[str, float]]:
    """What is done for the operator now: in words, and the share that is done."""
    job, capture, found = snapshot.job, snapshot.rig.capture, []
    if capture is not None:
        also = f", {capture.waiting} more waiting" if capture.waiting else ""
        says = f"Capturing {capture.name}: frame {capture.frame} of {capture.frames}{also}"
        if capture.doing:
            says = f"{capture.name}: {capture.doing}{also}"
        found.append((says, capture.frame / max(capture.frames, 1)))
    if job is not None and not job.background:
        also = f", {job.waiting} more waiting" if job.waiting else ""
        found.append((f"{job.name}: {job.doing or 'begins'}{also} ({job.seconds:.0f} s)", job.share))
    return found


def _panel(key: str) -> Callable[[Stage], Panel]:
    found: Callable[[Stage], Panel] = importlib.import_module(f"slviewer.gui.steps.{key}").Panel
    return found


def _counted(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"


def _notice(notice: Notice) -> str:
    time = toned(f"{notice.time:%H:%M}", "dim")
    return block(Html(f"{time} {toned(notice.text, _MARKS[notice.level])}"))  # type: ignore[arg-type]
