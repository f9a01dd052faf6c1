"""The inside of viser is as it was when the guard was written: what fails here must be read again
before it serves."""

import hashlib
import inspect
import re

import pytest
import viser
import websockets.asyncio.server
from facts import raises
from viser import _gui_api, _gui_handles, _messages, _scene_api, _scene_handles, _viser
from viser.infra import _infra
from viser.infra import _messages as infra_messages

from slviewer.errors import SlviewerError
from slviewer.server import viser_internals
from slviewer.server.auth_middleware import script_hash

SOURCES = {
    _infra.WebsockServer._background_worker: "59b19aac01fb31a3",
    _infra.WebsockMessageHandler: "b69722f2262ff75a",
    _infra._message_consumer: "ef071771f1a2bda2",
    infra_messages.Message.deserialize: "aae3671624edbf96",
    _viser.ViserServer.__init__: "14c27c9c9808abeb",
    _viser.ViserServer.request_share_url: "4404c261955cc680",
    _viser.ViserServer.stop: "09afbae8361af16a",
    _gui_api.GuiApi._handle_gui_updates: "98bff2504661cbbb",
    _gui_api.GuiApi._handle_file_transfer_start: "2b217030aed96b82",
    _gui_api.GuiApi._handle_file_transfer_part: "a771c431149bf103",
    _gui_api.GuiApi._finish_file_upload: "34e0339a8c08fc18",
    _gui_api.GuiApi._handle_command_trigger: "bda5e0f179ee2529",
    _gui_api.GuiApi._resolve_container_handle: "ccbb78d2c8efde36",
    _gui_handles._GuiHandleState: "269c78dac859f48c",
    _gui_handles.GuiTabHandle: "7b7f418ec1dd1d89",
    _gui_handles.GuiModalHandle: "5535c106047cc09e",
    _scene_handles.Gui3dContainerHandle: "fd6a7bad1d94cad8",
    _scene_api.SceneApi._handle_transform_controls_updates: "040ada44416d707d",
    _scene_api.SceneApi._handle_transform_controls_drag_start: "34dcfe5fe7ec0709",
    _scene_api.SceneApi._handle_transform_controls_drag_end: "937a30579754f3d3",
    _scene_api.SceneApi._handle_node_click_updates: "db50ec346ec9039c",
    _scene_api.SceneApi._handle_scene_pointer_updates: "316d5eb86062671a",
    _scene_api.SceneApi._register_owner_scoped_handler: "296c860860e42beb",
}
"""What the guard relies on, and the beginning of the SHA-256 of its source."""


def test_the_version_is_the_one_that_was_read(monkeypatch):
    viser_internals.check_version()
    monkeypatch.setattr(viser, "__version__", "1.2.0")
    with raises(SlviewerError, "viser==1.1.1"):
        viser_internals.check_version()


@pytest.mark.parametrize("source", SOURCES, ids=lambda s: s.__qualname__)
def test_what_the_guard_relies_on_is_unchanged(source):
    assert hashlib.sha256(inspect.getsource(source).encode()).hexdigest()[:16] == SOURCES[source]


def test_the_page_is_the_one_whose_scripts_are_allowed():
    page = viser_internals.CLIENT_PAGE.read_bytes()
    assert (
        hashlib.sha256(page).hexdigest()
        == "8c05b8bfea1ed54773a7616d1d868ebf0b45055ff8da8fc1603ccb2a7858f079"
    )
    (loader,) = re.findall(rb'<script data-p="[^"]*"[^>]*>(.*)</script>', page, re.S)
    assert script_hash(loader) == viser_internals.VISER_SCRIPTS[0]


def test_a_client_sends_nothing_that_was_not_thought_of(server, operator):
    operator.client()
    (client,) = server.viser.get_clients().values()
    handled = set(server.viser._websock_server._incoming_handlers) | set(
        client._websock_connection._incoming_handlers
    )
    unused = {
        _messages.GuiButtonHoldMessage,
        _messages.GuiFormSubmitMessage,
        _messages.GuiFormDirtyMessage,
        _messages.SceneNodeDragMessage,
    }
    asked = {_messages.LocalStorageGetItemResponseMessage}
    assert handled | asked == set(viser_internals.FROM_CLIENTS.values()) | unused


def test_every_input_is_known_to_the_check_of_values():
    inputs = {kind for kind in vars(_gui_handles).values() if inspect.isclass(kind)}
    concrete = {kind.__name__ for kind in inputs if issubclass(kind, _gui_handles._GuiInputHandle)}
    assert concrete - {"_GuiInputHandle", "GuiInputHandle"} == {
        *(
            "GuiButtonHandle",
            "GuiButtonGroupHandle",
            "GuiCheckboxHandle",
            "GuiDropdownHandle",
            "GuiMultiSliderHandle",
        ),
        *(
            "GuiNumberHandle",
            "GuiProgressBarHandle",
            "GuiRgbHandle",
            "GuiRgbaHandle",
            "GuiSliderHandle",
            "GuiTextHandle",
        ),
        *("GuiUploadButtonHandle", "GuiVector2Handle", "GuiVector3Handle"),
    }


def test_websockets_has_what_the_connection_uses():
    connection = websockets.asyncio.server.ServerConnection
    assert list(inspect.signature(connection.handshake).parameters) == [
        *("self", "process_request", "process_response", "server_header")
    ]
    assert list(inspect.signature(connection.recv).parameters) == ["self", "decode"]
    assert inspect.iscoroutinefunction(connection.drain) and inspect.iscoroutinefunction(
        connection.recv
    )
    source = inspect.getsource(connection)
    assert "self.request_rcvd" in source and "process_request(self, self.request)" in source
