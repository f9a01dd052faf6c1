"""The frame of the page: the steps on the left, the current step on the right, and what is visible
in every step; what is in the 3D view; and the links for other people and devices.

All browsers show the same step: an assistant sees the operator's step."""

import base64
import html
import importlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import cv2
import numpy as np
import viser

from slviewer.calibration.next_pose import nominal_lens
from slviewer.gui.panel import (
    NO_SESSION,
    PANEL_PLUGINS,
    ControlGroup,
    PanelContext,
    StepPanel,
)
from slviewer.gui.scene import CAMERA, PROJECTOR, USUAL_DISTANCE_MM, SceneLayer
from slviewer.gui.start import A_FOLDER, IMPORTED, START, StartPanel
from slviewer.gui.undo_controls import UndoControls
from slviewer.gui.widgets import (
    NOTICES,
    STEPS_PAGE,
    Html,
    Text,
    Tone,
    alert,
    coloured,
    help_link,
    meter,
    note,
    paragraph,
    to_html,
)
from slviewer.records.record import format_counts
from slviewer.session.atomic import format_bytes
from slviewer.wizard.autopilot import Autopilot
from slviewer.wizard.snapshot import (
    CalibrationView,
    Notice,
    PreviewView,
    RigView,
    SessionView,
    Snapshot,
    StepView,
)
from slviewer.wizard.steps import describe_awaited, list_activities

_EYES = {True: viser.Icon.EYE, False: viser.Icon.EYE_OFF}


class ViewTree(ControlGroup):
    """Inputs of the 3D view, for all browsers; the list follows the scene."""

    def __init__(self, context: PanelContext) -> None:
        super().__init__(context)
        gui = self._gui
        self._size: Any = gui.add_slider(
            "Point size", 0.25, 4.0, 0.25, 1.0, hint="Of all clouds, relative to their spacing"
        )
        self.react(self._size.on_update, lambda: context.scene.scale_points(self._size.value))
        self._eyes: dict[tuple[str, str], viser.GuiButtonHandle] = {}
        self._is_requested = False
        self._hint = Text(gui)
        self._hint.write("Press an object to hide it, or to show it again.", "dim")
        self._folder = gui.add_folder("In the view")
        context.scene.on_change = self._request

    def draw(self) -> None:
        """List the objects of the layers that are shown."""
        self._is_requested = False
        listed: dict[tuple[str, str], tuple[SceneLayer, str, bool]] = {
            (layer.name, name): (layer, *about)
            for layer in self._scene.layers
            for name, about in layer.list_objects().items()
        }
        for key in self._eyes.keys() - listed.keys():
            self._eyes.pop(key).remove()
        for key, (layer, title, visible) in listed.items():
            if key not in self._eyes:
                with self._folder:
                    self._eyes[key] = self.button(
                        title,
                        partial(layer.toggle, key[1]),
                        "eye",
                        hint="Shows or hides it in the view",
                    )
            eye = self._eyes[key]
            if (eye.label, eye.icon) != (title, _EYES[visible]):  # each would be sent
                eye.label, eye.icon = title, _EYES[visible]

    def _request(self) -> None:
        """Draw once more, after what is drawn now."""
        if not self._is_requested:
            self._is_requested = True
            self.context.submit(self.draw)


STEPS_PX, STEP_PX = 160, 340
"""Widths of the two panels: at 1280 px of page, the scene keeps 60 % of it."""

_DOUBTFUL = "done, with a warning"
_ICONS = {
    "done": "circle-check",
    _DOUBTFUL: "alert-triangle",
    "ready": "circle-dotted",
    "blocked": "lock",
}
_STEP_COLOURS: dict[str, Literal["green", "orange", "gray"]] = {
    "done": "green",
    _DOUBTFUL: "orange",
    "ready": "gray",
    "blocked": "gray",
}
"""Of the icons, by `page_style.css`; the shown step's button has the accent colour."""
_STEPS_WITH_RIG = ("rig", "target", "poses", "calibrate")  # in which the devices matter in 3D
STAGES = {
    "rig": "check-of-the-rig",
    "target": "target-poses",
    "poses": "target-poses",
    "calibrate": "calibration",
    "verify": "scans",
    "scan": "scans",
    "merge": "merge",
    "measure": "measurements",
    "export": "measurements",
}
"""{step: anchor of the findings of its stage in the help}."""
_STATED = ("target-poses", "calibration")  # sections whose warnings are in their step's panel
_HELP_STYLE = "float:right;font-size:0.875rem;line-height:1.9rem"
_QUIET_ZONE = 4
"""White modules around a QR code (ISO/IEC 18004)."""
_MOST_NOTICES = 12  # of the latest, in the panel
_MOST_FAULTS = 3  # of the session's files, in the panel


class Shell(ControlGroup):
    """The page: builds it once; `update` and `draw_preview` update it, from one thread."""

    def __init__(self, context: PanelContext, steps: Sequence[StepView]) -> None:
        super().__init__(context)
        self._devices = context.scene.layer("devices")
        self._drawn_devices: tuple[CalibrationView | None, tuple[int, int] | None] = (None, None)
        self._panels: dict[str, StepPanel] = {}
        self._shown_key = self._autopilot_key = self._following_key = ""
        self._folder: Path | None = None
        self._drawn = Snapshot()
        self._hands_free_awaits = ""
        self.current = START
        """The step that is shown, or will be with the next drawing."""
        self._gui.set_panel_label("slviewer")
        self._build_left(steps)
        self._build_right(steps)

    def go(self, key: str) -> None:
        """Show another step at the next drawing; may be called from any thread."""
        if key in self._panels:
            self.current = key

    def states(self, notice: Notice) -> bool:
        """Whether the shown step states what a notice reports: results, and findings that have
        their place in its panel."""
        is_shown = notice.section == STAGES.get(self._shown_key)
        return is_shown and (notice.level in ("info", "good") or notice.section in _STATED)

    # building

    def _build_left(self, steps: Sequence[StepView]) -> None:
        """Build the left panel: buttons of the steps, autopilot, session and progress."""
        gui = self._gui
        gui.main_panel.dock_left()
        gui.main_panel.set_width(STEPS_PX)
        self._start_button = self.button(
            "Sessions", partial(self.go, START), "folder-open", hint="New, recent and others"
        )
        self._step_buttons = {
            step.key: self.button(
                f"{number}. {step.title}",
                partial(self.go, step.key),
                _ICONS[step.state],
                hint=f"Shows the step {step.title}",
            )
            for number, step in enumerate(steps, 1)
        }
        gui.add_divider()
        self._autopilot = self.button(
            "Autopilot", self._toggle_autopilot, "player-play", at_once=True
        )
        self._autopilot.visible = False
        with gui.add_folder(None) as self._imports:
            for label, kinds in (("Import files", IMPORTED), ("Import a folder", A_FOLDER)):
                self.upload_button(label, self._operator.import_file, kinds)
        self._counts = Text(gui)
        self._undo = UndoControls(self.context)
        self._state = Text(gui)

    def _build_right(self, steps: Sequence[StepView]) -> None:
        """Build the right panel: the shown step with its problems and progress; the session; the
        messages."""
        gui, operator = self._gui, self._operator
        panel = gui.add_panel()
        panel.dock_right()
        panel.set_width(STEP_PX)
        with panel.add_tab("Step"):
            self._heading = Text(gui)
            self._faults = Text(gui)
            self._autopilot_status = Text(gui)
            self._cancel = self.button("Cancel", operator.cancel, "player-stop", at_once=True)
            self._next = self.button(
                "Continue", lambda: self.go(self._following_key), "arrow-right"
            )
            self._next.color = None
            self._cancel.visible = self._next.visible = False
            self._panels[START] = StartPanel(self.context, self._leave_start)
            for key in (step.key for step in steps):
                module = importlib.import_module(f"slviewer.gui.steps.{key}")
                self._panels[key] = getattr(module, f"{key.title()}Panel")(self.context)
            for plugin in PANEL_PLUGINS.usable().values():
                try:
                    self._panels[plugin.step].add_plugin(plugin)
                except Exception as error:  # whatever a package's panel raises
                    self.context.report_failure(error)
        with panel.add_tab("Session"):
            self._session = Text(gui)
            links = gui.add_button(
                "Links",
                icon=viser.Icon.LINK,
                color="gray",
                hint="For watching and for the projector",
            )
            links.on_click(
                lambda event: self.context.run(partial(show_links, self.context, event.client))
            )
        with panel.add_tab("Messages"):
            self._latest = Text(gui)
        with panel.add_tab("View"):
            ViewTree(self.context)

    # drawing

    def update(self, snapshot: Snapshot) -> None:
        """Update the page from a snapshot."""
        folder = snapshot.session.folder if snapshot.session else None
        if folder != self._folder:
            self._folder = folder
            self.current = next_step(snapshot) if folder else START
        self._follow_autopilot(snapshot)
        key = self.current
        if key != self._shown_key:
            self._switch_panel(key)
        self._imports.visible = key != START  # which has its own
        self._start_button.color = None if key == START else "gray"
        for step in snapshot.steps:
            button = self._step_buttons[step.key]
            state = _describe_state(step)
            button.icon = viser.IconName(_ICONS[state])
            button.color = None if step.key == key else _STEP_COLOURS[state]
        self._draw_heading(snapshot)
        self._drawn = snapshot
        self._draw_state()
        self._draw_session(snapshot)
        self._undo.update(snapshot)
        self._draw_devices(snapshot.calibration, snapshot.rig)
        self._panels[key].update(snapshot)

    def draw_preview(self, preview: PreviewView) -> None:
        """Show a preview, if the current step shows one."""
        if self._shown_key:
            self._panels[self._shown_key].draw_preview(preview)
        if preview.awaited != self._hands_free_awaits:
            self._hands_free_awaits = preview.awaited
            self._draw_state()

    @property
    def shows_preview(self) -> bool:
        """Whether the current step shows previews."""
        return type(self._panels[self.current]).draw_preview is not StepPanel.draw_preview

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
            self._panels[self._shown_key].show(False)
        self._shown_key = key
        self._panels[key].show(True)
        if key in _STEPS_WITH_RIG:
            self.context.viewpoints.overview()
        else:
            self._panels[key].show_view()

    def _draw_heading(self, snapshot: Snapshot) -> None:
        """Show the step's title, state, instruction and problems, and the button to continue."""
        if self._shown_key == START:
            self._heading.set("")
            self._next.visible = False
            return
        steps = list(snapshot.steps)
        at = next(i for i, step in enumerate(steps) if step.key == self._shown_key)
        step = steps[at]
        tone: Tone = "good" if step.state == "done" and not step.is_doubtful else "warning"
        state = "" if step.state == "ready" else coloured(_describe_state(step), tone)
        link = help_link(step.key, STEPS_PAGE, _HELP_STYLE)
        heading = paragraph(
            Html(
                f'<div style="font-size:1.25rem;font-weight:600">{at + 1}&ensp;'
                f'{to_html(step.title)}&ensp;<span style="font-size:0.8rem">{state}</span>{link}'
                f"</div><div style='margin-top:0.2em'>{to_html(step.instruction)}</div>"
            )
        )
        problems = (
            Html(f"{to_html(each)} {help_link(STAGES[step.key])}") for each in step.problems
        )
        self._heading.set(heading + "".join(alert(problem, "error") for problem in problems))
        following = steps[at + 1] if at + 1 < len(steps) else None
        if following:
            self._following_key = following.key
            self._next.label = f"Continue to {following.title}"
        can_continue = following is not None and following.state != "blocked"
        leads_on = can_continue and step.state == "done"
        self._next.visible = leads_on or step.key == "verify"  # which is optional
        for button in self.context.main_buttons:
            button.color = "gray" if leads_on else None

    def _draw_state(self) -> None:
        """Show what runs and what is awaited, and whether it can be cancelled."""
        snapshot, key = self._drawn, self._shown_key
        activities = list_activities(snapshot)
        if key != START:
            awaited = describe_awaited(snapshot, key, self._hands_free_awaits)
        else:
            awaited = "" if activities else "Waits for you: open a session, or make a new one."
        self._state.set(state_html(activities, awaited))
        job = snapshot.job
        self._cancel.visible = snapshot.rig.capture is not None or bool(job and job.can_cancel)

    def _draw_session(self, snapshot: Snapshot) -> None:
        """Show the session's folder, contents and free space, the autopilot and the latest
        notices."""
        session, space = snapshot.session, snapshot.space
        if session is None:
            about = note("No session is open.")
            self._counts.set(f"<div data-counts>{about}</div>")
        else:
            kinds = ["pose"] * len(session.poses) + [scan.purpose for scan in session.scans]
            name = f'<b style="overflow-wrap:anywhere">{to_html(session.folder.name)}</b>'
            lines = [name, format_counts(kinds)]
            self._counts.set(f"<div data-counts>{paragraph(Html('<br>'.join(lines)))}</div>")
            folder = f'<span style="overflow-wrap:anywhere">{coloured(session.folder, "dim")}'
            lines.insert(1, f"{folder}</span>")
            if space:
                text = f"{format_bytes(space.free_bytes)} free"
                if space.capture_bytes:
                    text += f"; a capture needs {format_bytes(space.capture_bytes)}"
                lines.append(coloured(text, "dim" if space.enough else "error"))
            about = paragraph(Html("<br>".join(lines)))
        self._session.set(about)
        faults = (session or NO_SESSION).faults
        more = len(faults) - _MOST_FAULTS
        rest = f"{more} more files are damaged: `slviewer inspect` lists them." if more > 0 else ""
        texts = (snapshot.read_failure, *faults[:_MOST_FAULTS], rest)
        self._faults.set("".join(alert(text, "error") for text in texts))
        self._autopilot.visible = snapshot.rig.simulated and session is not None
        self._autopilot.label = "Stop autopilot" if snapshot.autopilot else "Autopilot"
        self._autopilot_status.write(snapshot.autopilot, "info")
        latest = ""
        for notice in reversed(snapshot.notices[-_MOST_NOTICES:]):
            time = coloured(f"{notice.time:%H:%M}", "dim")
            text = coloured(notice.text, NOTICES[notice.level][3])
            is_fault = notice.section and notice.level in ("warning", "error")
            link = f" {help_link(notice.section)}" if is_fault else ""
            latest += paragraph(Html(f"{time} {text}{link}"))
        style = "padding-top:0.6em;overflow-wrap:anywhere"
        self._latest.set(f'<div style="{style}">{latest or note("No messages.")}</div>')

    def _draw_devices(self, calibration: CalibrationView | None, devices: RigView) -> None:
        """Draw camera and projector as frusta, if they have changed."""
        camera, projector = devices.camera, devices.projector
        if (calibration, camera) == self._drawn_devices:
            return
        self._drawn_devices = (calibration, camera)
        self._devices.clear()
        rig = calibration.stereo.rig if calibration else None
        self.context.show_distance(_estimate_distance(calibration))
        if camera:
            K = (rig.camera if rig else nominal_lens(camera)).K
            self._devices.device("camera", K, camera, np.eye(4), CAMERA)
        if projector and rig is not None and calibration is not None:
            T_camera_projector = np.eye(4)  # the inverse of X_p = R X_c + t
            T_camera_projector[:3, :3], T_camera_projector[:3, 3] = rig.R.T, -rig.R.T @ rig.t
            other = calibration.reprojection.other
            self._devices.device(
                other, rig.projector.K, rig.projector.size, T_camera_projector, PROJECTOR
            )

    # requests

    def _leave_start(self) -> None:
        """Show the first step that is not done, of the session that was opened."""
        self._folder = None

    def _toggle_autopilot(self) -> None:
        """Start the autopilot, or stop it where it runs."""
        if self._operator.snapshot().autopilot:
            self._operator.cancel()
        else:
            self._operator.start_autopilot(Autopilot(self._operator, pause_s=0.5))


def _estimate_distance(calibration: CalibrationView | None) -> float:
    """Return the working distance of a rig in mm."""
    if calibration is None:
        return USUAL_DISTANCE_MM
    depths = calibration.stereo.depth_range_mm  # unknown where it was imported
    return float(np.mean(depths)) if depths else 3.3 * calibration.stereo.rig.baseline_mm


def _describe_state(step: StepView) -> str:
    """Return the state of a step in words."""
    return _DOUBTFUL if step.is_doubtful else step.state


def next_step(snapshot: Snapshot) -> str:
    """Return the key of the step after the last one that is done, else the last one; a rig that is
    being opened counts as done."""
    steps = snapshot.steps
    done = [i for i, step in enumerate(steps) if step.state == "done"]
    if snapshot.rig.state == "opening":
        done.append(0)
    return steps[min(max(done, default=-1) + 1, len(steps) - 1)].key


def autopilot_step(snapshot: Snapshot) -> str:
    """Return the key of the autopilot's step, from what it has done so far; empty while it is
    off."""
    session, world = snapshot.session, snapshot.world
    if not snapshot.autopilot or session is None or world is None:
        return ""
    job = snapshot.job.name if snapshot.job else ""
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
    measured = any(each.record.source == latest for each in session.measurements)
    return "export" if measured else "measure"


def state_html(activities: Sequence[tuple[str, float | None]], awaited: str) -> Html:
    """Return the line of state: what runs, with bars that are filled to the shares done, and what
    is awaited; `page_style.css` puts it below everything."""
    parts = []
    for text, share in activities:
        bar = "" if share is None else meter(share)
        parts.append(f"{bar}<b>{to_html(text)}</b>")
    if awaited:
        parts.append(to_html(awaited))
    parts = [f"<span>{part}</span>" for part in parts]
    kind = "busy" if activities else "waiting"
    return Html(f'<div data-activity="{kind}" role="status">{"".join(parts)}</div>')


def show_links(context: PanelContext, client: viser.ClientHandle | None) -> None:
    """Open a dialog with the links in the browser of the operator that requests them, and in no
    other; None: it has disconnected."""
    server, operator = context.server, context.operator
    if client is None:
        return
    number = client.client_id

    def replace(_: object) -> None:
        """Replace all links, and print the new ones."""
        try:
            server.renew_links(number)
            operator.notify(
                "info", "The links were replaced: pages opened by the old ones are closed"
            )
        except OSError as error:
            operator.notify(
                "error",
                f"The links were replaced, but {server.serving.token_file} holds the old tokens,"
                f" valid again after a restart ({error.strerror}): write new ones into it",
            )
        context.print_links(server)

    origin = server.origin_of(number)
    is_own = origin is not None and urlsplit(origin).hostname in ("127.0.0.1", "localhost", "::1")
    if is_own and not server.loopback:
        origin = server.shared_origin
    others_reach = not (is_own and server.loopback)
    rows = [("To watch, from any computer that reaches this address", server.link("watch", origin))]
    if server.device_pages:
        rows.append(("Projector page, on another computer", server.link("project", origin)))
        link = server.link("camera", origin)
        needs = "" if link.startswith("https:") else ", whose browsers demand --tls"
        rows.append((f"Camera page, on a phone or another computer{needs}", link))
    with client.gui.add_modal("Links") as dialog:
        gui = client.gui
        gui.add_html("".join(_link_html(what, link, others_reach) for what, link in rows))
        if not others_reach:
            advice = Html(
                "Only this computer reaches these links. For others, and phones, start slviewer"
                " with <code style='white-space:nowrap'>--host 0.0.0.0 --tls</code>."
            )
            gui.add_html(str(alert(advice, "info")))
        about = Html(
            "<b>New links</b> closes every page that was opened by the present ones, those of"
            " projector and camera too. This page continues."
        )
        gui.add_html(str(paragraph(about)))
        renew = gui.add_button(
            "New links",
            icon=viser.Icon.REFRESH,
            color="gray",
            hint="Closes every page that the present links opened",
        )
        close = gui.add_button("Close", hint="Closes this dialog")
    renew.on_click(replace)
    close.on_click(lambda _: dialog.close())


def _link_html(what: str, link: str, qr_code: bool) -> Html:
    """Return the HTML of one link, selected by a click to be copied, and its QR code for a
    phone."""
    style = (
        "display:block;user-select:all;overflow-wrap:anywhere;padding:0.4em"
        " 0.6em;border-radius:4px;"
        "background:var(--mantine-color-gray-light);font-family:monospace;font-size:0.9em;flex:1"
    )
    code = f"<code style='{style}'>{html.escape(link)}</code>"
    if qr_code:
        look = "width:7.5em;height:7.5em;image-rendering:pixelated;background:#fff"
        code += f"<img alt='QR code of this link' style='{look}' src='{encode_qr_code(link)}'>"
    row = "display:flex;gap:0.6em;align-items:center;margin-top:0.2em"
    return paragraph(Html(f"{to_html(what)}:<span style='{row}'>{code}</span>"))


def encode_qr_code(text: str) -> str:
    """Return the QR code of a text as the address of a PNG picture, a pixel a module."""
    modules = cv2.QRCodeEncoder.create().encode(text)
    # OpenCV adds some of it
    border = max(0, _QUIET_ZONE - int((modules == 0).any(axis=0).argmax()))
    modules = cv2.copyMakeBorder(modules, *(border,) * 4, cv2.BORDER_CONSTANT, value=255)
    png = cv2.imencode(".png", modules)[1].tobytes()
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"
