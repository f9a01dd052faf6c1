"""Where the things are that ship with slviewer and are not code: rig presets and the demo object."""

from pathlib import Path

from slviewer.errors import InputError

_PACKAGE = Path(__file__).resolve().parent.parent


def asset(name: str) -> Path:
    """Path of a shipped file, such as ``rigs/letter.toml``: beside the package in a checkout, inside it in a wheel.

    Raises `InputError` if the installation lacks it.
    """
    for folder in (_PACKAGE / "assets", _PACKAGE.parent / "assets"):
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"the shipped file assets/{name} is missing: install slviewer again")
