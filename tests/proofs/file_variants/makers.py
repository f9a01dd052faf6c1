"""Calibration files of one camera whose entries or conventions are a maker's own. What they mean is
computed by the maker's formula; arrays are written without NumPy's writer."""

import io
import json
import pickle
import struct
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.io import savemat

from tests.proofs.file_variants.calibrations import SIZE, Camera, draw_camera, list_reasons
from tests.proofs.file_variants.variant import Form, Variant, end_lines

Formula = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class OwnCamera(Camera):
    """A lens whose maker's ``formula`` gives pixels from undistorted coordinates, the centre of the
    first pixel at (0.5, 0.5)."""

    formula: Formula | None = None

    def project(self, normalised: np.ndarray) -> np.ndarray:
        """Return the pixels (n, 2) of undistorted coordinates (n, 2)."""
        assert self.formula is not None
        return np.stack(self.formula(*normalised.T), axis=-1) - 0.5


_COLMAP = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4,
    "OPENCV_FISHEYE": 4, "FULL_OPENCV": 8, "SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2,
}  # fmt: skip
"""Of each model that is read how many coefficients it has."""
_OTHER_COLMAP = {"FOV": 5, "THIN_PRISM_FISHEYE": 12, "RAD_TAN_THIN_PRISM_FISHEYE": 16}
"""Of each other model how many parameters it has."""


def _distort_colmap(model: str, K: np.ndarray, D: np.ndarray) -> Formula:
    """Return COLMAP's formula (src/colmap/sensor/models.h); ``D`` in the order of its file."""
    k = np.append(D, np.zeros(8))

    def project(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if "FISHEYE" in model:
            r = np.hypot(u, v)
            theta = np.arctan2(r, 1)
            at = theta * (1 + sum(k[i] * theta ** (2 * i + 2) for i in range(4)))
            scale = np.divide(at, r, out=np.ones_like(r), where=r > 1e-12)
            return K[0, 0] * u * scale + K[0, 2] + 0.5, K[1, 1] * v * scale + K[1, 2] + 0.5
        r2 = u * u + v * v
        radial = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (
            1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3
        )
        x = u * radial + 2 * k[2] * u * v + k[3] * (r2 + 2 * u * u)
        y = v * radial + 2 * k[3] * u * v + k[2] * (r2 + 2 * v * v)
        return K[0, 0] * x + K[0, 2] + 0.5, K[1, 1] * y + K[1, 2] + 0.5

    return project


def draw_colmap(rng: np.random.Generator) -> Variant:
    """Draw cameras.txt of COLMAP."""
    form = Form(rng)
    model = form.draw("model", *_COLMAP, *_OTHER_COLMAP)
    end, cameras = form.draw("end", "\n", "\r\n"), form.draw("cameras", 1, 1, 1, 2)
    drawn = draw_camera(form, 4 if "FISHEYE" in model else 8)
    K, D = drawn.K, drawn.D * (0.2 if "FISHEYE" in model else 1)
    D[_COLMAP.get(model, 0) :] = 0
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    focal = [fx] if model.startswith(("SIMPLE", "RADIAL")) else [fx, fy]
    K[1, 1] = focal[-1]
    values = [*focal, cx + 0.5, cy + 0.5, *D[: _COLMAP.get(model, 0)].tolist()]
    if model in _OTHER_COLMAP:
        values = [*values[:4], *(0.01 * rng.uniform(-1, 1, _OTHER_COLMAP[model] - 4)).tolist()]
    text = "# Camera list with one line of data per camera:\n" if form.draw("head", 0, 1) else ""
    for number in range(cameras):
        text += f"{number + 1} {model} 640 480 {' '.join(map(repr, values))}\n"
    camera = OwnCamera(K, D, "FISHEYE" in model, formula=_distort_colmap(model, K, D))
    reasons = [model] if model in _OTHER_COLMAP else ["several"] if cameras == 2 else []
    truth = None if reasons else camera
    reasons += ["several"] if cameras == 2 else list_reasons(camera)
    return Variant("colmap", form.text(), "cameras.txt", end_lines(text, end), truth, (), reasons)


def draw_metashape(rng: np.random.Generator) -> Variant:
    """Draw an XML of Metashape: of a camera, or of the only sensor of a chunk."""
    form = Form(rng)
    camera = draw_camera(form, 5)
    k1, k2, p1, p2, k3 = (float(value) for value in camera.D)
    cx, cy, f = 640 * rng.uniform(-0.03, 0.03), 480 * rng.uniform(-0.03, 0.03), camera.K[0, 0]
    own = {"f": f, "cx": cx, "cy": cy, "b1": rng.uniform(-3, 3), "b2": 0.0}
    own |= {"k1": k1, "k2": k2, "k3": k3, "k4": 0.0, "p1": p1, "p2": p2}
    name, projection = form.draw("further", *([""] * 6), "b2", "k4", "p3"), "frame"
    if name:
        own[name] = 0.01
    if form.draw("zeros", "written", "left out") == "left out":
        own = {key: value for key, value in own.items() if value}

    def project(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Metashape's manual, appendix D."""
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x1 = x * radial + (p1 * (r2 + 2 * x * x) + 2 * p2 * x * y)
        y1 = y * radial + (p2 * (r2 + 2 * y * y) + 2 * p1 * x * y)
        return 640 * 0.5 + cx + x1 * f + x1 * own["b1"], 480 * 0.5 + cy + y1 * f

    projection = form.draw("projection", *(["frame"] * 5), "fisheye")
    lines = "".join(f"<{key}>{float(value)!r}</{key}>\n" for key, value in own.items())
    extras: list[list[str]] = []
    cameras = 1
    if form.draw("of", "camera", "chunk") == "camera":
        text = f"<calibration>\n<projection>{projection}</projection>\n<width>640</width>\n"
        text += f"<height>480</height>\n{lines}<date>2026-11-30T10:00:00Z</date>\n</calibration>\n"
    else:
        size = '<resolution width="640" height="480"/>\n'
        if form.draw("covariance", False, True):
            lines += "<covariance><params>f cx</params><coeffs>1 0 0 1</coeffs></covariance>\n"
            extras.append(["covariance"])
        cameras = form.draw("sensors", 1, 1, 2)
        sensor = f'<sensor id="0" label="a" type="{projection}">\n{size}'
        sensor += f'<calibration type="{projection}" class="initial">\n{size}<f>1000</f>\n'
        sensor += f'</calibration><calibration type="{projection}" class="adjusted">\n{size}{lines}'
        sensor += "</calibration>\n</sensor>\n"
        text = f'<document version="2.0.0">\n<chunk label="c">\n<sensors>{sensor * cameras}'
        text += "</sensors>\n</chunk>\n</document>\n"
    text = '<?xml version="1.0" encoding="UTF-8"?>\n' + text
    reasons = ([name if name != "b2" else "skew"] if name else []) + (
        ["fisheye"] if projection != "frame" else []
    )
    reasons += ["calibrations"] if cameras > 1 else []
    truth = None if reasons else OwnCamera(camera.K, camera.D, formula=project)
    return Variant("metashape", form.text(), "a.xml", text.encode(), truth, extras, reasons)


def draw_calibio(rng: np.random.Generator) -> Variant:
    """Draw a JSON of calib.io's Calibrator."""
    form = Form(rng)
    camera = draw_camera(form, 5, 14)
    names = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY"]
    values = {"f": camera.K[0, 0], "ar": camera.K[1, 1] / camera.K[0, 0]}
    values |= {"cx": camera.K[0, 2], "cy": camera.K[1, 2]}
    values |= dict(zip(names, np.append(camera.D, np.zeros(14)), strict=False))
    model = form.draw("model", *(["OpenCV"] * 4), "OpenCVFisheye", "Division")
    cameras = form.draw("cameras", 1, 1, 1, 2)
    inner = {
        "CameraModelCRT": {"CameraModelBase": {"imageSize": {"width": 640, "height": 480}}},
        "parameters": {key: {"state": 0, "val": float(v)} for key, v in values.items()},
    }
    one = {
        "model": {
            "polymorphic_id": 2147483649,
            "polymorphic_name": f"libCalib::CameraModel{model}",
            "ptr_wrapper": {"valid": 1, "data": inner},
        },
        "transform": {"rotation": {"rx": 0, "ry": 0, "rz": 0}},
    }
    tree = {"Calibration": {"cameras": [one] * cameras, "poses": [{"x": 1}], "targets": []}}
    reasons = ["cameras"] if cameras > 1 else [model] if model != "OpenCV" else []
    return Variant(
        "calib.io", form.text(), "a.json", json.dumps(tree).encode(), None if reasons else camera,
        [["poses"], ["targets"], ["transform"]], reasons or list_reasons(camera),
    )  # fmt: skip


def _to_npy(array: np.ndarray) -> bytes:
    """Return an array as NumPy's format 1.0 has it."""
    head = f"{{'descr': '{array.dtype.str}', 'fortran_order': False, 'shape': {array.shape}, }}"
    head += " " * (-(len(head) + 11) % 64) + "\n"
    body = array.tobytes() if array.dtype != object else pickle.dumps(array)
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + body


def draw_npz(rng: np.random.Generator) -> Variant:
    """Draw what np.savez writes of OpenCV's calibrateCamera."""
    form = Form(rng)
    camera = draw_camera(form, 4, 5, 8, 14)
    names = form.draw(
        "names", ("mtx", "dist"), ("camera_matrix", "dist_coeffs"), ("cameraMatrix", "distCoeffs"),
        ("K", "D"), ("arr_0", "arr_1"),
    )  # fmt: skip
    D = form.draw("coefficients in a", camera.D[None], camera.D[:, None], camera.D)
    arrays: dict[str, np.ndarray] = dict(zip(names, (camera.K, D), strict=True))
    extras = []
    if form.draw("poses", False, True):
        arrays |= {"rvecs": rng.normal(0, 1, (6, 3, 1)), "ret": np.array(0.21)}
        extras = [["rvecs"], ["ret"]]
    if form.draw("objects", False, True):
        arrays["corners"] = np.array([None, {"a": 1}], dtype=object)
        extras.append(["corners"])
    if form.draw("size", False, True):
        arrays["image_size"] = np.array(SIZE)
    packed = form.draw("packed", zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    with zipfile.ZipFile(file := io.BytesIO(), "w", packed) as archive:
        for key, value in arrays.items():
            archive.writestr(f"{key}.npy", _to_npy(value))
    reasons = list_reasons(camera)
    unnamed = names[0] == "arr_0"
    return Variant(
        "npz", form.text(), "a.npz", file.getvalue(), None if unnamed else camera, extras,
        ["arr_0"] if unnamed else reasons,
    )  # fmt: skip


def draw_bouguet(rng: np.random.Generator) -> Variant:
    """Draw Calib_Results.mat of Bouguet's toolbox, whose pixels count from 0."""
    form = Form(rng)
    camera = draw_camera(form, 5)
    skew = form.draw("skew", 0.0, 0.0, 0.0, 1e-3)
    tree: dict[str, Any] = {
        "fc": np.diag(camera.K)[:2, None], "cc": camera.K[:2, 2:], "kc": camera.D[:, None],
        "alpha_c": skew, "nx": 640, "ny": 480, "fc_error": np.ones((2, 1)), "KK": camera.K,
        "omc_1": np.ones((3, 1)), "x_1": rng.uniform(0, 400, (2, 80)), "calib_name": "Image",
    }  # fmt: skip
    extras = [["fc_error"], ["omc_1"], ["x_1"]]
    if not form.draw("matrix too", True, False):
        del tree["KK"]
    savemat(file := io.BytesIO(), tree, do_compression=form.draw("packed", False, True))
    return Variant(
        "bouguet", form.text(), "Calib_Results.mat", file.getvalue(), None if skew else camera,
        extras, ["skew"] if skew else [],
    )  # fmt: skip


_HALCON = """# INTERNAL CAMERA PARAMETERS

ParGroup: Camera: Parameter;
  "Internal camera parameters";

Focus:foc:      8.0e-03;
  DOUBLE:0.0:;
  "Focal length of the lens [meter]";
"""
_SCENE = {
    "version": ["1", "2", "0"], "views": [], "poses": [],
    "intrinsics": [{"intrinsicId": "1", "width": "640", "height": "480", "type": "radial3",
                    "pxFocalLength": "900", "principalPoint": ["320", "240"]}],
}  # fmt: skip
_BINARY = struct.pack("<QiiQQ4d", 1, 1, 1, 640, 480, 900.0, 900.0, 320.0, 240.0)
_SCRIPT = b"% Intrinsic and Extrinsic Camera Parameters\nfc = [ 657.3 ; 657.7 ];\n"
_PROJECT = b'<?xml version="1.0"?>\n<document version="1.2.0" path="{projectname}.files/p.zip"/>\n'
_PAIR = {"mtx": np.eye(3), "dist": np.zeros(5)}
_UNREAD: Mapping[str, tuple[bytes, str]] = {
    "a.pkl": (pickle.dumps(_PAIR, 4), "pickle"),
    "b.pickle": (pickle.dumps(_PAIR, 0), "pickle"),
    "a.npy": (_to_npy(np.array(_PAIR, dtype=object)), "NumPy"),
    "a.cal": (_HALCON.encode(), "HALCON"),
    "a.dat": (_HALCON.encode(), "HALCON"),
    "cameras.bin": (_BINARY, "COLMAP"),
    "Calib_Results.m": (_SCRIPT, "MATLAB"),
    "a.psx": (_PROJECT, "Metashape"),
    "a.xml": (_PROJECT, "Metashape"),
    "cameras.sfm": (json.dumps(_SCENE).encode(), "Meshroom"),
    "a.json": (json.dumps(_SCENE).encode(), "Meshroom"),
    "sfm_data.json": (json.dumps({"sfm_data_version": "0.3", **_SCENE}).encode(), "OpenMVG"),
}
"""Files that are refused, with the word that names what they are."""


def draw_unread(rng: np.random.Generator) -> Variant:
    """Draw a file of a kind that is not read."""
    form = Form(rng)
    content, word = _UNREAD[name := form.draw("name", *_UNREAD)]
    return Variant("unread", form.text(), name, content, reasons=[word])


def draw_kalibr_without(rng: np.random.Generator) -> Variant:
    """Draw a camchain of Kalibr without distortion."""
    form = Form(rng)
    camera = draw_camera(form, 4)
    camera = replace(camera, D=np.zeros(4))
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    coefficients = form.draw("coefficients", "[]", "[0.0, 0.0, 0.0, 0.0]")
    text = (
        f"cam0:\n  camera_model: pinhole\n  distortion_coeffs: {coefficients}\n"
        f"  distortion_model: none\n  intrinsics: {[fx, fy, cx, cy]}\n  resolution: [640, 480]\n"
    )
    return Variant("kalibr", form.text(), "a.yaml", text.encode(), camera)
