"""Which camera and which projector: a rig by name, or devices put together here, and kept under a name."""

import inspect
from typing import Any

import viser

from slviewer.devices.drivers import Driver, available
from slviewer.errors import InputError
from slviewer.gui.inputs import Follows, change
from slviewer.gui.panel import Stage
from slviewer.gui.widgets import Html, Tone, Words, block, boxed, cell, toned
from slviewer.pipeline.rig_choice import Choice
from slviewer.pipeline.rig_presets import Preset, check_choice, presets
from slviewer.wizard.snapshot import RigView, SessionView, Snapshot

SIMULATED: dict[str, dict[str, Any]] = {
    "Simulated, half resolution": {"driver": "simulated", "scale": 0.5},
    "Simulated, full resolution": {"driver": "simulated", "scale": 1.0},
    "Simulated, quarter resolution": {"driver": "simulated", "scale": 0.25},
}
_CHOOSE, _OWN, _REPLAY = "Choose …", "A camera and a projector …", "replay"
_FIRST = "opencv"
"""What most have: a webcam."""
_WHICH = ("source", "serial")
"""What drivers call the one device among several, or where it is."""


class RigChoice:
    """The part of the step Rig that says which devices are used."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._presets: dict[str, Preset] = {}
        self._session: SessionView | None = None
        gui = stage.gui
        self._choice: Any = gui.add_dropdown("Rig", (_CHOOSE, *SIMULATED, _OWN))
        self._follows = Follows(self._choice)
        self._choice.on_update(stage.safely_with(self._choose))
        self._says = Words(gui)
        self._again = gui.add_button("Try this rig again", icon=viser.Icon.REFRESH, visible=False)
        self._again.on_click(stage.safely(self._try_again))
        with gui.add_folder("Devices", visible=False) as self._devices:
            self._cameras = _by_words([d for d in available() if d.camera])
            self._projectors = _by_words([d for d in available() if d.projector])
            self._camera = gui.add_dropdown("Camera", tuple(self._cameras))
            self._camera.on_update(stage.safely(self._draw_devices))
            self._source = gui.add_text("Which", "", hint="A webcam's number, a file, an address, a serial number")
            self._projector = gui.add_dropdown("Projector", tuple(self._projectors))
            self._projector.on_update(stage.safely(self._draw_devices))
            self._size = gui.add_text("Its pixels", "", hint="Such as 1920x1080; empty: as its screen has")
            self._lacking = Words(gui)
            self._use = gui.add_button("Use these devices", icon=viser.Icon.PLUG_CONNECTED)
            self._use.on_click(stage.safely(lambda: stage.operator.choose_rig(self._entered())))
        self._page = Words(gui)
        with gui.add_folder("Recording", visible=False) as self._recording:
            self._folder = gui.add_text("Folder", "", hint="A session, or folders of images that can be imported")
            play = gui.add_button("Play it back", icon=viser.Icon.PLAYER_PLAY)
            play.on_click(
                stage.safely(lambda: stage.operator.choose_rig({"driver": "replay", "source": self._folder.value}))
            )
        with gui.add_folder("Keep this rig", visible=False, expand_by_default=False) as self._keeping:
            self._name = gui.add_text("Name", "", hint="It is then offered by this name, with its exposure")
            keep = gui.add_button("Keep", icon=viser.Icon.DEVICE_FLOPPY, color="gray")
            keep.on_click(stage.safely(lambda: stage.operator.save_rig(self._name.value)))
        self._needs_page = False
        self._draw_devices()
        self._offer()

    def draw(self, snapshot: Snapshot) -> None:
        """What is used now, and what else is offered."""
        if snapshot.session is not self._session:  # its own rigs may have changed
            self._session = snapshot.session
            self._offer()
        rig = snapshot.rig
        self._follows.tell(self._chosen(rig))
        preset = self._presets.get(self._choice.value)
        what = "" if preset is None else block(toned(preset.problem or preset.what, "dim"))
        self._says.set(what + _described(rig))
        change(self._again, visible=rig.state == "lost")
        self._draw_folders()
        change(self._keeping, visible=rig.state == "open" and not rig.simulated)
        self._needs_page = rig.page
        self._draw_page()

    def _offer(self) -> None:
        session = self._stage.operator.session
        self._presets = {p.name: p for p in presets(session) if p.choice.get("driver") != "simulated"}
        options = (_CHOOSE, *SIMULATED, *self._presets, _OWN)
        if tuple(self._choice.options) != options:
            value = self._choice.value
            self._choice.options = options
            self._choice.value = value if value in options else _CHOOSE

    def _chosen(self, rig: RigView) -> str:
        """What gave this rig."""
        if rig.choice is None:
            return _CHOOSE
        if rig.choice.get("driver") == "simulated":
            scale = rig.choice.get("scale", 1.0)
            return next((words for words, how in SIMULATED.items() if how["scale"] == scale), _CHOOSE)
        if rig.choice.get("driver") == _REPLAY:
            return _REPLAY
        return next((name for name, p in self._presets.items() if _same(p.choice, rig.choice)), _OWN)

    def _choose(self, event: Any) -> None:
        if event.client is None:
            return
        chosen = self._choice.value
        self._draw_folders()
        operator, preset = self._stage.operator, self._presets.get(chosen)
        if chosen in SIMULATED:
            granted = operator.choose_rig(SIMULATED[chosen])
        elif preset is None or chosen == _REPLAY:
            return
        elif preset.problem:
            granted = False
            operator.tell("error", f"{chosen} cannot be used here: {preset.problem}")
        else:
            granted = operator.choose_rig(preset.choice)
        if not granted:  # so that it says what is used, and the other can be chosen again
            self._choice.value = self._chosen(operator.snapshot().rig)
            self._draw_folders()

    def _try_again(self) -> None:
        choice = self._stage.operator.snapshot().rig.choice
        if choice is not None:
            self._stage.operator.choose_rig(choice)

    def _draw_folders(self) -> None:
        change(self._devices, visible=self._choice.value == _OWN)
        change(self._recording, visible=self._choice.value == _REPLAY)
        self._draw_page()

    def _draw_page(self) -> None:
        own = self._choice.value == _OWN and self._projectors[self._projector.value].channel
        self._page.set(_page_words(self._stage.projector_page()) if self._needs_page or own else "")

    # devices of one's own

    def _draw_devices(self) -> None:
        chosen = (self._cameras[self._camera.value], self._projectors[self._projector.value])
        lacking = "; ".join(f"{d.name} cannot be used here, {d.missing}" for d in chosen if d.missing)
        self._lacking.say(lacking, "warning")
        change(self._use, disabled=bool(lacking))
        change(self._source, visible=_which(chosen[0]) is not None)
        self._draw_page()

    def _entered(self) -> Choice:
        camera, projector = self._cameras[self._camera.value], self._projectors[self._projector.value]
        eye: dict[str, Any] = {"driver": camera.name}
        which, where = _which(camera), self._source.value.strip()
        if which is not None and where:
            eye[which] = int(where) if where.isdecimal() and which == "source" else where
        lamp: dict[str, Any] = {"driver": projector.name}
        page = self._stage.projector_page() if projector.channel else None
        if self._size.value.strip():
            lamp["size"] = _size(self._size.value)
        elif page is not None and page.size is not None:  # written down: the page may be opened after the session
            lamp["size"] = list(page.size)
        choice = {"name": f"{camera.name} and {projector.name}", "camera": eye, "projector": lamp}
        check_choice(choice, "this rig")
        return choice


def _by_words(drivers: list[Driver]) -> dict[str, Driver]:
    likely = sorted(drivers, key=lambda driver: driver.name != _FIRST)
    return {f"{driver.name}: {driver.what}": driver for driver in likely}


def _which(driver: Driver) -> str | None:
    """The option by which this driver is told which device it is."""
    known = inspect.signature(driver.camera).parameters if driver.camera else {}
    return next((name for name in _WHICH if name in known), None)


def _size(text: str) -> list[int]:
    sides = text.lower().replace("×", "x").split("x")
    if len(sides) != 2 or not all(side.strip().isdecimal() for side in sides):
        raise InputError(f"{text!r} is no size: write width x height in px, such as 1920x1080")
    return [int(side) for side in sides]


def _same(preset: Choice, choice: Choice) -> bool:
    """Whether a rig was chosen by this preset; what is measured of it later does not count."""
    return {**preset, "settle_ms": None} == {**choice, "settle_ms": None}


def _described(rig: RigView) -> str:
    if rig.state == "none":
        return boxed("No rig yet: the simulated one needs nothing but this program.", "info")
    if rig.state == "lost":
        return boxed(rig.fault or "The rig does not answer.", "error")
    if rig.state == "opening":
        return block(toned("Opening …", "dim"))
    sizes = [
        f"{what} {size[0]} × {size[1]} px"
        for what, size in (("camera", rig.camera), ("projector", rig.projector))
        if size is not None
    ]
    said = block(Html(f"{toned('●', 'good')} {cell(rig.name)} · {cell(', '.join(sizes))}"))
    return said + "".join(boxed(note, "warning") for note in rig.notes)


def _page_words(standing: Any) -> str:
    """Where the projector page stands, and how to open it; without the token, which is not for those who only watch."""
    if standing is None:
        return boxed("This rig needs the projector page, which is not served here.", "error")
    link = '<a href="/projector" target="_blank" rel="noopener">Open the projector page</a>'
    how = f"{link} and move its window onto the projector's screen; on another computer, open the link in the terminal."
    tone: Tone = {"waiting": "info", "refused": "warning", "ready": "good"}[standing.state]  # type: ignore[assignment]
    return boxed(Html(f"Projector page: {cell(standing.words)}" + ("" if tone == "good" else f"<br>{how}")), tone)
