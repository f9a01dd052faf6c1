"""The choice of the rig: by name, or from single devices, which can be saved under a name."""

import inspect
from collections.abc import Mapping
from typing import Any

from slviewer.devices.browser import PAGE_ROLES, PageRole
from slviewer.devices.drivers import Driver, available
from slviewer.devices.page_channel import PageState
from slviewer.errors import InputError
from slviewer.gui.panel import PanelPart, Setting
from slviewer.gui.widgets import Html, Text, Tone, alert, coloured, note, paragraph, to_html
from slviewer.pipeline.rig_choice import Choice, Preset, check_choice, presets
from slviewer.server.viser_internals import make_private
from slviewer.wizard.snapshot import RigView, SessionView, Snapshot

SIMULATED: dict[str, dict[str, Any]] = {
    "Simulated, half size": {"driver": "simulated", "scale": 0.5},
    "Simulated, full size": {"driver": "simulated", "scale": 1.0},
    "Simulated, quarter size": {"driver": "simulated", "scale": 0.25},
}
_CHOOSE, _CUSTOM, _REPLAY = "Choose …", "Custom …", "replay"
_FIRST = "opencv"
"""The most common driver: a webcam."""
_ADDRESSES = ("source", "serial")
"""Names of the drivers' options that choose one device among several."""


class RigChoice(PanelPart):
    """Inputs of the step Rig that choose the devices."""

    _presets: Mapping[str, Preset] = {}
    _session: SessionView | None = None
    _needed_pages: tuple[PageRole, ...] = ()

    def build(self) -> None:
        """Create the inputs."""
        gui, context, operator = self._gui, self._context, self._operator
        self._choice: Any = gui.add_dropdown("Rig", (_CHOOSE, *SIMULATED, _CUSTOM))
        self._chosen = Setting(context, self._choice, self._request_choice)
        self._status = Text(gui)
        self._retry = context.button("Try again", self._request_again, "refresh", None)
        with gui.add_folder("Devices", visible=False) as self._devices:
            self._cameras = _label_drivers([d for d in available() if d.camera])
            self._projectors = _label_drivers([d for d in available() if d.projector])
            self._camera = gui.add_dropdown("Camera", tuple(self._cameras))
            self._source = gui.add_text(
                "Camera ID", "", hint="Number of a webcam, file, address, or serial number"
            )
            make_private(self._source)  # it may hold a password
            self._projector = gui.add_dropdown("Projector", tuple(self._projectors))
            self._size = gui.add_text(
                "Resolution", "", hint="For example 1920x1080; empty: that of its screen"
            )
            self._missing = Text(gui)
            self._use = context.button(
                "Use these devices",
                lambda: operator.choose_rig(self._read_entered()),
                "plug-connected",
                None,
            )
        self._pages = {role: Text(gui) for role in PAGE_ROLES}
        with gui.add_folder("Recording", visible=False) as self._recording:
            source = gui.add_text(
                "Source folder", "", hint="A session, or folders of images that can be imported"
            )
            context.button(
                "Play back",
                lambda: operator.choose_rig({"driver": _REPLAY, "source": source.value}),
                "player-play",
                None,
            )
        with gui.add_folder("Save this rig", expand_by_default=False) as self._saving:
            name = gui.add_text(
                "Name", "", hint="The rig is then offered by this name, with its exposure"
            )
            context.button("Save", lambda: operator.save_rig(name.value), "device-floppy")
        context.on_change(self._draw_devices, self._camera, self._projector)
        self._draw_devices()
        self._offer_rigs()

    def draw(self, snapshot: Snapshot) -> None:
        """Show the rig in use, and offer the others."""
        if snapshot.session is not self._session:  # its own rigs may have changed
            self._session = snapshot.session
            self._offer_rigs()
        rig = snapshot.rig
        self._chosen.update(self._match_option(rig))
        preset = self._presets.get(self._choice.value)
        about = "" if preset is None else note(preset.problem or preset.what)
        self._status.set(about + _rig_html(rig))
        self._retry.visible = rig.state == "lost"
        self._needed_pages = rig.pages
        self._draw_folders()
        self._saving.visible = rig.state == "open" and not rig.simulated

    def _offer_rigs(self) -> None:
        """Update the options from the rig presets; a choice that is no longer offered is reset."""
        self._presets = {
            p.name: p
            for p in presets(self._operator.session)
            if p.choice.get("driver") != "simulated"
        }
        options = (_CHOOSE, *SIMULATED, *self._presets, _CUSTOM)
        if tuple(self._choice.options) != options:
            value = self._choice.value
            self._choice.options = options
            self._choice.value = value if value in options else _CHOOSE

    def _match_option(self, rig: RigView) -> str:
        """Return the option that gave this rig."""
        if rig.choice is None:
            return _CHOOSE
        if rig.choice.get("driver") == "simulated":
            scale = rig.choice.get("scale", 1.0)
            return next((name for name, r in SIMULATED.items() if r["scale"] == scale), _CHOOSE)
        if rig.choice.get("driver") == _REPLAY:
            return _REPLAY
        for name, preset in self._presets.items():
            # apart from the delay, which is measured later
            if {**preset.choice, "settle_ms": None} == {**rig.choice, "settle_ms": None}:
                return name
        return _CUSTOM

    def _request_choice(self, chosen: str) -> None:
        """Request the chosen rig; where it is refused, show the one in use again."""
        self._draw_folders()
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
            self._draw_folders()

    def _request_again(self) -> None:
        """Request the current rig again."""
        choice = self._operator.snapshot().rig.choice
        if choice is not None:
            self._operator.choose_rig(choice)

    def _draw_folders(self) -> None:
        """Show the inputs for custom devices or a recording, as chosen, and the states of the pages
        that the rig needs, or the devices that are being chosen."""
        self._devices.visible = self._choice.value == _CUSTOM
        self._recording.visible = self._choice.value == _REPLAY
        for role, text in self._pages.items():
            is_chosen = self._choice.value == _CUSTOM and self._drivers[role].page
            needed = is_chosen or role in self._needed_pages
            text.set(_page_html(role, self._context.page_state(role)) if needed else "")

    def _draw_devices(self) -> None:
        """Show what the chosen drivers lack, and whether the camera needs an identifier."""
        self._drivers: dict[PageRole, Driver] = {
            "camera": self._cameras[self._camera.value],
            "projector": self._projectors[self._projector.value],
        }
        missing = "; ".join(
            f"{d.name} cannot be used here, {d.missing}"
            for d in self._drivers.values()
            if d.missing
        )
        self._missing.write(missing, "warning")
        self._use.disabled = bool(missing)
        self._source.visible = _address_option(self._drivers["camera"]) is not None
        self._draw_folders()

    def _read_entered(self) -> Choice:
        """Return the rig of the entered devices. Raises InputError for an invalid one."""
        choices: dict[str, dict[str, Any]] = {}
        for role, driver in self._drivers.items():
            choices[role] = {"driver": driver.name}
            page = self._context.page_state(role) if driver.page else None
            if page is not None and page.size is not None:
                # saved, since the page may be opened after the session
                choices[role]["size"] = list(page.size)
        camera, projector = self._drivers["camera"], self._drivers["projector"]
        option, address = _address_option(camera), self._source.value.strip()
        if option is not None and address:
            is_number = address.isdecimal() and option == "source"
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
        raise InputError(f"{text!r} is not a size: write width x height in px, such as 1920x1080")
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
        for what, size in (("camera", rig.camera), ("projector", rig.projector))
        if size is not None
    ]
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
