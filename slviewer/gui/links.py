"""The links for other people and screens, shown to the operator's browser that requests them and to no other."""

import html
from collections.abc import Callable

import viser

from slviewer.gui.widgets import Html, paragraph, to_html
from slviewer.server.secure import SafeServer


def show_links(client: viser.ClientHandle, server: SafeServer, replace: Callable[[], None]) -> None:
    """Open a dialog with the links in one browser; `replace()` is called when new ones are requested in it."""
    origin = server.origin_of(client.client_id)
    rows = [("To watch, from any computer that reaches this address", server.link("watch", origin))]
    if server.projector.handler is not None:
        rows.append(("Projector page, on another computer", server.link("project", origin)))
    with client.gui.add_modal("Links") as dialog:
        gui = client.gui
        gui.add_html("".join(_link_html(what, link) for what, link in rows))
        gui.add_html(
            str(
                paragraph(
                    Html(
                        "<b>New links</b> closes every page that was opened by the present ones, for watching and of "
                        "the projector too. This page continues."
                    )
                )
            )
        )
        renew = gui.add_button("New links", icon=viser.Icon.REFRESH, color="red")
        close = gui.add_button("Close", color="gray")
    renew.on_click(lambda _: replace())
    close.on_click(lambda _: dialog.close())


def _link_html(what: str, link: str) -> Html:
    """Return the HTML of one link, selected by a click to be copied."""
    style = (
        "display:block;user-select:all;overflow-wrap:anywhere;padding:0.4em 0.6em;border-radius:4px;"
        "background:var(--mantine-color-gray-1);font-family:monospace;font-size:0.9em"
    )
    return paragraph(Html(f"{to_html(what)}:<code style='{style}'>{html.escape(link)}</code>"))
