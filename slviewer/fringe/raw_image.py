"""RAW files of cameras as levels proportional to light: what the sensor counted above its black
level, without tone curve, white balance or sharpening. LibRaw (the package rawpy) knows their
formats."""

import io
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from slviewer.errors import InputError

RAW_SUFFIXES = frozenset(
    {".arw", ".cr2", ".cr3", ".dng", ".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2"}
)

MOSAIC_TILES = 8
"""Parts along each side of an image in which an alternation is measured."""
LEAST_MOSAIC, SAME_SIGN = 0.02, 0.9
"""Alternation over the brightness from which on pixels are a mosaic: rows and columns of one sensor
differ by less than 1 %; share of the tiles in which it has one sign."""


@dataclass(frozen=True, eq=False)
class RawImage:
    """(h, w, 3) uint16 RGB, the level at which its sensor clips, and the focal length of the lens
    in mm, 0 where the file does not state it."""

    rgb: np.ndarray
    full_scale: int
    focal_mm: float


def develop(data: bytes, name: str, most_pixels: int = 2**28) -> RawImage:
    """Convert the content of the RAW file `name`; the mosaic is interpolated linearly, and the
    image is not rotated. Raises InputError where it cannot be read, or rawpy is missing."""
    if find_spec("rawpy") is None:
        raise InputError(
            f"{name} is a RAW file, and the package rawpy, which reads it, is missing",
            "pip install 'slviewer[raw]', or convert it to a TIFF of 16 bits without a tone curve",
        )
    import rawpy

    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            width, height = raw.sizes.raw_width, raw.sizes.raw_height
            if width * height > most_pixels:
                raise InputError(
                    f"{name} is {width}x{height} px, and {most_pixels / 1e6:.0f} megapixels are"
                    " read at most",
                    "record it at a lower resolution",
                )
            rgb = raw.postprocess(
                demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                gamma=(1, 1),
                user_wb=[1, 1, 1, 1],
                user_flip=0,
                no_auto_bright=True,
                no_auto_scale=True,
            )
            whites = [raw.white_level, *(raw.camera_white_level_per_channel or ())]
            full_scale = min(filter(None, whites)) - max(raw.black_level_per_channel)
            focal_mm = getattr(getattr(raw, "other", None), "focal_length", 0.0)  # of newer ones
    except InputError:
        raise
    except Exception as error:  # a file from anywhere may make its reader fail in any way
        reason = error.args[0] if error.args else type(error).__name__
        text = reason.decode() if isinstance(reason, bytes) else str(reason)
        raise InputError(
            f"{name} cannot be read as a RAW file ({text})",
            "copy or record it again, or convert it to DNG",
        ) from error
    if rgb.ndim == 2 or rgb.shape[2] == 1:
        rgb = np.repeat(rgb.reshape(*rgb.shape[:2], 1), 3, axis=2)
    return RawImage(rgb, int(full_scale), float(focal_mm))


def describe_mosaic(name: str, frames: np.ndarray) -> str:
    """Return a warning where frames (n, h, w) of a capture are raw mosaics; empty where not."""
    share = measure_mosaic(frames)
    if not share:
        return ""
    return (
        f"{name}: its images alternate from pixel to pixel by {200 * share:.0f} %, as the raw"
        " mosaic (Bayer pattern) of a colour camera does that is saved as grey, which displaces"
        " edges and fringes: let the camera save colour or monochrome images, or interpolate the"
        " mosaic to colour images, of which one channel is read"
    )


def measure_mosaic(frames: np.ndarray) -> float:
    """Return by which share of the brightness the 2x2 neighbours of frames (n, h, w) differ in all
    of the image, as those of a colour camera's raw mosaic do; 0 where they do not.

    Two of its pixels, diagonal neighbours, see green: the diagonals differ, or, where red and blue
    together are as bright, columns and rows alike. Stripes make only columns or only rows differ.
    """
    height, width = (side // 2 * 2 for side in frames.shape[1:])
    # stripes and their inverses, or all steps of a period, add up to even light
    mean = np.asarray(frames[:, :height, :width].mean(axis=0, dtype=np.float32))
    a, b, c, d = mean[::2, ::2], mean[::2, 1::2], mean[1::2, ::2], mean[1::2, 1::2]
    total = a + b + c + d
    is_lit = total > np.quantile(total, 0.5) / 2
    if not is_lit.any():
        return 0.0
    alternations = []
    for difference in (a + d - b - c, a + c - b - d, a + b - c - d):
        share = np.where(is_lit, difference / np.maximum(total, 1e-6), np.nan)
        tiles = [
            float(np.nanmedian(tile))
            for rows in np.array_split(share, MOSAIC_TILES)
            for tile in np.array_split(rows, MOSAIC_TILES, axis=1)
            if np.isfinite(tile).sum() > tile.size / 2
        ]
        middle = float(np.median(tiles)) if tiles else 0.0
        same = np.mean(np.sign(tiles) == np.sign(middle)) if tiles else 0.0
        alternations.append(abs(middle) if same >= SAME_SIGN else 0.0)
    diagonals, columns, rows = alternations
    largest = max(diagonals, min(columns, rows))
    return largest if largest >= LEAST_MOSAIC else 0.0
