"""Which drivers there are, what each finds connected, and what it would need."""

from dataclasses import dataclass

from slviewer.devices.drivers import Driver, available
from slviewer.errors import SlviewerError


@dataclass(frozen=True)
class DriverView:
    """One driver: what it drives and offers ("camera", "projector", "rig"), what is connected, a line each (None where
    it cannot look), what it needs, and what this machine lacks for it with how to install it, empty if nothing.
    """

    name: str
    what: str
    offers: tuple[str, ...]
    connected: tuple[str, ...] | None
    needs: str
    missing: str


def list_drivers() -> list[DriverView]:
    """All drivers, those that can be used here first. One that fails while it looks says so in place of a device."""
    return [
        DriverView(
            found.name,
            found.what,
            tuple(part for part in ("camera", "projector", "rig") if getattr(found, part) is not None),
            _connected(found),
            found.needs,
            found.missing,
        )
        for found in available()
    ]


def devices() -> str:
    """The same in words, for the terminal."""
    blocks = []
    for driver in list_drivers():
        lines = [f"{driver.name} ({', '.join(driver.offers)}): {driver.what}"]
        lines.append(f"  cannot be used here, {driver.missing}" if driver.missing else "  can be used")
        if driver.needs:
            lines.append(f"  needs {driver.needs}")
        if driver.connected is not None:
            lines += [f"  connected: {line}" for line in driver.connected] or ["  connected: nothing was found"]
        blocks.append("\n".join(lines))
    return "\n".join(blocks)


def _connected(driver: Driver) -> tuple[str, ...] | None:
    if driver.missing or driver.found is None:
        return None
    try:
        return tuple(driver.found())
    except SlviewerError as error:
        return (str(error),)
