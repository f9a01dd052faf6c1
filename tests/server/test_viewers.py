"""Who has drawn what: one that answers is ready again, one that stalls is asked nothing more and
holds nobody up."""

import threading

import pytest
from clocks import HANG_S, SteppingClock, until
from server_client import Browser, Client

from slviewer.server.secure import SafeServer
from slviewer.server.viewers import STALLED_S, Viewers


def answer(client: Client) -> None:
    """Say, as viser's page does, that all that came was drawn."""
    asked = next(
        m for m in reversed(client.received) if m["type"] == "LocalStorageGetItemRequestMessage"
    )
    client.send(
        "LocalStorageGetItemResponseMessage",
        value=None,
        error=None,
        request_uuid=asked["request_uuid"],
    )


def asked(client: Client) -> int:
    return sum(m["type"] == "LocalStorageGetItemRequestMessage" for m in client.received)


def test_each_is_ready_once_it_has_drawn_what_it_was_sent(
    server: SafeServer, operator: Browser, watcher: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick, slow = operator.client(), watcher.client()
    heard = threading.Event()
    clock = SteppingClock()
    monkeypatch.setattr("slviewer.server.viewers.monotonic", clock.now)
    viewers = Viewers(server.viser, heard.set)

    def ready() -> set[int]:
        return {client.client_id for client in viewers.ready()} & {quick.number, slow.number}

    assert ready() == {quick.number, slow.number} <= viewers.here()
    for client in viewers.ready():
        client.scene.add_label("/drawn", "something")
        viewers.sent(client)
    assert ready() == set()
    assert until(lambda: asked(quick) == asked(slow) == 1)
    # drawn before it asks
    assert quick.received[-2]["type"] == "LabelMessage" or "Label" in str(quick.received[:-1])
    clock.sleep(0.25)
    answer(quick)
    assert until(lambda: ready() == {quick.number}) and heard.wait(HANG_S)
    assert viewers.slowest_s() == pytest.approx(0.25)
    clock.sleep(0.5)
    assert viewers.slowest_s() == pytest.approx(0.75), "the slow one has not answered yet"
    clock.sleep(STALLED_S)
    assert viewers.slowest_s() == pytest.approx(0.25), (
        "one that stalls sets the pace for itself alone"
    )
    answer(quick)  # an answer to nothing is let in by nobody
    slow.send("LocalStorageGetItemResponseMessage", value=None, error=None, request_uuid="another")
    quick.flush()
    slow.flush()
    assert ready() == {quick.number}
    answer(slow)  # who only watches may say so too
    assert until(lambda: ready() == {quick.number, slow.number})
    viewers.sent(server.viser.get_clients()[slow.number])
    slow.socket.close()
    assert until(lambda: slow.number not in viewers.here())
    assert ready() == {quick.number}
