"""Strangers use up neither connections nor memory nor the log, and keep nobody out."""

import contextlib
import logging
import socket
import struct
import threading
from pathlib import Path

import pytest
from clocks import HANG_S, SteppingClock, until
from server_client import Browser

from slviewer.server import limits
from slviewer.server.connection import REQUEST_BYTES
from slviewer.server.limits import (
    CONNECTIONS,
    MAX_UNAUTHENTICATED_PER_ADDRESS,
    Listener,
    OncePerSecond,
    address_group,
)
from slviewer.server.secure import Serving, serve


@pytest.fixture
def crowd(server):
    """Opens connections that say nothing, as many as are asked for."""
    with contextlib.ExitStack() as ended:

        def open_connections(count: int, said: bytes = b"") -> list[socket.socket]:
            opened = []
            for _ in range(count):
                opened.append(
                    ended.enter_context(
                        socket.create_connection(("127.0.0.1", server.port), timeout=HANG_S)
                    )
                )
                with contextlib.suppress(OSError):
                    opened[-1].sendall(said)
            return opened

        yield open_connections


def is_open(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


@pytest.mark.parametrize("said", [b"", b"GET / HTTP/1.1\r\n", b"\x16\x03\x01"])
def test_a_crowd_of_strangers_keeps_nobody_out(server, operator, crowd, caplog, said):
    client = operator.client()
    slider = server.viser.gui.add_slider("gain", 0, 10, 1, 5)
    with caplog.at_level(logging.INFO):
        opened = crowd(3 * MAX_UNAUTHENTICATED_PER_ADDRESS, said)
        assert until(lambda: sum(map(is_open, opened)) <= MAX_UNAUTHENTICATED_PER_ADDRESS)
        assert operator.get().status == 200 and Browser(server, None).get("/").status == 200
        client.set(slider, 7)
        assert until(lambda: slider.value == 7)
    assert len(caplog.records) <= 5


def test_a_request_without_end_is_ended(server, crowd):
    (endless,) = crowd(1, b"GET / HTTP/1.1\r\n")
    with contextlib.suppress(ConnectionError):
        for n in range(2 * REQUEST_BYTES // 1000):
            endless.sendall(f"X-Filler-{n}: {'x' * 1000}\r\n".encode())
    assert until(lambda: not is_open(endless))


@pytest.mark.parametrize("upgrade", ["", "Connection: Upgrade\r\nUpgrade: websocket\r\n"])
def test_who_leaves_before_the_answer_is_no_error_of_the_server(server, crowd, caplog, upgrade):
    request = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n{upgrade}\r\n"
    for _ in range(50):
        (leaving,) = crowd(1, request.encode())
        # closed with a reset, as by a browser whose tab is closed
        leaving.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        leaving.close()
    assert until(lambda: Browser(server, None).get("/").status == 200)
    assert caplog.text == ""


def test_each_role_has_so_many_connections(monkeypatch):
    monkeypatch.setitem(CONNECTIONS, "watch", 2)
    server = serve(Serving(port=0))
    try:
        watcher, operator = Browser(server, "watch"), Browser(server, "operate")
        first, second = watcher.client(), watcher.client()
        assert watcher.get().status == 503 and operator.get().status == 200
        first.socket.close()
        assert until(lambda: watcher.get().status == 200)
        second.socket.close()
    finally:
        server.stop()


def test_the_busiest_address_makes_room(monkeypatch):
    closed = []
    monkeypatch.setattr(limits, "MAX_UNAUTHENTICATED", 4)
    with Listener(socket.AF_INET, socket.SOCK_STREAM) as listener:
        for number, address in enumerate(
            ["192.0.2.1", "192.0.2.1", "192.0.2.1", "192.0.2.2", "192.0.2.3"]
        ):
            one = limits._Accepted(socket.AF_INET, socket.SOCK_STREAM)
            monkeypatch.setattr(
                one, "shutdown", lambda how, number=number: closed.append(number), raising=False
            )
            listener.count(one, (address, number))
        assert closed == [0]


def test_accepting_pauses_so_that_others_are_served():
    with Listener(socket.AF_INET, socket.SOCK_STREAM) as listener, contextlib.ExitStack() as ended:
        listener.bind(("127.0.0.1", 0))
        listener.listen(64)
        for _ in range(2 * limits.ACCEPTED_AT_ONCE):
            ended.enter_context(socket.create_connection(listener.getsockname()))
        accepted = []
        with pytest.raises(BlockingIOError):
            while True:
                accepted.append(ended.enter_context(listener.accept()[0]))
        assert len(accepted) == limits.ACCEPTED_AT_ONCE
        assert listener.accept()[0].close() is None


def test_addresses_of_one_subscriber_are_one():
    assert (
        address_group("2001:db8::1")
        == address_group("2001:db8::ffff:2")
        != address_group("2001:db8:0:1::1")
    )
    assert address_group("192.0.2.1") != address_group("192.0.2.2")
    assert address_group("fe80::1%eth0") == address_group("fe80::2%eth0")


def test_a_fault_is_logged_once_a_second(monkeypatch):
    clock = SteppingClock()
    monkeypatch.setattr("slviewer.server.limits.monotonic", clock.now)
    records = OncePerSecond()

    def passes(text: str, error: type[Exception] | None = None) -> bool:
        info = (error, error(), None) if error else None
        return records.filter(
            logging.LogRecord("slviewer.server", logging.ERROR, "", 0, text, (1,), info)
        )

    assert [passes("failed %s") for _ in range(50)] == [True] + [False] * 49
    assert passes("another") and passes("failed %s", OSError) and not passes("failed %s", OSError)
    clock.sleep(1.01)
    assert passes("failed %s") and not passes("failed %s")
    for name in ("slviewer.server", "slviewer.server.websockets", "asyncio"):
        assert any(isinstance(one, OncePerSecond) for one in logging.getLogger(name).filters)


def test_descriptors_are_given_back(server, operator):
    open_files = Path("/proc/self/fd")
    if not open_files.exists():
        pytest.skip("the system does not list open files")
    before = len(list(open_files.iterdir()))

    def knock() -> None:
        for _ in range(100):
            with (
                contextlib.suppress(OSError),
                socket.create_connection(("127.0.0.1", server.port), timeout=HANG_S),
            ):
                pass

    threads = [threading.Thread(target=knock) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert until(lambda: len(list(open_files.iterdir())) <= before + 4)
    assert operator.get().status == 200
