"""A new session with the calibration of another one: its poses, models, rig and target, without
scans."""

import os
import shutil
from pathlib import Path

from slviewer.errors import InputError
from slviewer.pipeline.models import VERDICT, available_models
from slviewer.session import atomic, layout
from slviewer.session.store import Session

_DECISIONS = (
    "rig", "target", "patterns", "levels", "exposure", "exposures", "sigma_wanted_mm", "excluded",
    "model", "use_anyway",
)  # fmt: skip
"""What the new session remembers: what does not concern a part."""
_KINDS = ("calibration", "compiled", "projector", "scale")
"""Of results that are copied, beside those of the poses and the verdict."""


def duplicate_calibration(source: Path | str, target: Path) -> list[str]:
    """Make a session ``target`` with the calibration of another one; returns the names of its
    poses.

    Complete, or absent if it raises: InputError without a calibration, SessionError where the
    target exists. Frames, which never change, are linked where the disk allows it, so that they
    take no space.
    """
    with Session.open(source) as old:
        if not available_models(old):
            raise InputError(f"{old.folder.name} has no calibration", "calibrate it first")
        if target.exists():
            layout.new_folder(target)  # states what is there
        poses = old.capture_names("calibration")
        results = [
            name
            for name in old.result_names()
            if name.partition("/")[0] in _KINDS
            or name == VERDICT
            or name.partition("/")[2] in poses
        ]
        parts = [f"captures/{name}" for name in poses] + [f"results/{name}" for name in results]
        parts += ["rigs"] if old.rigs() else []
        with atomic.staged_folder(target, 0) as staged:
            with Session.create(staged) as new:
                for part in parts:
                    shutil.copytree(old.folder / part, new.folder / part, copy_function=_link)
                for what in _DECISIONS:
                    if (value := old.valid_decision(what)) is not None:
                        new.decide(what, value)
            atomic.commit(staged, target)
    return poses


def _link(source: str, target: str) -> None:
    """Link a file, or copy it where the disk has no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
