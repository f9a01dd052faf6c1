"""Scaling of frames to equal light, compiled."""

import numpy as np

from slviewer.geometry.jit import kernel


@kernel()
def equalize(
    first, last, stack, frames, gain, offset, along_rows, along_columns, albedo, scale, out
):
    """Fill ``out`` (k, h, w) uint16: the stack's frames of indices ``frames`` (k,) less their room
    light, over their gain, times ``scale``; never the 65535 that marks clipped pixels.

    ``gain`` (k, h); room light ``offset[k] + albedo (along_rows[k, y] + along_columns[k] (x / (w -
    1) - 0.5))``, with ``albedo`` (h, w), or (0, 0) where there is none in proportion to it.
    """
    width = stack.shape[2]
    per_column = np.float32(1.0 / max(width - 1, 1))
    for row in range(first, last):
        for k in range(len(frames)):
            times = np.float32(scale / gain[k, row])
            added = np.float32(offset[k])
            source, target = stack[frames[k], row], out[k, row]
            if len(albedo):
                a, b = np.float32(along_rows[k, row]), np.float32(along_columns[k])
                for x in range(width):
                    room_light = added + albedo[row, x] * (
                        a + b * (np.float32(x) * per_column - np.float32(0.5))
                    )
                    level = (np.float32(source[x]) - room_light) * times + np.float32(0.5)
                    target[x] = np.uint16(min(max(level, np.float32(0)), np.float32(65534)))
            else:
                for x in range(width):
                    level = (np.float32(source[x]) - added) * times + np.float32(0.5)
                    target[x] = np.uint16(min(max(level, np.float32(0)), np.float32(65534)))
