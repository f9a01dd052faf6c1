"""Which drivers there are, what each finds connected, and what it would need."""

from dataclasses import dataclass

from slviewer.devices.drivers import Driver, available
from slviewer.errors import SlviewerError
from slviewer.pipeline.rig_choice import rigs


@dataclass(frozen=True)
class DriverView:
    """One driver: what it drives and offers ("camera", "projector", "turntable", "rig"), what is
    connected, a line each (None where nobody looked, and `trouble` may say why), what it needs, and
    what this machine lacks for it with how to install it, empty if nothing.
    """

    name: str
    what: str
    offers: tuple[str, ...]
    connected: tuple[str, ...] | None
    needs: str
    missing: str
    trouble: str = ""


def list_drivers() -> list[DriverView]:
    """All drivers, those that can be used here first."""
    return [_view_driver(driver) for driver in available()]


def devices() -> str:
    """List the drivers: which can be used here, what is connected, what each needs, and the rigs to
    choose from."""
    blocks = []
    for driver in list_drivers():
        lines = [f"{driver.name} ({', '.join(driver.offers)}): {driver.what}"]
        lines.append(
            f"  cannot be used here, {driver.missing}" if driver.missing else "  can be used"
        )
        if driver.needs:
            lines.append(f"  needs {driver.needs}")
        if driver.trouble:
            lines.append(f"  could not look for what is connected: {driver.trouble}")
        if driver.connected is not None:
            lines += [f"  connected: {line}" for line in driver.connected] or [
                "  connected: no device"
            ]
        blocks.append("\n".join(lines))
    return "\n".join([*blocks, rigs()])


def _view_driver(driver: Driver) -> DriverView:
    """Return a driver's entry of the list, with its connected devices or the error that listing
    them raised."""
    offers = tuple(
        part
        for part in ("camera", "projector", "turntable", "rig")
        if getattr(driver, part) is not None
    )
    connected, trouble = None, ""
    if driver.list_connected is not None and not driver.missing:
        try:
            connected = tuple(driver.list_connected())
        except SlviewerError as error:
            trouble = str(error)
        except (
            Exception
        ) as error:  # a maker's library that is broken must not hide the other drivers' devices
            trouble = f"{error} ({type(error).__name__})"
    return DriverView(
        driver.name, driver.what, offers, connected, driver.needs, driver.missing, trouble
    )
