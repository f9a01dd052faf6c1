"""What a client may change: every message that viser would obey and ours must not is sent to a live
server."""

import dataclasses
import math
from functools import partial

import msgspec
import pytest
from clocks import until
from server_client import CAMERA, announced, settle

from slviewer.errors import SlviewerError
from slviewer.server import viser_internals
from slviewer.server.access import ROLES, MessageRefused
from slviewer.server.gate import MESSAGES, OUTLINE_LIMIT, UploadBudget, ViserGate


def test_the_operator_works(operator, gui):
    got: list = []
    slider = gui.add_slider("gain", 0.0, 10.0, 0.5, 5.0)
    button = gui.add_button("Capture")
    slider.on_update(lambda event: got.append((event.client_id, event.target.value)))
    button.on_click(lambda _: got.append("click"))
    client = operator.client()
    assert until(lambda: any(m["type"] == "GuiSliderMessage" for m in client.received))
    assert operator.server.role(client.number) == "operate"
    client.set(slider, 7)
    assert until(lambda: got == [(client.number, 7.0)]) and isinstance(slider.value, float)
    client.set(button, True)
    assert until(lambda: got[-1] == "click")
    slider.value = 3.0
    assert until(lambda: client.told(slider)[-1:] == [3.0])


def test_two_browsers_show_the_same(operator, watcher, gui):
    slider = gui.add_slider("gain", 0, 10, 1, 5)
    first, second, third = operator.client(), operator.client(), watcher.client()
    first.set(slider, 8)
    assert until(lambda: second.told(slider) == [8] and third.told(slider) == [8])


CASES = {
    "slider": (
        lambda g: g.add_slider("x", 0, 10, 1, 5),
        [0, 10, 7],
        [-1, 11, 2.5, math.nan, math.inf, "3", None, True, [3]],
    ),
    "number": (
        lambda g: g.add_number("x", 1.0, min=0.0, max=2.0),
        [0, 1.5],
        [-0.1, 2.1, math.nan, "1", 2**60, {}],
    ),
    "free number": (lambda g: g.add_number("x", 1), [-5, 2**40], [0.5, 2**60, -math.inf]),
    "text": (
        lambda g: g.add_text("x", "a"),
        ["", "ß 漢 <b>", "x" * 20_000],
        ["x" * 20_001, 5, b"a", None, "a\x00b", "a\nb"],
    ),
    "lines": (lambda g: g.add_text("x", "a", multiline=True), ["a\nb"], ["a\x1bb"]),
    "checkbox": (lambda g: g.add_checkbox("x", False), [True], [1, "yes", None, 0.0]),
    "dropdown": (lambda g: g.add_dropdown("x", ("a", "b")), ["b"], ["c", "", 0, None, ["a"]]),
    "choice": (lambda g: g.add_button_group("x", ("a", "b")), ["b"], ["c", True]),
    "vector2": (lambda g: g.add_vector2("x", (0.0, 0.0)), [], [[1, 0.5], [2, 0], 1]),
    "vector3": (
        lambda g: g.add_vector3("x", (1.0, 2.0, 3.0), min=(0.0, 0.0, 0.0)),
        [[0, 0.5, 7], [1.0, 2.0, 4.0]],
        [
            [1, 2],
            [1, 2, 3, 4],
            [1, -1, 2],
            [1, math.nan, 2],
            ["1", 2, 3],
            [1, True, 2],
            [[1], 2, 3],
            5,
            None,
            "123",
        ],
    ),
    "rgb": (lambda g: g.add_rgb("x", (1, 2, 3)), [], [[0, 255, 7], "red"]),
    "range": (lambda g: g.add_multi_slider("x", 0, 9, 1, (2, 5)), [], [[0, 9], [5, 2]]),
    "progress": (lambda g: g.add_progress_bar(5.0), [], [6, 7.0]),
    "upload": (lambda g: g.add_upload_button("x"), [], ["a", {"name": "a", "content": b""}, True]),
}


@pytest.mark.parametrize("case", CASES)
def test_values_stay_inside_the_range_and_the_options(operator, gui, case):
    make, good, bad = CASES[case]
    handle, calls = make(gui), []
    client = operator.client()
    handle._impl.update_cb.append(lambda event: calls.append(event.target.value))
    before = handle.value
    for value in bad:
        client.set(handle, value)
    settle(client)
    assert handle.value == before and not calls
    for count, value in enumerate(good, 1):
        client.set(handle, value)
        assert until(lambda count=count: len(calls) == count)
        assert handle.value == (tuple(value) if isinstance(value, list) else value)


def test_only_the_value_can_be_set(operator, gui):
    slider = gui.add_slider("gain", 0, 10, 1, 5)
    button = gui.add_button("Delete", disabled=True)
    client = operator.client()
    uuid = slider._impl.uuid
    for updates in (
        {"max": 99},
        {"disabled": False},
        {"value": 6, "max": 99},
        {"props": 1},
        {"update_cb": []},
        {},
    ):
        client.send("GuiUpdateMessage", uuid=uuid, updates=updates)
    client.send("GuiUpdateMessage", uuid=button._impl.uuid, updates={"disabled": False})
    client.send("GuiUpdateMessage", uuid="no such thing", updates={"value": 1})
    settle(client)
    assert (slider.value, slider.max, button.disabled) == (5, 10, True)


def test_what_is_disabled_or_hidden_stays_as_it_is(operator, gui):
    clicks: list = []
    folder = gui.add_folder("folder", visible=False)
    tabs = gui.add_tab_group(visible=False)
    panel = gui.add_panel(visible=False)
    with folder, gui.add_folder("inner"):
        in_folder = gui.add_button("a")
    with tabs.add_tab("tab"):
        in_tab = gui.add_button("b")
    with panel.add_tab("tab"):
        in_panel = gui.add_button("c")
    with gui.add_modal("modal") as modal:
        in_modal = gui.add_button("d")
    buttons = [
        gui.add_button("e", disabled=True),
        gui.add_button("f", visible=False),
        in_folder,
        in_tab,
        in_panel,
    ]
    slider = gui.add_slider("gain", 0, 10, 1, 5, disabled=True)
    for button in (*buttons, in_modal):
        button.on_click(lambda event: clicks.append(event.target.label))
    client = operator.client()
    for button in buttons:
        client.set(button, True)
    client.set(slider, 6)
    settle(client)
    assert clicks == [] and slider.value == 5
    assert until(lambda: client.told(slider) == [5]), "the page is shown the true value again"

    buttons[0].disabled = False
    for shown in (buttons[1], folder, tabs, panel):
        shown.visible = True
    for button in (*buttons, in_modal):
        client.set(button, True)
    assert until(lambda: sorted(clicks) == ["a", "b", "c", "d", "e", "f"])
    modal.close()
    client.set(in_modal, True)
    settle(client)
    assert clicks.count("d") == 1


def test_a_watcher_sees_all_and_changes_nothing(server, operator, watcher, gui):
    calls: list = []
    slider = gui.add_slider("gain", 0, 10, 1, 5)
    button, upload = gui.add_button("Capture"), gui.add_upload_button("Open")
    command = gui.add_command("Capture")
    gizmo = server.viser.scene.add_transform_controls("/board")
    for register in (
        slider.on_update,
        button.on_click,
        upload.on_upload,
        command.on_trigger,
        gizmo.on_update,
    ):
        register(lambda event: calls.append(event))
    server.viser.scene.on_click()(lambda event: calls.append(event))
    client = watcher.client()
    assert server.role(client.number) == "watch"
    assert until(
        lambda: (
            {"GuiSliderMessage", "TransformControlsMessage"} <= {m["type"] for m in client.received}
        )
    )
    client.set(slider, 7)
    client.set(button, True)
    client.send("CommandTriggerMessage", uuid=command._impl.uuid)
    client.send(
        "TransformControlsUpdateMessage",
        name="/board",
        wxyz=[1, 0, 0, 0],
        position=[1, 1, 1],
        owner="",
    )
    client.send("ScenePointerMessage", **POINTER)
    client.send("FileTransferStartUpload", **announced(upload, 0, 0))
    client.send("GuiFormDirtyMessage", uuid="x")
    client.send("ViewerCameraMessage", **{**CAMERA, "position": [7, 7, 7]})
    assert until(
        lambda: server.viser.get_clients()[client.number].camera.position.tolist() == [7, 7, 7]
    )
    assert slider.value == 5 and calls == [] and gizmo.position.tolist() == [0, 0, 0]
    assert until(lambda: client.told(slider) == [5])
    both = operator.client()
    both.set(slider, 9)
    assert until(lambda: client.told(slider)[-1] == 9) and len(calls) == 1


POINTER = {
    "event_type": "click",
    "ray_origin": [0, 0, 0],
    "ray_direction": [0, 0, 1],
    "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}


def test_commands_answer_only_where_they_are_and_forms_never(operator, gui):
    calls: list = []
    command, off = gui.add_command("Capture"), gui.add_command("Delete", disabled=True)
    form = gui.add_form("form")
    for one in (command, off):
        one.on_trigger(lambda event: calls.append(event.target.label))
    form.on_submit(lambda event: calls.append(event.target.label))
    client = operator.client()
    client.send("GuiFormSubmitMessage", uuid=form._impl.uuid)
    client.send("GuiFormDirtyMessage", uuid=form._impl.uuid)
    for uuid in ("x", off._impl.uuid, command._impl.uuid):
        client.send("CommandTriggerMessage", uuid=uuid)
    assert until(lambda: len(calls) == 1)
    settle(client)
    assert calls == ["Capture"]


def test_the_scene_answers_only_where_someone_listens(server, operator):
    scene, calls = server.viser.scene, []
    heard, deaf, hidden = (
        scene.add_transform_controls(name) for name in ("/heard", "/deaf", "/hidden")
    )
    ball, plain = scene.add_icosphere("/ball", 1.0), scene.add_icosphere("/plain", 1.0)
    for one in (heard, hidden):
        one.on_update(lambda event: calls.append((event.target.name, event.phase)))
    hidden.visible = False
    ball.on_click(lambda event: calls.append("ball"))
    client = operator.client()
    pose = {"wxyz": [1, 0, 0, 0], "position": [1, 2, 3]}
    click = {key: POINTER[key] for key in ("ray_origin", "ray_direction", "modifier")}
    for name in ("/heard", "/deaf", "/hidden", "/none", ""):
        client.send("TransformControlsUpdateMessage", name=name, **pose, owner="")
    for owner in ("1", "999", "x"):
        client.send("TransformControlsUpdateMessage", name="/heard", **pose, owner=owner)
    for wxyz in ([0, 0, 0, 0], [math.nan, 0, 0, 1], [1, 0, 0], "abcd"):
        client.send(
            "TransformControlsUpdateMessage", name="/heard", wxyz=wxyz, position=[9, 9, 9], owner=""
        )
    for name in ("/ball", "/plain", "/none"):
        node = {"name": name, "instance_index": None, "screen_pos": [0.1, 0.1], "owner": ""}
        client.send("SceneNodeClickMessage", **node, **click)
    client.send("ScenePointerMessage", **POINTER)
    settle(client)
    assert until(lambda: set(calls) == {("/heard", "update"), "ball"} and len(calls) == 2), calls
    assert heard.position.tolist() == [1, 2, 3]
    assert (
        deaf.position.tolist() == hidden.position.tolist() == plain.position.tolist() == [0, 0, 0]
    )

    scene.on_click()(lambda event: calls.append("scene"))
    client.send("ScenePointerMessage", **{**POINTER, "event_type": "rect-select"})
    client.send("ScenePointerMessage", **{**POINTER, "ray_origin": None})
    client.send("ScenePointerMessage", **{**POINTER, "screen_pos": []})
    client.send("ScenePointerMessage", **POINTER)
    assert until(lambda: "scene" in calls)
    settle(client)
    assert calls.count("scene") == 1

    shapes: list = []
    viser_internals.listen_to_shapes(scene, shapes.append)
    drawn = {**POINTER, "event_type": "rect-select", "ray_origin": None, "ray_direction": None}
    for count in (1, OUTLINE_LIMIT + 1, OUTLINE_LIMIT):
        places = [[count / 1e4, i / 1e4] for i in range(count)]
        client.send("ScenePointerMessage", **{**drawn, "screen_pos": places, "modifier": "shift"})
    assert until(lambda: shapes)
    settle(client)
    (shape,) = shapes
    assert len(shape.screen_pos) == OUTLINE_LIMIT and shape.modifier == "shift"


def test_a_drag_of_a_removed_gizmo_still_ends(server, operator):
    calls: list = []
    gizmo = server.viser.scene.add_transform_controls("/board")
    gizmo.on_update(lambda event: calls.append(event.phase))
    client = operator.client()
    client.send("TransformControlsDragStartMessage", name="/board", owner="")
    assert until(lambda: calls == ["start"])
    gizmo.remove()
    client.send("TransformControlsDragEndMessage", name="/board", owner="")
    assert until(lambda: calls == ["start", "end"])


def test_no_client_opens_a_tunnel(server, operator, gui):
    client = operator.client()
    client.send("ShareUrlRequest")
    client.send("ShareUrlDisconnect")
    settle(client)
    assert server.viser._share_tunnel is None
    with pytest.raises(SlviewerError):
        server.viser.request_share_url()
    gui.configure_theme(dark_mode=True)

    def themes() -> list[dict]:
        return [
            message for message in client.received if message["type"] == "ThemeConfigurationMessage"
        ]

    assert until(lambda: themes() and themes()[-1]["dark_mode"])
    assert not any(theme["show_share_button"] for theme in themes())


def test_messages_of_the_server_are_none_of_a_client(server, operator, gui):
    other = operator.client()
    client = operator.client()
    for kind, fields in (
        ("RunJavascriptMessage", {"source": "alert(1)"}),
        ("ResetGuiMessage", {}),
        ("GetRenderResponseMessage", {"payload": b"x" * 100, "render_uuid": "x"}),
        ("LocalStorageGetItemResponseMessage", {"value": "x", "error": None, "request_uuid": "x"}),
        ("NoSuchMessage", {}),
    ):
        client.send(kind, **fields)
    settle(client)
    assert not any(m["type"] in ("RunJavascriptMessage", "ResetGuiMessage") for m in other.received)


def test_garbage_hurts_nobody(server, operator, gui, capsys):
    slider = gui.add_slider("gain", 0, 10, 1, 5)
    client = operator.client()
    client.socket.send("text")
    client.socket.send(b"")
    client.socket.send(b"\xff" * 50)
    for thing in ([], 5, "x", {"type": 5}, {"type": ["GuiUpdateMessage"]}, {"uuid": "x"}, {1: 2}):
        client.socket.send(msgspec.msgpack.encode(thing))
    client.socket.send(b"\x91" * 100_000)
    client.send("GuiUpdateMessage", uuid=["a"], updates={"value": 1})
    client.send("GuiUpdateMessage", uuid=slider._impl.uuid, updates=[1])
    client.send(
        "GuiUpdateMessage", uuid=slider._impl.uuid, updates={"value": 1}, excluded_self_client=3
    )
    client.send("ViewerCameraMessage", **{**CAMERA, "position": [math.nan, 0, 0]})
    client.send("ViewerCameraMessage", **{**CAMERA, "image_width": -5})
    client.send("ViewerCameraMessage", **{**CAMERA, "fov": "wide"})
    settle(client)
    assert (
        slider.value == 5 and server.viser.get_clients()[client.number].camera.image_width == 1280
    )
    assert "Traceback" not in capsys.readouterr().err


ALLOWED = {
    "operate": {
        *(
            "ViewerCameraMessage",
            "GuiUpdateMessage",
            "CommandTriggerMessage",
            "LocalStorageGetItemResponseMessage",
        ),
        *("FileTransferStartUpload", "FileTransferPart", "TransformControlsUpdateMessage"),
        *("TransformControlsDragStartMessage", "TransformControlsDragEndMessage"),
        *("SceneNodeClickMessage", "ScenePointerMessage"),
    },
    "watch": {"ViewerCameraMessage", "LocalStorageGetItemResponseMessage"},
    "project": set(),
    "camera": set(),
}
"""The messages that are considered at all; whether one passes depends on what the page offers at
the moment."""
VALUES = {str: "/x", int: 1, float: 1.0, bool: True, bytes: b"x"}


def every_message() -> list[type]:
    """All messages of viser's protocol, of either direction."""
    found, waiting = [], [viser_internals.Message]
    while waiting:
        kinds = waiting.pop().__subclasses__()
        found += kinds
        waiting += kinds
    return found


def example(kind: type) -> dict:
    """Fields for a message of this kind; CAMERA and POINTER where those are known."""
    known = {"ViewerCameraMessage": CAMERA, "ScenePointerMessage": POINTER}.get(kind.__name__)
    return known or {field.name: VALUES.get(field.type, "/x") for field in dataclasses.fields(kind)}


@pytest.mark.parametrize("role", ROLES)
def test_every_message_of_the_protocol_for_every_role(server, operator, role, monkeypatch):
    client = operator.client()  # whatever the role, the gate is that of a connected client
    connection = viser_internals.ViserClient(server.viser, client.number).connection
    gate = ViserGate(server.viser, connection, role, UploadBudget(1000))
    considered = set()
    monkeypatch.setattr(
        gate, "_check_message", partial(note_considered, gate._check_message, considered)
    )
    monkeypatch.setattr(gate, "_send_refusal", lambda *_: None)
    passed = set()
    kinds = every_message()
    assert len(kinds) > 100 and all(
        name in {kind.__name__ for kind in kinds} for name in ALLOWED["operate"]
    )
    for kind in kinds:
        raw = msgspec.msgpack.encode({"type": kind.__name__, **example(kind)})
        if gate(raw) is not None:
            passed.add(kind.__name__)
    assert considered <= ALLOWED[role] and passed <= ALLOWED[role]
    passed.discard("ScenePointerMessage")  # something may listen to the pointer
    offered = {"ViewerCameraMessage"} if role in ("operate", "watch") else set()
    assert passed == offered, "nothing else is offered at present"
    assert {kind.__name__ for kind in MESSAGES[role]} == ALLOWED[role]


def note_considered(check, considered: set, message, raw):
    """Check a message, and note its kind unless the role may not send it at all."""
    try:
        passed = check(message, raw)
    except MessageRefused as refused:
        if str(refused) != "not for this link":
            considered.add(type(message).__name__)
        raise
    considered.add(type(message).__name__)
    return passed


def test_what_an_operator_types_into_a_private_input_reaches_no_watcher(
    server, operator, watcher, gui
):
    secret = "rtsp://admin:hunter2@camera/stream"
    address = gui.add_text("Camera ID", "")
    viser_internals.make_private(address)
    typing, other, watching = operator.client(), operator.client(), watcher.client()
    typing.set(address, secret)
    assert until(lambda: address.value == secret)
    watching.set(address, "x")  # is refused, and answered with the true value where it is no secret
    settle(typing)
    viser_internals.ViserClient(server.viser, other.number).send_private_values()
    assert until(lambda: other.told(address) == [secret])
    late = watcher.client()
    settle(typing)
    assert "hunter2" not in str(watching.received) + str(late.received)
