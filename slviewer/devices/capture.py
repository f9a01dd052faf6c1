"""One capture: every frame of a pattern sequence shown and grabbed."""

import time
from collections.abc import Callable

import numpy as np

from slviewer.devices.protocols import ColourCamera, Rig
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.sequence import PatternSequence


def capture(
    rig: Rig,
    sequence: PatternSequence,
    out: np.ndarray | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> np.ndarray:
    """The frames (n, h, w) of `sequence` as the open rig's camera sees them, in `out` if it is given.

    `progress(done, n)` is called before the first frame and after each, and may raise (Cancelled) to stop. Raises
    DeviceError, with the frame at which it happened; whatever is raised, `out` then holds no capture and the rig can be
    used again once its device answers. The projector is left showing the last frame.
    """
    rig.projector.load(sequence)
    n, (width, height) = len(sequence.frames), rig.camera.size
    if out is None:
        out = np.empty((n, height, width), rig.camera.dtype)
    if out.shape != (n, height, width) or out.dtype != rig.camera.dtype:
        raise InputError(
            f"the {n} frames of {rig.camera.name} need {(n, height, width)} {rig.camera.dtype}, "
            f"got {out.shape} {out.dtype}: make the array by the camera's size"
        )
    if progress is not None:
        progress(0, n)
    for k in range(n):
        try:
            rig.projector.show(k)
            settle(rig)
            rig.camera.grab(out[k])
        except DeviceError as error:
            raise DeviceError(f"the capture ended at frame {k + 1} of {n}, nothing is kept of it: {error}") from error
        if progress is not None:
            progress(k + 1, n)
    return out


def colour_texture(rig: Rig) -> np.ndarray | None:
    """(h, w, 3) RGB of the scene under white light, where the camera of the open rig sees colour; else None."""
    if not isinstance(rig.camera, ColourCamera):
        return None
    rig.projector.show_level(255)
    settle(rig)
    return rig.camera.grab_colour()


def settle(rig: Rig) -> None:
    """Wait until what the projector says it shows has reached the scene."""
    if rig.settle_ms > 0:
        time.sleep(rig.settle_ms / 1000)
