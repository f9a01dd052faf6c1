"""Pixels of two cameras matched by the phases that they see, against the truth of the renderer."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.fringe.phase import Reason
from slviewer.fringe.presets import p18
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.reconstruction.camera_match import epipolar_lines, match_cameras
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.second_camera import second_camera

pytestmark = pytest.mark.computes

RIG = letter(0.25)
SECOND = second_camera(RIG)
PLAN = letter_plan(RIG)


def seen(name: str):
    """The phases of both cameras, and the true place (h, w, 2) px in the second, of each pixel."""
    scene, sequence = PLAN[name], p18(RIG.projector.size)
    renderer = Renderer(RIG, scene)
    first = decode_frames("first", sequence, renderer.capture(sequence, 1))
    second = decode_frames("second", sequence, SECOND.capture(scene, sequence, 1))
    points = renderer.truth().points
    return first, second, SECOND.rig.camera.project(points @ SECOND.R.T + SECOND.t)


@pytest.fixture(scope="module")
def plane():
    return seen("plane_05")


def true_calibration():
    """Both cameras as they are, local distortion included."""
    lenses = [
        Lens(
            [
                [f[0] * s, 0, (c[0] + 0.5) * s - 0.5],
                [0, f[1] * s, (c[1] + 0.5) * s - 0.5],
                [0, 0, 1],
            ],
            each.brown,
            each.size,
        )
        for each in (RIG.camera, SECOND.rig.camera)
        for f, c, s in ((each.focal_px, each.centre_px, each.scale),)
    ]
    rays = RIG.camera.rays(), SECOND.rig.camera.rays()
    pinholes = StereoRig(*lenses, SECOND.R, SECOND.t)
    return SimpleNamespace(pinholes=pinholes, device_rays=rays)


def check_errors(matched, true, k):
    """The errors are those that sigma predicts, no larger and no smaller."""
    error = matched.coordinate - true[..., k]
    known = np.isfinite(error)
    scaled = error[known] / matched.sigma_px[known]
    assert 0.85 < 1.4826 * np.median(np.abs(scaled)) < 1.1
    assert np.sqrt(np.mean(error[known] ** 2)) < 0.03
    assert abs(np.median(error[known])) < 0.002
    return known


def test_both_axes_are_matched_within_their_noise(plane):
    first, second, true = plane
    matched = match_cameras(first, second)
    assert set(matched) == {"x", "y"}
    for k, axis in enumerate("xy"):
        known = check_errors(matched[axis], true, k)
        assert known.sum() > 0.98 * first["x"].mask.sum()


def test_one_axis_is_matched_along_epipolar_lines(plane):
    first, second, true = ({"x": plane[0]["x"]}, {"x": plane[1]["x"]}, plane[2])
    with raises(InputError, "one axis", "calibration"):
        match_cameras(first, second)
    (matched,) = match_cameras(first, second, epipolar_lines(true_calibration())).values()
    assert matched.axis == "x"
    known = check_errors(matched, true, 0)
    assert known.sum() > 0.98 * first["x"].mask.sum()


def test_rows_of_both_cameras_agree(plane):
    lines = epipolar_lines(true_calibration())
    first, second = lines.first, lines.second
    places = plane[2]
    inside = np.isfinite(places).all(-1) & (np.abs(places - [199.5, 149.5]) < [199, 149]).all(-1)
    u, v = np.rint(places[inside]).astype(int).T
    # half a pixel of rounding
    assert np.abs(second[v, u] - first[inside]).max() < 0.75


def test_what_the_second_camera_does_not_see_is_masked():
    first, second, true = seen("object_r2")
    hidden = np.zeros(second["x"].phase.shape, bool)
    hidden[:, :200] = True
    second = {
        axis: replace(each, phase=np.where(hidden, np.float32(np.nan), each.phase))
        for axis, each in second.items()
    }
    matched = match_cameras(first, second)["x"]
    behind = first["x"].mask & (true[..., 0] < 198)
    assert behind.sum() > 1000
    assert (matched.reason[behind] == Reason.UNSEEN).mean() > 0.99
    assert not matched.mask[behind].any()
    error = (matched.coordinate - true[..., 0])[matched.mask]
    assert np.mean(np.abs(error) > 1.0) < 0.002  # no edge is bridged


def test_nothing_seen_is_nothing_matched(plane):
    first, second, _ = plane
    dark = {
        axis: replace(
            each, phase=np.full_like(each.phase, np.nan), reason=np.full_like(each.reason, 1)
        )
        for axis, each in second.items()
    }
    matched = match_cameras(first, dark)["x"]
    assert not matched.mask.any() and np.isnan(matched.phase).all()
