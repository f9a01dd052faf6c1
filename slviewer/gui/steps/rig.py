"""Step 1: choose the rig, by name or from single devices, check its image, and set exposure and
light."""

import inspect
import time
from collections.abc import Mapping
from typing import Any

from slviewer.devices.browser import PAGE_ROLES, PageRole
from slviewer.devices.drivers import Driver, available
from slviewer.devices.page_channel import PageState
from slviewer.errors import InputError
from slviewer.gui.capture_inputs import ExposureInputs
from slviewer.gui.panel import PanelPart, StepPanel
from slviewer.gui.widgets import (
    Html,
    LiveImage,
    Text,
    Tone,
    alert,
    coloured,
    help_link,
    histogram_chart,
    note,
    paragraph,
    to_html,
)
from slviewer.pipeline.examination import CheckVerdict, Preflight
from slviewer.pipeline.rig_choice import Choice, Preset, check_choice, presets
from slviewer.server.viser_internals import make_private
from slviewer.session.store import Session
from slviewer.wizard.snapshot import PreviewView, RigView, SessionView

SIMULATED: dict[str, dict[str, Any]] = {
    "Simulated, half size": {"driver": "simulated", "scale": 0.5},
    "Simulated, full size": {"driver": "simulated", "scale": 1.0},
    "Simulated, quarter size": {"driver": "simulated", "scale": 0.25},
}
_PLAIN = {"preset": "letter", "seed": 0}
"""What a simulated rig is that does not say otherwise."""
_CHOOSE, _CUSTOM, _REPLAY = "Choose …", "Custom …", "replay"
_FIRST = "opencv"
"""The most common driver: a webcam."""
_ADDRESSES = ("source", "serial", "number", "model")
"""Names of the drivers' options that choose one device among several."""


def list_presets(session: Session | None) -> dict[str, Preset]:
    """Return the presets by name, without those that are `SIMULATED` already."""
    known = [_PLAIN | each for each in SIMULATED.values()]
    return {each.name: each for each in presets(session) if {**_PLAIN, **each.choice} not in known}


class RigChoice(PanelPart):
    """Inputs of the step Rig that choose the devices."""

    _presets: Mapping[str, Preset] = {}
    _session: SessionView | None = None

    def build(self) -> None:
        """Create the inputs."""
        gui, operator = self._gui, self._operator
        self._choice = self.dropdown("Rig", (_CHOOSE, *SIMULATED, _CUSTOM))
        self._chosen = self.setting(self._choice, self._request_choice)
        self._status = Text(gui)
        self._retry = self.button("Try again", self._request_again, "refresh")
        with gui.add_folder("Devices", visible=False) as self._devices:
            cameras = _label_drivers([d for d in available() if d.camera])
            self._camera = self.choice("Camera", options=cameras)
            self._source = gui.add_text(
                "Camera ID", "", hint="Number, file, address, serial number or model"
            )
            make_private(self._source)  # it may hold a password
            projectors = _label_drivers([d for d in available() if d.projector])
            self._projector = self.choice("Projector", options=projectors)
            self._size = gui.add_text(
                "Resolution", "", hint="For example 1920x1080; empty: that of its screen"
            )
            self._missing = Text(gui)
            self._use = self.button(
                "Use these devices",
                lambda: operator.choose_rig(self._read_entered()),
                "plug-connected",
            )
        self._pages = {role: Text(gui) for role in PAGE_ROLES}
        with gui.add_folder("Recording", visible=False) as self._recording:
            source = gui.add_text(
                "Source folder", "", hint="A session, or folders of images that can be imported"
            )
            self.button(
                "Play back",
                lambda: operator.choose_rig({"driver": _REPLAY, "source": source.value}),
                "player-play",
            )
        with gui.add_folder("Save this rig", expand_by_default=False) as self._saving:
            name = gui.add_text(
                "Name", "", hint="The rig is then offered by this name, with its exposure"
            )
            self.button("Save", lambda: operator.save_rig(name.value), "device-floppy")
        self._offer_rigs()

    def draw(self) -> None:
        """Show the rig in use, and offer the others; show the inputs for custom devices or a
        recording, as chosen."""
        if self.panel.session is not self._session:  # its own rigs may have changed
            self._session = self.panel.session
            self._offer_rigs()
        rig = self.panel.snapshot.rig
        self._chosen.update(self._match_option(rig))
        preset = self._presets.get(self._choice.value)
        about = "" if preset is None else note(preset.problem or preset.what)
        self._status.set(about + _rig_html(rig))
        self._retry.visible = rig.state == "lost"
        self._saving.visible = rig.state == "open" and not rig.simulated
        is_custom = self._devices.visible = self._choice.value == _CUSTOM
        self._recording.visible = self._choice.value == _REPLAY
        drivers = self._drivers
        missing = "; ".join(
            f"{d.name} cannot be used here, {d.missing}" for d in drivers.values() if d.missing
        )
        self._missing.write(missing, "warning")
        self._use.disabled = bool(missing)
        self._source.visible = _address_option(drivers["camera"]) is not None
        # of the rig, or of the devices that are being chosen
        for role, page in self._pages.items():
            needed = role in rig.pages or (is_custom and drivers[role].page)
            page.set(_page_html(role, self.context.page_state(role)) if needed else "")

    def _offer_rigs(self) -> None:
        """Update the options from the rig presets; a choice that is no longer offered is reset."""
        self._presets = list_presets(self._operator.session)
        options = (_CHOOSE, *SIMULATED, *self._presets, _CUSTOM)
        if tuple(self._choice.options) != options:
            value = self._choice.value
            self._choice.options = options
            self._choice.value = value if value in options else _CHOOSE

    def _match_option(self, rig: RigView) -> str:
        """Return the option that gave this rig."""
        if rig.choice is None:
            return _CHOOSE
        if rig.choice.get("driver") == _REPLAY:
            return _REPLAY
        for name, preset in self._presets.items():
            # apart from the delay, which is measured later
            if {**preset.choice, "settle_ms": None} == {**rig.choice, "settle_ms": None}:
                return name
        if rig.choice.get("driver") == "simulated":
            scale, cameras = rig.choice.get("scale", 1.0), rig.choice.get("cameras", 1)
            same = (name for name, each in SIMULATED.items() if each["scale"] == scale)
            return next(same, _CHOOSE) if cameras == 1 else _CUSTOM
        return _CUSTOM

    def _request_choice(self, chosen: str) -> None:
        """Request the chosen rig; where it is refused, show the one in use again."""
        operator, preset = self._operator, self._presets.get(chosen)
        granted = False
        if chosen in SIMULATED:
            granted = operator.choose_rig(SIMULATED[chosen])
        elif preset is None or chosen == _REPLAY:
            return
        elif preset.problem:
            operator.notify("error", f"{chosen} cannot be used here: {preset.problem}")
        else:
            granted = operator.choose_rig(preset.choice)
        if not granted:  # show what is in use; the other can be chosen again
            self._choice.value = self._match_option(operator.snapshot().rig)
            self.redraw()

    def _request_again(self) -> None:
        """Request the current rig again."""
        choice = self._operator.snapshot().rig.choice
        if choice is not None:
            self._operator.choose_rig(choice)

    @property
    def _drivers(self) -> dict[PageRole, Driver]:
        """The chosen drivers."""
        return {"camera": self._camera.value, "projector": self._projector.value}

    def _read_entered(self) -> Choice:
        """Return the rig of the entered devices. Raises InputError for an invalid one."""
        choices: dict[str, dict[str, Any]] = {}
        for role, driver in self._drivers.items():
            choices[role] = {"driver": driver.name}
            page = self.context.page_state(role) if driver.page else None
            takes_size = "size" in inspect.signature(getattr(driver, role)).parameters
            if page and page.size is not None and takes_size:
                # saved, since the page may be opened after the session
                choices[role]["size"] = list(page.size)
        camera, projector = self._drivers["camera"], self._drivers["projector"]
        option, address = _address_option(camera), self._source.value.strip()
        if option and address:
            is_number = address.isdecimal() and option in ("source", "number")
            choices["camera"][option] = int(address) if is_number else address
        if self._size.value.strip():
            choices["projector"]["size"] = _size(self._size.value)
        choice: Choice = {"name": f"{camera.name} and {projector.name}", **choices}
        check_choice(choice, "this rig")
        return choice


def _label_drivers(drivers: list[Driver]) -> dict[str, Driver]:
    """Return {label: driver}, the most common driver first."""
    drivers = sorted(drivers, key=lambda driver: driver.name != _FIRST)
    return {f"{driver.name}: {driver.what}": driver for driver in drivers}


def _address_option(driver: Driver) -> str | None:
    """Return the driver's option that chooses one device among several; None where it has none."""
    known = inspect.signature(driver.camera).parameters if driver.camera else {}
    return next((name for name in _ADDRESSES if name in known), None)


def _size(text: str) -> list[int]:
    """Parse "1920x1080" to [width, height] px. Raises InputError."""
    sides = text.lower().replace("×", "x").split("x")
    if len(sides) != 2 or not all(side.strip().isdecimal() for side in sides):
        raise InputError(f"{text!r} is not a size", "write width x height in px, such as 1920x1080")
    return [int(side) for side in sides]


def _rig_html(rig: RigView) -> str:
    """Describe the state of the rig."""
    if rig.state == "none":
        return alert("No rig yet. The simulated rig needs no devices.", "info")
    if rig.state == "lost":
        return alert(rig.fault or "The rig does not answer.", "error")
    if rig.state == "opening":
        return note("Opening …")
    sizes = [
        f"{what} {size[0]} × {size[1]} px"
        for what, size in (
            ("camera", rig.camera), ("second camera", rig.second), ("projector", rig.projector),
        )
        if size
    ]  # fmt: skip
    html = paragraph(
        Html(f"{coloured('●', 'good')} {to_html(rig.name)} · {to_html(', '.join(sizes))}")
    )
    return html + "".join(alert(note, "warning") for note in rig.notes)


_PAGE_USE: dict[PageRole, str] = {
    "projector": (
        "and move its window to the projector's screen; on another computer, open the link that"
        " Links shows."
    ),
    "camera": (
        "where this computer's camera is used; on a phone, open the link that Links shows, which"
        " needs <code style='white-space:nowrap'>slviewer --tls --host 0.0.0.0</code>."
    ),
}


def _page_html(role: PageRole, standing: PageState | None) -> str:
    """Describe the state of a device's page, and how to open it; viewers read this too, and may
    not."""
    if standing is None:
        return alert(f"This rig needs the {role} page, which is not served here.", "error")
    how = (
        f'<a href="{role}" target="_blank" rel="noopener">Open the {role} page</a>'
        f" {_PAGE_USE[role]}"
    )
    tone: Tone = {"waiting": "info", "refused": "warning", "ready": "good"}[standing.state]  # type: ignore[assignment]
    words = f"{role.capitalize()} page: {to_html(standing.words)}"
    return alert(Html(words if tone == "good" else f"{words}<br>{how}"), tone)


LIGHTS = {"White": "white", "Grey": "grey", "Dark": "dark", "Fringes": "pattern"}
_NAMES = {light: name for name, light in LIGHTS.items()}
_THIRD_OF_A_STOP = 2 ** (1 / 3)
# an exposure that is being dragged is not set back to what the camera reported a moment ago
_SETTLES_S = 1.5
_MARKS: dict[CheckVerdict, tuple[str, Tone]] = {
    "good": ("✓", "good"),
    "warning": ("!", "warning"),
    "bad": ("✕", "error"),
    "unknown": ("?", "dim"),
}
_ROW = (
    "display:flex;gap:0.6em;padding:0.3em 0;border-top:1px solid"
    " var(--mantine-color-default-border)"
)


class RigPanel(StepPanel):
    """Panel of the step Rig."""

    key = "rig"
    _entered = 0.0

    def build(self) -> None:
        """Create the inputs of devices, exposure, light and check."""
        gui = self._gui
        RigChoice(self)
        self._picture = LiveImage(gui)
        RigCheck(self)
        self._histogram = Text(gui)
        self._exposure: Any = gui.add_slider(
            "Exposure, ms", 0.01, 4.0, 0.01, 1.0, hint="Of each frame; brighter, not saturated"
        )
        self.react(self._exposure.on_update, self._set_exposure)
        self.button_group("Brightness", ("Darker", "Brighter"), self._step_exposure)
        self._light = self.setting(
            self.dropdown("Projector", LIGHTS, "Shown between captures"), self._set_light
        )
        ExposureInputs(self)

    def draw(self) -> None:
        """Show the rig."""
        rig = self.snapshot.rig
        self._picture.is_large = self.is_ready
        self._draw_exposure(rig)
        self._exposure.disabled = self._light.handle.disabled = rig.state != "open"
        if rig.light in _NAMES:
            self._light.update(_NAMES[rig.light])
        if rig.state != "open":
            self._picture.hide()
            self._histogram.set("")

    def _draw_exposure(self, rig: RigView) -> None:
        """Set the slider to the rig's exposure, unless it was moved a moment ago."""
        if rig.exposure_ms is not None and time.monotonic() - self._entered > _SETTLES_S:
            while rig.exposure_ms > self._exposure.max:
                self._exposure.max *= 4
            if abs(self._exposure.value - rig.exposure_ms) > 0.005:
                self._exposure.value = round(rig.exposure_ms, 2)

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the live image and its histogram."""
        self._draw_exposure(self._operator.snapshot().rig)
        self._picture.draw(preview)
        self._histogram.set(histogram_chart(preview))

    def _set_exposure(self) -> None:
        """Request the exposure of the slider."""
        self._entered = time.monotonic()
        self._operator.set_exposure(float(self._exposure.value))

    def _step_exposure(self, direction: str) -> None:
        """Request an exposure a third of a stop higher ("Brighter") or lower."""
        now = self._operator.snapshot().rig.exposure_ms
        if now is not None:
            self._entered = 0.0
            self._operator.set_exposure(
                now * _THIRD_OF_A_STOP if direction == "Brighter" else now / _THIRD_OF_A_STOP
            )

    def _set_light(self, name: str) -> None:
        """Request the chosen light; where it is refused, show the current one again."""
        if not self._operator.set_light(LIGHTS[name]):
            self._light.handle.value = _NAMES.get(self._operator.snapshot().rig.light, "White")


class RigCheck(PanelPart):
    """The check of the rig: its results, their remedies, and the settings that it recommends."""

    def build(self) -> None:
        """Create the inputs and the list of results."""
        operator = self._operator
        self._results = Text(self._gui)
        self._check = self.button(
            "Check rig", operator.check_rig, "stethoscope", None, hint="Takes about 10 s"
        )
        self._recommended = self.button("Set exposure", self._set_exposure, "sun")
        self._linear = self.setting(
            self.checkbox("Linear light", "Corrects the grey levels by the table of the check"),
            operator.set_linear_light,
        )

    def draw(self) -> None:
        """Show the result of the last check."""
        result, rig = self.panel.snapshot.preflight, self.panel.snapshot.rig
        is_linear = self.panel.session.is_linear
        # a recording cannot be checked
        self._check.disabled = not rig.is_idle or rig.is_recorded
        self._linear.handle.visible = bool(result and result.levels) or is_linear
        self._linear.update(is_linear)
        better = result.exposure_ms if result else None
        self._recommended.visible = better is not None and (
            # a camera uses the nearest exposure that it has
            rig.exposure_ms is None or abs(better / rig.exposure_ms - 1) > 0.02
        )
        if better is not None:
            self._recommended.label = f"Set exposure {better:.3g} ms"
        self._results.set(checks_table(result) if result else "")

    def _set_exposure(self) -> None:
        """Request the exposure that the check recommends."""
        result = self._operator.snapshot().preflight
        if result is not None and result.exposure_ms is not None:
            self._operator.set_exposure(result.exposure_ms)


def checks_table(result: Preflight) -> Html:
    """List each check in its colour, with its remedy."""
    lines = []
    for check in result.checks:
        sign, tone = _MARKS[check.verdict]
        mark = coloured(sign, tone, bold=True)
        remedy = f"<div>{coloured(check.remedy, tone)}</div>" if check.remedy else ""
        link = "" if check.verdict == "good" else f" {help_link(f'check-{check.name}')}"
        lines.append(
            f'<div style="{_ROW}"><div style="width:1em;text-align:center">{mark}</div>'
            f'<div style="flex:1"><b>{to_html(check.name)}</b>&ensp;{to_html(check.observation)}'
            f"{link}{remedy}</div></div>"
        )
    return paragraph(Html("".join(lines)))
