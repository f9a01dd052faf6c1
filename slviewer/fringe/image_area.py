"""The part of the camera's image that light can change, its dead columns and rows, and its dead and
hot pixels.

Bars, masks, padding, a lens hood's circle and dead sensor lines have the same level in every frame:
no light, and no noise or nothing but noise. So has a static background that is too dark for its
noise to show, and what the projector does not reach. What tells them apart is that boards move in
front of a background: its constant pixels are others in each pose, whereas those that are not image
are the same in every one.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import scipy

from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import list_runs

Box = tuple[int, int, int, int]
"""(u0, v0, u1, v1) px, the last column and row exclusive."""
AREA = "area_"
"""Before the names of an area's arrays."""
WIDEST_LINE_PX = 6
"""Largest width of a dead line, and of gaps between changing pixels."""
LEAST_SPECK_PX = 5
"""Smaller islands of changing pixels, as of a clock in a bar, are not image."""
DEAD_LINE = 0.2
"""Share of the image's side along which a dead line has changing pixels on both sides, without
gaps: the black gaps of a board's pattern are shorter."""
STRAIGHT = 0.5
"""Share of a side that changes right beside a bar: of a tilted board's corner it is next to
none."""
SHOWN = 0.8
"""Least share of the pixels right beside a hidden part that change, in the mean of the poses:
boards reach the end of a dark background in one pose or two."""
MIN_POSES = 3
"""Of fewer, nothing tells a background that boards cover from bars."""
REACH_PX = 6
"""Neighbours of a dead line on each side by which it is filled."""
MOST_DEAD = 4
"""Pixels within ``WIDEST_LINE_PX`` + 1 each way that may be dead or hot, all others there
changing: the dark of a pattern or background is wider."""
BLOCK_PX = 4
"""Side of the blocks in which noise, which differs between pixels, is told from light, which
changes all of them together."""
MOST_FRAMES = 24
"""Frames, at most, in which light is looked for: their number decides how little light is found."""
CHANCE = 1e-4
"""Share of blocks without light that may be taken for lit, and that must not hide faint light."""
COARSE = 8
"""Of the blocks' rows, each that many is looked at first."""
LEAST_SHARE = 1e-3
"""Share of these blocks without light from which on all of them are looked at."""


@dataclass(frozen=True, eq=False)
class ImageArea:
    """The part of an image of ``size`` (width, height) px whose grey levels change.

    ``packed``: the bits of its ``constant`` pixels, row by row; ``packed_unlit``: of those of which
    no light changes the level, but noise may.
    """

    size: tuple[int, int]
    packed: np.ndarray
    packed_unlit: np.ndarray

    @classmethod
    def whole(cls, size: tuple[int, int]) -> "ImageArea":
        """Return the whole of an image of ``size`` (width, height) px."""
        return cls.of(np.zeros(size[::-1], bool))

    @classmethod
    def of(cls, constant: Mask, unlit: Mask | None = None) -> "ImageArea":
        """Return the area of an image whose ``constant`` (h, w) bool pixels never change, and whose
        ``unlit`` ones, the same if None, nothing but noise does."""
        height, width = constant.shape
        packed = np.packbits(constant)
        return cls((width, height), packed, packed if unlit is None else np.packbits(unlit))

    @classmethod
    def of_frames(cls, stack: np.ndarray) -> "ImageArea":
        """Return the area of the frames (n, h, w) of a capture."""
        constant = find_constant_pixels(stack)
        return cls.of(constant, constant | _find_unlit_pixels(stack))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "ImageArea | None":
        """Return the area that ``to_arrays`` put among ``arrays``; None where there is none."""
        if AREA + "packed" not in arrays:
            return None
        width, height = arrays[AREA + "size"].tolist()
        return cls((width, height), arrays[AREA + "packed"], arrays[AREA + "packed_unlit"])

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the fields as named arrays, to be saved among others."""
        names = "size", "packed", "packed_unlit"
        return {AREA + name: np.array(getattr(self, name)) for name in names}

    @property
    def constant(self) -> Mask:
        """(h, w) bool: the pixels that never change."""
        return _unpack(self.packed, self.size)

    @cached_property
    def image(self) -> Mask:
        """(h, w) bool: the pixels that change, without islands and with small gaps filled; all of
        them where there would be none."""
        return _close_gaps(~self.constant)

    @cached_property
    def bounds(self) -> Box:
        """The box around ``image``."""
        u0, v0, across, down = cv2.boundingRect(self.image.view(np.uint8))
        return u0, v0, u0 + across, v0 + down

    @cached_property
    def box(self) -> Box:
        """Box of the image less the bars along its borders."""
        (u0, v0, u1, v1), (width, height) = self.bounds, self.size
        sides = self.image[v0:v1, [u0, u1 - 1]].T, self.image[[v0, v1 - 1], u0:u1]
        (left, right), (top, bottom) = (side.mean(axis=1) > STRAIGHT for side in sides)
        return (
            u0 if left else 0,
            v0 if top else 0,
            u1 if right else width,
            v1 if bottom else height,
        )

    @cached_property
    def lines(self) -> np.ndarray:
        """(n, 2): dead columns (0, u) and rows (1, v)."""
        constant = self.constant
        lines = [[axis, k] for axis in (0, 1) for k in _find_dead_lines(constant, axis)]
        return np.array(lines, int).reshape(-1, 2)

    @cached_property
    def dead(self) -> Mask:
        """(h, w) bool: single pixels and pairs that are constant amid changing ones."""
        constant = self.constant
        side = 2 * WIDEST_LINE_PX + 3
        around = cv2.boxFilter(constant.view(np.uint8), cv2.CV_16U, (side, side), normalize=False)
        return constant & (around <= MOST_DEAD)

    @cached_property
    def area_px(self) -> int:
        """How many pixels are image."""
        return int(np.count_nonzero(self.image))

    @property
    def is_whole(self) -> bool:
        """Whether every pixel of the image is in the area."""
        return self.area_px == self.size[0] * self.size[1]

    def contains(self, pixels: Floats) -> Mask:
        """(n,) bool: whether pixels (n, 2) are image."""
        u, v = np.rint(np.asarray(pixels)).astype(int).T
        width, height = self.size
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        inside[inside] = self.image[v[inside], u[inside]]
        return np.asarray(inside)

    def contains_cells(self, shape: tuple[int, int]) -> Mask:
        """(rows, columns) bool of equal cells of the image: those whose middle is inside."""
        rows, columns = shape
        u, v = ((np.arange(n) + 0.5) / n for n in (columns, rows))
        return self.contains(grid_points(u, v) * np.array(self.size) - 0.5).reshape(shape)

    def fill_outside(self, cells: np.ndarray) -> np.ndarray:
        """Return values of equal cells (rows, columns) of the image, in which those outside the
        area have the value of the nearest inside: they may hold a sliver of it."""
        outside = ~self.contains_cells((cells.shape[0], cells.shape[1]))
        nearest = scipy.ndimage.distance_transform_edt(
            outside, return_distances=False, return_indices=True
        )
        return np.asarray(cells[tuple(nearest)])

    def describe(self) -> str:
        """Describe the pixels that no light changes; "" where there are none."""
        texts = [text for text in (self.describe_cut(), self._describe_hidden()) if text]
        if count := int(np.count_nonzero(self.dead)):
            texts.append(f"{count} single pixel{'s' * (count > 1)}, dead or hot")
        return " and ".join(texts)

    def describe_cut(self) -> str:
        """Describe the bars and dead lines; "" where there are none."""
        texts = []
        (u0, v0, u1, v1), (width, height) = self.box, self.size
        sides = {"left": u0, "right": width - u1, "top": v0, "bottom": height - v1}
        if bars := [f"{px} px at the {side}" for side, px in sides.items() if px]:
            texts.append(f"bars of {', '.join(bars)}")
        for axis, name in enumerate(("column", "row")):
            places = self.lines[self.lines[:, 0] == axis, 1]
            runs = [f"{a} to {b}" if b > a else f"{a}" for a, b in list_runs(places)]
            if runs:
                texts.append(f"{name}{'s' * (len(places) > 1)} {', '.join(runs)}")
        return " and ".join(texts)

    def _describe_hidden(self) -> str:
        """Describe what is hidden inside the bars, as by a mask or a lens hood."""
        u0, v0, u1, v1 = self.box
        hidden = (~self.image[v0:v1, u0:u1]).view(np.uint8)
        share = 100 * np.count_nonzero(hidden) / self.image.size
        if not share:
            return ""
        _, _, _, centres = cv2.connectedComponentsWithStats(hidden)
        thirds = np.minimum(3 * (centres[1:] + np.array([u0, v0])) // self.size, 2).astype(int)
        places = dict.fromkeys(_PLACES[row][column] for column, row in thirds.tolist())
        return f"{share:.1f} % at the {', '.join(places)}"


_PLACES = (
    ("top left", "top", "top right"),
    ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)


def _unpack(packed: np.ndarray, size: tuple[int, int]) -> Mask:
    """Return the bits of an image of ``size`` (width, height) px as (h, w) bool."""
    width, height = size
    bits = np.unpackbits(packed, count=width * height)
    return bits.view(bool).reshape(height, width)


def _close_gaps(changing: Mask) -> Mask:
    """Return an image's ``changing`` (h, w) bool pixels without islands and with small gaps filled;
    all pixels where there would be none."""
    gap, speck = (np.ones((n, n), np.uint8) for n in (WIDEST_LINE_PX + 1, LEAST_SPECK_PX))
    closed = cv2.morphologyEx(changing.view(np.uint8), cv2.MORPH_CLOSE, gap)
    area = cv2.morphologyEx(closed, cv2.MORPH_OPEN, speck).view(bool)
    return area if area.any() else np.ones_like(area)


def find_constant_pixels(frames: Iterable[np.ndarray]) -> Mask:
    """(h, w) bool: pixels of the same level in all frames (h, w) or (h, w, 3); none of a single
    frame."""
    others = iter(frames)
    first = next(others)
    constant, is_single = np.ones(first.shape[:2], bool), True
    for frame in others:
        same: Mask = frame == first
        constant &= same.all(axis=2) if same.ndim == 3 else same
        is_single = False
    return constant & (not is_single)


def measure_picture_area(pictures: Iterable[np.ndarray], count: int) -> ImageArea:
    """Return the area of ``count`` pictures (h, w) or (h, w, 3) of a board that moves: without bars
    and dead lines alone, as single pixels of what stands still agree by chance."""
    area = ImageArea.of(find_constant_pixels(pictures))
    return ImageArea.of(area.constant & ~area.dead & (count >= MIN_POSES))


def _find_unlit_pixels(stack: np.ndarray) -> Mask:
    """(h, w) bool: pixels in blocks that only noise changes in the frames (n, h, w); none of fewer
    frames than tell noise from light."""
    unlit = np.zeros(stack.shape[1:], bool)
    if len(stack) < MOST_FRAMES // 2:
        return unlit
    # evenly spaced frames might be of one step of the pattern
    order = np.random.default_rng(0).permutation(len(stack))
    some = stack[np.sort(order[:MOST_FRAMES])]
    rows = some.shape[1] // BLOCK_PX
    coarse = some[:, : rows * BLOCK_PX].reshape(len(some), rows, BLOCK_PX, -1)[:, ::COARSE]
    if _find_unlit_blocks(coarse.reshape(len(some), -1, some.shape[2])).mean() < LEAST_SHARE:
        return unlit
    blocks = _find_unlit_blocks(some)
    width, height = BLOCK_PX * blocks.shape[1], BLOCK_PX * blocks.shape[0]
    wide = cv2.resize(blocks.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    unlit[:height, :width] = wide.view(bool)
    unlit[height:], unlit[:, width:] = unlit[height - 1], unlit[:, [width - 1]]
    return unlit


def _find_unlit_blocks(frames: np.ndarray) -> Mask:
    """(rows, columns) bool of ``BLOCK_PX`` blocks of frames (n, h, w): those of one level, in which
    no more changes than independent noise of their pixels.

    The variance of a block's mean over the frames, times its number of pixels, is then the mean of
    its pixels' variances; light multiplies it by up to that number. What room light shows differs
    between pixels by more than the noise of one frame.
    """
    n, pixels = len(frames), BLOCK_PX**2
    rows, columns = (size // BLOCK_PX for size in frames.shape[1:])
    first = frames[0].astype(np.float32)
    means, squares, own = np.zeros((3, rows, columns))
    sums = np.zeros(first.shape, np.float32)
    for frame in frames:
        change = frame.astype(np.float32) - first
        block = _average_blocks(change)
        means += block
        squares += block**2
        own += _average_blocks(change**2)
        sums += change
    together = squares - means**2 / n
    each = own - _average_blocks(sums**2) / n
    freedom = n - 1
    low, high = scipy.special.chdtri(freedom, [1 - CHANCE, CHANCE]) / freedom
    is_unlit = (pixels * together > low * each) & (pixels * together < high * each)
    level = (first + sums / n)[: rows * BLOCK_PX, : columns * BLOCK_PX]
    level -= cv2.resize(_average_blocks(level), level.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(is_unlit & (freedom * _average_blocks(level**2) < each))


def _average_blocks(values: np.ndarray) -> Floats:
    """Return the means of the blocks of values (h, w)."""
    rows, columns = (size // BLOCK_PX for size in values.shape)
    whole = values[: rows * BLOCK_PX, : columns * BLOCK_PX]
    size = columns, rows
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.float64)


def _find_dead_lines(constant: Mask, axis: int) -> list[int]:
    """Return the indices of the dead columns (``axis`` 0) or rows (1)."""
    across = constant if axis == 0 else constant.T
    reach = np.ones((1, WIDEST_LINE_PX + 1), np.uint8)
    closed = cv2.morphologyEx((~across).astype(np.uint8), cv2.MORPH_CLOSE, reach)
    is_thin = (closed > 0) & across
    least = DEAD_LINE * len(across)
    places = np.flatnonzero(is_thin.sum(axis=0) >= least)
    longest, run = np.zeros((2, len(places)), int)
    for row in is_thin[:, places] if len(places) else ():
        run = (run + 1) * row
        longest = np.maximum(longest, run)
    return places[longest >= least].tolist()


def combine_areas(areas: Sequence[ImageArea | None]) -> ImageArea | None:
    """Return the area of a session's image from those of its poses, None where one is not known;
    None for the whole image.

    What is constant, or without light, in every pose is not image where the poses show image right
    beside it, or where it is a bar: a dark background ends elsewhere in each. Lines and single
    pixels that are dead in every pose are not image either.
    """
    known = [area for area in areas if area is not None]
    if len(known) < max(MIN_POSES, len(areas)):
        return None
    size = known[0].size
    never = _unpack(np.bitwise_and.reduce([area.packed for area in known]), size)
    hidden = np.logical_and.reduce([area.dead for area in known])
    for axis, place in set.intersection(*({*map(tuple, area.lines.tolist())} for area in known)):
        line = np.s_[:, place] if axis == 0 else np.s_[place]
        hidden[line] |= never[line]
    hidden |= _find_hidden([area.image for area in known])
    hidden |= _find_hidden([_close_gaps(~_unpack(area.packed_unlit, size)) for area in known])
    return ImageArea.of(hidden) if hidden.any() else None


def _find_hidden(images: Sequence[Mask]) -> Mask:
    """(h, w) bool: what is image in none of the poses' ``images``, and in no pose can be."""
    union = np.logical_or.reduce(images)
    if union.all():
        return ~union
    bars = ImageArea.of(~union)
    u0, v0, u1, v1 = bars.box
    hidden = np.ones_like(union)
    hidden[v0:v1, u0:u1] = False
    count, labels = cv2.connectedComponents((~union).view(np.uint8))
    beside = cv2.dilate(labels.astype(np.float32), np.ones((3, 3))).astype(int)
    beside[~union] = 0
    pixels = np.bincount(beside.ravel(), minlength=count)
    shown = np.mean([np.bincount(beside[i], minlength=count) for i in images], axis=0)
    is_hidden = shown >= SHOWN * np.maximum(pixels, 1)
    is_hidden[0] = False
    return np.asarray(hidden | is_hidden[labels])


def fill_dead(image: np.ndarray, area: ImageArea) -> np.ndarray:
    """Return an image (h, w) or (h, w, 3) whose dead lines are interpolated between their
    neighbours, by cubic splines, and whose dead pixels have their neighbours' median; the image
    itself without any."""
    lines, dead = area.lines, area.dead
    if len(lines) or dead.any():
        image = image.copy()
        image[dead] = cv2.medianBlur(image, 3)[dead]
    for axis in (0, 1):
        across = np.moveaxis(image, 1 - axis, 0)
        for first, last in list_runs(lines[lines[:, 0] == axis, 1]):
            around = np.arange(max(first - REACH_PX, 0), min(last + REACH_PX + 1, len(across)))
            places = np.arange(first, last + 1)
            known = np.setdiff1d(around, lines[lines[:, 0] == axis, 1])
            filled = scipy.interpolate.CubicSpline(known, across[known])(places)
            across[places] = np.clip(np.rint(filled), 0, np.iinfo(image.dtype).max)
    return image
