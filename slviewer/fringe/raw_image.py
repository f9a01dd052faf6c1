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
