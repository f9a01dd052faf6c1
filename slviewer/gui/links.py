"""The links for other people and devices, shown to the operator's browser that requests them and to
no other."""

import base64
import html
from collections.abc import Callable
from urllib.parse import urlsplit

import cv2
import viser

from slviewer.gui.panel import PanelContext
from slviewer.gui.widgets import Html, alert, paragraph, to_html
from slviewer.server.secure import SafeServer

_QUIET_ZONE = 4
"""White modules around a QR code (ISO/IEC 18004)."""


def show_links(
    context: PanelContext,
    print_links: Callable[[SafeServer], None],
    client: viser.ClientHandle | None,
) -> None:
    """Open a dialog with the links in the browser that requests them; None: it has disconnected.

    New ones that are requested in it are passed to `print_links`.
    """
    server, operator = context.server, context.operator
    if client is None:
        return
    number = client.client_id

    def replace(_: object) -> None:
        """Replace all links, and print the new ones."""
        try:
            server.renew_links(number)
            operator.notify(
                "info", "The links were replaced: pages opened by the old ones are closed"
            )
        except OSError as error:
            operator.notify(
                "error",
                f"The links were replaced, but {server.serving.token_file} holds the old tokens,"
                f" valid again after a restart ({error.strerror}): write new ones into it",
            )
        print_links(server)

    origin = server.origin_of(number)
    is_own = origin is not None and urlsplit(origin).hostname in ("127.0.0.1", "localhost", "::1")
    if is_own and not server.loopback:
        origin = server.shared_origin
    others_reach = not (is_own and server.loopback)
    rows = [("To watch, from any computer that reaches this address", server.link("watch", origin))]
    if server.device_pages:
        rows.append(("Projector page, on another computer", server.link("project", origin)))
        link = server.link("camera", origin)
        needs = "" if link.startswith("https:") else ", whose browsers demand --tls"
        rows.append((f"Camera page, on a phone or another computer{needs}", link))
    with client.gui.add_modal("Links") as dialog:
        gui = client.gui
        gui.add_html("".join(_link_html(what, link, others_reach) for what, link in rows))
        if not others_reach:
            advice = Html(
                "Only this computer reaches these links. For others, and phones, start slviewer"
                " with <code style='white-space:nowrap'>--host 0.0.0.0 --tls</code>."
            )
            gui.add_html(str(alert(advice, "info")))
        about = Html(
            "<b>New links</b> closes every page that was opened by the present ones, those of"
            " projector and camera too. This page continues."
        )
        gui.add_html(str(paragraph(about)))
        renew = gui.add_button("New links", icon=viser.Icon.REFRESH, color="red")
        close = gui.add_button("Close", color="gray")
    renew.on_click(replace)
    close.on_click(lambda _: dialog.close())


def _link_html(what: str, link: str, qr_code: bool) -> Html:
    """Return the HTML of one link, selected by a click to be copied, and its QR code for a
    phone."""
    style = (
        "display:block;user-select:all;overflow-wrap:anywhere;padding:0.4em"
        " 0.6em;border-radius:4px;"
        "background:var(--mantine-color-gray-1);font-family:monospace;font-size:0.9em;flex:1"
    )
    code = f"<code style='{style}'>{html.escape(link)}</code>"
    if qr_code:
        look = "width:7.5em;height:7.5em;image-rendering:pixelated;background:#fff"
        code += f"<img alt='QR code of this link' style='{look}' src='{encode_qr_code(link)}'>"
    row = "display:flex;gap:0.6em;align-items:center;margin-top:0.2em"
    return paragraph(Html(f"{to_html(what)}:<span style='{row}'>{code}</span>"))


def encode_qr_code(text: str) -> str:
    """Return the QR code of a text as the address of a PNG picture, a pixel a module."""
    modules = cv2.QRCodeEncoder.create().encode(text)
    # OpenCV adds some of it
    border = max(0, _QUIET_ZONE - int((modules == 0).any(axis=0).argmax()))
    modules = cv2.copyMakeBorder(modules, *(border,) * 4, cv2.BORDER_CONSTANT, value=255)
    png = cv2.imencode(".png", modules)[1].tobytes()
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"
