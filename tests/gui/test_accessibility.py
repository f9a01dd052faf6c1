"""Each step can be read by screen readers and operated by the keyboard, in the light and the dark
theme."""

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect
from wizard_page import Opened, button, click, wait_until_still

STEPS = ["Rig", "Target", "Poses", "Calibrate", "Verify", "Scan", "Merge", "Measure", "Export"]


def find_violations(page: Page) -> dict[str, list[str]]:
    """Return {rule: elements} of what axe-core calls serious or critical."""
    found = Axe().run(page).response["violations"]
    return {
        each["id"]: [node["html"][:300] for node in each["nodes"]]
        for each in found
        if each["impact"] in ("serious", "critical")
    }


@pytest.mark.slow
def test_no_step_has_a_serious_fault_of_accessibility(opened: Opened) -> None:
    page, faults = opened.page, {}
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        page.locator(f"html[data-mantine-color-scheme={scheme}]").wait_for()
        for number, step in enumerate(STEPS, 1):
            click(page, f"{number}. {step}")
            wait_until_still(page)
            if find_violations(page):
                page.wait_for_timeout(1000)  # names follow a change of the page after 0.05 s
            if found := find_violations(page):
                faults[scheme, step] = found
    assert faults == {}


@pytest.mark.slow
def test_folders_open_by_the_keyboard(opened: Opened) -> None:
    page = opened.page
    click(page, "3. Poses")
    folder = button(page, "Import captures")
    expect(folder).to_have_attribute("aria-expanded", "false")
    folder.press("Enter")
    expect(button(page, "Import folder")).to_be_visible()
    expect(folder).to_have_attribute("aria-expanded", "true")
