"""A wizard that nobody touches costs next to nothing."""

import time

import pytest
from playwright.sync_api import Browser
from wizard_page import Opened, click, wait_until_still

from slviewer.wizard.operator import Operator

pytestmark = [pytest.mark.computes, pytest.mark.slow]

REST_S = 10.0
MOST_SHARE = 0.03
"""Of one core, for server and page together."""
AWAKE_S = 22.0
"""For so long a page that was just opened draws whatever happens."""


def measure_browser_s(browser: Browser) -> float:
    """Return the s of processor time that all processes of a browser have taken."""
    session = browser.new_browser_cdp_session()
    return sum(each["cpuTime"] for each in session.send("SystemInfo.getProcessInfo")["processInfo"])


def test_idle_server_and_page_take_three_percent_of_a_core(
    opened: Opened, browser: Browser, operator: Operator
) -> None:
    page = opened.page
    operator.choose_target("circles:21x16:9")
    click(page, "3. Poses")
    wait_until_still(page)
    page.wait_for_timeout(1000 * AWAKE_S)
    begun, server_s, browser_s = time.monotonic(), time.process_time(), measure_browser_s(browser)
    page.wait_for_timeout(1000 * REST_S)
    busy_s = time.process_time() - server_s + measure_browser_s(browser) - browser_s
    share = busy_s / (time.monotonic() - begun)
    print(f"idle: {100 * share:.1f} % of a core")
    assert share < MOST_SHARE
    number = operator.preview()
    operator.place("plane")  # and what changes is shown
    page.wait_for_timeout(2000)
    assert operator.preview() is not number and opened.errors == []
