"""Who is let in: every access that viser leaves open is tried."""

import contextlib
import logging
import socket
import time

import pytest
from websockets.exceptions import InvalidStatus

from slviewer.errors import SlviewerError, UsageError
from slviewer.server import connection
from slviewer.server.access import Access
from slviewer.server.secure import serve

EVIL = "http://evil.example"


def test_a_token_link_sets_a_cookie_and_leads_to_the_clean_address(server, stranger):
    path = server.url.partition(str(server.port))[2]
    answer = stranger.get(path)
    assert answer.status == 303 and answer.headers["Location"] == "/"
    cookie = answer.headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie and "no-store" in answer.headers["Cache-Control"]
    stranger.cookie = cookie.partition(";")[0]
    page = stranger.get("/")
    assert page.status == 200 and b"<title>Viser</title>" in page.content
    assert stranger.open().close() is None


def test_a_link_followed_from_another_site_still_arrives(server, stranger):
    # a strict cookie is not sent along a redirect that began elsewhere: a page of our own must lead on
    path = server.url.partition(str(server.port))[2]
    link = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate", "Sec_Fetch_Dest": "document"}
    answer = stranger.get(path, **link)
    assert answer.status == 200 and "Set-Cookie" in answer.headers and b"location.replace" in answer.content
    assert server.access.token.encode() not in answer.content
    assert "script-src 'sha256-" in answer.headers["Content-Security-Policy"]


@pytest.mark.parametrize("path", ["/", "/index.html", "/projector", "/download/x", "/../../etc/passwd", "/%2e%2e/x"])
def test_without_a_token_there_is_nothing_to_see(stranger, path):
    answer = stranger.get(path)
    assert answer.status in (403, 404) and len(answer.content) < 200


@pytest.mark.parametrize("cookie", ["", "wrong", "é", "T" * 200])
def test_a_wrong_token_opens_nothing(stranger, cookie):
    stranger.cookie = f"slviewer_{stranger.server.port}={cookie}".encode().decode("latin-1")
    assert stranger.get("/").status == 403
    assert stranger.get("/?token=" + "x" * 32).status == 403
    with pytest.raises(InvalidStatus) as refused:
        stranger.open()
    assert refused.value.response.status_code == 403


def test_the_refusal_says_what_to_do(stranger):
    assert b"open the link" in stranger.get("/").content


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1:1", "127.0.0.1", "localhost.evil:{port}"]
)
def test_a_rebound_host_name_is_refused(operator, host):
    name = host.format(port=operator.server.port)
    assert operator.get("/", Host=name).status == 421
    with pytest.raises(InvalidStatus) as refused:
        operator.open(host=name, origin=f"http://{name}")
    assert refused.value.response.status_code == 421


def test_localhost_is_this_host_too(operator):
    operator.host = f"localhost:{operator.server.port}"
    assert operator.get("/").status == 200


def test_two_hosts_are_none(operator):
    with socket.create_connection(("127.0.0.1", operator.server.port)) as raw:
        lines = f"GET / HTTP/1.1\r\nHost: {operator.host}\r\nHost: evil\r\nCookie: {operator.cookie}\r\n\r\n"
        raw.sendall(lines.encode())
        assert b"421" in raw.recv(100)


@pytest.mark.parametrize("origin", [EVIL, "null", None, "http://127.0.0.1:1", "http://localhost:{port}.evil", ""])
def test_another_pages_websocket_is_refused_even_with_the_cookie(operator, origin):
    with pytest.raises(InvalidStatus) as refused:
        operator.open(origin=origin)
    assert refused.value.response.status_code == 403


def test_another_pages_request_is_refused_even_with_the_cookie(operator):
    assert operator.get("/", Origin=EVIL).status == 403
    # another port of this machine is the same site, so that the strict cookie is sent along
    assert (
        operator.get("/", Sec_Fetch_Site="same-site", Sec_Fetch_Mode="no-cors", Sec_Fetch_Dest="script").status == 403
    )
    assert (
        operator.get("/", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate", Sec_Fetch_Dest="iframe").status == 403
    )
    assert operator.get("/", Sec_Fetch_Site="same-origin", Sec_Fetch_Mode="cors", Sec_Fetch_Dest="empty").status == 200


@pytest.mark.parametrize(
    "query", ["websocket=ws://evil", "playbackPath=http://evil/x.viser", "token={token}&websocket=ws://evil", "x", ""]
)
def test_parameters_that_make_the_page_load_foreign_messages_are_refused(operator, query):
    answer = operator.get("/?" + query.format(token=operator.server.access.token))
    assert answer.status == 400 and "Set-Cookie" not in answer.headers


def test_a_token_in_a_websockets_address_counts_for_nothing(server, stranger):
    with pytest.raises(InvalidStatus):
        stranger.open(f"/?token={server.access.token}")


@pytest.mark.parametrize("path", ["//evil.example/", "/\\evil.example/", "/a//b", "/a/../b", "http://evil.example/"])
def test_no_link_leads_elsewhere(server, stranger, path):
    answer = stranger.get(f"{path}?token={server.access.token}")
    assert answer.status == 404 and "Location" not in answer.headers


def test_nothing_but_the_page_is_read_from_visers_folder(operator):
    for path in ("/index.html", "/../package.json", "/%2e%2e/package.json", "/.git", "/x"):
        assert operator.get(path).status == 404
    with pytest.raises(InvalidStatus):
        operator.open("/elsewhere")


def test_every_answer_keeps_out_of_other_pages_and_of_caches(operator, stranger):
    for answer in (operator.get("/"), stranger.get("/"), operator.get("/none"), operator.get("/?x=1")):
        headers = answer.headers
        assert headers["X-Frame-Options"] == "DENY" and headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Referrer-Policy"] == "no-referrer" and headers["Cache-Control"] == "no-store"
        policy = headers["Content-Security-Policy"]
        assert "frame-ancestors 'none'" in policy and "default-src 'none'" in policy
        assert "unsafe-inline" not in policy.partition("script-src")[2].partition(";")[0]


def test_other_methods_and_half_requests_end_without_noise(operator, caplog):
    with caplog.at_level(logging.INFO):
        for text in (b"POST / HTTP/1.1\r\nContent-Length: 3\r\n\r\nabc", b"GET /\r\n\r\n", b"\x16\x03\x01\x02\x00"):
            with socket.create_connection(("127.0.0.1", operator.server.port)) as raw:
                raw.sendall(text)
                raw.shutdown(socket.SHUT_WR)
                raw.settimeout(3)
                assert b"200 OK" not in raw.recv(1000)
        assert operator.get("/").status == 200
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_whoever_asks_for_nothing_is_let_go(server, monkeypatch):
    monkeypatch.setattr(connection, "REQUEST_SECONDS", 0.1)
    with socket.create_connection(("127.0.0.1", server.port)) as idle:
        idle.sendall(b"GET / HTTP/1.1\r\n")
        idle.settimeout(2)
        with contextlib.suppress(ConnectionError):
            assert idle.recv(100) == b""


def test_an_ipv6_address_is_one_too():
    try:
        server = serve("::1", port=0)
    except SlviewerError:
        pytest.skip("this machine has no IPv6")
    try:
        assert server.loopback and server.url.startswith(f"http://[::1]:{server.port}/?token=")
        with socket.create_connection(("::1", server.port)) as raw:
            path = server.url.partition(f":{server.port}")[2]
            raw.sendall(f"GET {path} HTTP/1.1\r\nHost: [::1]:{server.port}\r\n\r\n".encode())
            assert raw.recv(100).startswith(b"HTTP/1.1 303")
    finally:
        server.stop()


def test_a_taken_port_is_an_error_at_once(server):
    start = time.monotonic()
    with pytest.raises(SlviewerError, match="--port"):
        serve(port=server.port)
    assert time.monotonic() - start < 2


@pytest.mark.parametrize("host", ["203.0.113.7", "no.such.host.invalid", "", "::1::2", "127.0.0.1:8080"])
def test_an_unusable_address_is_an_error_at_once(host):
    start = time.monotonic()
    with pytest.raises(SlviewerError):
        serve(host, port=0)
    assert time.monotonic() - start < 2


def test_a_slow_name_server_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: time.sleep(3) or [])
    start = time.monotonic()
    with pytest.raises(SlviewerError, match=r"127\.0\.0\.1"):
        serve("slow.example", port=0)
    assert time.monotonic() - start < 2


def test_it_serves_this_machine_alone_unless_told(server):
    assert server.host == "127.0.0.1" and server.loopback
    assert server.url.startswith(f"http://127.0.0.1:{server.port}/?token=")
    others = [info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)]
    for address in {one for one in others if not one.startswith("127.")}:
        with pytest.raises(OSError):
            socket.create_connection((address, server.port), timeout=0.5)


def test_tokens_are_long_and_two():
    access = Access(1, None, None)
    assert len(access.token) >= 32 and access.token != access.view_token
    assert (access.role_of(access.token), access.role_of(access.view_token)) == ("operator", "viewer")
    assert access.role_of("") is None and access.role_of("\udce9") is None
    with pytest.raises(UsageError):
        Access(1, "short", None)
    with pytest.raises(UsageError):
        Access(1, "T" * 20, "T" * 20)
    with pytest.raises(UsageError):
        Access(1, "T" * 20 + "; Path=/", None)


def test_on_a_network_it_answers_to_its_address_its_name_and_those_given():
    access = Access(8080, None, None, ("scanner.lab", "scan.example:443"))

    def answers(host: str, local: str) -> bool:
        from websockets.datastructures import Headers

        try:
            return bool(access.host(Headers({"Host": host}), local))
        except Exception:
            return False

    assert answers("192.0.2.5:8080", "192.0.2.5") and answers("[2001:db8::1]:8080", "2001:db8::1")
    assert answers("192.0.2.5:8080", "::ffff:192.0.2.5") and answers("SCANNER.lab:8080", "192.0.2.5")
    assert answers("scan.example:443", "192.0.2.5") and answers(f"{socket.gethostname()}:8080", "192.0.2.5")
    assert not answers("192.0.2.6:8080", "192.0.2.5") and not answers("localhost:8080", "192.0.2.5")
    assert not answers("scanner.lab.evil:8080", "192.0.2.5")
