"""Example data by name: the sample that ships with slviewer, unpacked into a folder."""

import hashlib
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from slviewer.errors import InputError
from slviewer.session.importers.archive import unpack
from slviewer.simulation.assets import asset


@dataclass(frozen=True)
class Dataset:
    """A zip of captures that ships with slviewer."""

    archive: str
    """Its path below assets."""
    sha256: str
    licence: str
    description: str


DATASETS = {
    "sample": Dataset(
        "datasets/sample.zip",
        "97c69a2d436351e9d8096a9afaa5b0a17a919a358f9ed0b9039709fe03f95514",
        "MIT",
        "six target poses (circles:21x16:9), a plane, a sphere and an object, simulated",
    ),
}
"""{name: data set}"""


def fetch(name: str = "sample", folder: Path | str | None = None) -> Path:
    """Copy a data set into a folder.

    Args:
        name: Name of the data set: sample.
        folder: Folder to make. Without it, the data set's folder in the user's cache, made when it is first used.

    Returns the folder: its subfolders poses, scan, sphere and object hold images in a known layout. Raises
    `InputError` for an unknown name, a damaged archive, or a given folder that exists.
    """
    if name not in DATASETS:
        raise InputError(f"no data set is called {name!r}: use {' or '.join(DATASETS)}")
    dataset = DATASETS[name]
    source = asset(dataset.archive)
    if hashlib.sha256(source.read_bytes()).hexdigest() != dataset.sha256:
        raise InputError(f"{source} is not the data set {name!r}: its hash differs; install slviewer again")
    if folder is None:
        target = _cache_folder() / f"{name}-{dataset.sha256[:12]}"
        if target.is_dir():  # renamed to its place when it was complete
            return target
    else:
        target = Path(folder)
        if target.exists():
            raise InputError(f"{target} exists: give the name of a new folder")
    target.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=target.parent, prefix=".fetch-") as scratch, source.open("rb") as archive:
        unpacked, _ = unpack(archive, Path(scratch), lambda done: None)
        try:
            unpacked.rename(target)
        except OSError:
            if folder is not None or not target.is_dir():  # else another process was faster
                raise
    return target


def _cache_folder() -> Path:
    """Return the user's folder for data sets; the environment variable SLVIEWER_DATASETS names another."""
    if given := os.environ.get("SLVIEWER_DATASETS"):
        return Path(given)
    if sys.platform == "win32":
        caches = Path(os.environ.get("LOCALAPPDATA", Path.home()))
    elif sys.platform == "darwin":
        caches = Path.home() / "Library" / "Caches"
    else:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return caches / "slviewer" / "datasets"
