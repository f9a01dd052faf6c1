"""The layouts that can be imported, by name, and which of them a folder has. Plugins add others."""

from pathlib import Path

from slviewer.entry_points import IMPORTERS, PluginGroup
from slviewer.errors import InputError
from slviewer.session.importers import (
    frames,
    opencv_graycode,
    p18,
    procam_calibration,
    slstudio,
    sltk,
)
from slviewer.session.importers.imported import FolderLayout, visible
from slviewer.session.reading import expand_user

BUILT_IN = {
    module.LAYOUT.name: module.LAYOUT
    for module in (p18, procam_calibration, slstudio, sltk, opencv_graycode, frames)
}
LAYOUT_PLUGINS = PluginGroup(IMPORTERS, FolderLayout, lambda: BUILT_IN)


def layouts() -> dict[str, FolderLayout]:
    """Return all layouts by name, those of plugins last."""
    return BUILT_IN | LAYOUT_PLUGINS.usable()


def detect_layout(source: Path) -> str:
    """The name of the layout of a folder, by its file names. Raises InputError where it is none, or
    not one alone.

    A TOML in the folder describes the images: it decides.
    """
    source = expand_user(source)
    if not source.is_dir():
        raise InputError(
            f"{source} is not a folder: give the folder of a capture, or a folder of such folders"
        )
    if find_description(source) is not None:
        return "frames"
    folders = [source, *(entry for entry in visible(source) if entry.is_dir())]
    candidates = [
        name
        for name, layout in layouts().items()
        if any(layout.recognises(folder) for folder in folders)
    ]
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        raise InputError(
            f"{source} holds captures of {' and '.join(candidates)}: name the layout, or import one"
            " at a time"
        )
    known = "; ".join(f"{layout.name}: {layout.holds}" for layout in layouts().values())
    raise InputError(
        f"{source} has none of the known layouts ({known}): describe the images in a TOML in the"
        " folder"
    )


def find_description(source: Path) -> Path | None:
    """The TOML in a folder; None where there is none. Raises InputError where there are several."""
    descriptions = sorted(
        entry for entry in visible(Path(source)) if entry.suffix.lower() == ".toml"
    )
    if len(descriptions) > 1:
        raise InputError(
            f"{source} holds {' and '.join(file.name for file in descriptions)}: keep one"
            " description"
        )
    return descriptions[0] if descriptions else None
