"""The wizard's page as a person finds their way in it: by what stands there to be read."""

from playwright.sync_api import ConsoleMessage, Locator, Page

SIZE = {"width": 1280, "height": 800}


class Opened:
    """A page that remembers what went wrong in it."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.errors: list[str] = []
        page.on("console", self._heard)
        page.on("pageerror", lambda error: self.errors.append(str(error)))

    def _heard(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self.errors.append(message.text)


def button(page: Page, name: str) -> Locator:
    """The button that says so."""
    return page.get_by_role("button", name=name)


def field(page: Page, label: str) -> Locator:
    """The input beside this label: viser's labels are text, without a tie to their input."""
    return page.locator(f"xpath=//*[normalize-space(text())='{label}']/following::input[1]")
