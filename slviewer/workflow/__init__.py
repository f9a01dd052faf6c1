"""What the operator does, without a face: the commands of the command line as Python functions.

``from slviewer.workflow import calibrate`` and so on; each is loaded when it is first asked for.
"""

import importlib
from typing import Any

_HOMES = {
    "import_captures": "importing",
    "detect_layout": "importing",
    "import_p18": "importing",
    "import_procam_calibration": "importing",
    "import_frames": "importing",
    "guess_description": "importing",
    "import_opencv_calibration": "importing_calibration",
    "identify_calibration_keys": "importing_calibration",
    "devices": "connecting",
    "rigs": "rig_presets",
    "capture": "capturing",
    "check_rig": "checking",
    "check_capture": "checking",
    "in_words": "checking",
    "summary": "inspecting",
    "calibrate": "calibrating",
    "calibrate_camera_alone": "calibrating_camera",
    "validate": "validating",
    "reconstruct": "reconstructing",
    "verify": "verifying",
    "merge": "merging",
    "mesh": "meshing",
    "compare": "comparing",
    "surface": "measured_surface",
    "add_point": "measuring",
    "add_distance": "measuring",
    "add_fit": "measuring",
    "add_relation": "measuring",
    "add_section": "measuring",
    "measurements": "measuring",
    "export_measurements": "measuring",
    "measure": "dimensions",
    "tell_measurements": "dimensions",
    "export": "exporting",
    "decode": "exporting_phase",
    "batch": "batching",
    "check": "drifting",
    "accept": "accepting",
    "simulate": "simulating",
    "reproduce": "reproducing",
    "prove": "proving",
    "patterns": "printing",
    "target": "printing",
    "detect_board": "detecting",
    "report": "reporting",
    "inspect": "inspecting",
    "bench": "benchmarking",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
