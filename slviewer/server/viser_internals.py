"""All uses of viser's private interface, written for exactly one version of it.

viser 1.1.1 has no hook for access, so its WebSocket server is created by ours, and its messages are
read on their way in. A test compares what is used here with what it was when this was written.
"""

import contextlib
import dataclasses
import json
import secrets
import threading
from collections.abc import Callable, Iterator
from functools import partial
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import msgspec
import rich
import viser
import websockets
from viser import _gui_handles, _messages, _scene_handles
from viser.infra import _infra

from slviewer.errors import SlviewerError

VISER = "1.1.1"
SUBPROTOCOL = f"viser-v{VISER}"
"""With which viser's page opens its WebSocket."""

VISER_SCRIPTS = (
    "'sha256-5iRcjB7VnwnYpbUpHa15FmjNIRu22hIQnvWuocHMxJw='",
    "'sha256-o/BTEGoB4UnTxqb+3RxwUFQZkWXpqUxouHkbDNrAkqE='",
)
"""The scripts that viser's page runs: the loader that stands in it, and the application that the
loader unpacks."""

Message = _messages.Message

CLIENT_PAGE = Path(viser.__file__).parent / "client" / "build" / "index.html"
PAGE_SCRIPT = b"\n".join(
    resources.files("slviewer.server").joinpath(name).read_bytes()
    for name in (
        "missing_features.js",
        "page_script.js",
        "control_script.js",
        "pointer_script.js",
        "image_lens.js",
        "view_bar.js",
        "point_readout.js",
    )
)
"""Our scripts, which run in viser's page before its own."""
PAGE_STYLE = resources.files("slviewer.server").joinpath("page_style.css").read_bytes()
"""Our style of viser's page."""

FROM_CLIENTS: dict[str, type[Any]] = {
    name: getattr(_messages, name)
    for name in (
        "ViewerCameraMessage",
        "GuiUpdateMessage",
        "CommandTriggerMessage",
        "FileTransferStartUpload",
        "FileTransferPart",
        "TransformControlsUpdateMessage",
        "TransformControlsDragStartMessage",
        "TransformControlsDragEndMessage",
        "SceneNodeClickMessage",
        "ScenePointerMessage",
        "LocalStorageGetItemResponseMessage",
    )
}
"""The messages that a client has reason to send; opening and closing a share tunnel is not among
them."""

_starting = threading.Lock()


class _Websockets:
    """Stands in for the websockets package inside viser while it starts, so that it serves with our
    function."""

    def __init__(self, serve: Callable[..., Any]) -> None:
        self.asyncio = SimpleNamespace(server=SimpleNamespace(serve=serve))

    def __getattr__(self, name: str) -> Any:
        return getattr(websockets, name)


def start(serve: Callable[..., Any], host: str, port: int) -> viser.ViserServer:
    """Start viser's server, listening through `serve` (called as websockets' own), without a share
    tunnel or output."""
    with _starting, _silence_prints():
        _infra.websockets = _Websockets(serve)  # type: ignore[assignment]
        try:
            server = viser.ViserServer(host=host, port=port, label="slviewer", verbose=False)
        finally:
            _infra.websockets = websockets
    for kind in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(kind)
    # A button that does nothing would be shown again by every later change of the theme.
    themed = partial(server.gui.configure_theme, show_logo=False, show_share_button=False)
    server.request_share_url, server.gui.configure_theme = _refuse_tunnel, themed  # type: ignore
    themed()
    return server


def check_version() -> None:
    """Raise SlviewerError where another version of viser is installed: its access control was not
    tested."""
    if viser.__version__ != VISER:
        raise SlviewerError(
            f"viser {viser.__version__} is installed, but this slviewer serves safely only with"
            f" viser {VISER}",
            f"install it with pip install viser=={VISER}.",
        )


def client_page() -> bytes:
    """The page that viser serves, with our style and script in it."""
    before, loader, after = CLIENT_PAGE.read_bytes().partition(b"<script data-p=")
    style = b"<style>" + PAGE_STYLE + b"</style>"
    return b"".join([before, style, b"<script>", PAGE_SCRIPT, b"</script>", loader, after])


def stop(server: viser.ViserServer) -> None:
    """Stop viser's server and its threads, without output."""
    with _silence_prints():
        server.stop()


def _refuse_tunnel(*_: Any, **__: Any) -> NoReturn:
    """Raise SlviewerError: replaces viser's request of a public share link."""
    raise SlviewerError(
        "slviewer opens no tunnel to the internet",
        "use --host, or ssh -L, to reach it from elsewhere.",
    )


@contextlib.contextmanager
def _silence_prints() -> Iterator[None]:
    """Suppress what viser prints: its own address, without the token, and its end, which only
    confuse the operator."""
    printing = rich.print
    rich.print = lambda *_, **__: None
    try:
        yield
    finally:
        rich.print = printing


def decode_message(raw: bytes) -> Message | None:
    """The message in these bytes with every field of its declared type; None if it is anything
    else."""
    try:
        fields = msgspec.msgpack.decode(raw)
        kind = FROM_CLIENTS[fields.pop("type")]
        known = {field.name for field in dataclasses.fields(kind)}
        # viser fails on unknown fields
        return msgspec.convert(fields, kind) if fields.keys() <= known else None
    except (msgspec.MsgspecError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None


def pack_message(message: Message) -> bytes:
    """The bytes in which a client sends this message."""
    return msgspec.msgpack.encode({"type": type(message).__name__, **vars(message)})


@dataclasses.dataclass(frozen=True)
class ViserClient:
    """The client with a ``number`` that viser's server gave it; it may have disconnected."""

    server: viser.ViserServer
    number: int

    def __str__(self) -> str:
        return str(self.number)

    @classmethod
    def of(cls, server: viser.ViserServer, connection: object) -> "ViserClient | None":
        """The client of this connection; None before and after."""
        live = server._websock_server._live_connections
        return next(
            (cls(server, number) for number, one in list(live.items()) if one is connection), None
        )

    @property
    def connection(self) -> Any:
        """The client's connection, or None."""
        return self.server._websock_server._live_connections.get(self.number)

    @property
    def _handle(self) -> viser.ClientHandle | None:
        """Viser's handle of the client; None where it is not connected."""
        return self.server._connected_clients.get(self.number)

    @property
    def _guis(self) -> list[viser.GuiApi]:
        """The GUI shared by all clients, and this client's own."""
        return [self.server.gui] if self._handle is None else [self.server.gui, self._handle.gui]

    def navigate(self, address: str) -> None:
        """Let the client's page give way to another address of this server."""
        self._queue_message(
            _messages.RunJavascriptMessage(f"location.replace({json.dumps(address)})")
        )

    def send_private_values(self) -> None:
        """Show the client the values of all private inputs."""
        for handle in list(self.server.gui._gui_input_handle_from_uuid.values()):
            if is_private(handle):
                self.send_value(handle)

    def gui_input(self, uuid: str) -> Any:
        """The input with this id that the client can see, or None."""
        candidates = (api._gui_input_handle_from_uuid.get(uuid) for api in self._guis)
        return next(
            (handle for handle in candidates if handle is not None and is_shown(handle)), None
        )

    def command(self, uuid: str) -> Any:
        """The command with this id that is not disabled, or None."""
        candidates = (api._command_handle_from_uuid.get(uuid) for api in self._guis)
        return next(
            (
                one
                for one in candidates
                if one is not None and not (one._impl.removed or one.disabled)
            ),
            None,
        )

    def scene_api(self, owner: str) -> Any:
        """The scene that a message names by its owner: the shared one, or the client's own; None
        for anyone else's."""
        if owner == "":
            return self.server.scene
        client = self._handle
        return client.scene if client is not None and client.scene._owner_id == owner else None

    def listens_to_gizmo(self, scene: Any, name: str) -> bool:
        """Whether this gizmo exists and has a callback; also true while a removed one is still
        being dragged."""
        if (self.number, name) in scene._active_transform_drag_handles:
            return True
        handle = scene._handle_from_transform_controls_name.get(name)
        return handle is not None and bool(handle._impl_aux.update_cb) and _is_visible(scene, name)

    def listens_to_pointer(self, event: str) -> bool:
        """Whether a callback for this pointer event over the whole scene is registered."""
        client = self._handle
        scenes = [self.server.scene] if client is None else [self.server.scene, client.scene]
        return any(
            entry.event_type == event for scene in scenes for entry in scene._scene_pointer_cb
        )

    def is_awaited(self, kind: type[Message]) -> bool:
        """Whether the server awaits this kind of message from the client, as the response to a
        request."""
        client = self._handle
        return client is not None and bool(client._websock_connection._incoming_handlers.get(kind))

    def forget_upload(self, transfer: str) -> None:
        """Discard the received parts of an upload."""
        for api in self._guis:
            api._current_file_upload_states.pop(transfer, None)

    def send_value(self, handle: Any) -> None:
        """Show the client the value that an input really has."""
        value = handle._impl.value
        if isinstance(value, bool | int | float | str | tuple) and not handle._impl.is_button:
            self._queue_message(_messages.GuiUpdateMessage(handle._impl.uuid, {"value": value}))

    def refuse_upload(self, source: str, transfer: str, size: int) -> None:
        """End the progress that the client shows for an upload, and its wait for more."""
        self._queue_message(_messages.FileTransferPartAck(source, transfer, size, size))
        self._queue_message(_messages.RemoveNotificationMessage(f"upload-{transfer}"))

    def show_error(self, title: str, body: str) -> None:
        """Show an error to the client."""
        if (client := self._handle) is not None:
            client.add_notification(title=title, body=body, color="red", auto_close_seconds=10.0)

    def _queue_message(self, message: Message) -> None:
        """Queue a message for the client; nothing if it has disconnected."""
        if (client := self._handle) is not None:
            client._websock_connection.queue_message(message)


def call_soon(
    server: viser.ViserServer, delay_s: float, function: Callable[..., Any], *args: Any
) -> None:
    """Call a function on the server's own thread, after a delay."""
    loop = server._websock_server._background_event_loop
    assert loop is not None
    with contextlib.suppress(RuntimeError):  # the server has stopped
        loop.call_soon_threadsafe(lambda: loop.call_later(delay_s, function, *args))


def make_private(handle: Any) -> None:
    """Send what is typed into this input to no other browser; `send_private_values` sends it to
    operators."""
    handle._impl.sync_cb = None


def is_private(handle: Any) -> bool:
    """Whether `make_private` was called for this input."""
    return handle._impl.sync_cb is None and not handle._impl.is_button


def is_shown(handle: Any) -> bool:
    """Whether this element, and every folder, tab, panel or modal that holds it, exists and is
    visible."""
    while True:
        impl = handle._impl
        if impl.removed or not impl.props.visible:
            return False
        if isinstance(handle, _gui_handles.PanelHandle) or impl.parent_container_id == "root":
            return True
        try:
            box = impl.gui_api._resolve_container_handle(impl.parent_container_id)
        except KeyError:
            return False
        if isinstance(box, _gui_handles.GuiModalHandle):
            return not box.closed
        if isinstance(box, _scene_handles.Gui3dContainerHandle):
            return not box._impl.removed and box._impl.visible
        if isinstance(box, _gui_handles.GuiTabHandle):
            if box.removed:
                return False
            box = box._parent
        handle = box


def listen_to_shapes(scene: viser.SceneApi, callback: Callable[[Any], None]) -> None:
    """Call back with each shape that is drawn into the scene by dragging, with Shift or without;
    its `screen_pos` are all its places, of which viser's own event keeps two."""
    for modifier in (None, "shift"):
        kind: Any = _scene_handles.ScenePointerEvent
        scene._register_scene_pointer_callback("rect-select", modifier, kind)(callback)  # type: ignore[arg-type]


def listens_to_clicks(scene: Any, name: str) -> bool:
    """Whether a callback for clicks on this node is registered."""
    handle = scene._handle_from_node_name.get(name)
    return handle is not None and bool(handle._impl.click_cb) and _is_visible(scene, name)


def _is_visible(scene: Any, name: str) -> bool:
    """Whether the node and all that it hangs from are visible."""
    parts = name.split("/")
    chain = ("/".join(parts[: n + 1]) for n in range(1, len(parts)))
    handles = (scene._handle_from_node_name.get(one) for one in chain)
    return all(handle is None or handle._impl.visible for handle in handles)


def request_answer(client: viser.ClientHandle, answered: Callable[[], None]) -> None:
    """Call `answered()`, on the server's thread, once this client has handled all that was queued
    for it alone."""
    connection, kind = client._websock_connection, _messages.LocalStorageGetItemResponseMessage
    question = secrets.token_hex(8)

    def handle_answer(_: int, message: _messages.LocalStorageGetItemResponseMessage) -> None:
        """Unregister this handler and call ``answered`` if the answer belongs to this question."""
        if message.request_uuid == question:
            connection.unregister_handler(kind, handle_answer)
            answered()

    connection.register_handler(kind, handle_answer)
    connection.queue_message(_messages.LocalStorageGetItemRequestMessage("slviewer", question))
