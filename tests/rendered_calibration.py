"""A simulated rig calibrated in memory from rendered target poses, as the proofs share it, or in
a session by its true lenses."""

from collections.abc import Mapping
from pathlib import Path

from slviewer.calibration.centres import calibrate_centres
from slviewer.calibration.observe import Observation
from slviewer.calibration.splined.model import SplinedModel, calibrate_splined
from slviewer.calibration.stereo import StereoModel
from slviewer.fringe.phase import PhaseMap
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.operation import Progress, track
from slviewer.pipeline.simulate import TARGET, save_true_stereo
from slviewer.session.store import Session
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import Scene
from slviewer.validation.bench_scaling import observe_rendered, scan_sequence


def true_calibration(folder: Path, rig: SimulatedRig) -> None:
    """Make a session whose stereo calibration is that of a simulated rig's true lenses, local
    distortion apart."""
    with Session.create(folder) as store:
        save_true_stereo(store, rig)


def calibrate_rendered(
    rig: SimulatedRig,
    plan: Mapping[str, Scene],
    progress: Progress,
) -> tuple[StereoModel, SplinedModel, list[Observation]]:
    """Render the target poses of a plan, numbered in their order, and calibrate the stereo and the
    splined model.

    Returns both models, and the observations with circles at their centres. Raises
    CalibrationRejected where the poses do not determine the rig.
    """
    targets = {name: scene for name, scene in plan.items() if name.startswith("pose_")}
    observations = [
        observe_rendered(rig, scene, name, i)
        for i, (name, scene, _) in enumerate(track(progress, targets, 0.0, 0.8))
    ]
    progress(0.8, "calibrating")
    return calibrate_observed(rig, observations)


def calibrate_observed(
    rig: SimulatedRig, observations: list[Observation]
) -> tuple[StereoModel, SplinedModel, list[Observation]]:
    """Calibrate the stereo and the splined model from observations of the target's poses.

    Returns both models, and the observations with circles at their centres.
    """
    stereo, observations = calibrate_centres(observations, rig.projector.size, TARGET)
    return stereo, calibrate_splined(observations, stereo), observations


def render_phase(renderer: Renderer, name: str, number: int) -> PhaseMap:
    """The phase of axis x of a rendered scan, whose noise ``number`` seeds."""
    sequence = scan_sequence(renderer.rig)
    return decode_frames(name, sequence, renderer.capture(sequence, number))["x"]
