"""Batches that wait together in a busy page are handed over as one, in their order, and none is
lost."""

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from clocks import HANG_S
from playwright.sync_api import Browser

from slviewer.server.viser_internals import PAGE_SCRIPT, client_page

WORKER = """async () => {
  const text = `onmessage = ({data: shared}) => {
    postMessage("ready");
    Atomics.wait(shared, 0, 0);
    for (let i = 0; i < 20; i++)
      postMessage(i === 7 ? {type: "closed"}
        : {type: "message_batch", messages: [2 * i, 2 * i + 1]});
    Atomics.store(shared, 1, 1);
  };`;
  const worker = new Worker(URL.createObjectURL(new Blob([text])));
  const [begin, sent] = [0, 1], shared = new Int32Array(new SharedArrayBuffer(8));
  worker.postMessage(shared);
  await new Promise((ready) => worker.addEventListener("message", ready, { once: true }));
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
  Atomics.store(shared, begin, 1);
  Atomics.notify(shared, begin);
  const end = performance.now() + HANG_MS;
  // the page is busy until the worker has sent all
  while (!Atomics.load(shared, sent) && performance.now() < end);
  await done;
  return { arrived, failed };
}""".replace("HANG_MS", f"{1000 * HANG_S:.0f}")


@pytest.fixture
def isolated_address() -> Iterator[str]:
    """The address of an empty page that may share memory with its workers."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", "0")
            self.send_header("Content-Type", "text/html")
            self.send_header("Cross-Origin-Opener-Policy", "same-origin")
            self.send_header("Cross-Origin-Embedder-Policy", "require-corp")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


def test_batches_that_wait_are_one_and_keep_their_order(
    browser: Browser, isolated_address: str
) -> None:
    context = browser.new_context()
    page = context.new_page()
    page.goto(isolated_address)
    page.add_script_tag(content=PAGE_SCRIPT.decode())
    found = page.evaluate(WORKER)
    context.close()
    whole = [
        each
        for batch in found["arrived"]
        for each in (batch if isinstance(batch, list) else [batch])
    ]
    assert whole == [*range(14), "closed", *range(16, 40)]
    assert 3 <= len(found["arrived"]) < 10  # of 20 that were sent
    assert found["failed"]  # the error was told, and what came after it was still handed over


def test_the_script_runs_before_visers_own() -> None:
    page = client_page()
    assert 0 < page.index(PAGE_SCRIPT) < page.index(b"<script data-p=")


NO_WEBGL = """
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...options) {
  return kind.startsWith("webgl") ? null : getContext.call(this, kind, ...options);
};
delete window.WebGLRenderingContext;
delete window.WebGL2RenderingContext;
"""
"""As where the browser's settings forbid it."""
LANGUAGE_C = """
Object.defineProperty(Navigator.prototype, "language", { get: () => "C" });
"""
"""As of WebKit where the system's locale is C."""


def test_without_webgl_what_draws_gets_a_stand_in_and_one_line_says_so(browser: Browser) -> None:
    page = browser.new_page()
    page.add_init_script(NO_WEBGL + LANGUAGE_C)
    page.goto("about:blank")
    page.add_script_tag(content=PAGE_SCRIPT.decode())
    drawn = page.evaluate(
        """() => {
          const gl = document.createElement("canvas").getContext("webgl2");
          const program = gl.createProgram();
          gl.linkProgram(program);
          const again = document.createElement("canvas").getContext("webgl2");
          return [gl.getProgramParameter(program, gl.LINK_STATUS), gl.drawArrays(gl.POINTS, 0, 3),
            gl.getParameter(gl.VERSION), gl === again, gl.canvas.getContext("webgl2") === gl,
            document.createElement("canvas").getContext("2d") !== null];
        }"""
    )
    assert drawn == [True, None, "WebGL 2.0", False, True, True]
    assert "WebGL" in page.get_by_role("status").inner_text()  # one line for both canvases
    assert page.evaluate("new Intl.NumberFormat(navigator.language).format(1.5)") == "1.5"
    page.close()


def test_the_page_is_as_it_is_where_nothing_is_missing(browser: Browser) -> None:
    page = browser.new_page(locale="de-DE")
    page.goto("about:blank")
    page.add_script_tag(content=PAGE_SCRIPT.decode())
    assert page.evaluate("navigator.language") == "de-DE"
    assert page.evaluate(
        "document.createElement('canvas').getContext('webgl2') instanceof WebGL2RenderingContext"
    )
    assert page.locator("#no-drawing").count() == 0
    page.close()
