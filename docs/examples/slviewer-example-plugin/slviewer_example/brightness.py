"""An operation: how bright a capture is."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from slviewer.plugins import Found, Input, Job, Record, operation


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
        brightest: Share of its pixels that count, the brightest ones.
    """

    capture: str
    brightest: Annotated[float, Input(0.1, 100, "%")] = 100.0


@operation("brightness", Brightness, BrightnessSettings)
def brightness(job: Job, settings: BrightnessSettings) -> Iterator[Found[Brightness]]:
    """Measure how bright a capture is."""
    capture = job.store.load_capture(settings.capture)
    frames = capture.frames
    counted = frames[frames >= np.percentile(frames, 100 - settings.brightest)]
    mean = 100 * float(counted.mean()) / np.iinfo(frames.dtype).max
    yield Found(
        capture.name, Brightness(mean_percent=mean, inputs=job.store.input_hashes(capture.name))
    )
