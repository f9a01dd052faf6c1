"""OpenEXR files of one float map: the 32-bit floats of an array as they are, NaN included.

Only the plainest form of the format is written (version 2, scan lines, one channel, uncompressed),
which every reader understands. Layout: openexr.com, "OpenEXR File Layout".
"""

import struct
from pathlib import Path

import numpy as np

_MAGIC, _VERSION = 20000630, 2
_FLOAT = 2  # pixel type of 32-bit floats


def write_exr(path: Path, values: np.ndarray) -> None:
    """Write (h, w) float32 as the luminance channel "Y" of an OpenEXR file, replacing a file of
    that name."""
    if values.ndim != 2 or values.dtype != np.float32:
        raise ValueError(f"an EXR map must be (h, w) float32, not {values.shape} {values.dtype}")
    height, width = values.shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = struct.pack("<2i", _MAGIC, _VERSION) + b"".join(
        (
            _encode_attribute(
                "channels",
                "chlist",
                b"Y\0" + struct.pack("<i4B2i", _FLOAT, 0, 0, 0, 0, 1, 1) + b"\0",
            ),
            _encode_attribute("compression", "compression", b"\0"),
            _encode_attribute("dataWindow", "box2i", window),
            _encode_attribute("displayWindow", "box2i", window),
            _encode_attribute("lineOrder", "lineOrder", b"\0"),
            _encode_attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
            _encode_attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
            _encode_attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)),
            b"\0",
        )
    )
    lines = np.empty(height, [("row", "<i4"), ("bytes", "<i4"), ("values", "<f4", (width,))])
    lines["row"], lines["bytes"], lines["values"] = np.arange(height), 4 * width, values
    first = len(header) + 8 * height
    offsets = first + lines.itemsize * np.arange(height, dtype="<u8")
    path.write_bytes(header + offsets.tobytes() + lines.tobytes())


def _encode_attribute(name: str, kind: str, value: bytes) -> bytes:
    """Return the bytes of one OpenEXR header attribute."""
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
