"""GenICam's pixel formats: which bits of a buffer are which pixel, by the names of the Pixel Format
Naming Convention.

Grey levels stay as the camera gives them: 10 and 12 bits become uint16 of 0 ... 1023 and 0 ...
4095, whose full scale `fringe.layout.clip_level` knows. "p" formats are one stream of bits, the
lowest first; GigE Vision's older "Packed" ones keep the upper eight bits of two pixels around a
byte with the rest of both.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.sequence import Size

_NAME = re.compile(r"(Mono|Bayer(?:RG|GR|GB|BG)|RGBa?|BGRa?)(8|10|12|14|16)(p|Packed)?")
_COLOURS = ("RGB", "RGBa", "BGR", "BGRa")
_DEMOSAIC = {
    "BayerRG": cv2.COLOR_BayerRGGB2RGB,
    "BayerGR": cv2.COLOR_BayerGRBG2RGB,
    "BayerGB": cv2.COLOR_BayerGBRG2RGB,
    "BayerBG": cv2.COLOR_BayerBGGR2RGB,
}


@dataclass(frozen=True)
class PixelFormat:
    """A pixel format of GenICam. `kind`: Mono, BayerRG ..., RGB, RGBa, BGR or BGRa; `packing`: "p",
    "Packed" or ""."""

    name: str
    kind: str
    bits: int
    packing: str

    @property
    def dtype(self) -> np.dtype:
        """uint8, or uint16 for more than 8 bits."""
        return np.dtype(np.uint8 if self.bits == 8 else np.uint16)

    @property
    def colour(self) -> bool:
        """Whether the format carries colour."""
        return self.kind != "Mono"

    @property
    def samples(self) -> int:
        """Samples per pixel."""
        return len(self.kind) if self.kind in _COLOURS else 1

    def nbytes(self, size: Size, padding: int = 0) -> int:
        """Return the bytes of an image (width, height) px whose rows end with `padding` bytes;
        seamless lines at 0."""
        width, height = size
        return (
            self._count_bytes(width * height)
            if padding == 0
            else height * (self._count_bytes(width) + padding)
        )

    def _count_bytes(self, pixels: int) -> int:
        """Return the number of bytes of so many consecutive pixels."""
        if self.packing == "Packed":
            return 3 * (pixels // 2) + 2 * (pixels % 2)
        stored = self.bits if self.packing else 8 * self.dtype.itemsize
        return (pixels * self.samples * stored + 7) // 8

    def unpack(self, data: np.ndarray, out: np.ndarray, padding: int = 0) -> None:
        """Fill `out`, contiguous (h, w), or (h, w, samples), of `dtype`, from the bytes of a
        buffer."""
        height, width = out.shape[:2]
        rows, pixels = (1, width * height) if padding == 0 else (height, width)
        used = self._count_bytes(pixels)
        lines = data[: self.nbytes((width, height), padding)].reshape(rows, used + padding)[
            :, :used
        ]
        if self.packing:
            _unpack_groups(lines, out.reshape(rows, pixels), self.bits, self.packing)
        elif self.bits == 8:
            np.copyto(out.reshape(rows, used), lines)
        else:
            np.copyto(out.reshape(rows, used // 2), np.ascontiguousarray(lines).view("<u2"))

    def view_samples(self, data: np.ndarray, size: Size, padding: int) -> np.ndarray:
        """Return a buffer's samples (h, w), or (h, w, samples), of `dtype`: a view where they need
        no unpacking."""
        width, height = size
        shape = (height, width) if self.samples == 1 else (height, width, self.samples)
        if self.bits == 8 and padding == 0:
            return data[: self.nbytes(size)].reshape(shape)
        out = np.empty(shape, self.dtype)
        self.unpack(data, out, padding)
        return out

    def rgb(self, samples: np.ndarray) -> np.ndarray:
        """Convert the result of `view_samples` to (h, w, 3) RGB; a Bayer mosaic is interpolated
        linearly."""
        if self.kind in _COLOURS:
            return samples[..., 2::-1] if self.kind.startswith("BGR") else samples[..., :3]
        if self.kind in _DEMOSAIC:
            return cv2.cvtColor(samples, _DEMOSAIC[self.kind])
        raise InputError(f"{self.name} tells no colours", "choose a colour format")


def pixel_format(name: str) -> PixelFormat | None:
    """Return the format called `name`; None for an unsupported one."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    kind, bits, packing = match[1], int(match[2]), match[3] or ""
    if kind in _COLOURS:
        packing = packing.replace("Packed", "")  # RGB8Packed is the old name of RGB8
        known = bits == 8 and not packing
    else:
        known = not packing or bits in (10, 12)
    return PixelFormat(name, kind, bits, packing) if known else None


def best_format(names: Sequence[str]) -> PixelFormat | None:
    """Return the best of the formats `names` that a camera offers; None if none is supported.

    Unpacked and up to 12 bits deep where there is such a one; a camera that offers colours is a
    colour camera, and its mosaic comes before colours that it would fill in itself and send as
    three.
    """
    formats = [
        candidate
        for name in names
        if (candidate := pixel_format(name)) is not None and candidate.bits <= 12
    ]
    colours = [candidate for candidate in formats if candidate.colour]
    return max(
        colours or formats,
        key=lambda f: (not f.packing, f.samples == 1, f.bits, -f.samples),
        default=None,
    )


def _unpack_groups(lines: np.ndarray, out: np.ndarray, bits: int, packing: str) -> None:
    """Fill `out` (rows, n) uint16 from (rows, bytes) in groups, of which the last may be short."""
    count = 4 if (bits, packing) == (10, "p") else 2
    size = 5 if count == 4 else 3  # of a group, bytes
    groups = -(-out.shape[1] // count)
    lines = np.pad(lines, ((0, 0), (0, groups * size - lines.shape[1])))
    columns = lines.reshape(len(lines), groups, size).astype(np.uint16)
    whole = np.empty((len(out), groups, count), np.uint16)
    for k in range(count):
        if packing == "Packed":
            rest = (columns[..., 1] >> 4 * k) & (2 ** (bits - 8) - 1)
            whole[..., k] = (columns[..., 2 * k] << (bits - 8)) | rest
        else:
            first, shift = divmod(k * bits, 8)
            pair = (columns[..., first + 1] << 8) | columns[..., first]
            whole[..., k] = (pair >> shift) & (2**bits - 1)
    out[:] = whole.reshape(len(out), -1)[:, : out.shape[1]]
