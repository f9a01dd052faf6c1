"""The lenses that other programs get of a splined calibration: they reproduce its clouds'
pixels."""

from pathlib import Path

import numpy as np
import pytest
from facts import raises
from splined_rig import BOARD, CELLS, observation, phase_map, poses, rig

from slviewer.calibration.pinhole_fit import MIN_PIXELS, fit_lens, fit_splined
from slviewer.calibration.splined.model import SplinedModel, calibrate_splined
from slviewer.calibration.stereo import StereoModel, calibrate_stereo
from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.pipeline.export import export
from slviewer.pipeline.models import frame_of, save_model, warn_if_frame_changed
from slviewer.session.importers import opencv_calibration
from slviewer.session.importers.filestorage import read_storage
from slviewer.session.store import Session


@pytest.fixture(scope="module")
def true():
    return rig(seed=5, local_distortion_px=0.0)


@pytest.fixture(scope="module")
def models(true) -> tuple[StereoModel, SplinedModel]:
    seen = [observation(true, pose, f"pose_{i:02d}") for i, pose in enumerate(poses(true, 9))]
    stereo = calibrate_stereo(seen, true.projector.size, str(BOARD))
    return stereo, calibrate_splined(seen, stereo, cells_across=CELLS)


def cloud_offsets(splined: SplinedModel, true, lens: Lens) -> np.ndarray:
    """(n,) px: from the pixels of a measured cloud to where a lens sees its points."""
    points = splined.points(phase_map(true, np.full(true.camera.size[::-1], 600.0)))
    v, u = np.nonzero(np.isfinite(points[..., 2]))
    return np.asarray(
        np.linalg.norm(lens.project(points[v, u].astype(float)) - np.column_stack([u, v]), axis=1)
    )


@pytest.mark.slow
@pytest.mark.computes
def test_the_fit_reproduces_the_clouds_pixels(models, true) -> None:
    _, splined = models
    camera, projector = fit_splined(splined)
    off = cloud_offsets(splined, true, camera.lens)
    assert len(off) > 20_000
    assert np.sqrt(np.mean(off**2)) < 0.05 and off.max() < 1.5 * camera.max_px + 0.01
    assert 0.0 < camera.rms_px < 0.05 and camera.rms_px <= camera.max_px < 0.5
    assert 0.0 < projector.rms_px < 0.1 and 0.2 < projector.share < 1.0


@pytest.mark.slow
@pytest.mark.computes
def test_what_a_lens_cannot_express_is_stated() -> None:
    _, splined = _bent()
    camera, _ = fit_splined(splined)
    assert camera.max_px > camera.rms_px > 0.01
    with raises(InputError, 10, MIN_PIXELS):
        fit_lens(np.zeros((10, 2)), np.zeros((10, 2)), camera.lens)


def _bent() -> tuple[StereoModel, SplinedModel]:
    bent = rig(seed=2)
    seen = [observation(bent, pose, f"pose_{i:02d}") for i, pose in enumerate(poses(bent, 9))]
    stereo = calibrate_stereo(seen, bent.projector.size, str(BOARD))
    return stereo, calibrate_splined(seen, stereo, cells_across=CELLS)


@pytest.mark.slow
@pytest.mark.computes
def test_the_exported_file_is_the_models_own_and_names_its_frame(
    models, true, tmp_path: Path
) -> None:
    stereo, splined = models
    warned: list[str] = []
    with Session.create(tmp_path / "session") as store:
        save_model(store, stereo)
        warn_if_frame_changed(store, "stereo", warned.append)
        assert not warned
        save_model(store, splined, inputs={f"pose_{i:02d}": "" for i in range(9)})
        warn_if_frame_changed(store, "stereo", warned.append)
        assert len(warned) == 1 and frame_of(store, "splined") in warned[0]
        assert (
            frame_of(store, "pixelwise") == frame_of(store, "stereo") != frame_of(store, "splined")
        )
        frame = frame_of(store, "splined")
    found = export(tmp_path / "session", "calibration", model="splined", out=tmp_path / "c.yml")
    assert frame in found.words
    text = found.path.read_text()
    assert frame in text and "fit_rms_px_camera" in text and "model: splined" in text
    read = opencv_calibration.read_matrices(read_storage(found.path))
    lens = Lens(read["K_camera"], read["D_camera"], true.camera.size)
    off = cloud_offsets(splined, true, lens)
    assert np.sqrt(np.mean(off**2)) < 0.05
    np.testing.assert_allclose(read["T"], splined.rig.t)
