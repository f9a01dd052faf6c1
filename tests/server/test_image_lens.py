"""The lens over the live image states the camera's pixel and the grey level under the pointer."""

import base64
import re

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from slviewer.server.viser_internals import PAGE_SCRIPT

PAGE = """<body style="margin:0"><div><div data-live="small" data-camera-px="1280"></div></div><div
><img id="live" width="160" height="120" style="display:block"></div>
<img id="small" data-zoom width="60" height="60" style="object-fit:cover"><img id="plot" width="60">
<script>%s</script><script>
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [320, 240];
  const context = canvas.getContext("2d");
  const fill = (colour, ...box) => { context.fillStyle = colour; context.fillRect(...box); };
  fill("rgb(30,30,30)", 0, 0, 320, 240);
  fill("rgb(200,200,200)", 100, 60, 100, 100);
  fill("rgb(255,0,80)", 240, 60, 40, 40);
  for (const image of document.images) image.src = canvas.toDataURL();
</script>"""


@pytest.mark.parametrize("dtype", ["<u1", "<u2"])
def test_the_lens_reads_the_pixels_of_the_stored_frame(browser: Browser, dtype: str) -> None:
    page = browser.new_page()
    page.set_content(PAGE % PAGE_SCRIPT.decode())
    frame = np.arange(240 * 320).reshape(240, 320).astype(dtype)
    content = base64.b64encode(frame.tobytes() + b"crc.").decode()
    page.locator("#small").evaluate(
        """(image, given) => Object.assign(image.dataset, given)""",
        {
            "frame": f"data:application/octet-stream;base64,{content}",
            "width": "320",
            "bytes": str(frame.itemsize),
        },
    )
    page.locator("#small").hover()
    x, y = 160, 120  # its middle; 4 px of the frame are one of the page
    lens = page.locator("#image-lens")
    expect(lens).to_have_text(re.compile(r"^x 1\d\d, y 1\d\d px: grey level \d+$"))
    found = [int(each) for each in re.findall(r"\d+", lens.inner_text())]
    assert abs(found[0] - x) <= 4 and abs(found[1] - y) <= 4
    assert found[2] == frame[found[1], found[0]]
    page.close()


def test_the_lens_states_pixel_and_grey_level(browser: Browser) -> None:
    page = browser.new_page()
    page.set_content(PAGE % PAGE_SCRIPT.decode())
    lens = page.locator("#image-lens")
    box = page.locator("#live").bounding_box()
    assert box is not None
    for at, words in {
        # twice the size on the page, and a quarter of the camera's
        (20, 10): "x 160, y 80 px: grey level about 30 of 255",
        (60, 50): "x 480, y 400 px: grey level about 200 of 255",
        (130, 40): "x 1040, y 320 px: covered by a mark",
    }.items():
        page.mouse.move(box["x"] + at[0], box["y"] + at[1])
        expect(lens).to_have_text(words)
    page.locator("#small").hover()
    expect(lens).to_have_text(re.compile("^grey level about 200 of 255$"))
    page.locator("#plot").hover()
    expect(lens).to_have_count(0)
    page.close()


def test_the_size_of_a_live_image_stays_as_chosen_while_it_comes_and_goes(browser: Browser) -> None:
    page = browser.new_page()
    page.set_content(PAGE % PAGE_SCRIPT.decode())

    def show(image: int | None) -> str | None:
        """Write the marker as the server does; returns which size the page makes of it."""
        marker = "" if image is None else f'<div data-live="small" data-image="{image}"></div>'
        page.locator("div").first.evaluate("(place, text) => (place.innerHTML = text)", marker)
        shown = page.locator("[data-live]")
        return shown.get_attribute("data-live") if image is not None else None

    assert show(1) == "small"
    page.locator("#live").click()
    assert show(1) == "large"
    assert show(None) is None  # the rig is opened again, for example
    assert show(1) == "large" and show(2) == "small"  # each step has an image of its own
    page.locator("#live").press("Enter")
    assert [show(each) for each in (None, 2, 1)] == [None, "large", "large"]
    page.close()
