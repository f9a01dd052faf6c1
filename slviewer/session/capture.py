"""A capture: what the projector showed, what the camera saw, and what it is for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from slviewer.errors import DamagedError, InputError, SessionError
from slviewer.fringe.hdr import choose_exposure, chosen, merge_exposures, peaks, pick
from slviewer.fringe.layout import lowest_white, sample_phase_steps
from slviewer.fringe.sequence import PatternSequence, Size
from slviewer.records.calibration import SECOND_CAMERA
from slviewer.records.record import from_plain
from slviewer.session.atomic import to_json, write_bytes
from slviewer.session.layout import time_now
from slviewer.session.reading import MOST_REMEMBERED, decoding, identify, read_json
from slviewer.session.results import Exposure, StoredSize, digest_bytes
from slviewer.session.stack import (
    FrameStack,
    check_indices,
    check_stack_array,
    hash_frames,
    write_stack,
)

Role = Literal["calibration", "scan"]
Purpose = Literal["pose", "scan", "plane", "sphere"]
"""What a capture is made for: all but target poses are scans."""
SECOND = "second"
"""Folder in a capture's, a capture itself: what a second camera saw of the same patterns."""
Comparison = Literal["absent", "same", "damaged", "different"]
"""Of a stored capture with a new one: "damaged" was the same when it was saved."""


@dataclass(frozen=True)
class TurnStep:
    """One capture of a turn on a turntable: the turn's name, which step of how many, from 1, and
    the angle of a step.

    Angles of one turn belong together; the object may have been moved between two turns.
    `position_deg` is what the table itself counted there.
    """

    turn: str
    step: Annotated[int, msgspec.Meta(ge=1)]
    steps: Annotated[int, msgspec.Meta(ge=1)]
    step_deg: float
    position_deg: float = 0.0

    @property
    def deg(self) -> float:
        """The angle of the table from the first step of the turn."""
        return self.step_deg * (self.step - 1)

    @property
    def name(self) -> str:
        """The name of the capture."""
        return f"{self.turn}_{self.step:02d}"


@dataclass(frozen=True)
class Capture:
    """A saved capture; frames and texture stay on disk until they are read."""

    name: str
    role: Role
    sequence: PatternSequence
    size: Size  # (width, height) of the camera's frames, px
    # of frames, exposures, texture, sequence: equal where every result computed from them is equal
    hash: str
    folder: Path
    # content of capture.json: source, settings, board, ...
    meta: dict[str, Any] = field(repr=False, compare=False)

    @property
    def purpose(self) -> Purpose:
        """What was captured: a pose of the target, an object, or a shape to verify with."""
        own: Purpose = "pose" if self.role == "calibration" else "scan"
        return self.meta.get("settings", {}).get("purpose", own)

    @property
    def is_imported_cloud(self) -> bool:
        """Whether it is a cloud from a file, which has no frames, and no calibration."""
        return not self.sequence.frames

    def require_frames(self, verb: str) -> None:
        """Raise InputError, that this cannot be done, for an imported cloud."""
        if self.is_imported_cloud:
            raise InputError(
                f"Cannot {verb} {self.name!r}",
                f"it was imported as a cloud ({self.meta['source']}) and has no frames. Align,"
                " merge, measure or compare it as it is.",
            )

    @property
    def brightest_frame(self) -> int:
        """The index of the frame that shows the scene best: a texture, else a white one."""
        ranks: dict[str, int] = {"texture": 0, "white": 1, "phase": 2, "gray": 3}
        frames = self.sequence.frames
        return min(range(len(frames)), key=lambda k: ranks.get(frames[k].kind, 9))

    def frame_file(self, index: int) -> tuple[Path, int]:
        """Return the file that begins with the pixels of a frame, row by row and little-endian, and
        the bytes of a pixel. Raises as `stack`."""
        self.require_frames("show")
        stored = FrameStack.open(self.folder / "frames.zarr")
        return stored.chunk_path(index), stored.dtype.itemsize

    @property
    def frames(self) -> np.ndarray:
        """All frames (n, h, w), uint8 or uint16, in the sequence's order; read anew at every
        access."""
        return self.stack()

    def stack(self, indices: Sequence[int] | None = None) -> np.ndarray:
        """Frames (n, h, w) at `indices` into the sequence, in that order (all where None); reads
        only these.

        Those of a capture in several exposures are merged, pixel by pixel, by `exposure_choice`.
        Raises DamagedError where a frame is not what was saved (of an older capture, whose frames
        have no checksums, only where all are read), SessionError where the capture was replaced
        since it was loaded, InputError for an imported cloud.
        """
        self.require_frames("decode")
        stored = FrameStack.open(self.folder / "frames.zarr")
        n, (width, height) = self.sequence.count_images(self.exposures_ms), self.size
        if (shape := stored.shape) != (n, height, width):
            raise DamagedError(
                f"{self.name}: {self.folder} is damaged: its description states {n} frames of"
                f" {width}x{height} px, and frames.zarr holds {shape[0]} of {shape[2]}x{shape[1]}"
                " px",
                "restore the folder from a copy, or import or record the capture again",
            )
        if (indices is None or self.exposures_ms) and not stored.has_checksums:
            _verify_once(self.folder, self.hash, stored.identify())
        stack = self._merged(stored, indices) if self.exposures_ms else stored.read(indices)
        _require_unchanged(self.folder, self.hash)
        return stack

    @cached_property
    def second(self) -> "Capture | None":
        """What the second camera saw of the same patterns; None of a rig with one."""
        if not self.is_of_pair:
            return None
        second = read_capture(self.folder / SECOND)
        if second.hash != self.meta[SECOND]:
            raise DamagedError(
                f"{self.name}: the frames of its second camera are not those that were saved with"
                " it",
                "restore the folder from a copy, or import or record the capture again",
            )
        return replace(second, name=f"{self.name}, second camera")

    @property
    def is_of_pair(self) -> bool:
        """Whether two cameras took it."""
        return bool(self.meta.get(SECOND))

    def name_devices(self, text: str) -> str:
        """Return a text on the calibration, in which a second camera has the projector's place,
        with its name there."""
        return text.replace("projector", SECOND_CAMERA) if self.is_of_pair else text

    @property
    def other_size(self) -> Size | None:
        """(width, height) px of the device that the camera is calibrated with: the second camera,
        else the projector, None where that is not known."""
        return self.sequence.projector_size if self.second is None else self.second.size

    def verify(self) -> list[str]:
        """Read everything; returns the hash of each stored frame. Raises DamagedError unless the
        frames and their description are those that were saved."""
        if self.is_imported_cloud:
            return []  # its points are those of the result that states its hash
        content, frames = FrameStack.open(self.folder / "frames.zarr").hash()
        described, exposures_ms = self.meta["sequence"], self.meta.get("exposures_ms")
        seen = self.meta.get(SECOND, "")
        if _hash_content(content, described, exposures_ms, self.texture, seen) != self.hash:
            raise DamagedError(
                f"{self.name}: what {self.folder} holds is not what was saved (its hash differs)",
                "restore the folder from a copy, or import or record the capture again",
            )
        if self.second is not None:
            self.second.verify()
        return frames

    @property
    def exposures_ms(self) -> tuple[float, ...]:
        """The exposure times of a sequence that was captured repeatedly; empty for a single
        exposure."""
        return tuple(float(exposure) for exposure in self.meta.get("exposures_ms") or ())

    @property
    def files(self) -> tuple[str, ...]:
        """The files that an importer read, one a frame of every exposure in turn; empty of captures
        without files."""
        return tuple(self.meta.get("files") or ())

    @property
    def turn_step(self) -> TurnStep | None:
        """The step of a turn that it was captured at; None for other captures."""
        stored = self.meta.get("settings", {}).get("turntable")
        return None if stored is None else from_plain(stored, TurnStep)

    @property
    def lens(self) -> dict[str, float]:
        """What the camera reported of its "focus", "zoom" and "aperture", in its own units."""
        return from_plain(self.meta.get("settings", {}).get("lens", {}), dict[str, float])

    @property
    def exposure_choice(self) -> np.ndarray | None:
        """(h, w) uint8: which of `exposures_ms` each pixel's frames are of; None for a single
        exposure."""
        if not self.exposures_ms:
            return None
        return _choose_exposures(self.folder, self.exposures_ms, self.sequence, self.hash)

    def _merged(self, stored: FrameStack, indices: Sequence[int] | None) -> np.ndarray:
        """The merged frames (n, h, w) at `indices`; with one frame of each exposure in memory at
        most."""
        n, choice = len(self.sequence.frames), self.exposure_choice
        assert choice is not None
        wanted = check_indices(self.name, indices, n)
        masks = chosen(choice, len(self.exposures_ms))
        stack = np.empty((len(wanted), *choice.shape), stored.dtype)
        for slot, index in enumerate(wanted):
            pick(list(stored.read(range(index, stored.shape[0], n))), masks, stack[slot])
        return stack

    @property
    def texture(self) -> np.ndarray | None:
        """The colour texture (h, w, 3) RGB stored with the frames, or None where there is none."""
        path = self.folder / "texture.png"
        if not self.meta.get("texture"):
            return None
        from slviewer.session.importers.images import read_image

        shape = (self.size[1], self.size[0], 3)
        try:
            image = read_image(path)
            if image.shape != shape:
                raise InputError(f"its shape is {image.shape}, not {shape}")
        except InputError as error:
            raise DamagedError(
                f"{self.name}: its texture is damaged ({path}: {error})",
                "restore this file from a copy, or import or record the capture again",
            ) from error
        return np.ascontiguousarray(image[..., ::-1])


@dataclass(frozen=True)
class _Camera:
    """The entry `camera` of `capture.json`."""

    size: StoredSize


@dataclass(frozen=True)
class _Description:
    """The entries of `capture.json` that are read, with their types and ranges."""

    role: Role
    hash: str
    camera: _Camera
    sequence: dict[str, Any]
    source: str = ""
    board: str | None = None
    texture: bool = False
    exposures_ms: list[Exposure] = field(default_factory=list)
    files: list[str] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)
    second: str = ""


@dataclass(frozen=True)
class NewCapture:
    """A capture in memory, to be saved: ``frames`` (n, h, w) uint8 or uint16 in the order of
    ``sequence``, or (k n, h, w) of the k ``exposures_ms``, one exposure after the other;
    ``texture`` (h, w, 3) RGB where the scene is known in colour; ``source``: where it comes from;
    ``files``: of an import, relative to that, one a frame. An imported cloud has no frames, (0, h,
    w) of its rows of points, and their hash as ``settings["cloud"]``. ``second``: what a second
    camera saw of the same sequence, in the same exposures; its name is not used.
    """

    name: str
    sequence: PatternSequence
    frames: np.ndarray
    texture: np.ndarray | None = None
    source: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    exposures_ms: Sequence[float] = ()
    files: tuple[str, ...] = ()
    second: "NewCapture | None" = None

    @property
    def hash(self) -> str:
        """The content hash that the capture will have once it is saved: of frames, exposures,
        texture, sequence."""
        described, exposures_ms = self.sequence.to_dict(), list(self.exposures_ms)
        frames = hash_frames(self.frames) if len(self.frames) else self.settings["cloud"]
        seen = self.second.hash if self.second else ""
        return _hash_content(frames, described, exposures_ms, self.texture, seen)

    @property
    def nbytes(self) -> int:
        """Total size of frames and texture, bytes."""
        own = self.frames.nbytes + (0 if self.texture is None else self.texture.nbytes)
        return own + (self.second.nbytes if self.second else 0)

    def merged_frames(self) -> np.ndarray:
        """(n, h, w): of several exposures, each pixel from the longest that did not clip it."""
        if not self.exposures_ms:
            return self.frames
        stacks = np.split(self.frames, len(self.exposures_ms))
        samples = [sample_phase_steps(self.sequence, stack) for stack in stacks]
        white = lowest_white(self.sequence, samples)
        return merge_exposures(stacks, self.exposures_ms, white)[0]

    def check(self) -> None:
        """Raise InputError unless frames, exposures and texture fit the sequence and one
        another."""
        exposures, texture, shape = self.exposures_ms, self.texture, self.frames.shape
        if not self.sequence.frames:
            return
        if self.second is not None:
            self.second.check()
            if self.second.sequence != self.sequence:
                raise InputError(
                    f"{self.name}: its two cameras saw different patterns",
                    "give both the same sequence",
                )
        check_stack_array(self.frames)
        if (
            len(exposures) == 1
            or len(set(exposures)) < len(exposures)
            or min(exposures, default=1) <= 0
        ):
            raise InputError(
                f"exposures of {list(exposures)} ms", "give two or more, each once, or none"
            )
        if len(self.frames) != self.sequence.count_images(exposures):
            times = f" in {len(exposures)} exposures" if exposures else ""
            raise InputError(
                f"{shape[0]} frames for a sequence of {len(self.sequence.frames)}{times}",
                "give one image a pattern",
            )
        if texture is not None and (
            texture.shape != (*shape[1:], 3) or texture.dtype not in (np.uint8, np.uint16)
        ):
            raise InputError(
                f"a colour texture of shape {(*shape[1:], 3)}, uint8 or uint16, is needed, "
                f"got {texture.shape} {texture.dtype}"
            )


def write_capture(folder: Path, capture: NewCapture, role: Role, board: str | None) -> None:
    """Write a checked capture into an empty folder, every file synced."""
    frames, texture, exposures_ms = capture.frames, capture.texture, list(capture.exposures_ms)
    frames_hash = (
        write_stack(folder / "frames.zarr", frames) if len(frames) else capture.settings["cloud"]
    )
    described = capture.sequence.to_dict()
    seen = ""
    if capture.second is not None:
        (folder / SECOND).mkdir()
        write_capture(folder / SECOND, capture.second, role, board)
        seen = capture.second.hash
    if texture is not None:
        import cv2

        # the fastest setting: level 1 halves nothing that matters and PNG stays readable everywhere
        done, data = cv2.imencode(
            ".png", cv2.cvtColor(texture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 1]
        )
        if not done:
            raise InputError(
                "the texture could not be encoded as PNG", "give a colour image of 8 or 16 bits"
            )
        write_bytes(folder / "texture.png", data.data)
    write_bytes(
        folder / "capture.json",
        to_json(
            {
                "role": role,
                "created": time_now(),
                "source": capture.source,
                "board": board,
                "camera": {"size": [frames.shape[2], frames.shape[1]], "dtype": str(frames.dtype)},
                "frames": len(frames),
                **({"exposures_ms": exposures_ms} if exposures_ms else {}),
                **({"files": capture.files} if capture.files else {}),
                **({SECOND: seen} if seen else {}),
                "hash": _hash_content(frames_hash, described, exposures_ms, texture, seen),
                "texture": texture is not None,
                "settings": capture.settings,
                "sequence": described,
            }
        ),
    )


def read_capture(folder: Path) -> Capture:
    """The capture in a folder; its frames stay there. SessionError where its description is
    damaged."""
    return _read_capture(folder, identify(folder / "capture.json"))


@lru_cache(MOST_REMEMBERED)
def _read_capture(folder: Path, identity: object) -> Capture:
    """Read a capture, as `read_capture` does."""
    meta = read_json(folder / "capture.json")
    with decoding(folder / "capture.json"):
        described = from_plain(meta, _Description)
        from_plain(described.settings.get("lens", {}), dict[str, float])
        sequence = PatternSequence(None, ())
        if "cloud" not in described.settings:
            sequence = PatternSequence.from_dict(described.sequence)
        if "turntable" in described.settings:
            from_plain(described.settings["turntable"], TurnStep)
    return Capture(
        folder.name, described.role, sequence, described.camera.size, described.hash, folder, meta
    )


def compare_stored(folder: Path, new: NewCapture, role: Role) -> Comparison:
    """How the capture stored in a folder compares with a new one, checked, for that role."""
    if not folder.exists():
        return "absent"
    try:
        saved = read_capture(folder)
    except SessionError:
        return "different"
    if (saved.role, saved.hash) != (role, new.hash):
        return "different"
    try:
        saved.verify()
    except SessionError:
        return "damaged"
    return "same"


def _hash_content(
    frames_hash: str,
    described: Mapping[str, Any],
    exposures_ms: Sequence[float] | None,
    texture: np.ndarray | None,
    second: str,
) -> str:
    """Return the content hash of a capture from that of its frames, its sequence as plain values,
    the rest, and the hash of what its ``second`` camera saw."""
    return digest_bytes(
        frames_hash.encode(),
        to_json(described),
        to_json(exposures_ms) if exposures_ms else b"",
        b"" if texture is None else np.ascontiguousarray(texture).data,
        second.encode(),
    ).hex()


@lru_cache(maxsize=1024)
def _verify_once(folder: Path, content_hash: str, identity: object) -> None:
    """Verify a capture whose frames have no checksums, once a process while its files stay the
    same."""
    capture = read_capture(folder)
    # else it is being replaced, which the reader of the frames reports
    if capture.hash == content_hash:
        capture.verify()


@lru_cache(maxsize=4)
def _choose_exposures(
    folder: Path, exposures_ms: tuple[float, ...], sequence: PatternSequence, content_hash: str
) -> np.ndarray:
    """(h, w) uint8: the exposure of each pixel, from all frames of the stack; cached by its
    content."""
    n, stored = len(sequence.frames), FrameStack.open(folder / "frames.zarr")
    highest, samples = [], []
    for e in range(len(exposures_ms)):
        stack = stored.read(range(e * n, (e + 1) * n))
        highest.append(peaks(stack))
        samples.append(sample_phase_steps(sequence, stack))
    choice = choose_exposure(np.stack(highest), exposures_ms, lowest_white(sequence, samples))
    _require_unchanged(folder, content_hash)
    choice.flags.writeable = False
    return choice


def _require_unchanged(folder: Path, content_hash: str) -> None:
    """Raise SessionError where the capture in a folder has another hash than when it was loaded."""
    if read_json(folder / "capture.json").get("hash") != content_hash:
        raise SessionError(
            f"capture {folder.name!r} was replaced while it was in use", "load it again"
        )
