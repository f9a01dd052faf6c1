"""Which messages of clients pass: those that the page offers to that client at this moment, with
valid values; and uploads within the size allowed, under a harmless name, in no parts but those
announced."""

import asyncio
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import viser
from viser import _messages as messages

from slviewer.server import viser_internals as inside
from slviewer.server.access import MessageRefused, Role
from slviewer.server.connection import Connection
from slviewer.server.text import safe_file_name

logger = logging.getLogger("slviewer.server")

SMALLEST_PART = 4096
"""Bytes; viser's page sends half a megabyte at a time. Smaller parts would cost more memory than
they carry."""


@dataclass
class UploadBudget:
    """How many bytes of unfinished uploads the server holds for all clients together (viser keeps
    them in memory), and the ``names`` of the transfers under way: viser keeps them in one place for
    all clients."""

    limit: int
    used: int = 0
    names: set[str] = field(default_factory=set)


@dataclass
class _Transfer:
    """An announced upload: its input, its size in bytes, its number of parts, and what has been
    received."""

    source: str
    size: int
    parts: int
    received: int = 0
    received_parts: set[int] = field(default_factory=set)


class Uploads:
    """The unfinished uploads of one client."""

    def __init__(self, budget: UploadBudget, forget: Callable[[str], None]) -> None:
        self._budget = budget
        self._forget = forget
        self._transfers: dict[str, _Transfer] = {}

    def start(self, message: Any) -> Any:
        """The announcement (a FileTransferStartUpload) with a safe file name; Refused where it is
        too large."""
        size, parts = message.size_bytes, message.part_count
        if size < 0 or not (parts == 0 if size == 0 else 1 <= parts <= size // SMALLEST_PART + 1):
            raise MessageRefused("an upload whose parts cannot make up its size")
        if size > self._budget.limit - self._budget.used:
            raise MessageRefused(
                f"an upload of {size / 1e6:.0f} MB where {self._budget.limit / 1e6:.0f} MB are"
                " allowed"
            )
        if message.transfer_uuid in self._budget.names:
            raise MessageRefused("an upload that is under way")
        if size:  # an empty file is complete with its announcement
            self._budget.used += size
            self._budget.names.add(message.transfer_uuid)
            self._transfers[message.transfer_uuid] = _Transfer(
                message.source_component_uuid, size, parts
            )
        return replace(message, filename=safe_file_name(message.filename))

    def part(self, message: Any) -> None:
        """Count one part (a FileTransferPart) in; Refused, and the upload forgotten, where it was
        not announced."""
        transfer = self._transfers.get(message.transfer_uuid)
        if transfer is None:
            raise MessageRefused("a part of no upload")
        transfer.received += len(message.content)
        fits = (
            message.source_component_uuid == transfer.source
            and 0 <= message.part_index < transfer.parts
            and message.part_index not in transfer.received_parts
            and transfer.received <= transfer.size
        )
        transfer.received_parts.add(message.part_index)
        complete = len(transfer.received_parts) == transfer.parts
        if not fits or (complete and transfer.received != transfer.size):
            self._end_upload(message.transfer_uuid)
            self._forget(message.transfer_uuid)
            raise MessageRefused("a part that was not announced")
        if complete:
            self._end_upload(message.transfer_uuid)

    def close(self) -> None:
        """End all uploads of a disconnected client."""
        for transfer in list(self._transfers):
            self._end_upload(transfer)
            self._forget(transfer)

    def _end_upload(self, transfer: str) -> None:
        """Remove an upload and return its bytes to the budget."""
        self._budget.used -= self._transfers.pop(transfer).size
        self._budget.names.discard(transfer)


VIEWER_LIMIT = 4096
"""Bytes of a message from someone who only watches: more than the longest that says where they look
from."""
MESSAGES: dict[Role, frozenset[type]] = {
    "operate": frozenset(inside.FROM_CLIENTS.values()),
    # viewpoint, and confirmation that something was drawn where that is requested
    "watch": frozenset({messages.ViewerCameraMessage, messages.LocalStorageGetItemResponseMessage}),
    "project": frozenset(),
    "camera": frozenset(),
}
"""The messages of viser that each role may send; all others, and those of later versions, are
refused."""
OUTLINE_LIMIT = 4096
"""Places of a shape that is drawn into the 3D view: twice as many as our script sends."""
TEXT_LIMIT = 20_000
"""Characters; no input of the wizard needs a tenth of it."""


class ViserGate:
    """Filters the messages of one client, and passes on to viser those that this client may send.

    A refused message is dropped: it may be no attack at all, but a click on a button that was
    disabled a moment ago.
    """

    def __init__(
        self, server: viser.ViserServer, connection: Connection, role: Role, budget: UploadBudget
    ) -> None:
        self._server = server
        self._connection = connection
        self._role = role
        self._client: inside.ViserClient | None = None
        self._uploads = Uploads(budget, self._forget_upload)

    def __call__(self, raw: Any) -> bytes | None:
        """Return the bytes of a client's message to pass on to viser; None where it is refused and
        dropped."""
        if self._client is None:
            self._client = inside.ViserClient.of(self._server, self._connection)
        usable = isinstance(raw, bytes) and (self._role == "operate" or len(raw) < VIEWER_LIMIT)
        message = inside.decode_message(raw) if usable else None
        if message is None or self._client is None:
            logger.debug("client %s: dropped a message that is none", self._client)
            return None
        try:
            return self._check_message(message, raw)
        except MessageRefused as refused:
            logger.debug("client %s: dropped %s: %s", self._client, type(message).__name__, refused)
            self._send_refusal(message, refused)
        except Exception:  # what the check stumbles over, viser would too
            logger.exception("client %s: dropped %s", self._client, type(message).__name__)
        return None

    def close(self) -> None:
        """Discard the uploads of the connection, which has ended."""
        self._uploads.close()

    def _check_message(self, message: Any, raw: bytes) -> bytes:
        """Return the bytes to pass on to viser for this message; raises MessageRefused if it is not
        allowed."""
        client = self._client
        assert client
        _check(type(message) in MESSAGES[self._role], "not for this link", correct=True)
        _check(_is_finite(vars(message)), "numbers that are none")
        match message:
            case messages.ViewerCameraMessage():
                sides_px = message.image_height, message.image_width
                _check(all(0 < side_px < 2**15 for side_px in sides_px), "no camera")
                _check(math.hypot(*message.wxyz) > 1e-6, "no camera")
            case messages.GuiUpdateMessage():
                _check(message.updates.keys() == {"value"}, "only an input's value can be set")
                check_value(self._require_input(message.uuid), message.updates["value"])
            case messages.CommandTriggerMessage():
                _check(client.command(message.uuid) is not None)
            case messages.FileTransferStartUpload():
                button = self._require_input(message.source_component_uuid)
                _check(isinstance(button, viser.GuiUploadButtonHandle))
                return inside.pack_message(self._uploads.start(message))
            case messages.FileTransferPart():
                self._uploads.part(message)
            case messages.ScenePointerMessage():
                _check(client.listens_to_pointer(message.event_type))
                click = message.event_type == "click"
                corners = len(message.screen_pos)
                _check(corners == 1 if click else 2 <= corners <= OUTLINE_LIMIT)
                _check(not click or None not in (message.ray_origin, message.ray_direction))
            case messages.LocalStorageGetItemResponseMessage():
                _check(client.is_awaited(type(message)))
            case _:
                self._check_scene_message(message, client)
        return raw

    def _check_scene_message(self, message: Any, client: inside.ViserClient) -> None:
        """Raise MessageRefused unless a visible scene element listens to this message."""
        scene = client.scene_api(message.owner)
        _check(scene is not None)
        match message:
            case (
                messages.TransformControlsUpdateMessage()
                | messages.TransformControlsDragStartMessage()
                | messages.TransformControlsDragEndMessage()
            ):
                turn = getattr(message, "wxyz", (1.0,))  # not in those that begin and end a drag
                _check(client.listens_to_gizmo(scene, message.name) and math.hypot(*turn) > 1e-6)
            case messages.SceneNodeClickMessage():
                _check(inside.listens_to_clicks(scene, message.name))
            case _:
                raise MessageRefused("no message of clients")

    def _require_input(self, uuid: str) -> Any:
        """Return the visible, enabled input with this id; raises MessageRefused otherwise."""
        assert self._client
        handle = self._client.gui_input(uuid)
        _check(handle is not None, "nothing visible there")
        _check(not getattr(handle, "disabled", False), "disabled", correct=True)
        return handle

    def _send_refusal(self, message: Any, refused: MessageRefused) -> None:
        """Notify the client that its upload was refused, or send it the true value of an input."""
        assert self._client
        if isinstance(message, messages.FileTransferStartUpload):
            self._client.refuse_upload(
                message.source_component_uuid, message.transfer_uuid, message.size_bytes
            )
            self._client.show_error("Not uploaded", f"The file was refused: {refused}.")
        elif isinstance(message, messages.GuiUpdateMessage) and refused.correct:
            handle = self._client.gui_input(message.uuid)
            if handle is not None and not (inside.is_private(handle) and self._role != "operate"):
                self._client.send_value(handle)

    def _forget_upload(self, transfer: str) -> None:
        """Let viser discard what was received of an upload, after the messages that are already
        waiting."""
        # viser handles what passed in tasks of its own, in their order: after those that are
        # waiting.
        assert self._client
        asyncio.get_running_loop().call_soon(self._client.forget_upload, transfer)


def _is_finite(value: Any) -> bool:
    """Whether no number in this message is NaN or infinite."""
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, dict):
        value = list(value.values())
    return not isinstance(value, list | tuple) or all(map(_is_finite, value))


def check_value(handle: Any, value: Any) -> None:
    """Raise MessageRefused unless the input accepts this value, as it is in the message."""
    match handle:
        case viser.GuiButtonHandle():
            _check(value is True, "a button is pressed, nothing else")
        case viser.GuiCheckboxHandle():
            _check(isinstance(value, bool), "not yes or no")
        case viser.GuiDropdownHandle() | viser.GuiButtonGroupHandle():
            _check(
                isinstance(value, str) and value in handle.options, "not an option", correct=True
            )
        case viser.GuiTextHandle():
            _check(
                isinstance(value, str) and _is_plain_text(value, handle.multiline), "not plain text"
            )
        case viser.GuiNumberHandle() | viser.GuiSliderHandle():
            _check_number(value, handle.value, handle.min, handle.max)
        case viser.GuiVector3Handle():
            _check(
                isinstance(value, list | tuple) and len(value) == 3,
                "not three numbers",
                correct=True,
            )
            for i, number in enumerate(value):
                _check_number(
                    number,
                    handle.value[i],
                    handle.min and handle.min[i],
                    handle.max and handle.max[i],
                )
        case _:  # uploads have messages of their own, and the wizard has no other inputs
            raise MessageRefused("this input takes no value")


def _check(condition: bool, reason: str = "nothing listens to that", correct: bool = False) -> None:
    """Raise MessageRefused with ``reason`` unless the condition holds."""
    if not condition:
        raise MessageRefused(reason, correct)


def _check_number(value: Any, current: float, low: float | None, high: float | None) -> None:
    """Raise MessageRefused unless the value is a finite number of the input's type within its
    range."""
    _check(
        isinstance(value, int | float) and not isinstance(value, bool), "not a number", correct=True
    )
    _check(abs(value) < 2**53 and math.isfinite(value), "not a finite number", correct=True)
    # viser would cut the fraction off in silence.
    _check(isinstance(current, float) or value == int(value), "not a whole number", correct=True)
    _check((low is None or value >= low) and (high is None or value <= high), "outside its range")


def _is_plain_text(text: str, multiline: bool) -> bool:
    """Whether the text is short enough and free of control characters; line breaks only if
    ``multiline``."""
    allowed = "\n\r\t" if multiline else "\t"
    return len(text) <= TEXT_LIMIT and all(
        c.isprintable() or c in allowed or ord(c) > 159 for c in text
    )
