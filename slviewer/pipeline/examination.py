"""Checks of a capture's frames: their examination, computed once and saved as `trust/<name>`, and
whether they are too bright or too dark; and the results of the checks of a rig or of a capture."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import structs

from slviewer.examination.examine import examine
from slviewer.examination.light import Look
from slviewer.fringe.cosines import select_rows
from slviewer.fringe.layout import white_level
from slviewer.fringe.phase import PhaseMaps, Reason
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.operation import Warn
from slviewer.records.record import from_plain, to_plain
from slviewer.records.verdict import Examination
from slviewer.session.capture import Capture
from slviewer.session.store import Session

CheckVerdict = Literal["good", "warning", "bad", "unknown"]
"""Fit to capture; with reservations; not before it is corrected; could not be determined."""

CheckName = Literal[
    "screen", "latency", "order", "repeats", "exposure", "gamma", "pixels", "flicker", "ambient",
    "motion", "burst",
    "turntable", "description", "noise", "decoding",
]  # fmt: skip

_WORST_FIRST: tuple[CheckVerdict, ...] = ("bad", "warning", "good")


class Check(msgspec.Struct, frozen=True, rename={"observation": "sentence"}):
    """The result of one check: the ``observation``; the ``remedy``, empty where none is needed; and
    the ``figures`` that they are based on, whose names contain their units. Both are whole
    sentences; JSON has the observation as "sentence".
    """

    name: CheckName
    verdict: CheckVerdict
    observation: str
    remedy: str = ""
    figures: dict[str, Any] = {}

    @property
    def message(self) -> str:
        """Observation and remedy."""
        return f"{self.observation} {self.remedy}".rstrip()


@dataclass(frozen=True)
class Preflight:
    """All checks of one rig, and what follows from them for its captures.

    ``settle_ms``: what `Rig.settle_ms` should be, None where it could not be measured. ``levels``:
    the table for `PatternSequence.levels` that makes the light proportional, None where it was not
    measured. ``exposure_ms``: the exposure to set, None where the one that is set is right, or
    unknown. ``seconds``: how long it took.
    """

    checks: tuple[Check, ...]
    settle_ms: float | None = None
    levels: tuple[int, ...] | None = None
    exposure_ms: float | None = None
    seconds: float = 0.0

    @property
    def verdict(self) -> CheckVerdict:
        """The worst of all checks; what is unknown does not make a good rig worse."""
        verdicts = {check.verdict for check in self.checks}
        return next((verdict for verdict in _WORST_FIRST if verdict in verdicts), "unknown")

    def join(self, second: "Preflight") -> "Preflight":
        """Return the checks of two cameras: of each the worse one, which says where it is the
        ``second`` camera's. The longer wait is set, and the shorter exposure, if both are wrong."""
        others = {check.name: check for check in second.checks}
        joined = []
        for check in self.checks:
            other = others.get(check.name, check)
            pair = Preflight((check, other))
            if other.verdict == pair.verdict != check.verdict:
                check = structs.replace(other, observation=f"Second camera: {other.observation}")
            joined.append(check)
        settle = self.settle_ms, second.settle_ms
        exposure = self.exposure_ms, second.exposure_ms
        return Preflight(
            tuple(joined),
            None if None in settle else max(filter(None, settle), default=0.0),
            self.levels,
            None if None in exposure else min(filter(None, exposure), default=None),
            self.seconds + second.seconds,
        )

    def check(self, name: CheckName) -> Check:
        """The check called `name`. Raises KeyError."""
        return {check.name: check for check in self.checks}[name]

    @property
    def failure(self) -> str:
        """Why the command ends with status 1; empty unless something is bad."""
        if self.verdict != "bad":
            return ""
        return (
            "the rig or the capture is not fit to measure with: correct what is marked bad, then"
            " check, or capture, again"
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return to_plain(self) | {"verdict": self.verdict, "seconds": round(self.seconds, 2)}

    def text(self) -> str:
        """Each check with its remedy, then what to set."""
        lines = []
        for check in self.checks:
            lines.append(f"{check.verdict:<8} {check.name}: {check.observation}")
            if check.remedy:
                lines.append(f"         -> {check.remedy}")
        if self.settle_ms is not None:
            lines.append(f"settle_ms = {self.settle_ms:g} is the value to set in the rig's file")
        if self.exposure_ms is not None:
            lines.append(f"exposure_ms = {self.exposure_ms:g} would be better")
        return "\n".join([*lines, f"{self.verdict} after {self.seconds:.1f} s"])


CLIPPED, MUCH_CLIPPED = 0.005, 0.05
"""Shares of the illuminated pixels that are saturated: a warning, and bad. Highlights saturate
fewer than the second, an exposure that is too long more."""
WEAK, TOO_WEAK = 0.4, 0.12
"""Of full scale, that the brightest illuminated pixels should reach: below, a warning, and bad."""
_BRIGHTER = "Raise the exposure, or open the aperture."


def check_capture_exposure(
    sequence: PatternSequence, frames: np.ndarray, phases: PhaseMaps
) -> Check:
    """Whether the frames (n, h, w) of a capture are too bright or too dark, by the pixels that see
    the patterns."""
    full = white_level(sequence, frames, range(len(frames)))
    illuminated = np.logical_or.reduce([phase.illuminated for phase in phases.values()])
    if not illuminated.any():
        return Check("exposure", "bad", "No pixel sees the patterns.", _BRIGHTER)
    rows = select_rows(*frames.shape[1:])
    brightest = np.max([frames[i][rows] for i in sequence.patterns], axis=0)
    levels = brightest[illuminated[rows]] if illuminated[rows].any() else brightest.ravel()
    share = float(np.quantile(levels, 0.995)) / full
    clipped = max(phase.share(Reason.SATURATED) for phase in phases.values())
    sentence = f"The brightest of the scene reaches {100 * share:.0f} % of the camera's range"
    verdict: CheckVerdict = "good"
    remedy = ""
    if clipped > CLIPPED:
        verdict = "bad" if clipped > MUCH_CLIPPED else "warning"
        sentence = f"{100 * clipped:.1f} % of the illuminated pixels are saturated."
        remedy = "Lower the exposure, or capture with two exposures."
    elif share < WEAK:
        verdict = "bad" if share < TOO_WEAK else "warning"
        sentence, remedy = f"{sentence}.", _BRIGHTER
    else:
        sentence += f"; {100 * clipped:.1f} % of the pixels are saturated."
    figures = {
        "bright_share_of_full_scale": round(share, 3),
        "saturated_share": round(clipped, 4),
    }
    return Check("exposure", verdict, sentence, remedy, figures)


def warn_of_exposure(
    name: str,
    sequence: PatternSequence,
    frames: np.ndarray,
    phases: PhaseMaps,
    warn: Warn,
) -> None:
    """Warn, with the capture's name, where `check_capture_exposure` finds it too bright or too
    dark."""
    exposure = check_capture_exposure(sequence, frames, phases)
    if exposure.verdict != "good":
        warn(f"{name}: {exposure.message}")


VERSION = 12
"""Of the examination; results of another version are computed anew."""
_NUMBERED = re.compile(
    r"\b((?:frame|image)s? )(\d+(?:(?:, | and )\d+)*)\b(?! is missing)", re.IGNORECASE
)


def name_frames(text: str, sequence: PatternSequence, files: Sequence[str]) -> str:
    """Return a message with the file after each number of a frame, counted from 1; unchanged where
    none are known.

    ``files``: one a frame of every exposure in turn.
    """
    count = len(sequence.frames)

    def name(number: re.Match[str]) -> str:
        """Return the number with the frame's files."""
        there = files[int(number[0]) - 1 :: count] if 0 < int(number[0]) <= count else ()
        return f"{number[0]} ({' and '.join(there)})" if there else number[0]

    return _NUMBERED.sub(lambda match: match[1] + re.sub(r"\d+", name, match[2]), text)


def examine_frames(
    sequence: PatternSequence,
    stack: np.ndarray,
    files: Sequence[str] = (),
    look: Look | None = None,
) -> Examination:
    """Examine the frames (n, h, w) of a capture; findings name their ``files``, see
    `name_frames`. ``look`` at the frames: taken if None."""
    examination = examine(sequence, stack, look)
    named = [
        structs.replace(finding, observation=name_frames(finding.observation, sequence, files))
        for finding in examination.findings
    ]
    return Examination(tuple(named), examination.light_rms)


def load_or_save_examination(
    session: Session, capture: Capture, look: Look | None = None
) -> Examination:
    """Return the saved examination of a capture; without one, examine its frames by a ``look`` at
    them, taken here if None, and save the result in a writable session."""
    if (saved := load_examination(session, capture.name)) is not None:
        return saved
    stack = look.stack if look else capture.frames
    examination = examine_frames(capture.sequence, stack, capture.files, look)
    if session.is_writable:
        meta = {
            "inputs": {capture.name: capture.hash},
            "version": VERSION,
            "examination": to_plain(examination),
        }
        session.save_result(f"trust/{capture.name}", meta, {})
    return examination


def load_examination(session: Session, name: str) -> Examination | None:
    """Return the saved examination of a capture; None where it is missing, of other frames or of
    another version."""
    return session.decode_fresh(
        f"trust/{name}",
        lambda meta, _: (
            from_plain(meta["examination"], Examination) if meta.get("version") == VERSION else None
        ),
    )
