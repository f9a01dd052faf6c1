"""Inputs of captures that several steps share: exposures, the turntable, the object before the
simulated rig, and the import of captures of other tools."""

from typing import Any, get_args

import numpy as np

from slviewer.gui.panel import NO_SESSION, PanelPart, Setting, StepPanel
from slviewer.gui.widgets import Html, Picture, Text, coloured, paragraph
from slviewer.pipeline.suggest_exposure import BUDGET_S, STATES, ExposureSuggestion
from slviewer.pipeline.turn import FULL_TURN_DEG, STEPS
from slviewer.registration.multiway import MOST_SCANS
from slviewer.session.capture import Role
from slviewer.session.importers.images import DEFAULT_CHANNEL, Channel
from slviewer.session.importers.layouts import Codec, layouts
from slviewer.wizard.snapshot import ExposureChange, Snapshot

_MULTIPLES: dict[str, tuple[float, ...]] = {
    "1": (),
    "2: 1×, 4×": (1.0, 4.0),
    "3: ¼×, 1×, 4×": (0.25, 1.0, 4.0),
}
_SUGGESTED = "as suggested"
_SATURATED, _DARK = (230, 40, 40), (40, 110, 230)
_UNLIT = 0.35  # of its brightness
_GAP_PX = 4
NEAREST_MM, FARTHEST_MM = 250.0, 1500.0
_OTHER = "other"
_GIZMO = "simulated object"
_DETECT = "detect"
_AUTOMATIC = "by number"
_RESULTS: dict[Role, str] = {"calibration": "target poses", "scan": "scans"}


class ExposureInputs(PanelPart):
    """Inputs for the exposures of each capture, chosen by the operator or suggested from what the
    camera sees, in the steps Rig and Scan."""

    _drawn: ExposureChange | None = None

    def __init__(self, panel: StepPanel, *, for_scan: bool = False) -> None:
        self._for_scan = for_scan
        super().__init__(panel)

    def build(self) -> None:
        """Create the inputs."""
        gui, context = self._gui, self._context
        self._budget = gui.add_number(
            "Time limit, s", BUDGET_S, min=0.5, max=600.0, step=0.5, hint="Of one capture",
            visible=False,
        )  # fmt: skip
        self._suggest = context.button(
            "Suggest exposure", self._request, "sun",
            hint="Tries exposures for some seconds, and sets the best",
        )  # fmt: skip
        self._undo = context.button("Undo exposure", self._operator.undo_exposure, "arrow-back-up")
        self._picture = Picture(gui, "Measured before and now")
        if self._for_scan:
            return
        several = gui.add_dropdown(
            "Exposures",
            (*_MULTIPLES, _SUGGESTED),
            hint="Several for shiny and dark parts: each pixel uses the best",
        )
        self._several = Setting(context, several, self._set_several)
        self._note = Text(gui)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the exposures of the session, and what the last suggestion measures."""
        session, rig, latest = snapshot.session, snapshot.rig, snapshot.exposure_change
        shown = rig.exposure_ms is not None and not rig.is_recorded
        self._suggest.visible, self._undo.visible = shown, shown and latest is not None
        self._suggest.disabled = self._undo.disabled = not (rig.is_idle and session is not None)
        if latest is not self._drawn:
            self._drawn = latest
            if latest is None:
                self._picture.hide()
            else:
                self._picture.set(
                    draw_suggestion(latest.suggestion), suggestion_html(latest.suggestion)
                )
        if self._for_scan:
            return
        self._budget.visible = self._several.handle.visible = shown
        exposures = (session or NO_SESSION).exposures_ms
        self._several.update(name_exposures(exposures, rig.exposure_ms))
        each = ", ".join(f"{exposure:g}" for exposure in exposures)
        self._note.write(f"Exposures of each capture: {each} ms." if exposures else "", "dim")
        self._several.handle.disabled = rig.state != "open"

    def _request(self) -> None:
        """Request a suggestion within the time that is allowed."""
        self._operator.suggest_exposure(self._for_scan, float(self._budget.value))

    def _set_several(self, chosen: str) -> None:
        """Request the chosen multiples of the current exposure, or a suggestion."""
        now = self._operator.snapshot().rig.exposure_ms
        if chosen == _SUGGESTED:
            self._request()
        elif now is not None:
            self._operator.set_exposures([now * times for times in _MULTIPLES[chosen]])


def draw_suggestion(suggestion: ExposureSuggestion) -> np.ndarray:
    """The scene before and now, side by side (h, 2 w, 3) uint8: saturated pixels red, too dark ones
    blue, and those that the projector does not light dim."""
    before, now = (
        _paint(suggestion.image, state) for state in (suggestion.state_before, suggestion.state)
    )
    gap = np.full((len(now), _GAP_PX, 3), 255, np.uint8)
    return np.concatenate([before, gap, now], axis=1)


def suggestion_html(suggestion: ExposureSuggestion) -> Html:
    """State what is measured before and now, and what the colours mean."""
    marks = (
        f"{coloured('■ saturated', 'error')}&ensp;<span style='color:rgb{_DARK}'>■ too dark</span>"
    )
    return paragraph(
        Html(
            '<div style="display:flex;justify-content:space-between">'
            f"<span>{100 * suggestion.share_before:.1f} % measured</span>"
            f"<b>{100 * suggestion.share:.1f} % measured</b></div><div>{marks}&ensp;"
            f"{coloured(f'{suggestion.capture_s:.1f} s a capture', 'dim')}</div>"
        )
    )


def _paint(image: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Colour an image (h, w) by the states of its pixels."""
    picture = np.repeat(image[..., None], 3, axis=2)
    picture[state == STATES.index("saturated")] = _SATURATED
    picture[state == STATES.index("dark")] = _DARK
    unlit = state == STATES.index("unlit")
    picture[unlit] = (_UNLIT * picture[unlit]).astype(np.uint8)
    return picture


def name_exposures(exposures_ms: tuple[float, ...], exposure_ms: float | None) -> str:
    """The label of exposures as multiples of the camera's, else that of suggested ones."""
    for label, multiples in _MULTIPLES.items():
        wanted = [times * (exposure_ms or 0.0) for times in multiples]
        if len(wanted) == len(exposures_ms) and np.allclose(wanted, exposures_ms, rtol=0.05):
            return label
    return _SUGGESTED


class TurnInputs(PanelPart):
    """Inputs to scan all round on the rig's turntable: number of steps, range, and the buttons to
    begin and to resume a turn; hidden without a turntable."""

    def build(self) -> None:
        """Create the inputs."""
        gui, context, operator = self._gui, self._context, self._operator
        with gui.add_folder("Turntable") as self._folder:
            self._steps: Any = gui.add_number(
                "Steps", STEPS, min=2, max=MOST_SCANS, step=1, hint="Scans of a turn"
            )
            self._range: Any = gui.add_number(
                "Range, °", FULL_TURN_DEG, min=-FULL_TURN_DEG, max=FULL_TURN_DEG, step=5.0,
                hint="360 for a full turn; negative turns the other way",
            )  # fmt: skip
            merge = gui.add_checkbox(
                "Merge and mesh",
                True,
                hint="At the end; the mesh is closed, also where the part stands",
            )
            self._scan = context.button(
                "Scan all round",
                lambda: operator.scan_all_round(
                    int(self._steps.value), float(self._range.value), then_merge=merge.value
                ),
                "rotate-360",
                None,
            )
            self._resume = context.button(
                "Resume turn",
                lambda: operator.resume_turn(then_merge=merge.value),
                "player-track-next",
                hint="Captures the missing steps. Leave part and table as they are.",
            )
            self._note = Text(gui)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the inputs where the rig has a turntable, and what the last turn lacks."""
        self._folder.visible = bool(snapshot.rig.turntable)
        ready = snapshot.rig.is_idle and snapshot.step("scan").state != "blocked"
        self._scan.disabled = self._resume.disabled = not ready
        scans = (snapshot.session or NO_SESSION).scans
        turned = [(scan.created, scan.turn_step) for scan in scans if scan.turn_step is not None]
        last = max(turned, key=lambda each: each[0], default=("", None))[1]
        captured = sum(last is not None and step.turn == last.turn for _, step in turned)
        self._resume.visible = last is not None and captured < last.steps
        if last is not None:
            self._resume.label = f"Resume {last.turn}"
        text = f"{last.turn}: {captured} of {last.steps} steps captured." if last else ""
        self._note.write(text if self._resume.visible else "", "warning")


class SimulatedObject(PanelPart):
    """Inputs that place and move an object in front of the simulated rig; hidden with real
    devices."""

    _standing = _handled = ""
    _T = np.eye(4)

    def __init__(self, panel: StepPanel, *things: str) -> None:
        self._things = things
        super().__init__(panel)

    def build(self) -> None:
        """Create the inputs."""
        gui, context = self._gui, self._context
        with gui.add_folder("Simulated rig") as self._folder:
            self._note = Text(gui)
            thing: Any = gui.add_dropdown("Object", (_OTHER, *self._things))
            self._distance = gui.add_number(
                "Depth, mm", 600.0, min=NEAREST_MM, max=FARTHEST_MM, step=5.0,
                hint="From the camera",
            )  # fmt: skip
            self._turn = gui.add_number("Turn, °", 0.0, min=-90.0, max=90.0, step=5.0)
            self._handles = gui.add_checkbox(
                "3D handles", False, hint="To move and turn it in the 3D view"
            )
        context.on_change(self._draw_handles, self._handles)
        self._settings = [
            Setting(context, thing, self._request_choice),
            Setting(context, self._distance, lambda mm: self._move(self._distance, distance_mm=mm)),
            Setting(context, self._turn, lambda deg: self._move(self._turn, turn_deg=deg)),
        ]

    def draw(self, snapshot: Snapshot) -> None:
        """Show the object in view, its depth and turn."""
        world = snapshot.world
        self._folder.visible = world is not None
        if world is None:
            self._standing = ""
            self._draw_handles()
            return
        fits = world.standing in self._things
        self._note.write(
            "" if fits else f"In view: the {world.standing}. Choose an object to capture.",
            "warning",
        )
        self._distance.disabled = self._turn.disabled = not fits
        self._standing, self._T = world.standing if fits else "", world.T_camera_object
        self._draw_handles()
        values = (
            world.standing if fits else _OTHER,
            round(float(np.clip(self._T[2, 3], NEAREST_MM, FARTHEST_MM)), 1),
            round(float(np.clip(world.turn_deg, -90, 90)), 1),
        )
        for setting, value in zip(self._settings, values, strict=True):
            setting.update(value)

    def _draw_handles(self) -> None:
        """Add, move or remove the 3D handles of the object in view."""
        wanted = self._standing if self._handles.value else ""
        if not wanted:
            self._layer.remove(_GIZMO)
        elif wanted != self._handled:
            self._layer.gizmo(_GIZMO, self._T, None, self._request_place)
        else:
            self._layer.move(_GIZMO, self._T)
        self._handled = wanted

    def _request_place(self, T: np.ndarray) -> None:
        """Request that the object be moved to T (4, 4) mm."""
        self._context.callback(lambda: self._operator.place(self._standing, T))(None)  # type: ignore[arg-type]

    def _request_choice(self, thing: Any) -> None:
        """Request that the chosen object be placed in view."""
        if thing in self._things:
            self._operator.place(thing)

    def _move(self, number: Any, **to: float) -> None:
        """Request that the object be moved to an entered number, if it is within its limits."""
        if all(number.min <= value <= number.max for value in to.values()):
            self._operator.move_object(**to)


class ImportInputs(PanelPart):
    """Inputs of a panel to import captures of other tools, from a folder of the computer that runs
    slviewer or from a zip: location, layout and role."""

    def __init__(self, panel: StepPanel, role: Role) -> None:
        self._role = role
        super().__init__(panel)

    def build(self) -> None:
        """Create the inputs."""
        gui, context = self._gui, self._context
        with gui.add_folder("Import captures", expand_by_default=False):
            Text(gui).write(
                f"Imports images of another program as {_RESULTS[self._role]}, one folder each.",
                "dim",
            )
            self._layout: Any = gui.add_dropdown(
                "Layout",
                (_DETECT, *layouts()),
                hint="How the files are named; detect uses the names, or a TOML",
            )
            self._description = Text(gui)
            self._projector = gui.add_text(
                "Projector", "", hint="Columns x rows, for example 1280x800"
            )
            self._size_hint = Text(gui)
            self._channel = gui.add_dropdown(
                "Channel", get_args(Channel), initial_value=DEFAULT_CHANNEL, hint="Of colour images"
            )
            self._codec = gui.add_dropdown(
                "Codec", (_AUTOMATIC, *get_args(Codec)), visible=False, hint="Of SLStudio"
            )
            self._prefix = gui.add_text(
                "Prefix", "", hint="Put before the names: part gives part_pose_01"
            )
            folder = gui.add_text("Folder path", "", hint="On the computer that runs slviewer")
            self._import = context.button(
                "Import folder",
                lambda: self._operator.import_folder(folder.value, **self._collect_options()),
                "folder-symlink",
                None,
            )
            self._upload = context.upload_button(
                "Upload zip",
                lambda name, content: self._operator.import_zip(
                    name, content, **self._collect_options()
                ),
                ".zip",
            )
        context.on_change(self._describe, self._layout)
        self._describe()

    def draw(self, snapshot: Snapshot) -> None:
        """Enable the import while a session is open and no requested job runs."""
        ready = snapshot.session is not None and not snapshot.is_busy
        self._import.disabled = self._upload.disabled = not ready

    def _describe(self) -> None:
        """Describe the chosen layout, and show the inputs that it needs."""
        name = self._layout.value
        layout = layouts().get(name)
        self._description.write(f"Contains {layout.holds}." if layout else "", "dim")
        self._codec.visible = name == "slstudio"
        size = layout.projector if layout else None
        if size is not None:
            empty = f"of the session, else {size[0]}x{size[1]}"
        elif name == "frames":
            empty = "of the TOML"
        else:
            empty = "of the layout or the session" if layout is None else "of the session"
        self._size_hint.write(f"Default size: {empty}.", "dim")

    def _collect_options(self) -> dict[str, Any]:
        """Return the import options that were entered: layout, role, projector, prefix, channel and
        codec."""
        chosen: dict[str, Any] = {"layout": self._layout.value, "role": self._role}
        for name, handle in (("projector", self._projector), ("prefix", self._prefix)):
            if handle.value.strip():
                chosen[name] = handle.value.strip()
        if self._channel.value != DEFAULT_CHANNEL:
            chosen["channel"] = self._channel.value
        if self._codec.visible and self._codec.value != _AUTOMATIC:
            chosen["codec"] = self._codec.value
        return chosen
