"""Plugins: what other packages add under entry points. A broken one is reported, and never stops
the program."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

IMPORTERS = "slviewer.importers"
"""Group of the importers, which the command line lists without importing one."""
T = TypeVar("T")


@dataclass(frozen=True)
class Plugin:
    """An entry point of a package: ``value`` is the object that it names, None where ``problem``
    states why not."""

    group: str
    name: str
    package: str
    value: Any = None
    problem: str = ""


def list_names(group: str) -> list[str]:
    """Return the names of a group's plugins, without importing them."""
    return sorted({entry.name for entry in entry_points(group=group)})


@dataclass(frozen=True)
class PluginGroup(Generic[T]):
    """Plugins under the entry points ``name``: objects of ``kind``, called otherwise than what is
    ``built_in()``."""

    name: str
    kind: type[T]
    built_in: Callable[[], Collection[str]]

    @cached_property
    def plugins(self) -> tuple[Plugin, ...]:
        """All of them, in order of their names, imported when this is first read.

        One has a ``problem`` where its import fails, it is not an instance of ``kind``, its
        ``name`` is not the entry point's, or the name is one of ``built_in`` or of a plugin before
        it.
        """
        plugins: list[Plugin] = []
        for entry in sorted(
            entry_points(group=self.name), key=lambda entry: (entry.name, _name_package(entry))
        ):
            taken = {*self.built_in(), *(plugin.name for plugin in plugins if not plugin.problem)}
            plugins.append(_load(entry, self.kind, taken))
        return tuple(plugins)

    def usable(self) -> dict[str, T]:
        """Return the plugins without a problem, by name."""
        return {plugin.name: plugin.value for plugin in self.plugins if not plugin.problem}

    def explain_missing(self, name: str) -> str:
        """Return why a plugin cannot be used, as an addition to a message; empty where no plugin
        has this name."""
        if name not in list_names(self.name):
            return ""
        return "; a plugin of this name cannot be used: `slviewer plugins` shows why"


def _load(entry: EntryPoint, kind: type, taken: set[str]) -> Plugin:
    """Import one plugin, and check it."""
    package = _name_package(entry)
    if entry.name in taken:
        return Plugin(
            entry.group,
            entry.name,
            package,
            problem=f"the name {entry.name} is taken: choose another",
        )
    try:
        value = entry.load()
    except Exception as error:  # whatever a package's import raises must not stop the program
        return Plugin(
            entry.group,
            entry.name,
            package,
            problem=f"its import failed, {type(error).__name__}: {error}",
        )
    if not isinstance(value, kind):
        problem = f"{entry.value} is a {type(value).__name__}, not a {kind.__name__}"
    elif getattr(value, "name", None) != entry.name:
        problem = (
            f"{entry.value} is called {getattr(value, 'name', None)!r}: use the same name for the"
            " entry point"
        )
    else:
        return Plugin(entry.group, entry.name, package, value)
    return Plugin(entry.group, entry.name, package, problem=problem)


def _name_package(entry: EntryPoint) -> str:
    """Return name and version of the package of an entry point."""
    return (
        f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "unknown package"
    )
