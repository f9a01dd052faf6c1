"""Bringing captures and calibrations that other tools made into a session: all of them, or none."""

import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.session.importers import frames as frames_layout
from slviewer.session.importers import opencv_calibration, p18, procam_calibration
from slviewer.session.store import Session
from slviewer.workflow.decoding import check_projector, decode_frames
from slviewer.workflow.feedback import Progress, Warn, unheard, unwarned
from slviewer.workflow.models import available, save_stereo
from slviewer.workflow.sizes import parse_size

if TYPE_CHECKING:
    from slviewer.session.importers.imported import ImportedCapture

Role = Literal["calibration", "scan"]
