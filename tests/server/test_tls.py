"""Encrypted: with a given certificate, or one that slviewer makes for itself."""

import hashlib
import http.client
import socket
import ssl
import sys

import pytest
from clocks import HANG_S, until
from facts import raises
from playwright.sync_api import Browser

from slviewer.errors import SlviewerError, UsageError
from slviewer.server import credentials
from slviewer.server.credentials import TlsCertificate, self_made_certificate
from slviewer.server.limits import MAX_UNAUTHENTICATED_PER_ADDRESS
from slviewer.server.secure import SafeServer, Serving, serve


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> TlsCertificate:
    return self_made_certificate("127.0.0.1", ("scanner.lab",), tmp_path_factory.mktemp("config"))


@pytest.fixture
def served(
    certificate: TlsCertificate, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
):
    """A server with this certificate: as the user's own, else as the one that slviewer made."""
    own = getattr(request, "param", False)
    monkeypatch.setattr(credentials, "_config_folder", lambda: certificate.chain.parent)
    files = (certificate.chain, certificate.key) if own else None
    server = serve(Serving(port=0, tls=not own, tls_files=files, names=("scanner.lab",)))
    yield server
    server.stop()


def ask(
    server: SafeServer, certificate: TlsCertificate, path: str, **headers: str
) -> http.client.HTTPResponse:
    context = ssl.create_default_context(cafile=str(certificate.chain))
    connection = http.client.HTTPSConnection(
        "127.0.0.1", server.port, timeout=HANG_S, context=context
    )
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer


@pytest.mark.parametrize("served", [False, True], indirect=True)
def test_the_cookie_is_for_encrypted_connections_alone(served, certificate, request):
    token = served.link().partition("#")[2]
    assert served.link().startswith(f"https://127.0.0.1:{served.port}/#")
    for name in ("127.0.0.1", "scanner.lab"):
        answer = ask(
            served,
            certificate,
            "/login",
            Authorization=f"Bearer {token}",
            Host=f"{name}:{served.port}",
        )
        assert answer.status == 200 and "; Secure" in answer.headers["Set-Cookie"]
    own = request.node.callspec.params["served"]
    assert ("Strict-Transport-Security" in answer.headers) == own, (
        "a self-made one would lock its host out later"
    )


def test_a_proxy_that_encrypts_has_secure_cookies_too(server, stranger):
    grant = server.access.grants["operate"]
    assert (
        "; Secure" in stranger.log_in(grant.token, X_Forwarded_Proto="https").headers["Set-Cookie"]
    )
    assert (
        "Secure" not in stranger.log_in(grant.token, X_Forwarded_Proto="http").headers["Set-Cookie"]
    )


def test_the_pages_work_encrypted(browser: Browser, served: SafeServer) -> None:
    context = browser.new_context(ignore_https_errors=True)
    page = context.new_page()
    page.goto(served.link())
    page.wait_for_url("https://**/operate-*/")
    assert until(served.viser.get_clients)
    (client,) = served.viser.get_clients()
    assert served.role(client) == "operate" and all(
        cookie["secure"] for cookie in context.cookies()
    )
    assert served.origin_of(client) == served.origin
    context.close()


def test_whoever_begins_no_handshake_keeps_nobody_out(served, certificate):
    crowd = [
        socket.create_connection(("127.0.0.1", served.port))
        for _ in range(3 * MAX_UNAUTHENTICATED_PER_ADDRESS)
    ]
    assert ask(served, certificate, "/").status == 200
    for one in crowd:
        one.close()


def test_plain_http_gets_no_answer_and_makes_no_noise(served, caplog):
    with socket.create_connection(("127.0.0.1", served.port), timeout=HANG_S) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert b"200" not in plain.recv(100)
    assert not caplog.records


def test_a_self_made_certificate_stays_the_same_until_it_does_not_fit(certificate, monkeypatch):
    folder = certificate.chain.parent
    again = self_made_certificate("127.0.0.1", ("SCANNER.lab:443",), folder)
    assert again == certificate and certificate.key.stat().st_mode & 0o777 == 0o600
    before = certificate.chain.read_bytes()
    der = ssl.PEM_cert_to_DER_cert(before.decode())
    assert certificate.fingerprint.replace(":", "").lower() == hashlib.sha256(der).hexdigest()
    assert self_made_certificate("192.0.2.7", (), folder).chain.read_bytes() != before


@pytest.mark.parametrize("name", ["ä.lab", "a b", "", "a/b", "::1", "x" * 300, "a:b", "*.lab"])
def test_a_name_that_no_browser_sends_is_refused(name):
    with raises(UsageError, "host name"):
        Serving(names=(name,))
    assert Serving(names=("Scanner.lab:8443", "xn--4ca.lab", "[::1]", "scan_1")).names


def test_files_that_are_no_certificate_are_refused_at_once(certificate, tmp_path):
    text = tmp_path / "text.pem"
    text.write_text("no certificate")
    for files in (
        (text, text),
        (certificate.chain, text),
        (tmp_path / "none", text),
        (certificate.key, certificate.key),
    ):
        with raises(SlviewerError, "PEM"):
            serve(Serving(port=0, tls_files=files))


def test_without_its_package_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with raises(SlviewerError, "slviewer[tls]"):
        serve(Serving(port=0, tls=True))
