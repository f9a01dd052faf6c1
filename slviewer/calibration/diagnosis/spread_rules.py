"""Causes that lie in how the poses are spread: too few, all alike, or not everywhere."""

from collections.abc import Iterator

from slviewer.calibration.diagnosis.evidence import Evidence
from slviewer.calibration.diagnosis.poses import FEW_POSES
from slviewer.calibration.diagnosis.verdict import Finding
from slviewer.calibration.soundness import MIN_POSES, MIN_TILT_SPREAD_DEG
from slviewer.calibration.stereo import MAX_FOCAL_SIGMA

MIN_TILT_DEG = 12.0
MAX_FOCAL_UNCERTAINTY = 0.02
HIGH_REPROJECTION_PX = 1.0


def find_too_few(e: Evidence) -> Iterator[Finding]:
    """Fewer poses than a calibration needs."""
    count = len(e.solution.used) if e.solution else len([p for p in e.usable if p.name not in e.set_aside])
    if count >= FEW_POSES:
        return
    refused = [f"{pose.name}: {pose.refused}" for pose in e.poses if pose.refused]
    because = f" ({'; '.join(refused[:3])})" if refused else ""
    yield Finding(
        "too-few-poses",
        "rejected" if count < MIN_POSES else "doubtful",
        f"{count} usable pose{'s' * (count != 1)} of {len(e.poses)}{because}",
        f"capture the board in more positions and tilts: {FEW_POSES} at least, and a dozen is better",
    )


def find_parallel(e: Evidence) -> Iterator[Finding]:
    """Boards that are all tilted alike."""
    solved = None if e.tilts_undetermined else e.solution
    spread = solved.tilt_spread_deg if solved else e.tilt_spread_deg
    if not spread < MIN_TILT_DEG or len(e.usable) < MIN_POSES:
        return
    rejected = spread < MIN_TILT_SPREAD_DEG or solved is None or bool(e.refusal)
    yield Finding(
        "parallel-poses",
        "rejected" if rejected else "doubtful",
        f"all {len(e.solution.used if e.solution else e.usable)} poses are nearly parallel "
        f"(tilts differ by {spread:.1f} degrees)",
        "tilt the board by 15 to 30 degrees, in different directions",
    )


def find_corners(e: Evidence) -> Iterator[Finding]:
    """Corners of the image that no pose reached."""
    if e.solution is not None and e.solution.empty_corners:
        corners = e.solution.empty_corners
        *others, last = corners
        where = f"{', '.join(others)} and {last}" if others else last
        yield Finding(
            "empty-corner",
            "doubtful",
            f"no pose reaches the {where} of the image, where lenses bend the most",
            f"capture poses that reach into the {where}",
        )


def find_uncertain(e: Evidence) -> Iterator[Finding]:
    """What the poses leave uncertain, or does not fit; of residuals so large, uncertainty is a consequence."""
    if e.solution is None:
        return
    misfit = e.solution.reprojection_px > HIGH_REPROJECTION_PX
    if misfit:
        yield Finding(
            "residuals",
            "rejected" if e.refusal else "doubtful",
            f"the reprojection error is {e.solution.reprojection_px:.1f} px",
            "check that the board is flat, in focus and held still, and look at the poses with the largest residuals",
        )
    for device, share in e.solution.focal_sigma.items():
        if not share < MAX_FOCAL_UNCERTAINTY:
            yield Finding(
                "uncertain",
                "doubtful" if misfit or share < MAX_FOCAL_SIGMA else "rejected",
                f"the poses leave the {device}'s focal length uncertain by {100 * share:.1f} %",
                "tilt the board by 15 to 30 degrees in different directions, and vary its distance",
            )
