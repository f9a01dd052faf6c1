"""An operation: how bright a capture is."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from slviewer.plugins import Found, Job, Record, operation


class Brightness(Record, frozen=True, kw_only=True):
    """How bright captures are."""

    kind = "brightness"
    title = "Brightness"
    mean_percent: float


@dataclass(frozen=True)
class BrightnessSettings:
    """What is measured.

    Args:
        capture: Name of the capture.
    """

    capture: str


@operation("brightness", Brightness, BrightnessSettings)
def brightness(job: Job, settings: BrightnessSettings) -> Iterator[Found[Brightness]]:
    """Measure how bright a capture is."""
    capture = job.store.load_capture(settings.capture)
    frames = capture.frames
    mean = 100 * float(frames.mean()) / np.iinfo(frames.dtype).max
    yield Found(
        capture.name, Brightness(mean_percent=mean, inputs=job.store.input_hashes(capture.name))
    )
