"""The choice of the rig: by name, or from single devices, which can be saved under a name."""

import inspect
from typing import Any

import viser

from slviewer.devices.browser import PAGE_ROLES, PageRole
from slviewer.devices.drivers import Driver, available
from slviewer.devices.page_channel import PageState
from slviewer.errors import InputError
from slviewer.gui.inputs import SessionValue, change
from slviewer.gui.panel import PanelContext
from slviewer.gui.widgets import Html, Text, Tone, alert, coloured, paragraph, to_html
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


class RigChoice:
    """Inputs of the step Rig that choose the devices."""

    def __init__(self, context: PanelContext) -> None:
        self._context = context
        self._presets: dict[str, Preset] = {}
        self._session: SessionView | None = None
        gui = context.gui
        self._choice: Any = gui.add_dropdown("Rig", (_CHOOSE, *SIMULATED, _CUSTOM))
        self._chosen_value = SessionValue(self._choice)
        self._choice.on_update(context.callback(self._request_choice, by_user=True))
        self._status = Text(gui)
        self._retry = context.button(
            "Try again", self._request_again, viser.Icon.REFRESH, None, visible=False
        )
        with gui.add_folder("Devices", visible=False) as self._devices:
            self._cameras = _label_drivers([d for d in available() if d.camera])
            self._projectors = _label_drivers([d for d in available() if d.projector])
            self._camera = gui.add_dropdown("Camera", tuple(self._cameras))
            self._camera.on_update(context.callback(self._draw_devices))
            self._source = gui.add_text(
                "Camera ID", "", hint="Number of a webcam, file, address, or serial number"
            )
            make_private(self._source)  # it may hold a password
            self._projector = gui.add_dropdown("Projector", tuple(self._projectors))
            self._projector.on_update(context.callback(self._draw_devices))
            self._size = gui.add_text(
                "Resolution", "", hint="For example 1920x1080; empty: that of its screen"
            )
            self._missing = Text(gui)
            self._use = context.button(
                "Use these devices",
                lambda: context.operator.choose_rig(self._read_entered()),
                viser.Icon.PLUG_CONNECTED,
                None,
            )
        self._pages = {role: Text(gui) for role in PAGE_ROLES}
        with gui.add_folder("Recording", visible=False) as self._recording:
            self._folder = gui.add_text(
                "Source folder", "", hint="A session, or folders of images that can be imported"
            )
            context.button(
                "Play back",
                lambda: context.operator.choose_rig(
                    {"driver": "replay", "source": self._folder.value}
                ),
                viser.Icon.PLAYER_PLAY,
                None,
            )
        with gui.add_folder(
            "Save this rig", visible=False, expand_by_default=False
        ) as self._saving:
            self._name = gui.add_text(
                "Name", "", hint="The rig is then offered by this name, with its exposure"
            )
            context.button(
                "Save",
                lambda: context.operator.save_rig(self._name.value),
                viser.Icon.DEVICE_FLOPPY,
            )
        self._needed_pages: tuple[PageRole, ...] = ()
        self._draw_devices()
        self._offer_rigs()

    def draw(self, snapshot: Snapshot) -> None:
        """Show the rig in use, and offer the others."""
        if snapshot.session is not self._session:  # its own rigs may have changed
            self._session = snapshot.session
            self._offer_rigs()
        rig = snapshot.rig
        self._chosen_value.update(self._match_option(rig))
        preset = self._presets.get(self._choice.value)
        about = "" if preset is None else paragraph(coloured(preset.problem or preset.what, "dim"))
        self._status.set(about + _rig_html(rig))
        change(self._retry, visible=rig.state == "lost")
        self._draw_folders()
        change(self._saving, visible=rig.state == "open" and not rig.simulated)
        self._needed_pages = rig.pages
        self._draw_pages()

    def _offer_rigs(self) -> None:
        """Update the options from the rig presets; a choice that is no longer offered is reset."""
        session = self._context.operator.session
        self._presets = {
            p.name: p for p in presets(session) if p.choice.get("driver") != "simulated"
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
            return next(
                (label for label, rig in SIMULATED.items() if rig["scale"] == scale), _CHOOSE
            )
        if rig.choice.get("driver") == _REPLAY:
            return _REPLAY
        return next(
            (name for name, p in self._presets.items() if _is_same_rig(p.choice, rig.choice)),
            _CUSTOM,
        )

    def _request_choice(self) -> None:
        """Request the chosen rig; where it is refused, show the one in use again."""
        chosen = self._choice.value
        self._draw_folders()
        operator, preset = self._context.operator, self._presets.get(chosen)
        if chosen in SIMULATED:
            granted = operator.choose_rig(SIMULATED[chosen])
        elif preset is None or chosen == _REPLAY:
            return
        elif preset.problem:
            granted = False
            operator.notify("error", f"{chosen} cannot be used here: {preset.problem}")
        else:
            granted = operator.choose_rig(preset.choice)
        if not granted:  # show what is in use; the other can be chosen again
            self._choice.value = self._match_option(operator.snapshot().rig)
            self._draw_folders()

    def _request_again(self) -> None:
        """Request the current rig again."""
        choice = self._context.operator.snapshot().rig.choice
        if choice is not None:
            self._context.operator.choose_rig(choice)

    def _draw_folders(self) -> None:
        """Show the inputs for custom devices or a recording, as chosen."""
        change(self._devices, visible=self._choice.value == _CUSTOM)
        change(self._recording, visible=self._choice.value == _REPLAY)
        self._draw_pages()

    def _draw_pages(self) -> None:
        """Show the states of the pages that the rig needs, or the devices that are being chosen."""
        own = {
            "camera": self._cameras[self._camera.value],
            "projector": self._projectors[self._projector.value],
        }
        for role, text in self._pages.items():
            is_chosen = self._choice.value == _CUSTOM and own[role].page
            needed = is_chosen or role in self._needed_pages
            text.set(_page_html(role, self._context.page_state(role)) if needed else "")

    def _draw_devices(self) -> None:
        """Show what the chosen drivers lack, and whether the camera needs an identifier."""
        chosen = (self._cameras[self._camera.value], self._projectors[self._projector.value])
        missing = "; ".join(
            f"{d.name} cannot be used here, {d.missing}" for d in chosen if d.missing
        )
        self._missing.write(missing, "warning")
        change(self._use, disabled=bool(missing))
        change(self._source, visible=_address_option(chosen[0]) is not None)
        self._draw_pages()

    def _read_entered(self) -> Choice:
        """Return the rig of the entered devices. Raises InputError for an invalid one."""
        camera, projector = (
            self._cameras[self._camera.value],
            self._projectors[self._projector.value],
        )
        camera_choice: dict[str, Any] = {"driver": camera.name}
        option, address = _address_option(camera), self._source.value.strip()
        if option is not None and address:
            camera_choice[option] = (
                int(address) if address.isdecimal() and option == "source" else address
            )
        video = self._context.page_state("camera") if camera.page else None
        if video is not None and video.size is not None:  # saved, as the projector's
            camera_choice["size"] = list(video.size)
        projector_choice: dict[str, Any] = {"driver": projector.name}
        page = self._context.page_state("projector") if projector.page else None
        if self._size.value.strip():
            projector_choice["size"] = _size(self._size.value)
        elif page is not None and page.size is not None:
            # saved, since the page may be opened after the session
            projector_choice["size"] = list(page.size)
        choice = {
            "name": f"{camera.name} and {projector.name}",
            "camera": camera_choice,
            "projector": projector_choice,
        }
        check_choice(choice, "this rig")
        return choice


def _label_drivers(drivers: list[Driver]) -> dict[str, Driver]:
    """Return {label: driver}, the most common driver first."""
    shape_of = sorted(drivers, key=lambda driver: driver.name != _FIRST)
    return {f"{driver.name}: {driver.what}": driver for driver in shape_of}


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


def _is_same_rig(preset: Choice, choice: Choice) -> bool:
    """Whether a rig was chosen by this preset, apart from the delay, which is measured later."""
    return {**preset, "settle_ms": None} == {**choice, "settle_ms": None}


def _rig_html(rig: RigView) -> str:
    """Describe the state of the rig."""
    if rig.state == "none":
        return alert("No rig yet. The simulated rig needs no devices.", "info")
    if rig.state == "lost":
        return alert(rig.fault or "The rig does not answer.", "error")
    if rig.state == "opening":
        return paragraph(coloured("Opening …", "dim"))
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
