"""Which plugins are installed, and whether each can be used."""

from slviewer.devices.drivers import DRIVER_PLUGINS
from slviewer.errors import InputError
from slviewer.session.importers.layouts import LAYOUT_PLUGINS
from slviewer.session.mesh_files import EXPORTER_PLUGINS
from slviewer.target.board import BOARD_PLUGINS


def plugins() -> str:
    """List the plugins: drivers, boards, importers and exporters that other packages add.

    Ends with status 1 where one cannot be used, and states why.
    """
    groups = (DRIVER_PLUGINS, BOARD_PLUGINS, LAYOUT_PLUGINS, EXPORTER_PLUGINS)
    found = [plugin for group in groups for plugin in group.plugins]
    if not found:
        return "no plugins are installed"
    lines = [
        f"{each.group.removeprefix('slviewer.')}: {each.name}, from {each.package}:"
        f" {each.problem or 'can be used'}"
        for each in found
    ]
    if any(plugin.problem for plugin in found):
        raise InputError(
            "a plugin cannot be used: update or uninstall its package\n" + "\n".join(lines)
        )
    return "\n".join(lines)
