"""slviewer: a camera and a projector as a metrology-grade 3D scanner.

``import slviewer as sl`` gives what a notebook needs, imported when it is first used. On a session,
a folder that holds captures and results, work `import_captures`, `calibrate`, `reconstruct`,
`verify`, `merge`, `mesh` and `measure`, named after their commands. On arrays, without a session,
work `read_captures`, `decode`, `detect_board`, `calibrate_frames`, `reconstruct_cloud`,
`evaluate_plane`, `evaluate_sphere`, `align_clouds`, `fuse_clouds`, `mesh_cloud`, `draw_error_maps`
and `write_ply`. `show` opens a cloud, a merge or a mesh in a 3D view.

Conventions, the same everywhere:

=================  =================================================================================
image              ``(h, w)``, uint8 or uint16; a texture may be ``(h, w, 3)`` RGB; a stack is ``(n,
                   h, w)``, C-contiguous, filled in place as frames arrive
pixel              ``(u, v)`` = (column, row); ``(0, 0)`` is the centre of the top-left pixel; the
                   same for the projector
lengths, angles    mm; rad, unless a name ends in ``_deg``; a doubtful quantity carries its unit in
                   its name
fringe image       ``I_k = A + B cos(phi + 2 pi k / n)``, k = 0 ... n-1; so ``phi = atan2(-sum I_k
                   sin, sum I_k cos)``, ``B = 2/n hypot(...)``
absolute phase     ``phi = 2 pi u_p / period_px``, zero at the centre of projector column 0 (row 0
                   for axis y)
axis               ``x`` = the pattern varies along projector columns (vertical stripes), ``y`` =
                   along rows
transform          ``T_projector_camera`` maps camera-frame points into the projector frame: ``X_p =
                   R X_c + t``
invalid            NaN in float maps and clouds, False in masks (True = valid)
depth ranges       R1 in front of the calibrated depths, R2 inside, R3 behind
=================  =================================================================================

"The Letter" is Vargas, Romero, Zhang and Marrugo, *Pixel-wise rational model for a structured light
system*, Optics Letters 2023; symbols follow it, and docstrings cite its equation or step.

Data flows one way: geometry, fringe, target, calibration, reconstruction, registration, surface,
evaluation, inspection, simulation, devices, session, report, pipeline, preflight, wizard, server,
gui, validation, and the command line at the end. A package imports only from those before it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from slviewer import plugins
    from slviewer.devices.capture import capture_frames
    from slviewer.devices.simulated import simulated_rig
    from slviewer.devices.world import SimulatedWorld
    from slviewer.errors import SlviewerError
    from slviewer.evaluation.fit import evaluate_plane, evaluate_sphere
    from slviewer.examination.examine import examine
    from slviewer.fringe.decode import decode, texture
    from slviewer.fringe.phase import PhaseMap, Reason
    from slviewer.fringe.presets import complementary, gray, micro, multifrequency, p18
    from slviewer.fringe.sequence import Frame, PatternSequence, one_axis
    from slviewer.gui.viewer import show
    from slviewer.operations.batch import batch
    from slviewer.pipeline import datasets
    from slviewer.pipeline.accept import accept, check
    from slviewer.pipeline.calibrate import (
        CalibrationResult,
        calibrate,
        calibrate_frames,
        save_calibration,
    )
    from slviewer.pipeline.capture import capture
    from slviewer.pipeline.compare import compare
    from slviewer.pipeline.export import export
    from slviewer.pipeline.import_captures import import_captures, read_captures
    from slviewer.pipeline.import_cloud import import_cloud
    from slviewer.pipeline.inspect_parts import run_plan
    from slviewer.pipeline.measure import measure
    from slviewer.pipeline.merge import align, merge
    from slviewer.pipeline.mesh import mesh
    from slviewer.pipeline.models import load_calibration
    from slviewer.pipeline.operation import load_arrays
    from slviewer.pipeline.reconstruct import reconstruct, verify
    from slviewer.pipeline.report import report
    from slviewer.pipeline.session_operations import SessionOperations as Session
    from slviewer.pipeline.simulate import simulate
    from slviewer.reconstruction.cloud import Cloud
    from slviewer.reconstruction.reconstruct import reconstruct_cloud
    from slviewer.records.measurement import Measurement, Quantity
    from slviewer.records.verification import Verification
    from slviewer.registration.multiway import register_all as align_clouds
    from slviewer.report.maps import draw_error_maps
    from slviewer.session.ply import read_ply, write_ply
    from slviewer.simulation.boards import Pose
    from slviewer.simulation.rig import letter as letter_rig
    from slviewer.surface.fuse import fuse as fuse_clouds
    from slviewer.surface.meshing import MeshingPlan
    from slviewer.surface.meshing import build_mesh as mesh_cloud
    from slviewer.target.board import Board
    from slviewer.target.detect import detect as detect_board

try:  # written by the build from the git tag
    from slviewer._version import version as __version__
except ImportError:  # a checkout that was never built or installed
    __version__ = "0.2.0.dev0"

_EXPORTS = {
    "Board": "target.board",
    "CalibrationResult": "pipeline.calibrate",
    "Cloud": "reconstruction.cloud",
    "Frame": "fringe.sequence",
    "Measurement": "records.measurement",
    "MeshingPlan": "surface.meshing",
    "PatternSequence": "fringe.sequence",
    "PhaseMap": "fringe.phase",
    "Pose": "simulation.boards",
    "Quantity": "records.measurement",
    "Reason": "fringe.phase",
    "Session": "pipeline.session_operations:SessionOperations",
    "SimulatedWorld": "devices.world",
    "SlviewerError": "errors",
    "Verification": "records.verification",
    "align": "pipeline.merge",
    "align_clouds": "registration.multiway:register_all",
    "batch": "operations.batch",
    "calibrate_frames": "pipeline.calibrate",
    "capture_frames": "devices.capture",
    "check": "pipeline.accept",
    "complementary": "fringe.presets",
    "datasets": "pipeline.datasets:*",
    "decode": "fringe.decode",
    "detect_board": "target.detect:detect",
    "draw_error_maps": "report.maps",
    "evaluate_plane": "evaluation.fit",
    "evaluate_sphere": "evaluation.fit",
    "examine": "examination.examine",
    "fuse_clouds": "surface.fuse:fuse",
    "gray": "fringe.presets",
    "letter_rig": "simulation.rig:letter",
    "load_arrays": "pipeline.operation",
    "load_calibration": "pipeline.models",
    "mesh_cloud": "surface.meshing:build_mesh",
    "micro": "fringe.presets",
    "multifrequency": "fringe.presets",
    "one_axis": "fringe.sequence",
    "p18": "fringe.presets",
    "plugins": "plugins:*",
    "read_captures": "pipeline.import_captures",
    "read_ply": "session.ply",
    "reconstruct_cloud": "reconstruction.reconstruct",
    "run_plan": "pipeline.inspect_parts",
    "save_calibration": "pipeline.calibrate",
    "show": "gui.viewer",
    "simulated_rig": "devices.simulated",
    "texture": "fringe.decode",
    "verify": "pipeline.reconstruct",
    "write_ply": "session.ply",
}
"""{public name: module}, or module:name where it has another name there, or module:* for the module
itself; the others are in the module of ``slviewer.pipeline`` that has their name."""

__all__ = [
    "Board", "CalibrationResult", "Cloud", "Frame", "Measurement", "MeshingPlan",
    "PatternSequence", "PhaseMap", "Pose", "Quantity", "Reason", "Session", "SimulatedWorld",
    "SlviewerError", "Verification", "accept", "align", "align_clouds", "batch", "calibrate",
    "calibrate_frames", "capture", "capture_frames", "check", "compare", "complementary",
    "datasets", "decode", "detect_board", "draw_error_maps", "evaluate_plane",
    "evaluate_sphere", "examine", "export", "fuse_clouds", "gray", "import_captures",
    "import_cloud", "letter_rig", "load_arrays", "load_calibration", "measure", "merge", "mesh",
    "mesh_cloud", "micro", "multifrequency", "one_axis", "p18", "plugins", "read_captures",
    "read_ply", "reconstruct", "reconstruct_cloud", "report", "run_plan", "save_calibration",
    "show", "simulate", "simulated_rig", "texture", "verify", "write_ply",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, original = _EXPORTS.get(name, f"pipeline.{name}").partition(":")
    imported = import_module(f"{__name__}.{module}")
    return imported if original == "*" else getattr(imported, original or name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
