"""The Letter's experiments repeated on the simulated rig, with its tables beside ours."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.errors import InputError, UsageError
from slviewer.evaluation import letter
from slviewer.evaluation.compare import Comparison
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings, part
from slviewer.pipeline.merge import MergeSettings, merge_scans
from slviewer.pipeline.models import load_model, load_stereo
from slviewer.pipeline.operation import Job
from slviewer.pipeline.poses import load_observations
from slviewer.pipeline.reconstruct import VerifySettings, compare_captures
from slviewer.pipeline.simulate import TARGET, TRUTH, simulate
from slviewer.records.verification import centre_distances_mm
from slviewer.session.layout import is_session
from slviewer.session.store import Session
from slviewer.validation.reproduction import MODELS, Reproduction, write_reproduction

QUICK_SCALE = 0.5
PIXEL = (500, 500)
"""Where the Letter shows its curves, at full resolution."""
OBJECTS = ("object_r1", "object_r2", "object_r3")


def reproduce(
    out: Path | str | None = None,
    *,
    quick: bool = False,
    scale: float | None = None,
    seed: int = 0,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> Reproduction:
    """Repeat the Letter's experiments on the simulated rig, and put its figures beside ours.

    Args:
        quick: Half resolution; its figures are its own.
        scale: Resolution of the camera, as a share of 1600x1200 px; by default 1, or 0.5 with
            --quick.
        out: Folder for the session and the report; by default reproduction, or reproduction-quick.
        seed: Another seed is another rig of the same kind.

    The session stays in ``out/session``, and serves the next run with the same settings.
    """
    out = Path(out or ("reproduction-quick" if quick else "reproduction"))
    session = out / "session"
    if scale is None:
        scale = QUICK_SCALE if quick else 1.0
    elif quick:
        raise UsageError(f"--quick is --scale {QUICK_SCALE:g}: give one of both")
    _simulate(session, scale, seed, part(progress, 0.0, 0.4))
    calibrate.run(session, CalibrateSettings(TARGET, MODELS), part(progress, 0.4, 0.65), warn)
    with Session.open(session) as store:
        names = store.capture_names("scan")
        stereo, pixelwise = load_stereo(store), load_model(store, "pixelwise")
        observations = load_observations(store, list(stereo.poses))
    assert isinstance(pixelwise, PixelwiseModel)
    planes, spheres = (
        [n for n in names if n.startswith("plane_")],
        [n for n in names if n.startswith("sphere_")],
    )
    flat = _compare_models(
        session, VerifySettings(planes, "plane"), part(progress, 0.65, 0.75), warn
    )
    round_ = VerifySettings(spheres, "sphere", radius=letter.SPHERE_RADIUS_MM)
    balls = _compare_models(session, round_, part(progress, 0.75, 0.82), warn)
    settings = MergeSettings(OBJECTS, OBJECTS[-1], out / "merged.ply", "pixelwise")
    with (
        Session.open(session) as store,
        merge_scans(Job(store, part(progress, 0.82, 0.9)), settings) as merged,
    ):
        spacings = _compare_spacings(session, balls)
    result = Reproduction(
        quick=quick,
        stereo=stereo,
        pixelwise=pixelwise,
        planes=flat,
        spheres=balls,
        spacings_mm=spacings,
        merged=merged,
        report=out / "report.html",
    )
    progress(0.92, "drawing the report")
    pixel = (round((PIXEL[0] + 0.5) * scale - 0.5), round((PIXEL[1] + 0.5) * scale - 0.5))
    write_reproduction(result, observations, pixel, seed)
    progress(1.0, "reproduced")
    return result


def _compare_models(
    session: Path, settings: VerifySettings, progress: Progress, warn: Warn
) -> dict[str, Comparison]:
    """Return the comparison of the models on each capture, in the Letter's depth ranges."""
    settings = replace(settings, models=MODELS, depth_range=letter.DEPTH_RANGE_MM)
    with Session.open(session) as store:
        compared = compare_captures(Job(store, progress, warn), settings)
        return {each.capture.name: each.found for each in compared}


def _simulate(session: Path, scale: float, seed: int, progress: Progress) -> None:
    """Simulate the session unless it has this scale and seed already; raises an error if it has
    other data."""
    if is_session(session):
        made = _load_truth(session)
        if (made.get("scale"), made.get("seed")) == (scale, seed):
            return
        with Session.open(session) as store:
            if made or store.capture_names():
                raise InputError(
                    f"{session} holds another simulation: choose another folder with --out, or"
                    " delete it"
                )
        shutil.rmtree(session)  # an interrupted run's, with nothing in it
    simulate(session, scale=scale, seed=seed, progress=progress)


def _load_truth(session: Path) -> dict[str, Any]:
    """The stored ground truth of a simulated session; empty where there is none."""
    path = session / TRUTH
    truth: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return truth


def _compare_spacings(
    session: Path, spheres: Mapping[str, Comparison]
) -> dict[str, tuple[float, Mapping[str, float]]]:
    """{pair: (true distance, distance by model)} of the sphere centres, mm: scored against the
    simulation's truth."""
    centres = {
        name: np.array(record["centres"][0])
        for name, record in _load_truth(session)["spheres"].items()
    }
    return {
        f"{a} - {b}": (float(np.linalg.norm(centres[a] - centres[b])), measured)
        for (a, b), measured in centre_distances_mm(
            {name: found.record() for name, found in spheres.items()}
        ).items()
    }
