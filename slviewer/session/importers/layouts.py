"""The layouts that can be imported, by name, and which of them a folder has."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slviewer.errors import InputError
from slviewer.session.importers import frames, opencv_graycode, p18, procam_calibration, slstudio, sltk
from slviewer.session.importers.imported import Imports, visible


@dataclass(frozen=True)
class FolderLayout:
    """How a tool lays its captures out on disk.

    `read(source, prefix=, projector=, ...)` reads a source; `is_capture(folder)` tells by file names whether a folder
    holds one capture; `projector` is the size where none is given, None where the layout does not imply one.
    """

    name: str
    holds: str
    read: Callable[..., Imports]
    is_capture: Callable[[Path], bool]
    projector: tuple[int, int] | None = None


LAYOUTS = {
    layout.name: layout
    for layout in (
        FolderLayout("p18", "pose_XX/{V,H}/P18_FNN images", p18.read, p18.is_capture, (912, 1140)),
        FolderLayout(
            "procam-calibration",
            "capture_N/graycode_NN images",
            procam_calibration.read,
            procam_calibration.is_capture,
            (1024, 768),
        ),
        FolderLayout("slstudio", "frameSeq_NN images", slstudio.read, slstudio.is_capture),
        FolderLayout("sltk", "TIME_[AA-BB-CC_NN]_img images", sltk.read, sltk.is_capture),
        FolderLayout("opencv-graycode", "pattern_camN_imN images", opencv_graycode.read, opencv_graycode.is_capture),
        FolderLayout("frames", "images and a TOML that describes them", frames.read, lambda folder: False),
    )
}


def detect_layout(source: Path) -> str:
    """The name of the layout of a folder, by its file names. Raises InputError where it is none, or not one alone.

    A TOML in the folder describes the images: it decides.
    """
    source = Path(source).expanduser()
    if not source.is_dir():
        raise InputError(f"{source} is no folder: give the folder of a capture, or a folder of such folders")
    if find_description(source) is not None:
        return "frames"
    folders = [source, *(entry for entry in visible(source) if entry.is_dir())]
    found = [name for name, layout in LAYOUTS.items() if any(layout.is_capture(folder) for folder in folders)]
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(f"{source} holds captures of {' and '.join(found)}: name the layout, or import one at a time")
    known = "; ".join(f"{layout.name}: {layout.holds}" for layout in LAYOUTS.values())
    raise InputError(f"{source} has none of the known layouts ({known}): describe the images in a TOML in the folder")


def find_description(source: Path) -> Path | None:
    """The TOML that lies in a folder; None where there is none. Raises InputError where there are several."""
    found = sorted(entry for entry in visible(Path(source)) if entry.suffix.lower() == ".toml")
    if len(found) > 1:
        raise InputError(f"{source} holds {' and '.join(file.name for file in found)}: keep one description")
    return found[0] if found else None
