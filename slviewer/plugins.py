"""What a package needs to add cameras, projectors, turntables, boards, importers and exporters to
slviewer.

A plugin is an object under an entry point, whose name is the object's ``name``:

=======================  ===========================================================================
``slviewer.drivers``     a `Driver`: factories of cameras, projectors, turntables or whole rigs
``slviewer.boards``      a `BoardType`: coordinates of a board's features, and their detection
``slviewer.importers``   a `FolderLayout`: another program's folders of images, best made by
                         `define_layout`
``slviewer.exporters``   an `Exporter`: a file format for points or meshes
=======================  ===========================================================================

The ``check_...`` functions test one as slviewer uses it, for the tests of its package.
"""

from slviewer.devices.drivers import Driver
from slviewer.devices.protocols import (
    Camera,
    CameraSettings,
    Openable,
    Projector,
    Rig,
    Turntable,
    check_angle,
    check_frame,
    check_index,
    check_level,
    check_sequence,
)
from slviewer.errors import DetectionError, DeviceError, InputError, TurntableError
from slviewer.fringe.patterns import render_pattern as render
from slviewer.fringe.presets import gray_bits, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence, PerAxis
from slviewer.pipeline.conformance import (
    check_board,
    check_camera,
    check_exporter,
    check_importer,
    check_projector,
    check_turntable,
)
from slviewer.session.importers.imported import (
    FolderLayout,
    ImportableRecording,
    check_complete,
    define_layout,
    has_images,
    match_images,
    unknown_files_warning,
)
from slviewer.session.mesh_files import Exporter
from slviewer.surface.shapes import Mesh, PointSet
from slviewer.target.board import Board, BoardType

__all__ = [
    "Board", "BoardType", "Camera", "CameraSettings", "DetectionError", "DeviceError", "Driver",
    "Exporter", "FolderLayout", "Frame", "ImportableRecording", "InputError", "Mesh", "Openable",
    "PatternSequence", "PerAxis", "PointSet", "Projector", "Rig", "Turntable", "TurntableError",
    "check_angle", "check_board", "check_camera", "check_complete", "check_exporter", "check_frame",
    "check_importer", "check_index", "check_level", "check_projector", "check_sequence",
    "check_turntable", "define_layout", "gray_bits", "has_images", "match_images", "phase_steps",
    "render", "unknown_files_warning",
]  # fmt: skip
