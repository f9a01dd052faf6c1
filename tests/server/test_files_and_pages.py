"""Downloads, further pages and endpoints, and text that users typed."""

import base64
import contextlib
import hashlib
import html
import io
import os
import re
import socket
import threading
import tracemalloc
import zipfile
from collections.abc import Iterator
from importlib import resources

import pytest
from clocks import HANG_S, until
from server_client import Browser
from websockets.exceptions import InvalidStatus

from slviewer.errors import InputError
from slviewer.server import connection
from slviewer.server.auth_middleware import DevicePage
from slviewer.server.connection import CHUNK
from slviewer.server.limits import CONNECTIONS
from slviewer.server.secure import Serving, serve
from slviewer.server.text import escape, safe_file_name
from slviewer.server.zip_stream import open_zip
from slviewer.session.importers.images import IMAGE_SUFFIXES

PAGE = "<!doctype html><title>projector</title><script>let a = 1</script>"


def test_an_offered_file_arrives_whole(operator, watcher, stranger, tmp_path):
    content = os.urandom(3 * CHUNK + 17)
    (tmp_path / "scan é.ply").write_bytes(content)
    downloads = operator.server.downloads
    address = downloads.offer(tmp_path / "scan é.ply", within=tmp_path)
    assert downloads.offer(tmp_path / "scan é.ply", within=tmp_path) == address
    for browser in (operator, watcher):
        answer = browser.get(address)
        assert answer.status == 200 and answer.content == content
        assert int(answer.headers["Content-Length"]) == len(content)
        disposition = answer.headers["Content-Disposition"]
        assert (
            disposition.startswith("attachment; ")
            and "filename*=UTF-8''scan%20%C3%A9.ply" in disposition
        )
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert (
        stranger.get(address).status == 403
        and Browser(operator.server, "project").get(address).status == 404
    )
    downloads.clear()
    assert operator.get(address).status == 404


def test_the_page_knows_every_image_that_is_imported():
    script = resources.files("slviewer.server").joinpath("page_script.js").read_text()
    pattern = re.search(r"const image = /(.*)/i;", script)
    assert all(re.search(pattern[1], f"pose{suffix}") for suffix in IMAGE_SUFFIXES)
    assert not re.search(pattern[1], "cloud.ply")


def test_an_empty_file_is_a_file(operator, tmp_path):
    (tmp_path / "empty.csv").touch()
    answer = operator.get(operator.server.downloads.offer(tmp_path / "empty.csv", within=tmp_path))
    assert (
        answer.status == 200 and answer.content == b"" and answer.headers["Content-Length"] == "0"
    )


def test_no_file_outside_the_folder_is_offered(operator, tmp_path):
    session, secret = tmp_path / "session", tmp_path / "secret.txt"
    session.mkdir()
    secret.write_text("secret")
    (session / "link.txt").symlink_to(secret)
    os.mkfifo(session / "pipe")
    downloads = operator.server.downloads
    for path in (
        secret,
        session / "link.txt",
        session / ".." / "secret.txt",
        session,
        session / "none",
        session / "pipe",
    ):
        with pytest.raises(InputError):
            downloads.offer(path, within=session)


def test_a_file_that_becomes_a_link_is_no_longer_sent(operator, tmp_path):
    session, secret = tmp_path / "session", tmp_path / "secret.txt"
    session.mkdir()
    secret.write_text("secret")
    (session / "a.txt").write_text("fine")
    address = operator.server.downloads.offer(session / "a.txt", within=session)
    (session / "a.txt").unlink()
    (session / "a.txt").symlink_to(secret)
    assert operator.get(address).status == 404
    operator.server.downloads.clear()


def test_archive_holds_the_parts_and_nothing_else(operator, stranger, tmp_path):
    session, secret = tmp_path / "session é", tmp_path / "secret.txt"
    content = os.urandom(3 * CHUNK + 17)
    wanted = {"exports/part.ply": content, "results/a/meta.json": b"{}", "session.json": b""}
    for name, data in {**wanted, "captures/frames": b"x", "exports/.part.tmp": b"x"}.items():
        (session / name).parent.mkdir(parents=True, exist_ok=True)
        (session / name).write_bytes(data)
    secret.write_text("secret")
    (session / "exports" / "link.txt").symlink_to(secret)
    (session / "results" / "out").symlink_to(tmp_path)
    os.utime(session / "session.json", (0, 0))  # before a zip's first year
    downloads = operator.server.downloads
    address = downloads.offer_zip(session, ("exports", "results", "session.json", "none"))
    answer = operator.get(address)
    assert answer.status == 200 and "session%20%C3%A9.zip" in answer.headers["Content-Disposition"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        found = {name: archive.read(name) for name in archive.namelist()}
    assert found == {f"{session.name}/{name}": data for name, data in wanted.items()}
    assert stranger.get(address).status == 403
    downloads.clear()
    assert operator.get(address).status == 404


def test_archive_is_read_as_it_is_sent(tmp_path):
    """An archive takes no more memory than a piece."""
    (tmp_path / "large").open("wb").truncate(2**28)
    tracemalloc.start()
    size = 0
    with open_zip([("large", (tmp_path / "large").open("rb"))]) as archive:
        while piece := archive.read(CHUNK):
            size += len(piece)
    assert 2**28 < size < 2**28 + 1000 and tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


@pytest.mark.parametrize(
    "path", ["download", "download/", "download/x", "download/../secret", "download/x/y"]
)
def test_addresses_that_were_not_offered_are_nothing(operator, path):
    assert operator.get(path).status == 404


LARGE = 512 * CHUNK
"""Bytes of a file that the buffers of no connection take."""


@pytest.fixture
def serving(tmp_path) -> Iterator:
    """Starts a server of a large file, and returns the operator's browser and the file's
    address."""
    servers = []

    def start() -> tuple[Browser, str]:
        with (tmp_path / "large.bin").open("wb") as file:
            file.truncate(LARGE)
        servers.append(serve(Serving(port=0)))
        return Browser(servers[-1], "operate"), servers[-1].downloads.offer(
            tmp_path / "large.bin", within=tmp_path
        )

    yield start
    for server in servers:
        server.stop()


def test_a_slow_reader_of_a_large_file_costs_little_and_stops_nobody(serving, monkeypatch):
    # whoever waited for the slow reader would wait for too long
    monkeypatch.setattr(connection, "STALL_SECONDS", 10 * HANG_S)
    operator, address = serving()
    with socket.create_connection(("127.0.0.1", operator.server.port), timeout=HANG_S) as slow:
        slow.sendall(operator.raw_request(address))
        assert slow.recv(100).startswith(b"HTTP/1.1 200")
        assert operator.get().status == 200
        content = operator.get(address).content
        assert len(content) == content.count(0) == LARGE
    assert operator.get().status == 200  # the reader that left half-way did no harm


def test_a_reader_who_takes_nothing_is_let_go(serving, monkeypatch):
    monkeypatch.setattr(connection, "STALL_SECONDS", 0.2)
    monkeypatch.setitem(CONNECTIONS, "operate", 1)
    operator, address = serving()
    with socket.create_connection(("127.0.0.1", operator.server.port), timeout=HANG_S) as stalled:
        stalled.sendall(operator.raw_request(address))
        assert stalled.recv(100).startswith(b"HTTP/1.1 200")
        assert until(lambda: operator.get().status == 200), "its connection is free again"
        received = 100
        with contextlib.suppress(ConnectionError):
            while part := stalled.recv(CHUNK):
                received += len(part)
        assert received < LARGE


def test_the_projector_page_has_a_link_of_its_own(
    server, operator, watcher, projector_page, stranger
):
    async def echo(connection) -> None:
        async for message in connection:
            await connection.send(f"{connection.role}: {message}")

    server.device_pages["project"] = DevicePage(PAGE.encode(), echo)
    answer = projector_page.get()
    assert answer.status == 200 and answer.content.decode() == PAGE
    script = base64.b64encode(hashlib.sha256(b"let a = 1").digest()).decode()
    assert f"script-src 'sha256-{script}';" in answer.headers["Content-Security-Policy"]
    with projector_page.open() as socket_:
        socket_.send("hello")
        assert socket_.recv(HANG_S) == "project: hello"
    for origin in ("http://evil.example", None):
        with pytest.raises(InvalidStatus):
            projector_page.open(origin=origin)
    led = operator.get("projector")  # the operator is led to that page, with its rights alone
    assert led.status == 303 and led.headers["Location"] == projector_page.path
    assert led.headers["Set-Cookie"].startswith(f"{projector_page.cookie};")
    assert watcher.get("projector").status == 404 and stranger.get("/projector").status == 403
    server.device_pages.clear()
    assert projector_page.get().status == 404 and operator.get("projector").status == 404
    with pytest.raises(InvalidStatus):
        projector_page.open()


def test_a_failing_endpoint_takes_nothing_with_it(server, operator, projector_page):
    async def fail(connection) -> None:
        raise RuntimeError("broken")

    server.device_pages["project"] = DevicePage(PAGE.encode(), fail)
    socket_ = projector_page.open()
    assert until(lambda: socket_.close_code == 1011)
    server.device_pages.clear()
    assert operator.client().number >= 0


NASTY = [
    "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    "[x](javascript:alert(1))",
    "![x](http://evil.example/x.png)",
    "{alert(1)}",
    '" onmouseover="alert(1)',
    "`code` **bold** _it_ # head | a | b | &lt;b&gt; \\<b>",
    "1. list\n\n> quote\n\n    code",
    "http://evil.example HTTPS://evil.example www.evil.example me@evil.example",
    "\u202egpj.exe \x00\x1b[31m",
]


@pytest.mark.parametrize("text", NASTY)
def test_typed_text_stays_text(text):
    safe = escape(text)
    assert not set(safe) & set("<>\"'`*_[](){}|!\\\n/:.~=@")
    shown = html.unescape(safe)
    assert not re.search(r"(?i)https?:|www\.|\w@", shown), (
        "viser's Markdown would make a link of it"
    )
    typed = "".join(c for c in text if c.isprintable() or c.isspace())
    assert shown.replace("\u2060", "").split() == typed.split()


def test_ordinary_names_stay_readable():
    assert (
        escape("Würfel 3") == "Würfel 3"
        and html.unescape(escape("a_b-1.ply (2)")) == "a_b-1.ply (2)"
    )


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("cloud.ply", "cloud.ply"),
        ("../../etc/passwd", "passwd"),
        ("C:\\Windows\\x.dll", "x.dll"),
        ("..", "upload"),
        ("", "upload"),
        (".bashrc", "bashrc"),
        ("a\x00\nb.txt", "ab.txt"),
        ("con.txt", "_con.txt"),
        ('a<b>:"|?*.yml', "a_b______.yml"),
        ("Kalibrierung für Würfel.yml", "Kalibrierung für Würfel.yml"),
        ("x/", "upload"),
        ("\u202etxt.exe", "txt.exe"),
    ],
)
def test_uploaded_names_are_plain_file_names(name, safe):
    assert safe_file_name(name) == safe


def test_long_names_are_cut_and_keep_their_suffix():
    name = safe_file_name("漢" * 300 + ".ply")
    assert (
        name.endswith(".ply")
        and len(name.encode()) <= 200
        and len(safe_file_name("a." + "b" * 500)) <= 120
    )


def test_the_server_stops_and_its_port_is_free_again(serving, monkeypatch):
    monkeypatch.setattr(connection, "STALL_SECONDS", 10 * HANG_S)
    browser, address = serving()
    server, client = browser.server, browser.client()
    with socket.create_connection(("127.0.0.1", server.port), timeout=HANG_S) as slow:
        slow.sendall(browser.raw_request(address))
        slow.recv(100)
        stopping = threading.Thread(target=server.stop, daemon=True)
        stopping.start()
        stopping.join(HANG_S)
        assert not stopping.is_alive()
    client.thread.join(HANG_S)
    assert not client.thread.is_alive()
    again = serve(Serving(port=server.port))
    again.stop()
