"""Batches that wait together in a busy page are handed over as one, in their order, and none is lost."""

from playwright.sync_api import Browser

from slviewer.server.viser_internals import PAGE_SCRIPT, client_page

WORKER = """async () => {
  const text = `for (let i = 0; i < 20; i++)
    postMessage(i === 7 ? {type: "closed"} : {type: "message_batch", messages: [2 * i, 2 * i + 1]});`;
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
  const until = performance.now() + 800;
  while (performance.now() < until);
  await done;
  return { arrived, failed };
}"""


def test_batches_that_wait_are_one_and_keep_their_order(browser: Browser) -> None:
    context = browser.new_context()
    page = context.new_page()
    page.add_script_tag(content=PAGE_SCRIPT.decode())
    found = page.evaluate(WORKER)
    context.close()
    whole = [each for batch in found["arrived"] for each in (batch if isinstance(batch, list) else [batch])]
    assert whole == [*range(14), "closed", *range(16, 40)]
    assert 3 <= len(found["arrived"]) < 10  # of 20 that were sent; a slow worker may send some after the page woke
    assert found["failed"]  # the error was told, and what came after it was still handed over


def test_the_script_runs_before_visers_own() -> None:
    page = client_page()
    assert 0 < page.index(PAGE_SCRIPT) < page.index(b"<script data-p=")
