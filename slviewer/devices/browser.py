"""Devices that any computer or phone has: a screen as the projector, a camera, each through a page
in a browser."""

from dataclasses import dataclass, field
from typing import Literal, get_args

from slviewer.devices.browser_camera import BrowserCamera, CameraChannel
from slviewer.devices.browser_projector import ProjectorChannel, browser_projector
from slviewer.devices.drivers import Driver

PageRole = Literal["projector", "camera"]
"""The devices that may be pages in a browser."""
PAGE_ROLES: tuple[PageRole, ...] = get_args(PageRole)


@dataclass(frozen=True)
class PageChannels:
    """The channels to the pages of the browser's devices."""

    projector: ProjectorChannel = field(default_factory=ProjectorChannel)
    camera: CameraChannel = field(default_factory=CameraChannel)


DRIVER = Driver(
    "browser",
    "a page on a screen, phone or laptop",
    needs=(
        "the projector page, open in a browser on the projector's screen; the camera page, on the"
        " phone or laptop"
    ),
    camera=BrowserCamera,
    projector=browser_projector,
    page=True,
)
