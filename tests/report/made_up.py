"""Made-up results that look like real ones: bent planes, noisy spheres, a hilly object seen from
three places."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from slviewer.calibration.stereo import StereoModel
from slviewer.fringe.presets import p18
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.records.merge import Merge, Registered
from slviewer.records.verification import ModelFit, Verification
from slviewer.report.maps import PixelCurve, verification_maps
from slviewer.report.reproduction import ReproductionData
from slviewer.report.session import CalibrationFigures, CaptureUse, RecordsView, SessionData
from slviewer.session.capture import Capture, Role
from slviewer.surface.fuse import Fused
from slviewer.surface.shapes import PointSet

MODELS = ("stereo", "pixelwise")
INCIDENCE = (
    (100, 0),
    (91.2, 8.8),
    (0, 100),
    (0, 100),
    (0, 47.6),
    (0, 0.7),
    (0, 0),
    (0, 0),
    (2.1, 97.9),
    (0, 87),
)
OURS = {
    "stereo": (0.134, 0.156, 0.198, 0.222, 0.293, 0.372, 0.456, 0.41, 0.21, 0.25),
    "pixelwise": (0.219, 0.149, 0.076, 0.079, 0.121, 0.189, 0.333, 0.41, 0.08, 0.088),
}
MIDDLES = (440, 475, 580, 610, 695, 740, 790, 770, 550, 655)


def grid(width: int) -> tuple[np.ndarray, np.ndarray]:
    """Image coordinates from -1 to 1 along the width."""
    height = width * 3 // 4
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    return (2 * u - width) / width, (2 * v - height) / width


def error_map(width: int, rms: float, noise: float, seed: int, round_: bool = False) -> np.ndarray:
    u, v = grid(width)
    rng = np.random.default_rng(seed)
    a, b, c = rng.uniform(2, 5, 3)
    bend = np.sin(a * u + b * v) + 0.7 * np.cos(b * u - c * v) + 0.5 * u * v
    bend *= np.sqrt(max(rms**2 - noise**2, 0.0)) / bend.std()
    errors = (bend + noise * rng.standard_normal(u.shape)).astype(np.float32)
    outside = (
        u**2 + v**2 > 0.3 if round_ else (np.abs(u + 0.1 * v) > 0.75) | (np.abs(v - 0.08 * u) > 0.6)
    )
    errors[outside] = np.nan
    return errors


def error_maps(
    found: Verification, width: int, seed: int, round_: bool = False
) -> dict[str, np.ndarray]:
    return {
        f"error_{m}": error_map(width, rms, 0.036, seed + i, round_)
        for i, (m, rms) in enumerate(found.rms_mm.items())
    }


def cloud(width: int, shift: float) -> np.ndarray:
    """(h, w, 3): a shell-like hill at about ``shift`` mm, with a spiral groove and holes."""
    u, v = grid(width)
    u, v = u * 1.35 * shift / 600, v * 1.35 * shift / 600
    radius, angle = np.hypot(u, v), np.arctan2(v, u)
    groove = (
        9 * np.cos(5 * np.log(radius + 0.04) - angle) * np.exp(-radius)
        + 2.2 * np.cos(26 * angle) * radius
    )
    z = shift - 75 * np.sqrt(np.clip(0.85 - radius**2, 0, None)) - groove
    rng = np.random.default_rng(int(shift))
    z = (z + 0.05 * rng.standard_normal(z.shape)).astype(np.float32)
    z[(radius > 0.85) | (np.hypot(u - 0.3, v + 0.2) < 0.03)] = np.nan
    return np.stack([u * 130, v * 130, z], axis=-1).astype(np.float32)


def pixel_curve() -> PixelCurve:
    rng = np.random.default_rng(3)
    z = np.sort(rng.uniform(505, 695, 25))
    c = np.array([900.0, -1.2, 0.004, 0.11, -0.05])
    phase = (c[0] - z) / (z * c[2] - c[1])
    noise = 0.03 * rng.standard_normal((3, 25))
    curve = PixelCurve(
        (500, 500),
        "x",
        phase,
        z + noise[0],
        c[3] * z + 0.2 * noise[1],
        c[4] * z + 0.2 * noise[2],
        c,
        np.array([0.03, 0.006, 0.006]),
    )
    curve.z[4] = np.nan
    return curve


def rms_maps(width: int) -> np.ndarray:
    u, v = grid(width)
    rng = np.random.default_rng(5)
    z = 0.03 + 0.04 * (u**2 + v**2) + 0.006 * np.abs(rng.standard_normal(u.shape))
    maps = np.stack([z, 0.2 * z, 0.15 * z]).astype(np.float32)
    maps[:, np.abs(u) > 0.95] = np.nan
    return maps


def outlines() -> dict[str, np.ndarray]:
    out = {}
    for i, middle in enumerate(MIDDLES):
        tilt = np.radians((-1) ** i * (4 + 2.5 * i))
        corners = np.array([[-110, -85, 0], [110, -85, 0], [110, 85, 0], [-110, 85, 0]], float)
        if i in (1, 4, 6):
            corners = corners[:, [0, 1, 2]] @ np.array(
                [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
            )
        else:
            corners = corners @ np.array(
                [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
            )
        out[f"plane_{i + 1:02d}"] = corners + np.array([10, -5, middle])
    return out


def planes() -> dict[str, Verification]:
    found = {}
    for i, (r1, r2) in enumerate(INCIDENCE):
        fits = {
            m: ModelFit(
                points=812_345,
                excluded=24000 if i and m == "pixelwise" else 1200,
                rms_mm=OURS[m][i],
                noise_floor_mm=0.036,
                coverage=0.981,
            )
            for m in MODELS
        }
        share = {"R1": float(r1), "R2": float(r2), "R3": 100.0 - r1 - r2}
        found[f"plane_{i + 1:02d}"] = Verification(shape="plane", models=fits, incidence=share)
    return found


def spheres() -> dict[str, Verification]:
    radii = (
        (97.91, 98.08),
        (98.1, 98.05),
        (98.2, 98.04),
        (98.25, 98.02),
        (98.31, 97.9),
        (98.39, 97.8),
    )
    rms = (
        (0.109, 0.08),
        (0.096, 0.074),
        (0.086, 0.062),
        (0.076, 0.056),
        (0.092, 0.076),
        (0.085, 0.085),
    )
    return {
        f"sphere_{i + 1}": Verification(
            shape="sphere",
            models={
                m: ModelFit(900, 0, rms[i][k], 0.04, radius_mm=radii[i][k])
                for k, m in enumerate(MODELS)
            },
        )
        for i in range(6)
    }


def stereo_model(width: int) -> StereoModel:
    K = np.array([[3510.2, 0, 801.3], [0, 3509.8, 598.2], [0, 0, 1]])
    D = np.array([-0.0812, 0.113, 0.0003, -0.0002, -0.04])
    a = np.radians(14.0)
    R = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    rig = StereoRig(
        Lens(K, D, (width, width * 3 // 4)),
        Lens(K * [[0.4], [0.8], [1]], -D, (912, 1140)),
        R,
        np.array([-178.2, 0.4, 21.3]),
    )
    return StereoModel(
        rig,
        "circles:21x16:9",
        ("x",),
        {"camera": 0.041, "projector": 0.062, "stereo": 0.053},
        {},
        {},
        {},
        (498.0, 703.0),
        {"camera": 1.2, "projector": 2.1},
        3,
    )


def reproduction_data(width: int = 1600) -> ReproductionData:
    clouds = [cloud(width, shift) for shift in (450, 590, 740)]
    merged = np.concatenate(
        [
            c.reshape(-1, 3) + np.array([0, 0, 590 - s], np.float32)
            for c, s in zip(clouds, (450, 590, 740), strict=True)
        ]
    )
    source = np.repeat(np.arange(3, dtype=np.uint8), [c.size // 3 for c in clouds])
    known = np.isfinite(merged[:, 2])
    from slviewer.reconstruction.reconstruct import normals

    facing = np.concatenate([normals(c).reshape(-1, 3) for c in clouds])
    names = ("object_r1", "object_r2", "object_r3")
    flat, round_ = planes(), spheres()
    eye = tuple(map(tuple, np.eye(4).tolist()))
    surface = PointSet(merged[known], normals=facing[known])
    return ReproductionData(
        quick=width < 1600,
        seed=0,
        stereo=stereo_model(width),
        pixel_curve=pixel_curve(),
        rms_maps_mm=rms_maps(width),
        planes=flat,
        spheres=round_,
        spacings_mm={
            "sphere_1 to sphere_2": (120.0, {"stereo": 120.57, "pixelwise": 119.8}),
            "pair": (150.0, {"stereo": 150.31, "pixelwise": 150.2}),
        },
        error_maps={
            **{
                name: error_maps(flat[name], width, i)
                for i, name in enumerate(("plane_01", "plane_03", "plane_08"))
            },
            **{
                name: error_maps(each, width, 20 + i, True)
                for i, (name, each) in enumerate(round_.items())
            },
        },
        plane_outlines=outlines(),
        merge=Merge(
            reference=names[2],
            scans=list(names),
            pairs={
                name: Registered(
                    rms_mm=0.1, point_to_point_rms_mm=mm, overlap=overlap, T_reference_scan=eye
                )
                for name, mm, overlap in ((names[0], 0.21, 0.84), (names[1], 0.12, 0.9))
            },
        ),
        clouds=dict(zip(names, clouds, strict=True)),
        fused=Fused(surface, source[known], source[known], names, {}, {}),
    )


def capture(name: str, role: Role, size: tuple[int, int]) -> Capture:
    return Capture(name, role, p18((912, 1140)), size, "", Path(), {})


def session_data(width: int = 1600) -> SessionData:
    rng = np.random.default_rng(7)
    height = width * 3 // 4
    names = [f"pose_{i:02d}" for i in range(1, 26) if i not in (9, 17)]
    rms = {name: tuple(0.04 * rng.uniform(0.7, 1.4, 2)) for name in names}
    rms["pose_14"] = (0.17, 0.21)
    residuals = {}
    for name in names:
        a = rng.uniform(-0.3, 0.3)
        v, u = np.mgrid[0:16, 0:21].reshape(2, -1) * 0.03 * width
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        pixels = np.stack([u, v], axis=1) @ turn + rng.uniform(0.05, 0.25, 2) * [width, height]
        noise = [rms[name][i] / np.sqrt(2) * rng.standard_normal(pixels.shape) for i in (0, 1)]
        noise[0][3] = np.nan
        residuals[name] = {
            "camera": (pixels, noise[0]),
            "projector": (pixels * [0.5, 0.8], noise[1]),
        }
    size = (width, height)
    captures = [CaptureUse(capture(n, "calibration", size), "used") for n in names]
    captures += [
        CaptureUse(
            capture("pose_09", "calibration", size),
            "unused",
            "12 of 336 circles found: lower the exposure, or move the board so that all of it is in"
            " view",
        ),
        CaptureUse(capture("pose_17", "calibration", size), "excluded", "the board slipped"),
        CaptureUse(capture("vase <b>blue</b>", "scan", size), "scan"),
    ]
    flat = {name: planes()[name] for name in ("plane_01", "plane_03")}
    maps = [
        verification_maps(name, each, error_maps(each, width, i))
        for i, (name, each) in enumerate(flat.items())
    ]
    stereo = replace(stereo_model(width), pose_rms_px=rms)
    return SessionData(
        name="Vase <script>alert(1)</script>",
        captures=captures,
        calibration=CalibrationFigures(stereo, stereo.reprojection, residuals),
        pixel_fits={"x": rms_maps(width)},
        records=[RecordsView(Verification, flat, maps)],
        warnings=[
            "the camera's exposure changed between pose_03 and pose_04: brightness differs by 20 %"
        ],
    )
