"""Calibrations that begin from a known lens."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import CalibrationRejected
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.lens import Lens
from slviewer.geometry.vectors import box_middle
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate, calibrate_camera_alone
from slviewer.pipeline.measure import measure
from slviewer.pipeline.models import load_model
from slviewer.pipeline.simulate import TARGET
from slviewer.records.calibration import ModelCalibration, StereoFit
from slviewer.records.verdict import Verdict
from slviewer.session.capture import NewCapture
from slviewer.session.exporters import write_calibration
from slviewer.session.importers.camera_file import read_camera_file
from slviewer.session.store import Session
from slviewer.simulation.boards import Pose, printed_board
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import sphere
from slviewer.simulation.truth import rig_record
from slviewer.target.board import Board
from tests.proofs.report_cases.case import BASE_SCALE, Case, Outcome, Workplace, read_refusal

_RIG = letter(BASE_SCALE, 0)
_FOCAL = {device: rig_record(_RIG)[device]["K"][0][0] for device in ("camera", "projector")}
_TILTS_DEG = ((4, 0, 0), (-3, 4, 0), (0, -5, 0), (3, 3, 0))
_PLACES_MM = ((-20, 0, 540), (20, 10, 600), (10, -15, 660), (-15, 15, 570))
"""Of four boards that are nearly parallel."""
_DIAMETER_MM, _CENTRE_MM = 196.0, (0.0, 0.0, 650.0)
_QUICK = CalibrateSettings(TARGET, models=("stereo", "splined"), cells_across=12)


def _read_lens(workplace: Workplace, session: Path) -> tuple[Path, Lens]:
    """Return the file that `calibrate --camera-only` writes from a session's poses, and its
    lens."""
    path = workplace.folder / "lens.yaml"
    calibrate_camera_alone(session, TARGET, out=path)
    return path, read_camera_file(path, _RIG.camera.size).lens


def _write_lens(path: Path, lens: Lens, factor: float = 1.0) -> Path:
    """Write a lens as OpenCV's sample does, with its focal length times a factor."""
    fx, fy, *rest = lens.parameters[:9]
    other = Lens.from_parameters((factor * fx, factor * fy, *rest), lens.size)
    sizes = dict(zip(("image_width", "image_height"), lens.size, strict=True))
    write_calibration(path, {"camera_matrix": other.K, "distortion_coefficients": other.D, **sizes})
    return path


def _few_poses(workplace: Workplace) -> Path:
    """Return a session of four nearly parallel boards and a sphere before the rig of the base."""
    made = workplace.shared / "few"
    if not made.exists():
        board, both = Board.parse(TARGET), p18(_RIG.projector.size)
        along, middle = one_axis(both, "x"), box_middle(board.points)
        poses = []
        for i, (tilt, place) in enumerate(zip(_TILTS_DEG, _PLACES_MM, strict=True)):
            R = rotation(np.radians(tilt))
            scene = printed_board(board, Pose(R, np.array(place) - R @ middle), seed=_RIG.seed)
            frames = Renderer(_RIG, scene).capture(both, i)
            poses.append(NewCapture(f"pose_{i}", both, frames))
        frames = Renderer(_RIG, sphere(_CENTRE_MM)).capture(along, len(poses))
        with Session.create(made) as store:
            store.save_captures(poses, "calibration", board=board)
            store.save_captures([NewCapture("sphere", along, frames)], "scan")
    return Path(shutil.copytree(made, workplace.folder / "few"))


def _calibrate(session: Path, file: Path, is_fixed: bool) -> tuple[Verdict, StereoFit]:
    """Calibrate a session with a lens file; return the verdict and the stereo model's figures."""
    record = calibrate.run(session, replace(_QUICK, camera=file, fix_camera=is_fixed))["stereo"]
    assert isinstance(record, ModelCalibration) and isinstance(record.fit, StereoFit)
    return record.verdict or Verdict(), record.fit


def _fixed_lens(workplace: Workplace) -> Outcome:
    """Four nearly parallel poses are rejected; with the camera's lens they measure."""
    file, session = _read_lens(workplace, workplace.base())[0], _few_poses(workplace)
    try:
        calibrate(session, TARGET, models=("stereo",))
        without = "good"
    except CalibrationRejected:
        without = "rejected"
    _calibrate(session, file, True)
    found = measure(session, "sphere", "sphere", ball=(*_CENTRE_MM, 101.0), model="splined").only
    diameter = found["diameter"]
    with Session.open(session) as store:
        model = load_model(store, "splined")
    assert isinstance(model, SplinedModel)
    focal = float(model.pinholes.projector.K[0, 0])
    U = diameter.U or 0.0
    return Outcome(
        f"without {without}; with: projector {focal:.1f} px, {diameter.value:.3f} +- {U:.3f} mm",
        f"projector {_FOCAL['projector']:.1f} px, {_DIAMETER_MM} mm",
        without == "rejected"
        and abs(focal / _FOCAL["projector"] - 1) < 0.004
        and abs(diameter.value - _DIAMETER_MM) < U < 1.0,
    )


def _refocused(workplace: Workplace) -> Outcome:
    """A lens of another focus is named with its error, which the remedy removes."""
    session = workplace.base()
    _, lens = _read_lens(workplace, session)
    file = _write_lens(workplace.folder / "other.yaml", lens, 1.005)
    truth = 100 * (1 - _FOCAL["camera"] / (1.005 * lens.K[0, 0]))
    verdict, _ = _calibrate(session, file, True)
    named = next((each for each in verdict.findings if each.cause == "camera-file"), None)
    stated = float(named.observation.partition("length ")[2].split()[0]) if named else np.nan
    after, fit = _calibrate(session, file, False)
    return Outcome(
        f"{verdict.level}: {stated:.2f} % too long; without --fix-camera {after.level},"
        f" {fit.focal_px['camera'][0]:.1f} px",
        f"{truth:.2f} % too long, {_FOCAL['camera']:.1f} px",
        named is not None
        and verdict.level == "doubtful"
        and "shorter" in named.observation
        and abs(stated - truth) < 0.1
        and "without --fix-camera" in named.remedy
        and after.level == "good"
        and abs(fit.focal_px["camera"][0] / _FOCAL["camera"] - 1) < 0.003,
    )


def _start(workplace: Workplace) -> Outcome:
    """A start that is 2 % off, and of images four times as large, changes nothing."""
    session = workplace.base()
    _, lens = _read_lens(workplace, session)
    verdict, fit = _calibrate(
        session, _write_lens(workplace.folder / "start.yaml", lens.resize(4), 1.02), False
    )
    focal = fit.focal_px["camera"][0]
    return Outcome(
        f"{verdict.level}: camera {focal:.1f} px",
        f"good: camera {_FOCAL['camera']:.1f} px",
        verdict.level == "good" and abs(focal / _FOCAL["camera"] - 1) < 0.003,
    )


def _cropped(workplace: Workplace) -> Outcome:
    """A lens of cropped images is refused, with both sizes."""
    width, height = _RIG.camera.size
    lens = Lens.from_parameters((_FOCAL["camera"],) * 2 + (width / 2, 112.0), (width, 225))
    file = _write_lens(workplace.folder / "cropped.yml", lens)
    measured = read_refusal(lambda: _calibrate(workplace.base(), file, True), "accepted")
    sizes = f"{width}x225 px", f"{width}x{height} px"
    return Outcome(measured, f"refused: {' and '.join(sizes)}", all(s in measured for s in sizes))


CASES: dict[str, Case] = {
    "fixed lens, four parallel poses": _fixed_lens,
    "fixed lens, refocused": _refocused,
    "lens as a start": _start,
    "lens of cropped images": _cropped,
}
