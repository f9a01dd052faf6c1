"""Image files into one stack, and none of them believed without a look: OpenCV decodes half a file
without a word."""

import io
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from PIL import Image

from slviewer.errors import InputError
from slviewer.fringe.layout import clip_level
from slviewer.fringe.raw_image import RAW_SUFFIXES, develop
from slviewer.session.names import join_names
from slviewer.session.reading import (
    MAX_CLOUD_BYTES,
    MAX_IMAGE_BYTES,
    open_regular,
    read_file,
    read_input,
)

IMAGE_SUFFIXES = RAW_SUFFIXES | {
    ".png",
    ".jpg",
    ".jpeg",
    ".bmp",
    ".tif",
    ".tiff",
    ".pgm",
    ".ppm",
}

Channel = Literal["red", "green", "blue", "luma", "max"]
DEFAULT_CHANNEL: Channel = "green"

MAX_PIXELS = 160_000_000
_THREADS = 4  # decoding releases the interpreter
_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "PPM")
# Pillow reads headers alone here: `MAX_PIXELS` limits what is decoded, and faults are reported
Image.MAX_IMAGE_PIXELS = None
warnings.filterwarnings("ignore", module=r"PIL\.")
_TIFF_SUFFIXES = {".tif", ".tiff"}
_PNG = b"\x89PNG\r\n\x1a\n"
_CHECKED = (_PNG, b"\xff\xd8", b"BM")
"""Beginnings of PNG, JPEG and BMP files, which OpenCV may decode as far as they go."""
SUBFILE_TAG, ORIENTATION_TAG, INTERPRETATION_TAG = 254, 274, 262
SEVERAL = (
    "save each as a file of its own, or all as a TIFF that is the only image of its folder, or the"
    " only one of its pattern in a TOML"
)
REDUCED = 1
"""Bit of the tag of a subfile: a thumbnail, or a level of a pyramid."""
WHITE_IS_ZERO = 0
"""Of the tag of interpretation; OpenCV turns such images of 8 bits round, and those of 16 not."""
_TURNS_BACK: Mapping[int, Callable[[np.ndarray], np.ndarray]] = {
    2: np.fliplr,
    3: lambda pixels: np.rot90(pixels, 2),
    4: np.flipud,
    5: lambda pixels: pixels.swapaxes(0, 1),
    6: lambda pixels: np.rot90(pixels, 1),
    7: lambda pixels: np.rot90(pixels.swapaxes(0, 1), 2),
    8: lambda pixels: np.rot90(pixels, -1),
}
"""What undoes the orientations of EXIF, which OpenCV applies to TIFF files, and to no others."""
_NETPBM = re.compile(
    rb"P[1-7]" + 2 * rb"(?:\s|#[^\n]*\n)+(\d{1,9})" + rb"(?:(?:\s|#[^\n]*\n)+(\d{1,5})\s)?"
)


@dataclass(frozen=True)
class FrameImages:
    """Image files as frames of one channel. ``in_colour``: whether the files hold colours, of which
    one channel was used. ``full_scale``: the grey level at which their camera clipped, None where
    neither file nor caller states it.
    """

    stack: np.ndarray  # (n, h, w) uint8 or uint16
    # (h, w, 3) RGB of the frame that was asked for, where it is in colour
    texture: np.ndarray | None
    in_colour: bool
    full_scale: int | None


def read_frames(
    paths: Sequence[Path],
    colour_frame: int | None = None,
    channel: Channel = DEFAULT_CHANNEL,
    full_scale: int | None = None,
) -> FrameImages:
    """The frames of image files, and the colours of frame `colour_frame` if it has any;
    `full_scale` where it is known.

    Colour frames are reduced to one channel, by default green: a colour camera samples it most
    densely, and unlike a mixture it stays linear up to the level at which it saturates, which
    decoding can see. Raises InputError, naming the file, for an image that is missing, cut short,
    damaged, of another size or bit depth than the first.
    """
    several = {path.parent for path in paths} & {file_of(path) for path in paths}
    stacks = {each: read_input(each, MAX_CLOUD_BYTES, "divide it") for each in several}
    first = read_image(paths[0], stacks.get(paths[0].parent))
    try:
        stack = np.empty((len(paths), *first.shape[:2]), first.dtype)
    except MemoryError as error:
        raise InputError(
            f"{len(paths)} images of {_format_size(first)} px do not fit into the memory: {error}"
        ) from error
    texture: list[np.ndarray] = []
    in_colour = np.zeros(len(paths), bool)

    def read(index: int) -> None:
        """Read image ``index`` into the stack, and the texture if it is the colour frame."""
        path = paths[index]
        image = first if index == 0 else read_image(path, stacks.get(path.parent))
        mine, firsts = _short_path(paths[index]), _short_path(paths[0])
        if image.shape[:2] != first.shape[:2]:
            raise InputError(
                f"{mine} is {_format_size(image)} px, {firsts} is {_format_size(first)}",
                "all frames of a capture must have one size",
            )
        if image.dtype != first.dtype:
            raise InputError(
                f"{mine} has {8 * image.itemsize} bits, {firsts} has {8 * first.itemsize}",
                "all frames of a capture must have one bit depth",
            )
        if image.ndim == 2:
            stack[index] = image
            return
        stack[index] = reduce_channels(image, channel, full_scale)
        in_colour[index] = (image != image[..., :1]).any()
        if index == colour_frame and in_colour[index]:
            texture.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))

    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(read, range(len(paths))))
    if full_scale is None and stack.dtype == np.uint16 and not stacks:
        full_scale = _stated_full_scale(paths[0], stack)
    return FrameImages(stack, texture[0] if texture else None, bool(in_colour.any()), full_scale)


def _stated_full_scale(path: Path, stack: np.ndarray) -> int | None:
    """Return the full scale that the first of the files states; None where its format states none.

    A RAW file states where its sensor clips. A PGM states its largest grey level, which many
    programs leave at 65535. A PNG may state the number of significant bits: by its standard the
    upper ones, but programs that leave the bits at the bottom write it too. The tags of a TIFF
    state the extremes of its own pixels.
    """
    if is_raw(path):
        return develop(read_file(path, MAX_IMAGE_BYTES), _short_path(path)).full_scale
    data, largest = read_file(path, MAX_IMAGE_BYTES)[:4096], int(stack.max())
    at = data.find(b"sBIT") if data.startswith(_PNG) else -1
    bits = data[at + 4] if at > 0 else 0
    if netpbm := _NETPBM.match(data):
        bits = (int(netpbm[3] or 0) + 1).bit_length() - 1
    if not 8 < bits < 16:
        return None
    full_scale = (1 << bits) - 1
    if netpbm:
        return full_scale if largest <= full_scale == int(netpbm[3]) else None
    return full_scale if largest <= full_scale else full_scale << (16 - bits)


def reduce_channels(
    image: np.ndarray, channel: Channel, full_scale: int | None = None
) -> np.ndarray:
    """(h, w) of a (h, w, 3) BGR image, of its dtype.

    luma is that of ITU-R BT.601, and full scale where one of the channels saturates: the mixture
    would hide it. ``full_scale`` as in `clip_level`.
    """
    if channel == "max":
        return image.max(axis=2)
    if channel != "luma":
        return image[..., ("blue", "green", "red").index(channel)]
    luma = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    white = clip_level(image.dtype, int(image.max()), full_scale)
    luma[(image >= white).any(axis=2)] = white
    return luma


def list_pages(path: Path) -> list[Path]:
    """Return a path for each image of a TIFF that holds several, as if the file were a folder of
    them; the path alone for other files."""
    count = count_images(path) if path.suffix.lower() in _TIFF_SUFFIXES else 1
    digits = max(3, len(str(count)))
    pages = [path / f"{path.stem}_{n:0{digits}d}{path.suffix}" for n in range(1, count + 1)]
    return pages if count > 1 else [path]


def file_of(path: Path) -> Path:
    """Return the file that an image of `list_pages` is in, else the path."""
    is_page = path.parent.suffix.lower() in _TIFF_SUFFIXES and path.parent.is_file()
    return path.parent if is_page else path


def count_images(path: Path) -> int:
    """Return how many images a TIFF, a PNG or a GIF holds, without thumbnails; 1 for other files,
    and for damaged ones."""
    with (
        suppress(Exception),  # a malformed file may make Pillow fail in any way
        open_regular(path) as file,
        Image.open(file, formats=("TIFF", "PNG", "GIF")) as image,
    ):
        return len(_find_pages(image))
    return 1


def _find_pages(image: Image.Image) -> list[int]:
    """Return the numbers of the images in an open file, without thumbnails."""
    count = getattr(image, "n_frames", 1)
    if image.format != "TIFF" or count == 1:
        return list(range(count))
    pages = []
    for number in range(count):
        image.seek(number)
        if not image.tag_v2.get(SUBFILE_TAG, 0) & REDUCED:  # type: ignore[attr-defined]
            pages.append(number)
    return pages


def read_image(path: Path, data: bytes | None = None) -> np.ndarray:
    """(h, w) or (h, w, 3) BGR, uint8 or uint16, without an alpha channel, in the rows and columns
    of the sensor, however the camera was turned (EXIF). ``data``: the content of the file, by
    default read. Raises InputError for anything that is not wholly an image, and for several."""
    file, name = file_of(path), _short_path(path)
    data = data or read_input(file, MAX_IMAGE_BYTES, "check the file")
    if not data:
        raise InputError(f"{name} is empty", "copy or record it again")
    if is_raw(path):
        return cv2.cvtColor(develop(data, name, MAX_PIXELS).rgb, cv2.COLOR_RGB2BGR)
    page = None if file == path else int(path.stem.rpartition("_")[2]) - 1
    header = _check_header(data, name, page)
    buffer, number = np.frombuffer(data, np.uint8), header.number
    pixels: np.ndarray | None = None
    with suppress(cv2.error, MemoryError):
        if number:
            chosen = cv2.imdecodemulti(buffer, cv2.IMREAD_UNCHANGED, range=(number, number + 1))[1]
            pixels = chosen[0] if len(chosen) == 1 else None
        else:
            pixels = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError(f"{name} is not a readable image", "copy or record it again")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"{name} has pixels of type {pixels.dtype}", "save frames with 8 or 16 bits"
        )
    if pixels.ndim == 3 and pixels.shape[2] not in (3, 4):
        raise InputError(f"{name} has {pixels.shape[2]} channels", "save frames in grey or RGB")
    if header.interpretation == WHITE_IS_ZERO and pixels.dtype == np.uint16:
        pixels = np.invert(pixels)
    pixels = _TURNS_BACK.get(header.orientation or 0, np.asarray)(pixels)
    return np.ascontiguousarray(pixels if pixels.ndim == 2 else pixels[..., :3])


@dataclass(frozen=True)
class _Header:
    """The ``number`` of an image in its file; of a TIFF ``orientation`` and ``interpretation``,
    None where it states none, and for other formats: OpenCV turns none of these."""

    number: int = 0
    orientation: int | None = None
    interpretation: int | None = None


def _check_header(data: bytes, name: str, page: int | None) -> _Header:
    """Return the header of the only image, or of ``page`` among several. Raises InputError for
    what is too large or cut short, for several images, and for a page that is not there."""
    width = height = 0
    header, pages = _Header(), [0]
    try:
        with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
            if image.format in ("TIFF", "PNG"):
                pages = _find_pages(image)
            if image.format == "TIFF" and page in (None, *range(len(pages))):
                image.seek(number := pages[page or 0])
                tags = image.tag_v2  # type: ignore[attr-defined]
                header = _Header(number, tags.get(ORIENTATION_TAG), tags.get(INTERPRETATION_TAG))
            width, height = image.size
            if width * height <= MAX_PIXELS and data.startswith(_CHECKED):
                (image.verify if data.startswith(_PNG) else image.load)()
    except Exception as error:  # a malformed file may make Pillow fail in any way
        if data.startswith(_CHECKED):
            raise InputError(
                f"{name} is damaged or cut short ({error})", "copy or record it again"
            ) from error
    if page is None and len(pages) > 1:
        raise InputError(f"{name} holds {len(pages)} images", SEVERAL)
    if page is not None and page >= len(pages):
        raise InputError(f"{name} is not in its file", "copy or record it again")
    if width * height > MAX_PIXELS:
        raise InputError(
            f"{name} is {width}x{height} px, and images of up to {MAX_PIXELS / 1e6:.0f} megapixels"
            " are read",
            "crop it, or record it at a lower resolution",
        )
    return header


def warn_of_unread(paths: Sequence[Path]) -> list[str]:
    """Warnings that images have a channel, or JPEG files further images, that `read_image` leaves
    aside, by their headers."""
    transparent, paged = [], []
    for path in dict.fromkeys(map(file_of, paths)):
        with (
            suppress(OSError, SyntaxError, ValueError),
            Image.open(path, formats=_FORMATS) as image,
        ):
            if image.mode in ("LA", "PA", "RGBA"):
                transparent.append(path.name)
            if image.format not in ("TIFF", "PNG") and getattr(image, "n_frames", 1) > 1:
                paged.append(path.name)
    listed = {
        "transparency (an alpha channel) is ignored": transparent,
        "the first of several images in one file is read; save each as a file of its own": paged,
    }
    return [f"{join_names(names)}: {what}" for what, names in listed.items() if names]


def is_raw(path: Path) -> bool:
    """Whether a file is a camera's RAW file, by its name."""
    return path.suffix.lower() in RAW_SUFFIXES


def _format_size(image: np.ndarray) -> str:
    """Format an image's size as "WxH"."""
    return f"{image.shape[1]}x{image.shape[0]}"


def _short_path(path: Path) -> str:
    """Format a path as the file with the two folders above it: enough to identify it in a source of
    many captures."""
    return "/".join(path.parts[-3:])
