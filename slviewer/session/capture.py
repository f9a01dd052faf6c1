"""A capture: what the projector showed, what the camera saw, and what it is for."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import numpy as np

from slviewer.errors import InputError, SessionError
from slviewer.fringe.hdr import choose_exposure, chosen, peaks, pick
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.atomic import read_json, to_json, write_bytes, write_json
from slviewer.session.stack import check_frames, describe_stack, read_stack, write_stack

Role = Literal["calibration", "scan"]

_AT_ONCE = 8  # frames of an exposure that are in memory together while their peaks are taken


@dataclass(frozen=True)
class Capture:
    """A saved capture; frames and texture stay on disk until they are asked for."""

    name: str
    role: Role
    sequence: PatternSequence
    size: tuple[int, int]  # (width, height) of the camera's frames, px
    hash: str  # of frames, exposures, texture, sequence: equal where every result computed from them is equal
    folder: Path
    meta: dict[str, Any] = field(repr=False, compare=False)  # capture.json as it stands: source, settings, board, ...

    @property
    def frames(self) -> np.ndarray:
        """All frames (n, h, w), uint8 or uint16, in the sequence's order; read anew at every access."""
        return self.stack()

    def stack(self, indices: Sequence[int] | None = None) -> np.ndarray:
        """Frames (n, h, w) at `indices` into the sequence, in that order (all where None); reads only these.

        Those of a capture in several exposures are merged, pixel by pixel, as `exposure_choice` says. Raises
        SessionError where a frame is missing or damaged, or the capture was replaced since it was loaded.
        """
        path = self.folder / "frames.zarr"
        stack = self._merged(path, indices) if self.exposures_ms else read_stack(path, indices)
        if read_json(self.folder / "capture.json").get("hash") != self.hash:
            raise SessionError(f"capture {self.name!r} was replaced while it was in use: load it again")
        return stack

    @property
    def exposures_ms(self) -> tuple[float, ...]:
        """The exposures in which the sequence was taken one after another; empty where there was but one."""
        return tuple(float(exposure) for exposure in self.meta.get("exposures_ms") or ())

    @property
    def exposure_choice(self) -> np.ndarray | None:
        """(h, w) uint8: which of `exposures_ms` each pixel's frames are of; None where there was but one."""
        if not self.exposures_ms:
            return None
        return _choice(self.folder / "frames.zarr", self.exposures_ms, len(self.sequence.frames), self.hash)

    def _merged(self, path: Path, indices: Sequence[int] | None) -> np.ndarray:
        """Frame by frame, so that no more than one frame of each exposure is in memory beside the result."""
        n, choice = len(self.sequence.frames), self.exposure_choice
        assert choice is not None
        wanted = list(range(n)) if indices is None else [int(index) for index in indices]
        if any(not 0 <= index < n for index in wanted):
            raise InputError(f"frames {wanted} were asked for, {self.name} has frames 0 to {n - 1}")
        masks = chosen(choice, len(self.exposures_ms))
        stack = np.empty((len(wanted), *choice.shape), describe_stack(path)[1])
        for slot, index in enumerate(wanted):
            pick(list(read_stack(path, [index + n * e for e in range(len(masks))])), masks, stack[slot])
        return stack

    @property
    def texture(self) -> np.ndarray | None:
        """The colour texture (h, w, 3) RGB kept beside the frames, or None where the frames are all there is."""
        path = self.folder / "texture.png"
        if not self.meta.get("texture"):
            return None
        import cv2

        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None or image.shape != (self.size[1], self.size[0], 3):
            raise SessionError(f"{path} is missing or damaged: import or record capture {self.name!r} again")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


class NewCapture(Protocol):
    """What `Session.save_captures` takes: `importers.imported.ImportedCapture`, or anything like it."""

    @property
    def name(self) -> str: ...
    @property
    def sequence(self) -> PatternSequence: ...
    @property
    def frames(self) -> np.ndarray: ...
    @property
    def texture(self) -> np.ndarray | None: ...
    @property
    def source(self) -> str: ...
    @property
    def settings(self) -> Mapping[str, Any]: ...
    @property
    def exposures_ms(self) -> Sequence[float]: ...


def check_capture(
    role: str,
    sequence: PatternSequence,
    frames: np.ndarray,
    texture: np.ndarray | None,
    exposures_ms: Sequence[float] = (),
) -> None:
    """Raise InputError unless frames (n, h, w), or (k n, h, w) of k exposures, and a texture (h, w, 3) fit."""
    if role not in get_args(Role):
        raise InputError(f"role {role!r} is unknown: use 'calibration' or 'scan'")
    check_frames(frames)
    if len(exposures_ms) == 1 or len(set(exposures_ms)) < len(exposures_ms) or min(exposures_ms, default=1) <= 0:
        raise InputError(f"exposures of {list(exposures_ms)} ms: give two or more, each once, or none")
    if len(frames) != len(sequence.frames) * max(1, len(exposures_ms)):
        times = f" in {len(exposures_ms)} exposures" if exposures_ms else ""
        raise InputError(
            f"{len(frames)} frames for a sequence of {len(sequence.frames)}{times}: give one image a pattern"
        )
    if texture is not None and (texture.shape != (*frames.shape[1:], 3) or texture.dtype not in (np.uint8, np.uint16)):
        raise InputError(
            f"a colour texture of shape {(*frames.shape[1:], 3)}, uint8 or uint16, is needed, "
            f"got {texture.shape} {texture.dtype}"
        )


def write_capture(
    folder: Path,
    role: Role,
    sequence: PatternSequence,
    frames: np.ndarray,
    *,
    texture: np.ndarray | None,
    source: str,
    settings: Mapping[str, Any],
    board: str | None,
    exposures_ms: Sequence[float] = (),
) -> None:
    """Write a checked capture into an empty folder, every file synced; one exposure's frames after the other's."""
    frames_hash = write_stack(folder / "frames.zarr", frames)
    described = sequence.to_dict()
    whole = hashlib.blake2b(frames_hash.encode() + to_json(described), digest_size=20)
    if exposures_ms:
        whole.update(to_json(list(exposures_ms)))
    if texture is not None:
        whole.update(np.ascontiguousarray(texture).data)
        write_bytes(folder / "texture.png", _png(texture))
    write_json(
        folder / "capture.json",
        {
            "role": role,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "source": source,
            "board": board,
            "camera": {"size": [frames.shape[2], frames.shape[1]], "dtype": str(frames.dtype)},
            "frames": len(frames),
            **({"exposures_ms": list(exposures_ms)} if exposures_ms else {}),
            "hash": whole.hexdigest(),
            "texture": texture is not None,
            "settings": dict(settings),
            "sequence": described,
        },
    )


def read_capture(folder: Path) -> Capture:
    """The capture in a folder; its frames stay there. SessionError where its description is damaged."""
    meta = read_json(folder / "capture.json")
    try:
        width, height = meta["camera"]["size"]
        role, sequence, content_hash = meta["role"], PatternSequence.from_dict(meta["sequence"]), str(meta["hash"])
    except (KeyError, TypeError, ValueError, InputError) as error:
        raise SessionError(
            f"{folder / 'capture.json'} is damaged ({error!r}): move the folder away and import it again"
        ) from error
    return Capture(folder.name, role, sequence, (int(width), int(height)), content_hash, folder, meta)


@lru_cache(maxsize=4)
def _choice(path: Path, exposures_ms: tuple[float, ...], n: int, content_hash: str) -> np.ndarray:
    """The choice for the stack of that content; it takes a look at every frame, and is asked for again and again."""

    def frames(exposure: int) -> Iterator[np.ndarray]:
        for first in range(0, n, _AT_ONCE):
            yield from read_stack(path, range(exposure * n + first, exposure * n + min(first + _AT_ONCE, n)))

    choice = choose_exposure(np.stack([peaks(frames(e)) for e in range(len(exposures_ms))]), exposures_ms)
    if read_json(path.parent / "capture.json").get("hash") != content_hash:
        raise SessionError(f"capture {path.parent.name!r} was replaced while it was in use: load it again")
    choice.flags.writeable = False
    return choice


def _png(texture: np.ndarray) -> Any:
    import cv2

    # the fastest setting: level 1 halves nothing that matters and PNG stays readable everywhere
    done, data = cv2.imencode(".png", cv2.cvtColor(texture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise InputError("the texture could not be encoded as PNG: give a colour image of 8 or 16 bits")
    return data.data
