"""Drivers by name: every file of this folder that holds a `DRIVER` is one, and plugins add
others."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec

import slviewer.devices
from slviewer.devices.protocols import Camera, Projector, Rig, Turntable
from slviewer.entry_points import PluginGroup, import_modules
from slviewer.errors import DeviceError, InputError


@dataclass(frozen=True)
class Driver:
    """A driver of devices; its factories take the driver's options, and import vendor packages when
    called.

    `what`: in a few words, what it drives. `packages`: how to install each package that must be
    importable, such as ``{"harvesters": "pip install 'slviewer[genicam]'"}``. A driver offers
    cameras, projectors, turntables, whole rigs (where both devices share something), or several of
    these. `page`: camera and projector are pages in a browser, and take the keyword `page`, the
    channel to it. `list_connected` returns a line per connected device.
    """

    name: str
    what: str
    needs: str = ""
    packages: Mapping[str, str] = field(default_factory=dict)
    camera: Callable[..., Camera] | None = None
    projector: Callable[..., Projector] | None = None
    rig: Callable[..., Rig] | None = None
    turntable: Callable[..., Turntable] | None = None
    page: bool = False
    list_connected: Callable[[], Sequence[str]] | None = None

    @property
    def missing(self) -> str:
        """What is missing on this machine and how to install it, in words; empty if the driver can
        be used."""
        return "; ".join(
            f"the package {package} is missing: {remedy}"
            for package, remedy in self.packages.items()
            if find_spec(package) is None
        )


@cache
def drivers() -> dict[str, Driver]:
    """Return all drivers by name, usable here or not; those of plugins last."""
    return builtin_drivers() | DRIVER_PLUGINS.usable()


@cache
def builtin_drivers() -> dict[str, Driver]:
    """Return the drivers of this folder by name."""
    modules = import_modules(slviewer.devices, "\nDRIVER = ")
    return {module.DRIVER.name: module.DRIVER for module in modules}


DRIVER_PLUGINS = PluginGroup("slviewer.drivers", Driver, builtin_drivers)


def available() -> list[Driver]:
    """List all drivers, those that can be used here first; `needs` and `missing` name what the
    others require."""
    return sorted(drivers().values(), key=lambda driver: (bool(driver.missing), driver.name))


def driver(name: str) -> Driver:
    """Return the driver called `name`. Raises InputError if there is none, DeviceError if it lacks
    a package."""
    if name not in drivers():
        why = DRIVER_PLUGINS.explain_missing(name)
        raise InputError(
            f"no driver is called {name!r}", f"use one of {', '.join(sorted(drivers()))}{why}"
        )
    selected = drivers()[name]
    if selected.missing:
        raise DeviceError(f"the driver {name} cannot be used here, {selected.missing}")
    return selected
