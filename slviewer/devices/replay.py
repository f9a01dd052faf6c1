"""A recorded capture as camera and projector: the frame that is shown is the frame that was
recorded."""

import numpy as np

from slviewer.devices.drivers import Driver
from slviewer.devices.protocols import (
    CameraDriver,
    Openable,
    Rig,
    check_index,
    check_level,
)
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.decode import texture
from slviewer.fringe.sequence import PatternSequence


class Recording:
    """Recorded frames (n, h, w), uint8 or uint16, and the sequence that was projected; `play`
    replaces both."""

    def __init__(self, frames: np.ndarray, sequence: PatternSequence) -> None:
        _check_recording(frames, sequence)
        self.played = (frames, sequence)
        self.visible_frame: np.ndarray | None = (
            None  # (h, w) of the pattern shown; None: not recorded
        )

    def play(self, frames: np.ndarray, sequence: PatternSequence) -> None:
        """Play another capture of the same rig; a running capture then ends with the old one. For
        any thread."""
        _check_recording(frames, sequence)
        before, projector = self.played[0], self.played[1].projector
        if (
            frames.shape[1:] != before.shape[1:]
            or frames.dtype != before.dtype
            or sequence.projector != projector
        ):
            raise InputError(
                f"the recording holds frames of {before.shape[1:]} {before.dtype} for a projector"
                f" of {projector}, got {frames.shape[1:]} {frames.dtype} and {sequence.projector}",
                "replay captures of one rig together",
            )
        self.played = (frames, sequence)


class ReplayCamera(CameraDriver):
    """Returns the recorded frames. Its settings are unknown and cannot be changed."""

    def __init__(self, recording: Recording) -> None:
        super().__init__("the replay camera")
        self._recording = recording
        height, width = recording.played[0].shape[1:]
        self.size, self.dtype = (width, height), recording.played[0].dtype

    @property
    def full_scale(self) -> int | None:
        """The grey level at which the recording's camera clipped; None where it is not known."""
        return self._recording.played[1].full_scale

    def _fill(self, out: np.ndarray) -> None:
        """Copy the recorded frame of the pattern shown; under even light of any level, the recorded
        texture."""
        if self._recording.visible_frame is None:
            raise DeviceError("the recording holds no dark frame", "show a pattern or light")
        out[:] = self._recording.visible_frame


class ReplayProjector(Openable):
    """Accepts the recorded sequence, and refuses any other."""

    def __init__(self, recording: Recording) -> None:
        super().__init__("the replay projector")
        self._recording = recording
        self._loaded: tuple[np.ndarray, PatternSequence] | None = None
        self.size = recording.played[1].projector

    def _start(self) -> None:
        """Start dark, with nothing loaded."""
        self._loaded = None
        self.show_level(None)

    def load(self, sequence: PatternSequence) -> None:
        """Load the recorded sequence. Raises DeviceError for any other."""
        self.check_open()
        played = self._recording.played
        if sequence != played[1]:
            raise DeviceError(
                "the recording answers only to the patterns it was made with,"
                f" {_describe_sequence(played[1])}, and was asked for"
                f" {_describe_sequence(sequence)}",
                "capture with its own sequence",
            )
        self._loaded = played

    def show(self, index: int) -> None:
        """Select frame `index` as the camera's next one."""
        self.check_open()
        frames, sequence = self._loaded or (np.empty(0), None)
        check_index(self, sequence, index)
        self._recording.visible_frame = frames[index]

    def show_level(self, grey: int | None) -> None:
        """Show even light as the recording has it: its texture, or its dark frame."""
        self.check_open()
        frames, sequence = self._recording.played
        if check_level(grey):
            self._recording.visible_frame = texture(sequence, frames)
        else:
            dark = [i for i, frame in enumerate(sequence.frames) if frame.kind == "black"]
            self._recording.visible_frame = frames[dark[0]] if dark else None


def replay(frames: np.ndarray, sequence: PatternSequence) -> Rig:
    """Return a rig that replays `frames` (n, h, w) of `sequence`, not copied. Raises InputError if
    they do not fit."""
    return recording_rig(Recording(frames, sequence))


def recording_rig(recording: Recording) -> Rig:
    """Return a rig that replays `recording`, on which more captures can be played later."""
    return Rig("replay", ReplayCamera(recording), ReplayProjector(recording))


DRIVER = Driver(
    "replay",
    "a recorded capture, played back",
    needs="frames and their pattern sequence",
    rig=replay,
)


def _check_recording(frames: np.ndarray, sequence: PatternSequence) -> None:
    """Raise InputError unless frames are (n, h, w) uint8 or uint16, one for each pattern."""
    if (
        frames.ndim != 3
        or frames.dtype not in (np.uint8, np.uint16)
        or len(frames) != len(sequence.frames)
    ):
        raise InputError(
            f"{len(sequence.frames)} frames (n, h, w) of uint8 or uint16 are needed for this"
            f" sequence, got {frames.shape} {frames.dtype}",
            "give one image a pattern",
        )


def _describe_sequence(sequence: PatternSequence) -> str:
    """Describe a sequence for messages: number of frames, projector size, kinds and periods."""
    width, height = sequence.projector
    kinds = sorted({frame.kind for frame in sequence.frames})
    periods = sorted({frame.period_px for frame in sequence.frames if frame.kind == "phase"})
    listed = [*kinds, *(f"period {period:g} px" for period in periods)]
    return f"{len(sequence.frames)} frames of {width}x{height} px ({', '.join(listed)})"
