"""What a client's message may change: only what the page offers to that client at this moment."""

import asyncio
import logging
import math
from typing import Any

import viser
from viser import _messages as messages

from slviewer.server import viser_internals as inside
from slviewer.server.access import Role
from slviewer.server.connection import Connection
from slviewer.server.uploads import UploadBudget, Uploads
from slviewer.server.values import ValueRefused, check_value

logger = logging.getLogger("slviewer.server")

VIEWER_LIMIT = 4096
"""Bytes of a message from someone who only watches: more than the longest that says where they look from."""


class ViserGate:
    """Stands between one client's connection and viser, and lets pass what that client may send.

    A refused message is dropped: it may be no attack at all, but a click on a button that was disabled a moment ago.
    """

    def __init__(self, server: viser.ViserServer, connection: Connection, role: Role, budget: UploadBudget) -> None:
        self._server = server
        self._connection = connection
        self._role = role
        self._client: int | None = None
        self._uploads = Uploads(budget, self._forget)

    def __call__(self, raw: Any) -> bytes | None:
        if self._client is None:
            self._client = inside.client_of(self._server, self._connection)
        usable = isinstance(raw, bytes) and (self._role == "operator" or len(raw) < VIEWER_LIMIT)
        message = inside.decode(raw) if usable else None
        if message is None or self._client is None:
            logger.debug("client %s: dropped a message that is none", self._client)
            return None
        try:
            return self._passed(message, raw)
        except ValueRefused as refused:
            logger.debug("client %s: dropped %s: %s", self._client, type(message).__name__, refused)
            self._answer(message, refused)
        except Exception:  # what the check stumbles over, viser would too
            logger.exception("client %s: dropped %s", self._client, type(message).__name__)
        return None

    def close(self) -> None:
        """The connection has ended."""
        self._uploads.close()

    def _passed(self, message: Any, raw: bytes) -> bytes:
        """The bytes that viser gets to see for this message; Refused where it may not."""
        server, client = self._server, self._client
        assert client is not None
        # besides where they look from, those who watch may say that they have drawn something, when they are asked
        watching = messages.ViewerCameraMessage | messages.LocalStorageGetItemResponseMessage
        if self._role != "operator" and not isinstance(message, watching):
            raise ValueRefused("this link only watches", correct=True)
        if not _finite(vars(message)):
            raise ValueRefused("numbers that are none")
        match message:
            case messages.ViewerCameraMessage():
                _camera(message)
            case messages.GuiUpdateMessage():
                if message.updates.keys() != {"value"}:
                    raise ValueRefused("only an input's value can be set")
                check_value(self._enabled(message.uuid), message.updates["value"])
            case messages.GuiButtonHoldMessage():
                _require(inside.holds(self._enabled(message.uuid), message.frequency))
            case messages.GuiFormSubmitMessage() | messages.GuiFormDirtyMessage():
                _require(inside.gui_form(server, client, message.uuid) is not None)
            case messages.CommandTriggerMessage():
                _require(inside.command(server, client, message.uuid) is not None)
            case messages.FileTransferStartUpload():
                button = self._enabled(message.source_component_uuid)
                _require(isinstance(button, viser.GuiUploadButtonHandle))
                return inside.encode(self._uploads.start(message))
            case messages.FileTransferPart():
                self._uploads.part(message)
            case messages.ScenePointerMessage():
                _require(inside.pointer_listens(server, client, message.event_type))
                click = message.event_type == "click"
                _require(len(message.screen_pos) == (1 if click else 2))
                _require(not click or None not in (message.ray_origin, message.ray_direction))
            case messages.GetRenderResponseMessage() | messages.LocalStorageGetItemResponseMessage():
                _require(inside.awaited(server, client, type(message)))
            case _:
                self._scene(message, client)
        return raw

    def _scene(self, message: Any, client: int) -> None:
        scene = inside.scene_api(self._server, client, message.owner)
        _require(scene is not None)
        match message:
            case messages.TransformControlsUpdateMessage():
                _require(inside.gizmo(scene, client, message.name) and math.hypot(*message.wxyz) > 1e-6)
            case messages.TransformControlsDragStartMessage() | messages.TransformControlsDragEndMessage():
                _require(inside.gizmo(scene, client, message.name))
            case messages.SceneNodeClickMessage():
                _require(inside.node_clicks(scene, message.name))
            case messages.SceneNodeDragMessage():
                _require(inside.node_drags(scene, client, message.name))
            case _:
                raise ValueRefused("no message of clients")

    def _enabled(self, uuid: str) -> Any:
        assert self._client is not None
        handle = inside.gui_input(self._server, self._client, uuid)
        if handle is None:
            raise ValueRefused("nothing to be seen there")
        if getattr(handle, "disabled", False):
            raise ValueRefused("disabled", correct=True)
        return handle

    def _answer(self, message: Any, refused: ValueRefused) -> None:
        assert self._client is not None
        if isinstance(message, messages.FileTransferStartUpload):
            inside.refuse_upload(
                self._server, self._client, message.source_component_uuid, message.transfer_uuid, message.size_bytes
            )
            inside.notify(self._server, self._client, "Not uploaded", f"The file was refused: {refused}.")
        elif isinstance(message, messages.GuiUpdateMessage) and refused.correct:
            handle = inside.gui_input(self._server, self._client, message.uuid)
            if handle is not None:
                inside.send_value(self._server, self._client, handle)

    def _forget(self, transfer: str) -> None:
        # viser handles what passed in tasks of its own, in their order: after those that are waiting.
        asyncio.get_running_loop().call_soon(inside.forget_upload, self._server, self._client, transfer)


def _require(condition: bool) -> None:
    if not condition:
        raise ValueRefused("nothing listens to that")


def _camera(message: messages.ViewerCameraMessage) -> None:
    usable = 0 < message.image_height < 2**15 and 0 < message.image_width < 2**15 and math.hypot(*message.wxyz) > 1e-6
    if not usable:
        raise ValueRefused("no camera")


def _finite(value: Any) -> bool:
    """Whether no number in this message is NaN or infinite."""
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, dict):
        return all(map(_finite, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_finite, value))
    return True
