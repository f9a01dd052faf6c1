"""RAW files as a camera writes them: the smallest DNG that LibRaw develops."""

import struct

import numpy as np

_TYPES = {1: "B", 2: "B", 3: "H", 4: "I", 5: "I", 10: "i"}


def write_dng(mosaic: np.ndarray, black: int = 0, white: int = 4095, orientation: int = 1) -> bytes:
    """Return a DNG of an RGGB mosaic (h, w), whose levels are `black` ... `white`."""
    height, width = mosaic.shape
    pixels = mosaic.astype("<u2").tobytes()
    unit = [1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1]
    tags: list[tuple[int, int, object]] = [
        (254, 4, [0]),
        (256, 4, [width]),
        (257, 4, [height]),
        (258, 3, [16]),
        (259, 3, [1]),
        (262, 3, [32803]),  # a colour filter array
        (271, 2, b"slviewer\0"),
        (272, 2, b"test\0"),
        (273, 4, [0]),  # where the pixels begin, below
        (274, 3, [orientation]),
        (277, 3, [1]),
        (278, 4, [height]),
        (279, 4, [len(pixels)]),
        (33421, 3, [2, 2]),
        (33422, 1, bytes([0, 1, 1, 2])),
        (50706, 1, bytes([1, 4, 0, 0])),
        (50708, 2, b"slviewer test\0"),
        (50714, 3, [black]),
        (50717, 4, [white]),
        (50721, 10, unit),
        (50728, 5, [1] * 6),
        (50778, 3, [21]),
    ]
    begin = 8 + 2 + 12 * len(tags) + 4

    def directory(place: int) -> tuple[bytes, bytes]:
        entries, longer = b"", b""
        for tag, kind, values in tags:
            values = [place] if tag == 273 else values
            data = struct.pack(f"<{len(values)}{_TYPES[kind]}", *values)
            entries += struct.pack("<HHI", tag, kind, len(values) // (2 if kind in (5, 10) else 1))
            if len(data) <= 4:
                entries += data.ljust(4, b"\0")
            else:
                entries += struct.pack("<I", begin + len(longer))
                longer += data + b"\0" * (len(data) % 2)
        return entries, longer

    place = begin + len(directory(0)[1])
    entries, longer = directory(place)
    head = b"II*\0" + struct.pack("<IH", 8, len(tags))
    return head + entries + b"\0" * 4 + longer + pixels
