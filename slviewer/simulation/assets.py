"""Where the things are that ship with slviewer and are not code: rigs to choose, the simulated rig,
the demo object."""

from pathlib import Path

from slviewer.errors import InputError

_PACKAGE = Path(__file__).resolve().parent.parent


def asset(name: str) -> Path:
    """Path of a shipped file or folder, such as ``rigs/webcam.toml`` or ``rigs``: beside the
    package in a checkout, inside it in a wheel.

    Raises `InputError` if the installation lacks it.
    """
    for folder in (_PACKAGE / "assets", _PACKAGE.parent / "assets"):
        if (folder / name).exists():
            return folder / name
    raise InputError(f"the shipped assets/{name} is missing", "install slviewer again")
