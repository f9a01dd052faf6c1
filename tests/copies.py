"""Copies of sessions that share what nothing changes."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path


def copy_session(
    source: Path, target: Path, ignore: Callable[[str, list[str]], set[str]] | None = None
) -> Path:
    """Copy a session and return the copy; frames are the same files: replace them, never write into
    them."""

    def copy(file: str, to: str) -> None:
        (os.link if ".zarr" in file else shutil.copy2)(file, to)

    return Path(shutil.copytree(source, target, ignore=ignore, copy_function=copy))
