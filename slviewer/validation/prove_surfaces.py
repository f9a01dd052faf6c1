"""What surfaces that light themselves do to a measurement, by sequence, and what of it is masked.

Grooves, a bowl and wax before the simulated rig, whose truth is known, measured with the rig's own
geometry, so that the codes alone are compared; then surfaces without indirect light, of which
nothing should be masked.
"""

from dataclasses import dataclass, replace

import numpy as np

from slviewer.evaluation.render import Row
from slviewer.fringe.decode import decode
from slviewer.fringe.phase import Reason
from slviewer.fringe.presets import PRESETS
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.vectors import rms
from slviewer.pipeline.feedback import Progress
from slviewer.simulation.boards import Pose
from slviewer.simulation.concave import Indirect, bowl, groove, wax
from slviewer.simulation.plans import objects, planes, rotation, spheres
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import Scene
from slviewer.simulation.truth import PerfectModel
from slviewer.validation.proof import BandCheck, Proof, prove_checks, track

LEAST_GAIN = 5.0
"""Of p18's error over micro's, RMS without any mask, in the groove that is judged."""
WRONG_SIGMAS = 5.0
GROSS_PX = 5.0
"""Error in projector px beyond which a point has the order of another place."""
LEAST_CAUGHT = 0.9
"""Share of these points that is masked. Of the points more than `WRONG_SIGMAS` sigma wrong it is
reported only: most of them are off by a tenth of a stripe, by light from beside them, which weakens
fringes no more than defocus does."""
DEFOCUS = 4.0
"""Times the preset's defocus, with which the mask must spare surfaces too."""
MOST_LOST = 0.005
"""Share of the good points of surfaces without indirect light that is masked."""
JUDGED = "groove 90 deg"
"""The others are reported: where Gray code is not misled, micro gains less, and light of the
nearest stripes stays."""


@dataclass(frozen=True)
class SequenceErrors:
    """Errors of one sequence on one surface.

    ``rms_mm``: of the depth without the mask; ``masked_rms_mm`` with it. ``wrong``: share of the
    points more than `WRONG_SIGMAS` sigma wrong, ``caught``: of these the share that is masked,
    ``gross_caught``: of those more than `GROSS_PX` wrong, ``lost``: of the good ones.
    """

    rms_mm: float
    masked_rms_mm: float
    wrong: float
    caught: float
    gross_caught: float
    lost: float


def surface_cases() -> dict[str, tuple[Scene, bool]]:
    """Return the surfaces by name, each with whether it lights itself."""
    tilted = {
        turn: Pose(rotation(np.radians([0, turn, 0])), np.array([0, 0, 640.0]))
        for turn in (0, 10, 15, 20)
    }
    glossy = Indirect(2, gloss=0.6, exponent=12.0)
    lit: dict[str, Scene] = {
        JUDGED: groove(tilted[15]),
        "groove 90 deg, one bounce": groove(tilted[15], indirect=Indirect(1)),
        "groove 70 deg, darker": groove(tilted[10], 70, 0.6),
        "groove 70 deg, glossy": groove(tilted[10], 70, 0.9, glossy),
        "groove 110 deg": groove(tilted[20], 110),
        "bowl": bowl(tilted[0], 60, 90, 0.9),
        "wax": wax(tilted[0]),
    }
    clean: dict[str, Scene] = {
        "groove without bounces": groove(tilted[15], indirect=Indirect(0)),
        "plane": planes()["plane_03"],
        "sphere": spheres()["sphere_2"],
        "object": objects()["object_r2"],
        "unsharp plane": planes()["plane_02"],
        "unsharp sphere": spheres()["sphere_1"],
        "unsharp object": objects()["object_r1"],
    }
    return {name: (scene, name in lit) for name, scene in (lit | clean).items()}


def prove_surfaces(scale: float, seed: int, progress: Progress) -> Proof:
    """Measure every surface with p18, complementary, multifrequency and micro; judge gain, mask and
    false alarms.

    ``scale``: resolution of the camera, as a share of the Letter's.
    """
    rig = letter(scale, seed)
    model = PerfectModel(rig)
    defocus = DEFOCUS * rig.light.defocus_px_mm
    blurred = replace(rig, light=replace(rig.light, defocus_px_mm=defocus))
    rows: list[Row] = []
    record: dict[str, dict[str, SequenceErrors]] = {}
    checks: list[BandCheck] = []
    gains: list[str] = []
    for name, (scene, is_indirect), _ in track(progress, surface_cases()):
        renderer = Renderer(blurred if name.startswith("unsharp") else rig, scene)
        errors = record[name] = {
            preset: measure_errors(renderer, preset, model, seed)
            for preset in ("p18", "complementary", "multifrequency", "micro")
        }
        rows += [
            {
                "surface": name,
                "patterns": preset,
                "RMS mm": each.rms_mm,
                "with mask": each.masked_rms_mm,
                ">5 sigma %": round(100 * each.wrong, 2),
                "of these masked %": 100 * each.caught,
                "gross masked %": 100 * each.gross_caught,
                "good masked %": round(100 * each.lost, 2),
            }
            for preset, each in errors.items()
        ]
        gain = errors["p18"].rms_mm / errors["micro"].rms_mm
        gains.append(f"{name} {gain:.1f}")
        if not is_indirect:
            worst = max(errors, key=lambda preset: errors[preset].lost)
            what = f"good points masked with {worst}"
            checks.append(BandCheck(name, what, errors[worst].lost, 0.0, MOST_LOST))
        if name == JUDGED:
            what = f"share of p18's points over {GROSS_PX:g} px wrong masked"
            checks += [
                BandCheck(name, "error of p18 over that of micro", gain, LEAST_GAIN, np.inf),
                BandCheck(name, what, errors["p18"].gross_caught, LEAST_CAUGHT, 1.0),
            ]
    line = f"p18's RMS over micro's: {', '.join(gains)}"
    return prove_checks(checks, scale, rows, {"surfaces": record}, below=[line])


def measure_errors(
    renderer: Renderer, preset: str, model: PerfectModel, seed: int
) -> SequenceErrors:
    """Return the errors in depth of one sequence on the renderer's scene, along axis x."""
    sequence = one_axis(PRESETS[preset](renderer.rig.projector.size), "x")
    frames = renderer.capture(sequence, seed)
    plain = decode(sequence, frames, "x", mask_indirect=False)
    masked = decode(sequence, frames, "x").reason == Reason.INDIRECT
    truth = renderer.truth()
    z = model.points(plain)[..., 2]
    error = np.abs(z - truth.points[..., 2])
    off = np.abs(plain.coordinate - truth.projector[..., 0])
    valid = plain.mask & truth.mask & np.isfinite(error)
    wrong = valid & (off > WRONG_SIGMAS * plain.sigma_px)
    gross = valid & (off > GROSS_PX)
    caught, gross_caught, lost = (
        float(np.mean(masked[points])) if points.any() else np.nan
        for points in (wrong, gross, valid & ~wrong)
    )
    return SequenceErrors(
        rms(error[valid]),
        rms(error[valid & ~masked]),
        float(np.mean(wrong[valid])),
        caught,
        gross_caught,
        lost,
    )
