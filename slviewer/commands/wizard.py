"""The wizard in the browser."""

from collections.abc import Callable
from pathlib import Path

from tyro.conf import Positional


def wizard(
    session: Positional[Path | None] = None,
    rig: str = "",
    host: str = "127.0.0.1",
    port: int = 8080,
    no_browser: bool = False,
) -> Callable[[], None]:
    """Start the wizard in the browser: from an unknown rig to a merged mesh. Plain `slviewer` does the same.

    Args:
        session: Session folder, made if it does not exist; by default slviewer-session, here.
        rig: simulated (half resolution), simulated:0.25 and the like, or a driver's name; by default the one that the
            session remembers, else the simulated one.
        host: Address to serve at; any other than the default lets others on the network try.
        port: Port to serve at; 0 takes any free one.
        no_browser: Print the address, and open no browser.
    """

    def start() -> None:
        """Run the wizard in the browser."""
        from slviewer.gui.app import run

        run(session, rig, host, port, open_browser=not no_browser)

    return start
