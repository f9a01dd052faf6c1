"""Which plugins are installed, and whether each can be used."""

from slviewer.devices.drivers import Driver, builtin_drivers
from slviewer.entry_points import BOARDS, DRIVERS, EXPORTERS, IMPORTERS, Plugin, load_plugins
from slviewer.errors import InputError
from slviewer.session.importers.imported import FolderLayout
from slviewer.session.importers.layouts import BUILT_IN
from slviewer.session.mesh_files import IN_WORDS, Exporter
from slviewer.target.board import EXAMPLES, BoardType


def list_plugins() -> list[Plugin]:
    """All plugins that are installed, group by group; each is imported. One that cannot be used has a ``problem``."""
    groups: dict[str, tuple[type, frozenset[str]]] = {
        DRIVERS: (Driver, frozenset(builtin_drivers())),
        BOARDS: (BoardType, frozenset(EXAMPLES)),
        IMPORTERS: (FolderLayout, frozenset(BUILT_IN)),
        EXPORTERS: (Exporter, frozenset(IN_WORDS)),
    }
    return [plugin for group, (kind, built_in) in groups.items() for plugin in load_plugins(group, kind, built_in)]


def plugins() -> str:
    """List the plugins: drivers, boards, importers and exporters that other packages add.

    Ends with status 1 where one cannot be used, and states why.
    """
    found = list_plugins()
    if not found:
        return "no plugins are installed"
    lines = [
        f"{each.group.removeprefix('slviewer.')}: {each.name}, from {each.package}: {each.problem or 'can be used'}"
        for each in found
    ]
    if any(plugin.problem for plugin in found):
        raise InputError("a plugin cannot be used: update or uninstall its package\n" + "\n".join(lines))
    return "\n".join(lines)
