"""Plugins: what other packages add under entry points. A broken one is reported, and never stops
the program."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

IMPORTERS, OPERATIONS = "slviewer.importers", "slviewer.operations"
"""Groups of the importers, which the command line lists without importing one, and of operations,
whose commands it reads from their sources."""
OWN = "slviewer"
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


def import_modules(package: ModuleType, declaring: str = "") -> list[ModuleType]:
    """Import the modules of a package that hold what another one looks up, and return them in the
    order of their names. ``declaring``: a text in the source of each; the others are not
    imported."""
    return [
        import_module(f"{package.__name__}.{path.stem}")
        for folder in package.__path__
        for path in sorted(Path(folder).glob("[!_]*.py"))
        if declaring in path.read_text("utf-8")
    ]


def list_names(group: str) -> list[str]:
    """Return the names of a group's plugins, without importing them."""
    return sorted({entry.name for entry in entry_points(group=group)})


def find_sources(group: str) -> dict[str, str]:
    """Return ``module:object`` of a group's entry points by name, slviewer's own first."""
    entries = sorted(entry_points(group=group), key=_sort_key)
    sources: dict[str, str] = {}
    for entry in entries:
        sources.setdefault(entry.name, entry.value)
    return sources


@dataclass(frozen=True)
class PluginGroup(Generic[T]):
    """Plugins under the entry points ``name``: objects of ``kind``, called otherwise than what is
    ``built_in()``."""

    name: str
    kind: type[T]
    built_in: Callable[[], Collection[str]]

    @cached_property
    def plugins(self) -> tuple[Plugin, ...]:
        """All of them, slviewer's own first, imported when this is first read."""
        own = (entry for entry in entry_points(group=self.name) if _is_own(entry))
        return (*(self._import(entry) for entry in sorted(own, key=_sort_key)), *self.others)

    @cached_property
    def others(self) -> tuple[Plugin, ...]:
        """Those of other packages, in order of their names, imported when this is first read.

        One has a ``problem`` where its import fails, it is not an instance of ``kind``, its
        ``name`` is not the entry point's, or the name is one of ``built_in``, of slviewer's own or
        of a plugin before it.
        """
        taken, plugins = {*self.built_in()}, list[Plugin]()
        for entry in sorted(entry_points(group=self.name), key=_sort_key):
            if not _is_own(entry):
                plugins.append(self._import(entry, taken))
                if plugins[-1].problem:
                    continue
            taken.add(entry.name)
        return tuple(plugins)

    def _import(self, entry: EntryPoint, taken: Collection[str] = ()) -> Plugin:
        """Import a plugin, unless its name is ``taken``."""
        value, problem = None, f"the name {entry.name} is taken: choose another"
        if entry.name not in taken:
            value, problem = _load(entry, self.kind)
        return Plugin(self.name, entry.name, _name_package(entry), value, problem)

    def usable(self) -> dict[str, T]:
        """Return the plugins without a problem, by name."""
        return {plugin.name: plugin.value for plugin in self.plugins if not plugin.problem}

    def explain_missing(self, name: str) -> str:
        """Return why a plugin cannot be used, as an addition to a message; empty where no plugin
        has this name."""
        if name not in list_names(self.name):
            return ""
        return "; a plugin of this name cannot be used: `slviewer plugins` shows why"


def _load(entry: EntryPoint, kind: type) -> tuple[Any, str]:
    """Import one plugin, and check it: its value, None where it has a problem, and the problem."""
    try:
        value = entry.load()
    except Exception as error:  # whatever a package's import raises must not stop the program
        return None, f"its import failed, {type(error).__name__}: {error}"
    name = getattr(value, "name", entry.name)
    if not isinstance(value, kind):
        return None, f"{entry.value} is a {type(value).__name__}, not a {kind.__name__}"
    if name != entry.name:
        return (None, f"{entry.value} is called {name!r}: use the same name for the entry point")
    return value, ""


def _sort_key(entry: EntryPoint) -> tuple[bool, str, str]:
    """Return what entry points are sorted by: slviewer's own first."""
    return not _is_own(entry), entry.name, _name_package(entry)


def _is_own(entry: EntryPoint) -> bool:
    """Whether an entry point is of slviewer itself."""
    return entry.value.partition(".")[0] == OWN


def _name_package(entry: EntryPoint) -> str:
    """Return name and version of the package of an entry point."""
    return (
        f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "unknown package"
    )


OPERATION_PLUGINS = PluginGroup[Callable[..., Any]](
    OPERATIONS,
    Callable,  # type: ignore[arg-type]
    lambda: (),
)
"""Operations that are found by entry points, which register their kinds of records when they are
imported."""
