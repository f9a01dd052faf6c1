"""Rates, delays and counts of what the wizard repeats by itself."""

from dataclasses import dataclass

from slviewer.calibration.guidance import pose_selection
from slviewer.wizard import acquisition, preview_watcher


@dataclass(frozen=True)
class Timing:
    """How often the wizard repeats what it does by itself, and how much it computes each time.

    ``retry_s``: s between two attempts to open devices, or to read files that could not be read.
    ``previews_per_s``: rate of the camera preview. ``trials``: candidates of the next pose whose
    gain is computed. ``hold_s``: s for which a board is held still before the hands-free countdown
    starts, which takes ``count_s``.
    """

    retry_s: float = acquisition.RETRY_S
    previews_per_s: float = acquisition.PREVIEWS_PER_S
    trials: int = pose_selection.TRIALS
    hold_s: float = preview_watcher.HOLD_S
    count_s: float = preview_watcher.COUNT_S
