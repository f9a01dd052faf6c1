"""The one pass for CUDA devices against the definitions: in numba's simulator, and on a device
where there is one."""

import importlib.util
import json
import logging
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from decode_reference import decode_reference
from facts import missing_facts, raises

from slviewer.calibration.pixelwise import PixelFit, PixelwiseModel
from slviewer.calibration.splined.compiled import CompiledAxis
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.fringe.decode import texture
from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import complementary, gray, multifrequency, p18, short
from slviewer.geometry import cuda_device
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.reconstruction.onepass import OnePass
from slviewer.reconstruction.onepass_cuda import CudaPass, has_pass, one_pass
from slviewer.validation import bench_rows

pytestmark = pytest.mark.computes

ROOT = Path(__file__).parents[2]
PROJECTOR = (912, 1140)
HEIGHT, WIDTH = 14, 20  # the simulator runs each pixel as a Python thread
V, U = np.mgrid[:HEIGHT, :WIDTH].astype(float)
SEQUENCES = {
    "p18": replace(p18(PROJECTOR), phase_offset_rad=1.9),
    "complementary": complementary(PROJECTOR, 3, 18.0),
    "short": short(PROJECTOR, "x"),
    "heterodyne": multifrequency((400, 400), 5, (18.0, 21.0, 25.0)),
}
CASES = {  # sequence, model, dtype
    "steps and Gray code, pixelwise": ("p18", "pixelwise", "uint8"),
    "complementary code, splined": ("complementary", "splined", "uint16"),
    "three frequencies, stereo": ("short", "stereo", "uint8"),
    "heterodyne, pixelwise": ("heterodyne", "pixelwise", "uint16"),
}


def pixelwise():
    c = np.stack(
        [
            400 + 0.02 * U,
            np.full(U.shape, 1.4),
            np.full(U.shape, -9e-4),
            (U - 10) / 300,
            (V - 7) / 300,
        ]
    )
    c[:, 5, 5] = np.nan
    low, high, ones = (
        np.full(U.shape, 22, np.float32),
        np.full(U.shape, 38, np.float32),
        np.ones(U.shape, np.float32),
    )
    fit = PixelFit(c, np.stack([ones] * 3), np.full(U.shape, 20, np.uint16), low, high, ones)
    return PixelwiseModel({"x": fit}, {"x": 18.0}, {}, "x")


def splined():
    """A made-up compiled form: what a joint adjustment would leave, with cells that no pose
    illuminated."""
    c = np.stack([560 + 0.02 * U, np.full(U.shape, 0.5), np.full(U.shape, -4e-4)]).astype(
        np.float32
    )
    grid = np.random.default_rng(2).normal(0, 0.1, (4, 5, 17)).astype(np.float32)
    held = grid.copy()
    held[2, 3, :5] = np.nan
    model = object.__new__(SplinedModel)
    rays = np.stack([(U - 10) / 300, (V - 7) / 300])
    vars(model).update(
        rays=rays, _compiled={"x": CompiledAxis(c, 155.5, grid, held, 6, 500.0, 600.0)}
    )
    return model


def stereo():
    camera = Lens(
        [[320, 0, 9.5], [0, 320, 6.5], [0, 0, 1]], [-0.1, 0.05, 1e-3, -1e-3, 0], (WIDTH, HEIGHT)
    )
    projector = Lens(
        [[1900, 0, 455], [0, 1950, 570], [0, 0, 1]], [-0.05, 0.02, 5e-4, 8e-4, 0.01], PROJECTOR
    )
    R = np.array([[np.cos(0.3), 0, -np.sin(0.3)], [0, 1, 0], [np.sin(0.3), 0, np.cos(0.3)]])
    return StereoModel.from_rig(StereoRig(camera, projector, R, [60.0, 2.0, 30.0]))


MODELS = {"pixelwise": pixelwise, "splined": splined, "stereo": stereo}


def frames_of(sequence, dtype, model):
    """Noisy frames of a wavy surface with a depth step, a shadow and a glare."""
    rng = np.random.default_rng(0)
    if model.name == "stereo":
        z = 580 + 3 * np.sin(U / 4)
        rays = model.rig.camera.rays()
        coordinate = model.rig.project(np.dstack([rays * z[..., None], z]))[..., 0]
    else:
        coordinate = 62 + 0.9 * U + 0.1 * V + 2 * np.sin(V / 9)
        coordinate[5:9, 10:16] += 31.3
    gain = np.full(U.shape, 170.0)
    gain[:, :2], gain[10:, 16:18] = 0.5, 300.0
    frames = np.empty((len(sequence.frames), HEIGHT, WIDTH))
    for i in range(len(frames)):
        along, levels = profile(sequence, i)
        seen = (
            np.zeros(U.shape)
            if along == "y"
            else np.interp(coordinate, np.arange(len(levels)), levels)
        )
        frames[i] = 15 + gain * seen / 255 + rng.normal(0, 1.5, U.shape)
    full, depth = (255, 1) if dtype == "uint8" else (4095, 16)
    return np.clip(np.rint(frames * depth), 0, full).astype(dtype)


def made(case):
    sequence, model, dtype = CASES[case]
    sequence, model = SEQUENCES[sequence], MODELS[model]()
    return sequence, model, frames_of(sequence, dtype, model)


def scans_to(folder):
    """What a device makes of all cases, saved; and then what happens when it fails in the
    middle."""
    said = []
    assert cuda_device.find_device() is None  # nobody asked for one
    cuda_device.use_device()
    folder, handler = Path(folder), logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())
    logging.getLogger("slviewer.cuda").addHandler(handler)
    logging.getLogger("slviewer.cuda").setLevel(logging.INFO)
    for number, case in enumerate(CASES):
        sequence, model, frames = made(case)
        one = one_pass(sequence, model, "x")
        assert isinstance(one, CudaPass) and has_pass(model)
        scan = one.run(frames)
        # light of a camera of fewer bits is found out, and arrays are used again
        if case.startswith("heterodyne"):
            before = scan.points.copy()
            again = one.run(frames, replace(scan.light, white=1023.0), scan)
            assert again.light.white == 4095 and again.points is scan.points
            np.testing.assert_array_equal(again.points, before)
        assert cuda_device.find_device() is not None
        maps = {key: value for key, value in vars(scan).items() if isinstance(value, np.ndarray)}
        np.savez(folder / f"{number}.npz", **maps)
    bench_rows.TIMES = bench_rows.AHEAD = bench_rows.COPIED = 1  # in this process alone
    rows = bench_rows.gpu_rows(*made("complementary code, splined"))
    assert cuda_device.find_device() is None
    cuda_device.use_device()
    (folder / "rows.json").write_text(json.dumps(rows))
    for case in list(CASES)[::2]:
        sequence, model, frames = made(case)
        one = CudaPass(sequence, model, "x")
        one._card = SimpleNamespace(dtype=frames.dtype, load=lambda frames: 1 / 0)
        scan = one.run(frames)
        np.savez(folder / f"failed {model.name}.npz", points=scan.points, phase=scan.phase)
        assert cuda_device.find_device() is None and not has_pass(stereo())
    (folder / "said.json").write_text(json.dumps(said))


@pytest.fixture(scope="module", params=["simulator", "device"])
def scans(request, tmp_path_factory):
    folder, there = tmp_path_factory.mktemp(request.param), {}
    if request.param == "simulator":
        if importlib.util.find_spec("numba.cuda") is None:
            pytest.skip("numba has no CUDA simulator here: pip install 'slviewer[cuda]'")
        there = {"NUMBA_ENABLE_CUDASIM": "1"}
    elif not cuda_device.is_present():
        pytest.skip("there is no CUDA device here")
    here = Path(__file__)
    code = (
        f"import sys; sys.path[:0] = {[str(here.parent), str(here.parents[1])]!r}; "
        f"import {here.stem} as it; it.scans_to({str(folder)!r})"
    )
    command = [sys.executable, "-W", "ignore", "-c", code]
    run = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **there}, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return folder


def points_of(model, phase):
    if model.name != "splined":
        points = model.points(phase)
        return points, model.sigma_z(phase, points)
    fast, per_rad = model.fast_axis("x"), phase.period_px / (2 * np.pi)
    points = fast.depth(phase.phase, per_rad, model.rays.astype(np.float32), True)
    return points, fast.depth_per_px(phase.phase, per_rad) * np.float32(per_rad) * phase.sigma_phase


@pytest.mark.process
@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_device_measures_what_the_definition_says(scans, case):
    sequence, model, frames = made(case)
    phase = decode_reference(sequence, frames, "x")
    points, sigma = points_of(model, phase)
    seen = np.isfinite(points[..., 2])
    assert 0.3 < seen.mean() < 0.95 and len(np.unique(phase.reason)) >= 3
    with np.load(scans / f"{list(CASES).index(case)}.npz") as found:
        np.testing.assert_array_equal(found["reason"], phase.reason)
        np.testing.assert_allclose(found["phase"], phase.phase, rtol=0, atol=1e-4)
        np.testing.assert_allclose(found["modulation"], phase.modulation, rtol=1e-5, atol=1e-3)
        np.testing.assert_allclose(found["points"], points, rtol=0, atol=3e-4)
        np.testing.assert_allclose(found["sigma_z"][seen], sigma[seen], rtol=1e-3)
        np.testing.assert_array_equal(found["texture"], texture(sequence, frames))


@pytest.mark.process
@pytest.mark.slow
def test_the_benchmark_has_rows_of_a_device(scans):
    kernel, *copies = json.loads((scans / "rows.json").read_text())
    pixels, frames = HEIGHT * WIDTH, 2 * (3 + 6)  # uint16, without the texture
    assert kernel["MB"] * 1e6 > pixels * (frames + 20 + 25) and "GB/s" in kernel["note"]
    assert len(copies) == 2 and all(row["ms"] > 0 and "clouds/s" in row["note"] for row in copies)


@pytest.mark.process
@pytest.mark.slow
def test_a_device_that_fails_is_told_once_and_the_processor_goes_on(scans):
    for case in list(CASES)[::2]:
        sequence, model, frames = made(case)
        phase = decode_reference(sequence, frames, "x")
        with np.load(scans / f"failed {model.name}.npz") as found:
            np.testing.assert_allclose(found["phase"], phase.phase, rtol=0, atol=1e-4)
            np.testing.assert_allclose(found["points"], model.points(phase), rtol=0, atol=1e-3)
    said = json.loads((scans / "said.json").read_text())
    (failure,) = [line for line in said if not missing_facts(line, "failed")]
    assert not missing_facts(failure, "graphics card", "division by zero")


def test_without_a_device_all_is_the_processors(monkeypatch, caplog):
    monkeypatch.setattr(cuda_device, "_cached_name", [])
    monkeypatch.setattr(cuda_device, "_wanted", [True])
    # as if the kernel's module were another version's
    broken = SimpleNamespace(cuInit=lambda flags: 803)
    monkeypatch.setattr(cuda_device.ctypes, "CDLL", lambda name: broken)
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: name == "numba_cuda" or real(name)
    )
    assert type(one_pass(SEQUENCES["p18"], pixelwise(), "x")) is OnePass
    assert type(one_pass(SEQUENCES["p18"], splined(), "x")) is OnePass
    assert has_pass(splined()) and not has_pass(stereo()) and not has_pass(None)
    with raises(InputError, "stereo"):
        one_pass(SEQUENCES["p18"], stereo(), "x")
    room = cuda_device.allocate_frames((3, 2, 2), np.uint16)
    assert room.shape == (3, 2, 2) and room.dtype == np.uint16
    (said,) = caplog.messages
    assert not missing_facts(said, "CUDA", 803)


@pytest.mark.process
def test_a_look_for_a_driver_loads_nothing_else():
    code = (
        "import sys, importlib.util\n"
        "real = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name: real(name) or name == 'numba_cuda'\n"
        "from slviewer.geometry import cuda_device\n"
        "cuda_device.use_device()\n"
        "found = cuda_device.find_device()\n"
        "sys.exit(found is None and bool({'numba', 'numba_cuda'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_a_stereo_pass_refuses_what_it_cannot_do():
    with raises(InputError, "phase steps"):
        CudaPass(gray(PROJECTOR), stereo(), "x")
    one = CudaPass(SEQUENCES["p18"], stereo(), "x")
    assert one.shape == (HEIGHT, WIDTH)
    with pytest.raises(InputError):
        one.run(np.zeros((len(SEQUENCES["p18"].frames), HEIGHT, WIDTH + 1), np.uint8))


def test_a_device_that_measures_otherwise_is_found_out(monkeypatch, caplog):
    """Its first scans are compared with the processor's, whose scan is returned then."""
    monkeypatch.setattr(cuda_device, "_cached_name", ["a card"])
    monkeypatch.setattr(cuda_device, "_wanted", [True])
    monkeypatch.setattr(cuda_device, "allocate_frames", np.empty)
    sequence, model, frames = made("steps and Gray code, pixelwise")
    right = OnePass(sequence, model, "x").run(frames)
    for distance, is_found in ((1e-3, False), (0.05, True)):  # mm, at depths of 400 mm

        def run(job, frames, scan, moved=distance):
            return replace(right, points=right.points + np.float32(moved))

        monkeypatch.setattr(CudaPass, "_run_on_device", run)
        scan = CudaPass(sequence, model, "x").run(frames)
        assert (cuda_device.find_device() is None) == is_found
        error = np.nanmax(np.abs(scan.points - right.points))
        assert error == (0 if is_found else pytest.approx(distance, rel=0.1))
    (said,) = caplog.messages
    assert not missing_facts(said, "%", "processor")


@pytest.mark.parametrize("cc", [pytest.param((7, 5), marks=pytest.mark.slow), (9, 0)])
@pytest.mark.parametrize(
    "model",
    [
        "stereo",
        pytest.param("pixelwise", marks=pytest.mark.slow),
        pytest.param("splined", marks=pytest.mark.slow),
    ],
)
def test_kernels_compile_for_real_devices(monkeypatch, model, cc):
    """As far as PTX, which needs no device."""
    pytest.importorskip(
        "numba_cuda", reason="kernels are compiled by numba-cuda: pip install 'slviewer[cuda]'"
    )
    from numba import cuda
    from numba.core import types

    from slviewer.fringe.kernels_spikes import spike_rules
    from slviewer.reconstruction import onepass_cuda_card as card

    there = sys.modules[type(card._verdict).__module__]
    monkeypatch.setattr(there, "get_current_device", lambda: SimpleNamespace(compute_capability=cc))
    job = CudaPass(SEQUENCES["short"], MODELS[model](), "x")
    measure, c, extra = card._depths(job)
    single, whole, words = types.float32[::1], types.uint16[::1], types.uint8[::1]
    maps, points = types.float32[:, ::1], types.float32[:, ::1]
    number = types.float64 if model == "stereo" else types.float32
    tables = number[:, ::1], (number[::1], number[:, ::1], number[:, :, ::1])[extra.ndim - 1]
    assert c.dtype == extra.dtype == number.name

    def compiled(kernel, *arguments):
        ptx, _ = cuda.compile_ptx(kernel.py_func, arguments, cc=cc)
        return ".visible .entry" in ptx and "ld.local" not in ptx

    kernel = card.sweep_kernel(job, len(job.frames), measure, True)
    light = types.UniTuple(types.float32, 6)
    assert compiled(
        kernel,
        whole,
        light,
        *tables,
        single,
        words,
        single,
        points,
        single,
        whole,
        types.int32[::1],
    )
    list_changes, change = card.spike_kernels(spike_rules(job.layout), (HEIGHT, WIDTH), measure)
    flag = types.boolean
    assert compiled(list_changes, maps, flag, words)
    assert compiled(change, words, flag, *tables, single, words, points, single)
