"""Which drivers there are, what each finds connected, and what it would need."""

from slviewer.devices.drivers import available
from slviewer.errors import SlviewerError
from slviewer.pipeline.rig_choice import rigs


def devices() -> str:
    """List the drivers: which can be used here, what is connected, what each needs, and the rigs to
    choose from."""
    blocks = []
    for driver in available():  # those that can be used here first
        parts = ("camera", "projector", "turntable", "rig")
        offers = ", ".join(part for part in parts if getattr(driver, part) is not None)
        lines = [
            f"{driver.name} ({offers}): {driver.what}",
            f"  cannot be used here, {driver.missing}" if driver.missing else "  can be used",
        ]
        if driver.needs:
            lines.append(f"  needs {driver.needs}")
        if driver.list_connected is not None and not driver.missing:
            try:
                connected = driver.list_connected() or ["no device"]
                lines += [f"  connected: {line}" for line in connected]
            except Exception as error:  # a broken library of a maker must not hide other devices
                kind = "" if isinstance(error, SlviewerError) else f" ({type(error).__name__})"
                lines.append(f"  could not look for what is connected: {error}{kind}")
        blocks.append("\n".join(lines))
    return "\n".join([*blocks, rigs()])
