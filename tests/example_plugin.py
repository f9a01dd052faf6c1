"""The example plugin, installed in the process of a test."""

import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "docs" / "examples" / "slviewer-example-plugin"
Install = Callable[[str, str, str], None]


def forget_plugins() -> None:
    """Let the plugins be read anew when they are next used."""
    from slviewer.devices.drivers import DRIVER_PLUGINS, drivers
    from slviewer.entry_points import OPERATION_PLUGINS
    from slviewer.gui.panel import PANEL_PLUGINS
    from slviewer.pipeline.operation import OPERATIONS
    from slviewer.records.record import RECORDS
    from slviewer.session.importers.layouts import LAYOUT_PLUGINS
    from slviewer.session.shape_files import EXPORTER_PLUGINS
    from slviewer.target.board import BOARD_PLUGINS

    groups = (
        *(DRIVER_PLUGINS, LAYOUT_PLUGINS, EXPORTER_PLUGINS, BOARD_PLUGINS),
        *(OPERATION_PLUGINS, PANEL_PLUGINS),
    )
    for group in groups:
        for cached in ("plugins", "others"):
            vars(group).pop(cached, None)
    drivers.cache_clear()
    for registry in (RECORDS, OPERATIONS):
        registry.pop("brightness", None)
    for module in [name for name in sys.modules if name.startswith("slviewer_example")]:
        del sys.modules[module]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Install a package in this process until the test ends: write its metadata, as pip does, into
    a folder.

    The package's modules are in that folder, ``site`` of ``tmp_path``, or beside it on the path.
    """

    def write(name: str, version: str, entry_points: str) -> None:
        info = tmp_path / "site" / f"{name}-{version}.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        (info / "entry_points.txt").write_text(entry_points)
        monkeypatch.syspath_prepend(str(tmp_path / "site"))
        forget_plugins()

    monkeypatch.chdir(tmp_path)
    yield write
    monkeypatch.undo()
    forget_plugins()


@pytest.fixture
def example(install: Install, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example plugin is installed in this process."""
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text("utf-8"))["project"]
    lines = []
    for group, entries in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    install(project["name"], project["version"], "\n".join(lines))
    monkeypatch.syspath_prepend(str(PACKAGE))
