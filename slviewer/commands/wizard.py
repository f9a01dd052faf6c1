"""The wizard in the browser."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from slviewer.commands.command import Work


@dataclass(frozen=True)
class Address:
    """Where and how to serve the page.

    Args:
        host: Address to serve at; any other than the default lets others on the network try.
        port: Port to serve at; 0 takes any free one.
        name: Further host names under which browsers reach this server, such as scanner.lab, behind
            a proxy.
        tls: Encrypt, with a certificate that slviewer makes; its fingerprint is printed.
        tls_files: Encrypt, with this certificate and this key (PEM files).
        token_file: TOML file with the tokens of the links, which so stay the same; made if it does
            not exist.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    name: tuple[str, ...] = ()
    tls: bool = False
    tls_files: tuple[Path, Path] | None = None
    token_file: Path | None = None


def wizard(
    session: Positional[Path | None] = None,
    rig: str = "",
    address: Address = Address(),
    no_browser: bool = False,
) -> Work:
    """Start the wizard in the browser: from an unknown rig to a merged mesh. Plain `slviewer` does
    the same.

    Args:
        session: Session folder, made if it does not exist; by default slviewer-session, here.
        rig: simulated (half resolution), simulated:0.25 or a driver; by default that of the
            session, else simulated.
        address: Where and how to serve the page.
        no_browser: Print the address, and open no browser.
    """

    def start() -> None:
        """Run the wizard in the browser."""
        from slviewer.gui.app import run
        from slviewer.server.secure import Serving

        run(session, rig, Serving(*vars(address).values()), open_browser=not no_browser)

    return start
