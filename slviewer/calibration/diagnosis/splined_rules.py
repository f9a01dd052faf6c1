"""What the joint adjustment's residuals say of a calibration: whether noise explains them."""

from collections.abc import Mapping

from slviewer.calibration.diagnosis.verdict import Finding, Verdict
from slviewer.calibration.splined.evidence import Noise

DOUBTFUL_RATIO = 4.0
"""Of residuals over predicted noise. On clean rigs, whose lenses bend as no polynomial does, it is 0.5 to 1.1, and 0.8
on real Gray code. A block of 5 by 5 camera pixels whose noise is fully alike, as after demosaicing or compression,
scatters by up to five times what is predicted of independent pixels: in part, as such noise is, by less than four."""
EXPLAINING = ("gamma", "saturation", "moved", "frame-lag", "frame-order", "missing-frame")
REJECTED_RATIO = 25.0
REJECTED_PX = 1.0
"""Beyond both the phases contradict the geometry, whatever the noise: a column more or less than was measured."""


def judge_splined(verdict: Verdict, noise: Noise) -> Verdict:
    """The verdict with what the joint adjustment's residuals add to it; a cause that explains them is known already
    where one of ``EXPLAINING`` was found."""
    ratios: Mapping[str, float] = dict(zip("xy", noise.ratio, strict=True))
    axis = max(ratios, key=lambda name: ratios[name])
    ratio, px = ratios[axis], noise.sample_px["xy".index(axis)]
    if ratio < DOUBTFUL_RATIO:
        return verdict
    known = [finding.cause for finding in verdict.findings if finding.cause in EXPLAINING]
    because = f" (probable cause: {known[0]}, named above)" if known else ""
    rejected = ratio > REJECTED_RATIO and px > REJECTED_PX
    finding = Finding(
        "residuals",
        "rejected" if rejected else "doubtful",
        f"the residuals of the joint adjustment in {axis}, {px:.2f} px, are {ratio:.1f} times the predicted noise"
        f"{because}",
        "see that light, exposure and rig did not change while a pose was captured, that the projector scales nothing, "
        "and that its response is linear; sigmas of clouds are raised by that factor",
    )
    return Verdict.of([*verdict.findings, finding])
