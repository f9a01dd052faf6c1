"""Batches that wait together in a busy page are handed over as one, in their order, and none is lost."""

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from clocks import HANG_S
from playwright.sync_api import Browser

from slviewer.server.viser_internals import PAGE_SCRIPT, client_page

WORKER = """async () => {
  const request = function request(address) {
    const sent = new XMLHttpRequest();
    sent.open("GET", address, false);
    sent.send();
  };
  const text = `for (let i = 0; i < 20; i++)
    postMessage(i === 7 ? {type: "closed"} : {type: "message_batch", messages: [2 * i, 2 * i + 1]});
  ${request.toString()}
  request("${location.origin}/sent");`;
  const worker = new Worker(URL.createObjectURL(new Blob([text])));
  const arrived = [];
  let failed = false;
  window.onerror = () => (failed = true);
  const done = new Promise((all) => {
    worker.onmessage = ({ data }) => {
      arrived.push(data.type === "closed" ? "closed" : data.messages);
      if (arrived.flat().length === 39) all();
      if (data.type === "closed") throw new Error("in the page");
    };
  });
  request("/wait"); // the page is busy until the worker has sent all
  await done;
  return { arrived, failed };
}"""


@pytest.fixture
def address() -> Iterator[str]:
    """A server whose `/wait` is answered once `/sent` was requested."""
    sent = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path == "/sent":
                sent.set()
            elif self.path == "/wait":
                sent.wait(HANG_S)
            self.send_response(200)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    sent.set()
    server.shutdown()
    server.server_close()


def test_batches_that_wait_are_one_and_keep_their_order(browser: Browser, address: str) -> None:
    context = browser.new_context()
    page = context.new_page()
    page.goto(address)
    page.add_script_tag(content=PAGE_SCRIPT.decode())
    found = page.evaluate(WORKER)
    context.close()
    whole = [each for batch in found["arrived"] for each in (batch if isinstance(batch, list) else [batch])]
    assert whole == [*range(14), "closed", *range(16, 40)]
    assert 3 <= len(found["arrived"]) < 10  # of 20 that were sent
    assert found["failed"]  # the error was told, and what came after it was still handed over


def test_the_script_runs_before_visers_own() -> None:
    page = client_page()
    assert 0 < page.index(PAGE_SCRIPT) < page.index(b"<script data-p=")
