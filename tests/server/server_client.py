"""A client that speaks to the server as a browser does, or as one never would."""

import contextlib
import http.client
import json
import socket
import threading
from typing import Any

import msgspec
import viser
import zstandard
from clocks import HANG_S, until
from websockets.sync.client import ClientConnection, connect

from slviewer.server.access import Role
from slviewer.server.secure import SafeServer

CAMERA = {
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1, 2, 3.0],
    "fov": 1.0,
    "near": 0.01,
    "far": 100,
    "image_height": 720,
    "image_width": 1280,
    "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}


class Client:
    """A WebSocket to viser, past the authentication."""

    def __init__(self, server: SafeServer, connection: ClientConnection) -> None:
        self.server = server
        self.socket = connection
        self.received: list[dict] = []
        self._moves = 10
        self.thread = threading.Thread(target=self._listen, daemon=True)
        self.thread.start()
        before = set(server.viser.get_clients())
        self.send("ViewerCameraMessage", **CAMERA)
        assert until(lambda: set(server.viser.get_clients()) - before), (
            "the camera message made no client of it"
        )
        (self.number,) = set(server.viser.get_clients()) - before

    def _listen(self) -> None:
        with contextlib.suppress(Exception):
            for raw in self.socket:
                assert isinstance(raw, bytes)
                size = int.from_bytes(raw[8:16], "little")
                inner = zstandard.ZstdDecompressor().decompress(
                    raw[16 : 16 + size], int.from_bytes(raw[:8], "little")
                )
                self.received.extend(msgspec.msgpack.decode(inner)["messages"])

    def send(self, kind: str, **fields: Any) -> None:
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def set(self, handle: Any, value: Any) -> None:
        self.send("GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": value})

    def flush(self) -> None:
        """Wait until all that was sent before has been handled, whatever the role."""
        self._moves += 1
        self.send("ViewerCameraMessage", **{**CAMERA, "position": [self._moves, 0, 0]})
        camera = self.server.viser.get_clients()[self.number].camera
        assert until(lambda: camera.position.tolist() == [self._moves, 0, 0])

    def told(self, handle: Any) -> list:
        """The values of an input that the server sent since the client connected."""
        updates = [
            m
            for m in self.received
            if m["type"] == "GuiUpdateMessage" and m["uuid"] == handle._impl.uuid
        ]
        return [m["updates"]["value"] for m in updates]


class Browser:
    """Requests to one server, with the cookie of a role and below its path."""

    def __init__(self, server: SafeServer, role: Role | None) -> None:
        self.server = server
        self.host = f"127.0.0.1:{server.port}"
        grant = server.access.grants[role] if role else None
        self.cookie = f"{grant.cookie_name}={grant.value}" if grant else None
        self.path = f"{grant.path}/" if grant else "/"
        self.clients: list[Client] = []

    def get(self, path: str = "", **headers: str) -> http.client.HTTPResponse:
        """The answer, with its body in `.content`; a path without a slash is below the role's."""
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=HANG_S)
        cookie = {"Cookie": self.cookie} if self.cookie else {}
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        address = path if path.startswith(("/", "http")) else self.path + path
        connection.request("GET", address, headers={"Host": self.host, **cookie, **named})
        response = connection.getresponse()
        response.content = response.read()  # type: ignore[attr-defined]
        connection.close()
        return response

    def log_in(self, token: str, **headers: str) -> http.client.HTTPResponse:
        """The answer to a token; its cookie and path are used from then on."""
        answer = self.get("/login", Authorization=f"Bearer {token}", **headers)
        if answer.status == 200:
            self.cookie = answer.headers["Set-Cookie"].partition(";")[0]
            self.path = json.loads(answer.content)["path"]  # type: ignore[attr-defined]
        return answer

    def raw_request(self, path: str = "") -> bytes:
        """The bytes of a request, to be sent by hand."""
        lines = f"GET {self.path}{path} HTTP/1.1", f"Host: {self.host}", f"Cookie: {self.cookie}"
        return "\r\n".join([*lines, "", ""]).encode()

    def open(
        self, path: str = "", origin: str | None = "own", host: str | None = None
    ) -> ClientConnection:
        """A WebSocket; raises InvalidStatus where the server refuses it."""
        headers = [("Cookie", self.cookie)] if self.cookie else []
        if origin is not None:
            headers.append(("Origin", f"http://{self.host}" if origin == "own" else origin))
        uri = f"ws://{host or self.host}{path if path.startswith('/') else self.path + path}"
        return connect(
            uri,
            sock=socket.create_connection(("127.0.0.1", self.server.port), timeout=HANG_S),
            additional_headers=headers,
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=2**26,
        )

    def client(self) -> Client:
        client = Client(self.server, self.open())
        self.clients.append(client)
        return client

    def close(self) -> None:
        for client in self.clients:
            client.socket.close()


def settle(client: Client) -> None:
    """Wait until all that the client sent before has been handled."""
    gui = client.server.viser.gui
    seen = threading.Event()
    mark = gui.add_checkbox("settled", False)
    mark.on_update(lambda _: seen.set())
    client.set(mark, True)
    assert seen.wait(HANG_S)
    mark.remove()


def announced(button, size: int, parts: int, name: str = "a.txt", transfer: str = "t") -> dict:
    return {
        "source_component_uuid": button._impl.uuid,
        "transfer_uuid": transfer,
        "filename": name,
        "mime_type": "",
        "size_bytes": size,
        "part_count": parts,
    }


def part(button, index: int, content: bytes, transfer: str = "t") -> dict:
    return {
        "source_component_uuid": button._impl.uuid,
        "transfer_uuid": transfer,
        "part_index": index,
        "content": content,
    }
