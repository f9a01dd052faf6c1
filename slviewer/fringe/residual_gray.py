"""Gray code frames that contradict each other.

From one column of the projector to the next only one bit of a Gray code changes, and the less significant ones are then
1, 0, 0 ...: whatever the scene, as long as neighbouring pixels see neighbouring columns. A frame that shows another's
pattern breaks this along its stripes. A bit and its inverse, moreover, add up to the same light everywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.layout import Layout
from slviewer.fringe.residual_sample import FEWEST, PIXELS, roughness, spread_rows
from slviewer.fringe.sequence import PatternSequence
from slviewer.fringe.suspect import Suspect

_DECIDED = 0.2  # of the contrast, that a bit must lie away from the middle to be read
_REACH = 4  # px between two read pixels that count as neighbours
_FEWEST_EDGES = 30
_BROKEN, _WHOLE = 0.5, 0.9
"""Shares of a bit's edges that obey the code: fewer than the one are a fault, and more than the other explain it."""
_SAME = 0.1  # rms difference of repeated frames, as a share of the contrast
_SHARP = 0.5  # of the pixels, that must be read in it: fine stripes blur to the same grey
_STRIPED = 0.03  # of the pixels that must be dark, and bright, in a frame that could be told from its neighbour
_INSIDE = 0.35  # of the contrast: blurred stripes seen through a gamma of 2.2 lie 0.28 from the middle
_ALIKE = 0.2  # of these pixels, that may be alike in a bit and its inverse; half are in frames that are no pair
_READABLE = 6.0  # px: mean width of stripes that can be read at most pixels
_NOT_WHITE = 0.2  # of the pixels


@dataclass(frozen=True, eq=False)
class _Lines:
    """Pixels along rows and columns of the image: ``frames`` by index (p,) float32 grey levels.

    ``line`` (p,) counts the lines, of which those from ``columns`` on are columns; ``place`` (p,) px along a line.
    """

    frames: dict[int, np.ndarray]
    line: np.ndarray
    columns: int
    place: np.ndarray
    middle: np.ndarray
    contrast: np.ndarray

    def bit(self, index: int) -> np.ndarray:
        """(p,) bool."""
        return self.frames[index] > self.middle

    def decided(self, index: int, part: float = _DECIDED) -> np.ndarray:
        """(p,) bool: not on the edge of a stripe, farther from the middle than this part of the contrast."""
        return np.abs(self.frames[index] - self.middle) > part * self.contrast


def code_suspects(sequence: PatternSequence, found: Layout, stack: np.ndarray, white: float) -> list[Suspect]:
    """What is wrong with the Gray code frames of one axis."""
    bits = (*found.gray, *(() if found.complementary is None else (found.complementary,)))
    lines = _lines(sequence, found, stack, bits, white)
    if lines is None:
        return []
    out = _repeated(lines, sorted({*bits, *found.inverse}))
    if not out and found.inverse:
        out = _sums(lines, found)
    if not out:
        out = _disordered(lines, bits, found.inverse)
    return out + _not_white(sequence, lines)


def _lines(
    sequence: PatternSequence, found: Layout, stack: np.ndarray, bits: Sequence[int], white: float
) -> _Lines | None:  # fmt: skip
    height, width = stack.shape[1:]
    rows = spread_rows(height, width, PIXELS // 2)
    columns = spread_rows(width, height, PIXELS // 2)
    code = (*bits, *found.inverse)
    lit = [i for i, frame in enumerate(sequence.frames) if frame.kind in ("white", "black", "texture")]
    wanted = sorted({*code, *(i - 1 for i in code if i), *lit})

    def sampled(i: int) -> np.ndarray:
        return np.concatenate([stack[i][rows].ravel(), stack[i][:, columns].T.ravel()]).astype(np.float32)

    frames = {i: sampled(i) for i in wanted}
    line = np.concatenate(
        [np.repeat(np.arange(len(rows)), width), np.repeat(len(rows) + np.arange(len(columns)), height)]
    )
    place = np.concatenate([np.tile(np.arange(width), len(rows)), np.tile(np.arange(height), len(columns))])
    clipped = np.maximum.reduce([frames[i] for i in code]) >= white
    # Fringes and white light make sure of the contrast where a bit that shows another's pattern would take it away.
    all_seen = [*(frames[i] for i in (*code, *lit)), *(sampled(i) for shift in found.shifts for i in shift.indices)]
    high, low = (extreme.reduce(all_seen) for extreme in (np.maximum, np.minimum))
    noise = roughness(np.stack([frames[i][: len(rows) * width] for i in code]), width)
    limit = 2 * max(limits.DARK_LEVELS * white / 255, limits.DARK_SIGMAS * noise)
    seen = (high - low > limit) & ~clipped
    if np.count_nonzero(seen) < FEWEST:
        return None
    return _Lines(
        {i: frame[seen] for i, frame in frames.items()},
        line[seen],
        len(rows),
        place[seen],
        (0.5 * (high + low))[seen],
        (high - low)[seen],
    )


def _repeated(lines: _Lines, code: list[int]) -> list[Suspect]:
    """Frames like the one before them, where its stripes are seen: no two frames of a code have an edge in common."""
    out = []
    for i in code:
        if i - 1 not in lines.frames:
            continue
        difference = (lines.frames[i] - lines.frames[i - 1]) / lines.contrast
        share = float(lines.bit(i - 1).mean())
        striped = min(share, 1 - share) > _STRIPED and _edges(lines, i - 1) >= _FEWEST_EDGES
        sharp = float(lines.decided(i - 1).mean()) > _SHARP
        if striped and sharp and float(np.sqrt(np.mean(difference**2))) < _SAME:
            out.append(Suspect(i, "late", f"frame {i + 1} shows the pattern of frame {i}: it is late or repeated"))
    return out


def _sums(lines: _Lines, found: Layout) -> list[Suspect]:
    """Bits and inverses that are bright together, or dark together.

    Only pixels inside stripes count: where stripes are finer than the blur, both frames show the same grey, which a
    camera's gamma moves away from the middle.
    """
    alike = {}
    for i, j in zip(found.gray, found.inverse, strict=True):
        inside = lines.decided(i, _INSIDE) & lines.decided(j, _INSIDE)
        if np.count_nonzero(inside) >= FEWEST:
            alike[i, j] = float(np.mean((lines.bit(i) == lines.bit(j))[inside]))
    wrong = [pair for pair, share in alike.items() if share > _ALIKE]
    out = []
    # Where one image is lost or comes twice, all that follow have moved.
    if len(wrong) > 2 and wrong == list(alike)[-len(wrong) :]:
        i = min(wrong[0])
        text = (
            f"from frame {i + 1} on bits and inverses do not add up to white: the camera is an image behind or ahead, "
            "or one was lost there"
        )
        return [Suspect(i, "lag", text)]
    for i, j in wrong:
        text = f"frames {i + 1} and {j + 1}, a bit and its inverse, do not add up to white: one of them is not its own"
        out.append(Suspect(i, "strange", text))
    return out


def _disordered(lines: _Lines, bits: Sequence[int], inverse: Sequence[int]) -> list[Suspect]:
    """Frames that have changed places, or come too early, by what their edges say."""
    while bits and _stripe(lines, bits[-1]) < _READABLE:  # the rest is the Gray code of wider cells
        bits, inverse = bits[:-1], inverse[: len(bits) - 1]
    n = len(bits)
    if n < 2:
        return []
    edges = _Edges(lines, bits)
    if edges.obeyed(list(range(n)), _BROKEN):
        return []
    consecutive = tuple(bits) == tuple(range(bits[0], bits[0] + n))
    stories: list[tuple[list[int | None], Suspect]] = []
    for k in range(n - 1):
        order: list[int | None] = list(range(n))
        order[k], order[k + 1] = k + 1, k
        text = f"frames {bits[k] + 1} and {bits[k + 1] + 1} have changed places"
        stories.append((order, Suspect(bits[k], "swapped", text)))
    for k in range(n - 1 if consecutive else 0):
        order = [*range(k), None, *range(k, n - 1)]
        text = f"frame {bits[k] + 1} is missing, and those that follow came too early"
        stories.append((order, Suspect(bits[k], "dropped", text)))
    for k in range(n):
        order = [None if b == k else b for b in range(n)]
        text = f"frame {bits[k] + 1} does not fit the other bits: something else was shown"
        stories.append((order, Suspect(bits[k], "strange", text)))
    for k, other in enumerate(inverse):
        order = [~b if b == k else b for b in range(n)]
        first, second = sorted((bits[k], other))
        text = f"frames {first + 1} and {second + 1}, a bit and its inverse, have changed places"
        stories.append((order, Suspect(first, "swapped", text)))
    fitting = [(edges.explained(order), suspect) for order, suspect in stories if edges.obeyed(order, _WHOLE)]
    most = max((explained for explained, _ in fitting), default=0)
    best = [suspect for explained, suspect in fitting if explained == most]
    if len(best) > 2:
        return best[-1:]
    return [replace(best[0], sentence=", or ".join(suspect.sentence for suspect in best))] if best else []


class _Edges:
    """Where exactly one of the bits changes between two neighbours that are read."""

    def __init__(self, lines: _Lines, bits: Sequence[int]) -> None:
        read = np.logical_and.reduce([lines.decided(i) for i in bits])
        kept = np.flatnonzero(read)
        near = (np.diff(lines.place[kept]) <= _REACH) & (np.diff(lines.line[kept]) == 0)
        self._values = np.stack([lines.bit(i)[kept] for i in bits])
        self._changes = (self._values[:, 1:] != self._values[:, :-1]) & near
        self._first = self._values[:, :-1]

    def obeyed(self, order: Sequence[int | None], share: float) -> bool:
        """Whether so many of each bit's edges obey the code.

        order[b] is the frame that shows bit b, by its place among the bits; None if none does, and ~place if inverted.
        """
        counts = [(seen, legal) for seen, legal in self._counted(order) if seen >= _FEWEST_EDGES]
        return all(legal >= share * seen for seen, legal in counts)

    def explained(self, order: Sequence[int | None]) -> int:
        """How many edges obey the code, less those that break it."""
        return sum(2 * legal - seen for seen, legal in self._counted(order))

    def _counted(self, order: Sequence[int | None]) -> list[tuple[int, int]]:
        """Of each bit that is shown: its edges that are no other bit's, and how many of them obey the code."""
        shown = {b: frame for b, frame in enumerate(order) if frame is not None}
        single = sum(self._changes[_place(frame)].astype(np.int8) for frame in shown.values()) == 1
        counts = []
        for b, frame in shown.items():
            here = np.flatnonzero(single & self._changes[_place(frame)])
            legal = np.ones(len(here), bool)
            for lower in range(b + 1, len(order)):
                if lower in shown:
                    frame = shown[lower]
                    wanted = (lower == b + 1) == (frame >= 0)
                    legal &= self._first[_place(frame), here] == wanted
            counts.append((len(here), int(np.count_nonzero(legal))))
        return counts


def _place(frame: int) -> int:
    return frame if frame >= 0 else ~frame


def _edges(lines: _Lines, i: int) -> int:
    """How many edges of stripes a frame has along the lines."""
    bit = lines.bit(i)
    near = (np.diff(lines.place) <= _REACH) & (np.diff(lines.line) == 0)
    return int(np.count_nonzero((bit[1:] != bit[:-1]) & near))


def _stripe(lines: _Lines, i: int) -> float:
    """Mean width in px of a frame's stripes, along the rows or the columns, whichever is less."""
    bit = lines.bit(i)
    near = (np.diff(lines.place) <= _REACH) & (np.diff(lines.line) == 0)
    edges = (bit[1:] != bit[:-1]) & near
    across = lines.line[1:] >= lines.columns
    return min(float(np.count_nonzero(part)) / (1 + np.count_nonzero(edges & part)) for part in (across, ~across))


def _not_white(sequence: PatternSequence, lines: _Lines) -> list[Suspect]:
    """White frames that are dark in places, and dark ones that are bright."""
    out = []
    for i, frame in enumerate(sequence.frames):
        if frame.kind in ("white", "texture", "black") and i in lines.frames:
            bright = lines.frames[i] > lines.middle
            wrong = float(bright.mean() if frame.kind == "black" else 1 - bright.mean())
            if wrong > _NOT_WHITE:
                what = "dark" if frame.kind == "black" else "white"
                text = f"frame {i + 1} should be {what}, and is not: it is late or out of order"
                out.append(Suspect(i, "strange", text))
    return out
