"""What the second axis of a capture says of the calibration: nothing, a raised sigma, or why they
do not belong."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from facts import missing_facts, raises

from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.reconstruction.axis_agreement import check_phases, check_sizes, measure_axis_agreement

pytestmark = pytest.mark.computes

SIZE, PROJECTOR, PERIOD = (160, 120), (912, 1140), 18.0
SIGMA_PX = 0.03
CALIBRATED = (500.0, 700.0)


def rig() -> StereoRig:
    """A baseline of 180 mm mostly along x, axes crossing at 600 mm; rows half as high as columns
    are wide."""
    camera = Lens(
        np.array([[356.0, 0, 81], [0, 357.0, 59], [0, 0, 1]]),
        np.array([-0.08, 0.03, 4e-4, -3e-4, 0]),
        SIZE,
    )
    projector = Lens(
        np.array([[1400.0, 0, 460], [0, 2800.0, 560], [0, 0, 1]]),
        np.array([-0.06, 0.02, 3e-4, 5e-4, 0]),
        PROJECTOR,
    )
    R = cv2.Rodrigues(np.array([0.01, 0.29, -0.005]))[0]
    return StereoRig(camera, projector, R, -R @ np.array([180.0, 5.0, 8.0]))


def coordinates(true: StereoRig, depth: float = 600.0) -> np.ndarray:
    """(h, w, 2) px with noise: where the projector sees a tilted plane; NaN beyond its image."""
    rays = true.camera.rays()
    z = depth / (1 + 0.3 * rays[..., 0] - 0.2 * rays[..., 1])
    found = true.project(np.dstack([rays * z[..., None], z]))
    found = np.where(
        ((found >= 0) & (found <= np.array(PROJECTOR) - 1)).all(-1)[..., None], found, np.nan
    )
    return np.asarray(found + np.random.default_rng(1).normal(0, SIGMA_PX, found.shape))


def phases(found: np.ndarray, axes: str = "xy") -> dict:
    """Phase maps (h, w) of coordinates (h, w, 2), whose noise is as predicted."""
    maps = {}
    for column, axis in enumerate("xy"):
        phase = (found[..., column] * 2 * np.pi / PERIOD).astype(np.float32)
        ones = np.ones(phase.shape, np.float32)
        reason = np.isnan(phase).astype(np.uint8)
        modulation = ones * np.sqrt(2 / 8) / (SIGMA_PX * 2 * np.pi / PERIOD)
        maps[axis] = PhaseMap(axis, PERIOD, phase, phase, modulation, ones, reason, (1.0, 0.0), 8)  # type: ignore[arg-type]
    return {axis: maps[axis] for axis in axes}


def by(rig: StereoRig) -> StereoModel:
    return StereoModel.from_rig(rig)


def turned(true: StereoRig, mrad: tuple[float, float, float]) -> StereoRig:
    """The projector turned about its own centre."""
    R = cv2.Rodrigues(1e-3 * np.array(mrad))[0]
    return StereoRig(true.camera, true.projector, R @ true.R, R @ true.t)


@pytest.mark.slow
def test_the_misfit_of_a_sound_capture_is_its_noise() -> None:
    true, found = rig(), coordinates(rig())
    v, u = np.nonzero(np.isfinite(found[..., 0]))
    pixels = np.column_stack([u, v]).astype(float)
    agreement = measure_axis_agreement(
        by(true), pixels, found[v, u], np.full((len(u), 2), SIGMA_PX)
    )
    assert agreement is not None
    assert agreement.misfit_px == pytest.approx(SIGMA_PX, rel=0.05)
    assert agreement.ratio == pytest.approx(1.0, abs=0.05)
    assert agreement.in_front == 1.0 and np.median(agreement.depths_mm) == pytest.approx(
        600, abs=15
    )
    check = check_phases("scan", phases(found), by(true), CALIBRATED)
    assert (check.misfit, check.warnings) == (None, ())


def flipped(found: np.ndarray, x: bool, y: bool) -> np.ndarray:
    return np.where((x, y), np.array(PROJECTOR) - 1 - found, found)


WRONG = {
    "x and y are exchanged": lambda f: f[..., ::-1],
    "x axis is reversed": lambda f: flipped(f, True, False),
    "y axis is reversed": lambda f: flipped(f, False, True),
    "turned by 180 degrees": lambda f: flipped(f, True, True),
    "half as many columns and half as many rows": lambda f: (f + 0.5) / 2 - 0.5,
    "half as many rows": lambda f: (f + 0.5) / (1, 2) - 0.5,
    "half as many columns": lambda f: (f + 0.5) / (2, 1) - 0.5,
    "camera's image is mirrored": lambda f: f[:, ::-1],
}


@pytest.mark.parametrize("reason", WRONG)
def test_coordinates_of_another_projector_image_are_refused_for_that_reason(reason: str) -> None:
    with raises(InputError, "scan", reason) as caught:
        check_phases("scan", phases(WRONG[reason](coordinates(rig()))), by(rig()), CALIBRATED)
    assert re.search(r"\d+\.\d px", str(caught.value))


def test_an_inverted_transform_and_exchanged_matrices_are_named() -> None:
    true, found = rig(), phases(coordinates(rig()))
    inverted = StereoRig(true.camera, true.projector, true.R.T, -true.R.T @ true.t)
    with raises(InputError, "R and T"):
        check_phases("scan", found, by(inverted))
    exchanged = StereoRig(
        Lens(true.projector.K, true.projector.D, SIZE),
        Lens(true.camera.K, true.camera.D, PROJECTOR),
        true.R,
        true.t,
    )
    with raises(InputError, "camera and projector"):
        check_phases("scan", found, by(exchanged))


def test_a_rig_that_was_moved_is_refused_or_raises_sigma() -> None:
    true, found = rig(), phases(coordinates(rig()))
    with raises(InputError, "rig"):
        check_phases("scan", found, by(turned(true, (3.0, 0, 0))))
    accepted = check_phases("scan", found, by(turned(true, (3.0, 0, 0))), accept=True)
    assert accepted.warnings and accepted.agreement and accepted.agreement.ratio > 100
    little = check_phases("scan", found, by(turned(true, (0.1, 0, 0))))  # 0.28 px in the rows
    assert little.agreement and 6 < little.agreement.ratio < 15
    assert little.misfit is not None and little.misfit.change is not None
    nod_mrad = np.linalg.norm(little.misfit.change[2])  # in units of 1 mrad
    assert 0.09 < nod_mrad < 0.2
    assert not missing_facts(little.warnings[0], "uncertainty")


def test_residuals_of_the_calibration_are_no_contradiction() -> None:
    true, found = rig(), phases(coordinates(rig()))
    rms = {"camera": 0.05, "projector": 0.3, "stereo": 0.22}
    model = replace(by(turned(true, (0.1, 0, 0))), reprojection_rms_px=rms)
    assert check_phases("scan", found, model).misfit is None


def test_one_axis_is_judged_by_what_the_projector_could_light_and_by_depth() -> None:
    true, found = rig(), coordinates(rig())
    for axis in "xy":
        assert check_phases("scan", phases(found, axis), by(true), CALIBRATED).warnings == ()
    with raises(InputError, "scan", "100 %"):
        check_phases("scan", phases((found + 0.5) / 2 - 0.5, "y"), by(true), CALIBRATED)
    (warning,) = check_phases(
        "scan", phases((found + 0.5) / 3 - 0.5, "x"), by(true), CALIBRATED
    ).warnings
    assert not missing_facts(warning, "350 mm", "980 mm")


def test_sizes_are_named_and_their_ratio() -> None:
    check_sizes("scan", SIZE, PROJECTOR, rig())
    check_sizes("scan", SIZE, None, rig())  # not known
    with raises(InputError, "456x570", "912x1140"):
        check_sizes("scan", SIZE, (456, 570), rig())
    with raises(InputError, "150x120", "160x120"):
        check_sizes("scan", (150, 120), PROJECTOR, rig())


def test_light_by_another_path_raises_sigma_where_it_falls() -> None:
    """A mirror below the scene bends both axes by waves that no mean over the image shows."""
    true, found = rig(), coordinates(rig())
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    wave = 0.3 * np.dstack([np.sin(u / 1.7 + v), np.sin(u / 2.3 - v)])
    bent = found + np.where((v > 90)[..., None], wave, 0)
    check = check_phases("scan", phases(bent), by(true), CALIBRATED)
    assert check.misfit is not None and check.misfit.change is None
    excess = check.misfit.excess_px
    illuminated = np.isfinite(found[..., 0]).reshape(12, 10, 16, 10).mean((1, 3)) > 0.5
    assert (excess[:9] == 0).all() and (excess[9:][illuminated[9:]] > 0).mean() > 0.9
    assert 0.1 < np.median(excess[excess > 0]) < 0.4
    (warning,) = check.warnings
    assert warning.startswith("scan: ") and not missing_facts(warning, "reflections")
