"""Inputs of captures that several steps share: exposures, the turntable, the object before the
simulated rig, and the import of captures of other tools."""

from typing import Any, get_args

import numpy as np

from slviewer.gui.panel import Form, PanelPart, StepPanel
from slviewer.gui.widgets import Html, Picture, Text, coloured, paragraph
from slviewer.pipeline.capture import CaptureSettings, TurnSettings
from slviewer.pipeline.suggest_exposure import STATES, ExposureSuggestion
from slviewer.session.capture import Role
from slviewer.session.importers.images import DEFAULT_CHANNEL, Channel
from slviewer.session.importers.layouts import Codec, layouts
from slviewer.wizard.snapshot import ExposureChange

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
TURN_DEG = 30.0
"""Two such scans overlap by more than half."""
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
        self._budget = Form(self, CaptureSettings, "budget_s")["budget_s"]
        self._budget.visible = False
        self._suggest = self.button(
            "Suggest exposure", self._request, "sun",
            hint="Tries exposures for some seconds, and sets the best",
        )  # fmt: skip
        self._undo = self.button("Undo exposure", self._operator.undo_exposure, "arrow-back-up")
        self._picture = Picture(self._gui, "Measured before and now")
        if self._for_scan:
            return
        several = self.dropdown(
            "Exposures",
            (*_MULTIPLES, _SUGGESTED),
            "Several for shiny and dark parts: each pixel uses the best",
        )
        self._several = self.setting(several, self._set_several)
        self._note = Text(self._gui)

    def draw(self) -> None:
        """Show the exposures of the session, and what the last suggestion measures."""
        snapshot = self.panel.snapshot
        rig, latest = snapshot.rig, snapshot.exposure_change
        shown = rig.exposure_ms is not None and not rig.is_recorded
        self._suggest.visible, self._undo.visible = shown, shown and latest is not None
        self._suggest.disabled = self._undo.disabled = not (rig.is_idle and snapshot.session)
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
        exposures = self.panel.session.exposures_ms
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
        operator = self._operator
        with self._gui.add_folder("Turntable") as self._folder:
            self._turn = Form(self, TurnSettings, "steps", "range_deg")
            merge = self.checkbox(
                "Merge and mesh", "At the end; the mesh is closed, also where the part stands", True
            )
            self._scan = self.button(
                "Scan all round",
                lambda: operator.scan_all_round(**self._turn.values(), then_merge=merge.value),
                "rotate-360",
            )
            self._resume = self.button(
                "Resume turn",
                lambda: operator.resume_turn(then_merge=merge.value),
                "player-track-next",
                hint="Captures the missing steps. Leave part and table as they are.",
            )
            self._note = Text(self._gui)

    def draw(self) -> None:
        """Show the inputs where the rig has a turntable, and what the last turn lacks."""
        rig, scans = self.panel.snapshot.rig, self.panel.session.scans
        self._folder.visible = bool(rig.turntable)
        self._scan.disabled = self._resume.disabled = not rig.is_idle or self.panel.is_blocked
        turned = [(scan.created, scan.turn_step) for scan in scans if scan.turn_step]
        last = max(turned, key=lambda each: each[0], default=("", None))[1]
        captured = sum(last is not None and step.turn == last.turn for _, step in turned)
        self._resume.visible = last is not None and captured < last.steps
        if last:
            self._resume.label = f"Resume {last.turn}"
        text = f"{last.turn}: {captured} of {last.steps} steps captured." if last else ""
        self._note.write(text if self._resume.visible else "", "warning")


class SimulatedObject(PanelPart):
    """Inputs that place and move an object in front of the simulated rig; hidden with real
    devices."""

    def __init__(self, panel: StepPanel, *things: str) -> None:
        self._things = things
        super().__init__(panel)

    def build(self) -> None:
        """Create the inputs."""
        with self._gui.add_folder("Simulated rig") as self._folder:
            self._note = Text(self._gui)
            self._thing = self.dropdown("Object", self._things)
            self._distance = self.number(
                "Depth, mm", 600.0, NEAREST_MM, FARTHEST_MM, 5.0, "From the camera"
            )
            self._turn = self.number("Turn, °", 0.0, -180.0, 180.0, 5.0)
            self._turn_button = self.button(
                f"Turn by {TURN_DEG:g}°", self._turn_further, "rotate-clockwise",
                hint="Turns the object to show its next side",
            )  # fmt: skip
            self._handles = self.checkbox("3D handles", "To move and turn it in the 3D view")
        self._settings = [
            self.setting(self._thing, self._request_choice),
            self.setting(self._distance, lambda mm: self._move(self._distance, distance_mm=mm)),
            self.setting(self._turn, lambda deg: self._move(self._turn, turn_deg=deg)),
        ]

    def draw(self) -> None:
        """Show the object in view, its depth and turn, and its 3D handles."""
        world = self.panel.snapshot.world
        self._folder.visible = world is not None
        if world is None:
            self._layer.remove(_GIZMO)
            return
        fits = world.standing in self._things
        self._note.write(
            "" if fits else f"In view: the {world.standing}. Choose an object to capture.",
            "warning",
        )
        self._distance.disabled = self._turn.disabled = self._turn_button.disabled = not fits
        T = world.T_camera_object
        if fits and self._handles.value:
            self._layer.gizmo(_GIZMO, T, None, self._place)
        else:
            self._layer.remove(_GIZMO)
        options = self._things if fits else (world.standing, *self._things)
        if self._thing.options != options:
            self._thing.options = options
        values = (
            world.standing,
            round(float(np.clip(T[2, 3], NEAREST_MM, FARTHEST_MM)), 1),
            round(world.turn_deg, 1),
        )
        for setting, value in zip(self._settings, values, strict=True):
            setting.update(value)

    def _place(self, T: np.ndarray) -> None:
        """Request that the object in view be moved to T (4, 4) mm."""
        if world := self.panel.snapshot.world:
            self._operator.place(world.standing, T)

    def _turn_further(self) -> None:
        """Request that the object be turned by one step."""
        if world := self.panel.snapshot.world:
            self._operator.move_object(turn_deg=world.turn_deg + TURN_DEG)

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
        gui = self._gui
        with gui.add_folder("Import captures", expand_by_default=False):
            Text(gui).write(
                f"Imports images of another program as {_RESULTS[self._role]}, one folder each.",
                "dim",
            )
            self._layout = self.dropdown(
                "Layout",
                (_DETECT, *layouts()),
                "How the files are named; detect uses the names, or a TOML",
            )
            self._description = Text(gui)
            self._projector = gui.add_text(
                "Projector", "", hint="Columns x rows, for example 1280x800"
            )
            self._size_hint = Text(gui)
            self._channel = gui.add_dropdown(
                "Channel", get_args(Channel), initial_value=DEFAULT_CHANNEL, hint="Of colour images"
            )
            self._codec = self.dropdown("Codec", (_AUTOMATIC, *get_args(Codec)), "Of SLStudio")
            self._prefix = gui.add_text(
                "Prefix", "", hint="Put before the names: part gives part_pose_01"
            )
            folder = gui.add_text("Folder path", "", hint="On the computer that runs slviewer")
            self._import = self.button(
                "Import folder",
                lambda: self._operator.import_folder(folder.value, **self._collect_options()),
                "folder-symlink",
            )
            self._upload = self.upload_button(
                "Upload zip",
                lambda name, content: self._operator.import_zip(
                    name, content, **self._collect_options()
                ),
                ".zip",
            )

    def draw(self) -> None:
        """Enable the import while a session is open and no requested job runs; describe the chosen
        layout, and show the inputs that it needs."""
        snapshot, name = self.panel.snapshot, self._layout.value
        ready = snapshot.session is not None and not snapshot.is_busy
        self._import.disabled = self._upload.disabled = not ready
        layout = layouts().get(name)
        self._description.write(f"Contains {layout.holds}." if layout else "", "dim")
        self._codec.visible = name == "slstudio"
        size = layout.projector if layout else None
        if size:
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
