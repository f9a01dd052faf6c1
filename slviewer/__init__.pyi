"""The public names, and the modules that they are imported from when they are first used:
`slviewer.__getattr__` reads this file, and so do type checkers."""

import typing

if typing.TYPE_CHECKING:  # low in the order in which mypy resolves modules that need each other
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
    from slviewer.operations.hand_eye import hand_eye
    from slviewer.operations.relate_rigs import relate_rigs
    from slviewer.operations.show_on_part import projection_image, show_on_part
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
    from slviewer.pipeline.machine_poses import import_poses
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

__version__: str
__all__ = [
    "Board", "CalibrationResult", "Cloud", "Frame", "Measurement", "MeshingPlan", "PatternSequence",
    "PhaseMap", "Pose", "Quantity", "Reason", "Session", "SimulatedWorld", "SlviewerError",
    "Verification", "accept", "align", "align_clouds", "batch", "calibrate", "calibrate_frames",
    "capture", "capture_frames", "check", "compare", "complementary", "datasets", "decode",
    "detect_board", "draw_error_maps", "evaluate_plane", "evaluate_sphere", "examine", "export",
    "fuse_clouds", "gray", "hand_eye", "import_captures", "import_cloud", "import_poses",
    "letter_rig", "load_arrays", "load_calibration", "measure", "merge", "mesh", "mesh_cloud",
    "micro", "multifrequency", "one_axis", "p18", "plugins", "projection_image", "read_captures",
    "read_ply", "reconstruct", "reconstruct_cloud", "relate_rigs", "report", "run_plan",
    "save_calibration", "show", "show_on_part", "simulate", "simulated_rig", "texture", "verify",
    "write_ply",
]  # fmt: skip
