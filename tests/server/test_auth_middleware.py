"""Who is let in: every access that viser leaves open is tried."""

import contextlib
import http.server
import logging
import os
import socket
import threading
import time

import pytest
from clocks import HANG_S, SteppingClock, until
from facts import missing_facts, raises
from playwright.sync_api import ViewportSize
from server_client import Browser
from websockets.exceptions import InvalidStatus

from slviewer.errors import SlviewerError, UsageError
from slviewer.server import binding, connection, secure
from slviewer.server.access import (
    ONE_TIME_SECONDS,
    ROLES,
    WRONG_TOKENS,
    WRONG_TOKENS_SECONDS,
    Access,
    Refusal,
)
from slviewer.server.auth_middleware import DevicePage
from slviewer.server.credentials import load_tokens
from slviewer.server.secure import Serving, serve

EVIL = "http://evil.example"
SMALL: ViewportSize = {"width": 320, "height": 240}
"""Of windows whose pictures nobody looks at."""


@pytest.mark.parametrize("role", ROLES)
def test_a_link_is_exchanged_for_a_cookie_of_its_own_path(server, stranger, role):
    origin, _, token = server.link(role).partition("/#")
    assert origin == server.origin and "?" not in server.link(role)
    answer = stranger.log_in(token)
    cookie, grant = answer.headers["Set-Cookie"], server.access.grants[role]
    assert (
        f"slviewer_{server.port}_{role}=" in cookie
        and f"Path=/{role}-" in cookie
        and "Secure" not in cookie
    )
    assert (
        "HttpOnly" in cookie
        and "SameSite=Strict" in cookie
        and "no-store" in answer.headers["Cache-Control"]
    )
    assert (
        token not in cookie
        and token not in str(answer.headers)
        and token.encode() not in answer.content
    )
    assert stranger.path == f"{grant.path}/"
    if role not in ("project", "camera"):
        assert b"<title>Viser</title>" in stranger.get().content
        assert stranger.open().close() is None


def test_one_browser_holds_the_cookies_of_all_roles(browser, server):
    context = browser.new_context(viewport=SMALL)
    operating, watching = context.new_page(), context.new_page()
    requests = []
    context.on("request", lambda request: requests.append(request))
    for page, role in ((operating, "operate"), (watching, "watch")):
        page.goto(server.link(role))
        page.wait_for_url(f"**/{role}-*/")
        assert server.access.grants[role].token not in page.content() + page.title()
    assert until(
        lambda: (
            {server.role(client) for client in server.viser.get_clients()} == {"operate", "watch"}
        )
    )
    assert operating.url == f"{server.origin}{server.access.grants['operate'].path}/"
    operating.reload()
    # a page that is hidden may not draw, and what has not drawn is no client
    operating.bring_to_front()
    assert until(
        lambda: "operate" in {server.role(client) for client in server.viser.get_clients()}
    )
    grants = [server.access.grants[role] for role in ("operate", "watch")]
    assert {cookie["path"] for cookie in context.cookies()} == {grant.path for grant in grants}
    sent = [r.url.partition("#")[0] + r.headers.get("referer", "") for r in requests]
    assert not [one for one in sent for grant in grants if grant.token in one]
    bare = context.new_page()  # the bare address leads on to where the last link led
    bare.goto(server.origin)
    bare.wait_for_url("**/watch-*/", wait_until="commit")
    context.close()


def test_another_server_of_this_machine_is_sent_no_cookie(browser, server):
    received = []

    class Thief(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            received.append(self.headers["Cookie"])
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_):
            pass

    thief = http.server.HTTPServer(("127.0.0.1", 0), Thief)
    threading.Thread(target=thief.serve_forever, daemon=True).start()
    context = browser.new_context(viewport=SMALL)
    page = context.new_page()
    try:
        page.goto(server.link())
        page.wait_for_url("**/operate-*/", wait_until="commit")
        assert context.cookies()
        page.evaluate(f"location.href = 'http://127.0.0.1:{thief.server_port}/operate'")
        assert until(lambda: received) and not any(received)
    finally:
        context.close()
        thief.shutdown()
        thief.server_close()


def test_a_pasted_link_opens_the_page_and_a_wrong_one_says_why(browser, server):
    context = browser.new_context(viewport=SMALL)
    page = context.new_page()
    page.goto(server.origin)
    page.get_by_label("Link").fill("x" * 32)
    page.get_by_role("button", name="Open").click()
    page.get_by_text("not, or no longer, valid").wait_for()
    page.get_by_label("Link").fill(server.link())
    page.get_by_role("button", name="Open").click()
    page.wait_for_url("**/operate-*/", wait_until="commit")
    context.clear_cookies()
    page.reload()
    page.get_by_text("no longer valid").wait_for()
    context.close()


def test_a_one_time_link_opens_once(server, stranger):
    token = server.one_time_link().partition("#")[2]
    assert server.access.is_pending(token)
    assert stranger.log_in(token).status == 200 and stranger.path.startswith("/operate-")
    assert stranger.log_in(token).status == 403 and not server.access.is_pending(token)


def test_a_one_time_link_expires(monkeypatch):
    clock = SteppingClock()
    monkeypatch.setattr("slviewer.server.access.monotonic", clock.now)
    rules = Access(1)
    early, late = rules.issue_one_time_token(), rules.issue_one_time_token()
    clock.sleep(ONE_TIME_SECONDS - 1)
    assert rules.is_pending(early) and rules.exchange(early, "192.0.2.1").role == "operate"
    clock.sleep(2)
    assert not rules.is_pending(late)
    with pytest.raises(Refusal) as refused:
        rules.exchange(late, "192.0.2.1")
    assert refused.value.status == 403


def test_wrong_tokens_are_limited_and_lock_out_no_random_one(monkeypatch):
    clock = SteppingClock()
    monkeypatch.setattr("slviewer.server.access.monotonic", clock.now)
    rules = Access(1, {"watch": "aaaaaaaaaaaaaaaa"})
    statuses = []
    for n in range(WRONG_TOKENS + 2):
        with pytest.raises(Refusal) as refused:
            rules.exchange(f"guess number {n}", "192.0.2.1")
        statuses.append(refused.value.status)
    assert statuses == [403] * WRONG_TOKENS + [429] * 2
    with pytest.raises(Refusal):  # what a person chose may be guessed
        rules.exchange("aaaaaaaaaaaaaaaa", "192.0.2.1")
    assert rules.exchange(rules.grants["operate"].token, "192.0.2.1").role == "operate"
    assert rules.exchange("aaaaaaaaaaaaaaaa", "192.0.2.2").role == "watch"
    clock.sleep(WRONG_TOKENS_SECONDS - 1)
    with pytest.raises(Refusal):
        rules.exchange("aaaaaaaaaaaaaaaa", "192.0.2.1")
    clock.sleep(2)
    assert rules.exchange("aaaaaaaaaaaaaaaa", "192.0.2.1").role == "watch"


def test_new_links_end_all_that_the_old_ones_opened(operator_server, monkeypatch):
    server = operator_server
    browsers = {role: Browser(server, role) for role in ("operate", "watch")}
    asking, other, watching = (
        browsers["operate"].client(),
        browsers["operate"].client(),
        browsers["watch"].client(),
    )
    old = {role: grant.token for role, grant in server.access.grants.items()}
    monkeypatch.setattr(secure, "LEAVING_SECONDS", 1.0)
    server.renew_links(asking.number)
    for client in (other, watching):
        client.thread.join(HANG_S)
        assert not client.thread.is_alive()
    assert until(lambda: any(m["type"] == "RunJavascriptMessage" for m in asking.received))
    (script,) = (m["source"] for m in asking.received if m["type"] == "RunJavascriptMessage")
    once = script.partition("#")[2].rstrip('")')
    asking.thread.join(HANG_S)
    assert not asking.thread.is_alive()  # whether or not it went on to its new page
    for role, browser in browsers.items():
        assert browser.get().status == 403 and browser.log_in(old[role]).status == 403
        assert (
            browser.log_in(server.access.grants[role].token).status == 200
            and browser.get().status == 200
        )
    assert Browser(server, None).log_in(once).status == 200


@pytest.fixture
def operator_server(tmp_path):
    server = serve(Serving(port=0, token_file=tmp_path / "tokens.toml"))
    yield server
    server.stop()


def test_tokens_stay_in_a_file_that_nobody_else_reads(operator_server, tmp_path):
    file = tmp_path / "tokens.toml"
    assert file.stat().st_mode & 0o777 == 0o600
    assert load_tokens(file) == {
        role: grant.token for role, grant in operator_server.access.grants.items()
    }
    operator_server.renew_links(0)
    assert load_tokens(file)["operate"] == operator_server.access.grants["operate"].token
    assert file.stat().st_mode & 0o777 == 0o600
    file.chmod(0o644)
    with raises(UsageError, "chmod 600"):
        load_tokens(file)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "operate = 5",
        "other = 'x'",
        "operate",
        "a = [" + "[" * 3000,
        "\xff",
        "operate = 'short'",
    ],
)
def test_a_file_of_no_tokens_is_refused(tmp_path, content):
    file = tmp_path / "tokens.toml"
    file.write_text(content)
    file.chmod(0o600)
    with pytest.raises(UsageError):
        serve(Serving(port=0, token_file=file))


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_secrets_are_read_from_regular_files_alone(tmp_path, kind):
    file = tmp_path / "tokens.toml"
    if kind == "pipe":
        os.mkfifo(file, 0o600)
    elif kind == "device":
        file.symlink_to("/dev/zero")
    else:
        file.mkdir(0o700)
    with pytest.raises(UsageError):
        serve(Serving(port=0, token_file=file))
    with raises(SlviewerError, "PEM"):
        serve(Serving(port=0, tls_files=(file, file)))


def test_health_is_answered_without_a_link_and_discloses_nothing(server, stranger):
    answer = stranger.get("/healthz")
    assert (answer.status, answer.content) == (204, b"") and not {"Set-Cookie", "Server"} & set(
        answer.headers
    )
    assert stranger.get("/healthz", Origin=EVIL).status == 403
    assert stranger.get("/healthz?x").status == 400 and stranger.get("/healthz/x").status == 403


ROUTES = {
    "": {"operate": 200, "watch": 200, "project": 200, "camera": 200},
    "favicon.ico": {"operate": 204, "watch": 204, "project": 204, "camera": 204},
    "projector": {"operate": 303, "watch": 404, "project": 404, "camera": 404},
    "camera": {"operate": 303, "watch": 404, "project": 404, "camera": 404},
    "download/{offered}": {"operate": 200, "watch": 200, "project": 404, "camera": 404},
    "download/x": {"operate": 404, "watch": 404, "project": 404, "camera": 404},
    "login": {"operate": 404, "watch": 404, "project": 404, "camera": 404},
    "x": {"operate": 404, "watch": 404, "project": 404, "camera": 404},
}
"""Statuses of what stands below the path of each role."""


@pytest.mark.parametrize("role", ROLES)
def test_every_route_of_every_role(server, stranger, role, tmp_path):
    async def handle(connection):
        await connection.send(f"{connection.role} page")

    (tmp_path / "a.txt").write_text("a")
    offered = server.downloads.offer(tmp_path / "a.txt", within=tmp_path).partition("/")[2]
    server.device_pages.update(
        {device: DevicePage(b"page", handle) for device in ("project", "camera")}
    )
    mine = Browser(server, role)
    for route, statuses in ROUTES.items():
        path = route.format(offered=offered)
        assert mine.get(path).status == statuses[role], (route, role)
        stranger.path = mine.path
        assert stranger.get(path).status == 403, "the path alone opens nothing"
        for other in ROLES:
            if other != role:
                theirs = Browser(server, other)
                theirs.path = mine.path
                assert theirs.get(path).status == 403, "nor does the cookie of another role"
                with pytest.raises(InvalidStatus):
                    theirs.open(path)
        if path:
            with pytest.raises(InvalidStatus):
                mine.open(path)
    with mine.open() as socket_:
        if role in ("project", "camera"):
            assert socket_.recv(HANG_S) == f"{role} page"
    server.device_pages.clear()


@pytest.mark.parametrize(
    "path", ["/index.html", "/projector", "/download/x", "/../../etc/passwd", "/%2e%2e/x", "/login"]
)
def test_without_a_token_there_is_nothing_to_see(stranger, path):
    answer = stranger.get(path)
    assert answer.status in (401, 403, 404) and len(answer.content) < 200


def test_the_page_that_takes_a_link_holds_no_secret(server, stranger):
    content = stranger.get("/").content.decode()
    for grant in server.access.grants.values():
        assert not any(one in content for one in (grant.token, grant.value, grant.path))


@pytest.mark.parametrize("cookie", ["", "wrong", "é", "T" * 200])
def test_a_wrong_cookie_opens_nothing(server, stranger, cookie):
    grant = server.access.grants["operate"]
    stranger.path = f"{grant.path}/"
    stranger.cookie = f"{grant.cookie_name}={cookie}".encode().decode("latin-1")
    assert stranger.get().status == 403
    with pytest.raises(InvalidStatus) as refused:
        stranger.open()
    assert refused.value.response.status_code == 403


def test_the_refusal_says_what_to_do(stranger):
    assert missing_facts(stranger.get("/x").content.decode(), "open", "link") == []


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:{port}", "127.0.0.1:1", "127.0.0.1", "localhost.evil:{port}"],
)
def test_a_rebound_host_name_is_refused(operator, host):
    name = host.format(port=operator.server.port)
    assert operator.get("", Host=name).status == 421
    with pytest.raises(InvalidStatus) as refused:
        operator.open(host=name, origin=f"http://{name}")
    assert refused.value.response.status_code == 421


def test_localhost_is_this_host_too(operator):
    operator.host = f"localhost:{operator.server.port}"
    assert operator.get("").status == 200


def test_two_hosts_are_none(operator):
    with socket.create_connection(("127.0.0.1", operator.server.port)) as raw:
        raw.sendall(operator.raw_request().replace(b"\r\n", b"\r\nHost: evil\r\n", 1))
        assert b"421" in raw.recv(100)


@pytest.mark.parametrize(
    "origin", [EVIL, "null", None, "http://127.0.0.1:1", "http://localhost:{port}.evil", ""]
)
def test_another_pages_websocket_is_refused_even_with_the_cookie(operator, origin):
    with pytest.raises(InvalidStatus) as refused:
        operator.open(origin=origin)
    assert refused.value.response.status_code == 403


def test_another_pages_request_is_refused_even_with_the_cookie(operator):
    assert operator.get("", Origin=EVIL).status == 403
    # another port of this machine is the same site, so that the strict cookie is sent along
    assert (
        operator.get(
            "", Sec_Fetch_Site="same-site", Sec_Fetch_Mode="no-cors", Sec_Fetch_Dest="script"
        ).status
        == 403
    )
    assert (
        operator.get(
            "", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate", Sec_Fetch_Dest="iframe"
        ).status
        == 403
    )
    assert (
        operator.get(
            "", Sec_Fetch_Site="same-origin", Sec_Fetch_Mode="cors", Sec_Fetch_Dest="empty"
        ).status
        == 200
    )


@pytest.mark.parametrize(
    "query", ["websocket=ws://evil", "playbackPath=http://evil/x.viser", "token={token}", "x", ""]
)
def test_addresses_take_no_parameters(operator, query):
    token = operator.server.access.grants["operate"].token
    for path in ("", "/", "/login"):
        answer = operator.get(f"{path}?{query.format(token=token)}")
        assert answer.status == 400 and "Set-Cookie" not in answer.headers
    if query:
        with pytest.raises(InvalidStatus):
            operator.open(f"?{query}")


@pytest.mark.parametrize(
    "path", ["//evil.example/", "/\\evil.example/", "/a//b", "/a/../b", "http://evil.example/"]
)
def test_no_address_leads_elsewhere(stranger, path):
    answer = stranger.get(path)
    assert answer.status == 404 and "Location" not in answer.headers


def test_nothing_but_the_page_is_read_from_visers_folder(operator):
    for path in ("index.html", "../package.json", "%2e%2e/package.json", ".git", "x"):
        assert operator.get(path).status == 404
    with pytest.raises(InvalidStatus):
        operator.open("elsewhere")


def test_every_answer_keeps_out_of_other_pages_and_of_caches(operator, stranger):
    for answer in (operator.get(""), stranger.get("/"), operator.get("none"), operator.get("?x=1")):
        headers = answer.headers
        assert (
            headers["X-Frame-Options"] == "DENY" and headers["X-Content-Type-Options"] == "nosniff"
        )
        assert (
            headers["Referrer-Policy"] == "no-referrer" and headers["Cache-Control"] == "no-store"
        )
        policy = headers["Content-Security-Policy"]
        assert "frame-ancestors 'none'" in policy and "default-src 'none'" in policy
        assert "unsafe-inline" not in policy.partition("script-src")[2].partition(";")[0]


def test_other_methods_and_half_requests_end_without_noise(operator, caplog):
    with caplog.at_level(logging.INFO):
        for text in (
            b"POST / HTTP/1.1\r\nContent-Length: 3\r\n\r\nabc",
            b"GET /\r\n\r\n",
            b"\x16\x03\x01\x02\x00",
        ):
            with socket.create_connection(("127.0.0.1", operator.server.port)) as raw:
                raw.sendall(text)
                raw.shutdown(socket.SHUT_WR)
                raw.settimeout(HANG_S)
                assert b"200 OK" not in raw.recv(1000)
        assert operator.get("").status == 200
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_whoever_asks_for_nothing_is_let_go(monkeypatch):
    monkeypatch.setattr(connection, "REQUEST_SECONDS", 0.1)
    server = serve(Serving(port=0))
    try:
        with socket.create_connection(("127.0.0.1", server.port), timeout=HANG_S) as idle:
            idle.sendall(b"GET / HTTP/1.1\r\n")
            with contextlib.suppress(ConnectionError):
                assert idle.recv(100) == b""
    finally:
        server.stop()


def test_an_ipv6_address_is_one_too():
    try:
        server = serve(Serving("::1", 0))
    except SlviewerError:
        pytest.skip("this machine has no IPv6")
    try:
        assert server.loopback and server.link().startswith(f"http://[::1]:{server.port}/#")
        with socket.create_connection(("::1", server.port)) as raw:
            raw.sendall(f"GET / HTTP/1.1\r\nHost: [::1]:{server.port}\r\n\r\n".encode())
            assert raw.recv(100).startswith(b"HTTP/1.1 200")
    finally:
        server.stop()


def test_a_taken_port_is_an_error_at_once(server):
    start = time.monotonic()
    with raises(SlviewerError, "--port", server.port):
        serve(Serving(port=server.port))
    assert time.monotonic() - start < HANG_S


@pytest.mark.parametrize(
    "host", ["203.0.113.7", "no.such.host.invalid", "", "::1::2", "127.0.0.1:8080"]
)
def test_an_unusable_address_is_an_error_at_once(host):
    start = time.monotonic()
    with pytest.raises(SlviewerError):
        serve(Serving(host, 0))
    assert time.monotonic() - start < HANG_S


def test_a_slow_name_server_is_not_waited_for(monkeypatch):
    asked, answering, answered = threading.Event(), threading.Event(), []

    def look_up(*_: object, **__: object) -> list:
        asked.set()
        answering.wait(HANG_S)
        answered.append("slow.example")
        return []

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setattr(binding, "RESOLVE_SECONDS", 0.1)
    with raises(SlviewerError, "slow.example", "127.0.0.1"):
        serve(Serving("slow.example", 0))
    assert asked.wait(HANG_S) and not answered
    answering.set()
    assert until(lambda: answered)


def test_it_serves_this_machine_alone_unless_told(server):
    assert server.serving.host == "127.0.0.1" and server.loopback
    assert server.link().startswith(f"http://127.0.0.1:{server.port}/#")
    others = [info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)]
    for address in {one for one in others if not one.startswith("127.")}:
        with pytest.raises(OSError):
            socket.create_connection((address, server.port), timeout=0.5)


def test_tokens_are_long_and_differ():
    grants = Access(1).grants.values()
    assert all(len(grant.token) >= 32 for grant in grants)
    assert len(
        {one for grant in grants for one in (grant.token, grant.value, grant.path)}
    ) == 3 * len(ROLES)
    for token in ("", "\udce9", "x" * 300):
        with pytest.raises(Refusal):
            Access(1).exchange(token, "127.0.0.1")
    for tokens in (
        {"operate": "short"},
        {"operate": "T" * 20, "watch": "T" * 20},
        {"watch": "T" * 20 + "; Path=/"},
    ):
        with pytest.raises(UsageError):
            Access(1, tokens)


def test_on_a_network_it_answers_to_its_address_its_name_and_those_given():
    rules = Access(8080, names=("scanner.lab", "scan.example:443"))

    def answers(host: str, local: str) -> bool:
        from websockets.datastructures import Headers

        try:
            return bool(rules.host(Headers({"Host": host}), local))
        except Exception:
            return False

    assert answers("192.0.2.5:8080", "192.0.2.5") and answers("[2001:db8::1]:8080", "2001:db8::1")
    assert answers("192.0.2.5:8080", "::ffff:192.0.2.5") and answers(
        "SCANNER.lab:8080", "192.0.2.5"
    )
    assert answers("scan.example:443", "192.0.2.5") and answers(
        f"{socket.gethostname()}:8080", "192.0.2.5"
    )
    assert not answers("192.0.2.6:8080", "192.0.2.5") and not answers("localhost:8080", "192.0.2.5")
    assert not answers("scanner.lab.evil:8080", "192.0.2.5")
