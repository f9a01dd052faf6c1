"""What the joint adjustment's residuals say about a calibration."""

from slviewer.calibration.splined.residual_noise import Noise
from slviewer.records.verdict import Finding, Verdict

DOUBTFUL_RATIO = 4.0
"""Ratio of residuals to predicted noise. It is 0.5 to 1.1 on clean simulated rigs with local
distortion, and 0.8 on real Gray code. Noise that is correlated between pixels, as after demosaicing
or compression, raises it to less than 4: it would be 5 if the 5 by 5 camera pixels of a block had
identical noise."""
EXPLAINING_CAUSES = ("gamma", "saturation", "moved", "frame-lag", "frame-order", "missing-frame")
REJECTED_RATIO = 25.0
REJECTED_PX = 1.0
"""Beyond both limits the phases contradict the geometry, whatever the noise."""


def judge_splined(verdict: Verdict, noise: Noise) -> Verdict:
    """Return the verdict with a finding added where the joint adjustment's residuals exceed their
    predicted noise.

    The finding names the first of ``EXPLAINING_CAUSES`` among the others as its probable cause.
    """
    ratio, px, axis = max(zip(noise.ratio, noise.sample_px, "xy", strict=True))
    if ratio < DOUBTFUL_RATIO:
        return verdict
    known = [finding.cause for finding in verdict.findings if finding.cause in EXPLAINING_CAUSES]
    because = f" (probable cause: {known[0]}, named above)" if known else ""
    finding = Finding(
        "residuals",
        "rejected" if ratio > REJECTED_RATIO and px > REJECTED_PX else "doubtful",
        f"the residuals of the joint adjustment in {axis}, {px:.2f} px, are {ratio:.1f} times the"
        f" predicted noise{because}",
        "see that light, exposure and rig did not change while a pose was captured, that the"
        " projector scales nothing, and that its response is linear; sigmas of clouds are raised by"
        " that factor",
    )
    return Verdict.of([*verdict.findings, finding])
