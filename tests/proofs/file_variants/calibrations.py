"""Calibration files of random form: of one camera, and of a camera with a projector."""

import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.io import savemat

from tests.proofs.file_variants.variant import Form, Variant, end_lines

SIZE = (640, 480)
_NAMES = {4: "k1 k2 p1 p2", 5: "k3", 8: "k4 k5 k6", 12: "s1 s2 s3 s4", 14: "tau"}


@dataclass(frozen=True, eq=False)
class Camera:
    """``K`` (3, 3) px and ``D`` in OpenCV's order; of a ``fisheye`` k1 to k4 of its polynomial. Of
    a rig ``R`` (3, 3) and ``T`` (3,) mm to the projector, whose lens is the same."""

    K: np.ndarray
    D: np.ndarray
    fisheye: bool = False
    R: np.ndarray | None = None
    T: np.ndarray | None = None

    def project(self, normalised: np.ndarray) -> np.ndarray:
        """Return the pixels (n, 2) of undistorted coordinates (n, 2), by OpenCV."""
        points = np.append(normalised, np.ones((len(normalised), 1)), axis=1)[:, None]
        zero = np.zeros(3)
        if self.fisheye:
            return cv2.fisheye.projectPoints(points, zero, zero, self.K, self.D)[0].reshape(-1, 2)
        return cv2.projectPoints(points, zero, zero, self.K, self.D)[0].reshape(-1, 2)


def draw_camera(form: Form, *counts: int, stereo: bool = False) -> Camera:
    """Draw a lens with so many coefficients, those behind the fifth zero at times."""
    rng = form.rng
    f = rng.uniform(700, 1200)  # no distortion drawn folds the image over
    K = np.array([[f, 0, rng.uniform(300, 340)], [0, f * 1.001, rng.uniform(220, 260)], [0, 0, 1]])
    count = form.draw("coefficients", *counts)
    D = rng.uniform(-1, 1, 14) * np.array(
        [0.2, 0.1, 1e-3, 1e-3, 0.05, 0.2, 0.1, 0.05, 1e-2, 1e-3, 1e-2, 1e-3, 1e-2, 1e-2]
    )
    if count > 5 and form.draw("further", "zero", "used") == "zero":
        D[5:] = 0
    if not stereo:
        return Camera(K, D[:count])
    R, _ = cv2.Rodrigues(rng.uniform(-0.3, 0.3, 3))
    return Camera(K, D[:count], R=R, T=rng.uniform(50, 200, 3))


def list_reasons(camera: Camera) -> tuple[str, ...]:
    """Return the words of which a refusal of a lens that five coefficients cannot hold has one."""
    if camera.fisheye:
        return ("fisheye", "equidistant", "residual")
    if camera.D[5:].any():
        return ("rational", "k4", "thin", "residual", f"{camera.D.size} ")
    return ()


def _format_number(value: float, style: str) -> str:
    """Return a number as different writers show it."""
    value = float(value)
    if style == "exponent":
        return f"{value:.17e}"
    if style == "opencv" and value == int(value):
        return f"{int(value)}."
    if style == "short" and value != 0 and abs(value) < 1e-3:
        return np.format_float_scientific(value, trim="-")
    return repr(value)


def draw_ros(rng: np.random.Generator) -> Variant:
    """Draw camera_info of ROS, in flow or block style."""
    form = Form(rng)
    model = form.draw("model", "plumb_bob", "plumb_bob", "rational_polynomial", "equidistant")
    if model == "equidistant":
        camera = draw_camera(form, 4)
        camera = Camera(camera.K, camera.D * 0.2, True)
    else:
        camera = draw_camera(form, *((5, 4) if model == "plumb_bob" else (8,)))
    style = form.draw("lists", "flow", "block")
    numbers = form.draw("numbers", "plain", "short", "exponent", "opencv")
    cols = form.draw("cols", camera.D.size, camera.D.size, 5)
    order = form.draw("cols first", False, True)
    extra_rows = (
        ("rectification_matrix", np.eye(3)),
        ("projection_matrix", np.hstack([camera.K, np.zeros((3, 1))])),
    )
    lines = ["image_width: 640", "image_height: 480", "camera_name: narrow_stereo"]
    for name, matrix in (
        ("camera_matrix", camera.K),
        ("distortion_coefficients", camera.D[None]),
        *extra_rows,
    ):
        shape = [f"  rows: {matrix.shape[0]}", f"  cols: {matrix.shape[1]}"]
        if name.startswith("dist"):
            lines.append(f"distortion_model: {model}")
            shape[1] = f"  cols: {cols}"
        shown = [_format_number(v, numbers) for v in matrix.ravel()]
        if style == "flow":
            rows = [f"  data: [{', '.join(shown)}]"]
        else:
            rows = ["  data:", *(f"  - {v}" for v in shown)]
        lines += [f"{name}:", *(shape[::-1] if order else shape), *rows]
    content = end_lines("\n".join(lines) + "\n", form.draw("end", "\n", "\r\n"))
    suffix = form.draw("suffix", "yaml", "yml")
    reasons = (*list_reasons(camera), *(("cols", "5") if cols != camera.D.size else ()))
    return Variant(
        "ros", form.text(), f"a.{suffix}", content, camera,
        [["rectification_matrix"], ["projection_matrix"]], reasons,
    )  # fmt: skip


def draw_echo(rng: np.random.Generator) -> Variant:
    """Draw a message of camera_info as ROS prints it."""
    form = Form(rng)
    camera = draw_camera(form, 5, 8)
    model = "plumb_bob" if camera.D.size == 5 else "rational_polynomial"
    upper = form.draw("capitals", True, False)
    projection = np.hstack([camera.K, np.zeros((3, 1))])
    entries = {"D": camera.D, "K": camera.K, "R": np.eye(3), "P": projection}
    text = f"header: \n  seq: 7\nheight: 480\nwidth: 640\ndistortion_model: {model!r}\n"
    for name, matrix in entries.items():
        shown = ", ".join(repr(float(v)) for v in matrix.ravel())
        text += f"{name if upper else name.lower()}: [{shown}]\n"
    text += "binning_x: 0\nroi: \n  x_offset: 0\n  height: 0\n  width: 0\n---\n"
    extras = [["P", "p,"], ["binning_x"], ["roi.x_offset"], ["header.seq"]]
    return Variant(
        "ros", form.text(), "a.yaml", text.encode(), camera, extras, list_reasons(camera)
    )


def draw_realsense(rng: np.random.Generator) -> Variant:
    """Draw intrinsics of a depth camera as JSON, of one stream or of two."""
    form = Form(rng)
    camera = draw_camera(form, 5)
    model = form.draw("model", "brown_conrady", "inverse_brown_conrady")
    (fx, _, ppx), (_, fy, ppy), _ = camera.K.tolist()
    stream = {"width": 640, "height": 480, "ppx": ppx, "ppy": ppy, "fx": fx, "fy": fy}
    stream |= {"model": f"distortion.{model}", "coeffs": camera.D.tolist()}
    streams = form.draw("streams", 1, 2)
    other = {**stream, "fx": fx + 1, "width": 1280}
    text = json.dumps({"color": stream, "depth": other} if streams == 2 else stream)
    reasons = ["inverse"] if model.startswith("inverse") else []
    reasons += ["color"] if streams == 2 else []
    truth = None if reasons else camera
    return Variant("json", form.text(), "a.json", text.encode(), truth, (), reasons)


_YAML_HEAD = {4: "%YAML:1.0\n---\n", 5: "%YAML 1.2\n---\n"}


def _to_opencv(entries: Mapping[str, object], kind: str, form: Form) -> str:
    """Return entries as OpenCV writes them: matrices, whole numbers and texts."""
    version = form.draw("opencv", 4, 5)
    parts = []
    for name, value in entries.items():
        if not isinstance(value, np.ndarray):
            quoted = f'"{value}"' if isinstance(value, str) else f"{value}"
            parts.append(
                f"<{name}>{quoted}</{name}>" if kind == "xml"
                else f'    "{name}": {quoted}' if kind == "json" else f"{name}: {quoted}"
            )  # fmt: skip
            continue
        number = "plain" if kind == "json" else "opencv"
        shown = [_format_number(v, number) for v in value.ravel()]
        rows, cols = value.shape
        if kind == "xml":
            parts.append(
                f'<{name} type_id="opencv-matrix">\n  <rows>{rows}</rows>\n  <cols>{cols}</cols>\n'
                f"  <dt>d</dt>\n  <data>\n    {' '.join(shown)}</data></{name}>"
            )
        elif kind == "json":
            parts.append(
                f'    "{name}": {{\n        "type_id": "opencv-matrix",\n        "rows": {rows},\n'
                f'        "cols": {cols},\n        "dt": "d",\n        "data": ['
                f"{', '.join(shown)}]\n    }}"
            )
        else:
            broken = ", ".join(shown[:3]) + ",\n       " + ", ".join(shown[3:])
            parts.append(
                f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n"
                f"   data: [ {broken} ]"
            )
    if kind == "xml":
        body = "\n".join(parts)
        return f'<?xml version="1.0"?>\n<opencv_storage>\n{body}\n</opencv_storage>\n'
    if kind == "json":
        return "{\n" + ",\n".join(parts) + "\n}\n"
    return _YAML_HEAD[version] + "\n".join(parts) + "\n"


def draw_opencv(rng: np.random.Generator) -> Variant:
    """Draw an OpenCV FileStorage of one camera."""
    form = Form(rng)
    fisheye = form.draw("fisheye", False, False, False, True)
    camera = draw_camera(form, *((4,) if fisheye else (4, 5, 8, 12, 14)))
    if fisheye:
        camera = Camera(camera.K, camera.D * 0.2, True)
    names = form.draw(
        "names", ("camera_matrix", "distortion_coefficients"), ("cameraMatrix", "distCoeffs"),
        ("Camera_Matrix", "Distortion_Coefficients"), ("K", "D"), ("mtx", "dist"),
    )  # fmt: skip
    shape = form.draw("coefficients in a", "column", "row")
    D = camera.D[:, None] if shape == "column" else camera.D[None]
    entries: dict[str, object] = {"calibration_time": "Thu Nov 26 10:00:00 2026"}
    entries |= {"image_width": 640, "image_height": 480}
    if fisheye or form.draw("states the model", False, True):
        entries["fisheye_model"] = int(fisheye)
    entries |= {names[0]: camera.K, names[1]: D}
    extras = []
    if form.draw("points", False, True):
        entries["image_points"] = rng.uniform(0, 400, (5, 20))
        extras.append(["image_points"])
    if form.draw("error", False, True):
        entries["avg_reprojection_error"] = 0.25
        extras.append(["avg_reprojection_error"])
    kind = form.draw("kind", "yml", "xml", "json")
    content = end_lines(_to_opencv(entries, kind, form), form.draw("end", "\n", "\r\n"))
    return Variant(
        "opencv", form.text(), f"a.{kind}", content, camera, extras, list_reasons(camera)
    )


def draw_stereo(rng: np.random.Generator) -> Variant:
    """Draw an OpenCV FileStorage of a camera and a projector."""
    form = Form(rng)
    camera = draw_camera(form, 4, 5, 8, stereo=True)
    assert camera.R is not None and camera.T is not None
    names = form.draw(
        "names", ("K1", "D1", "K2", "D2"), ("M1", "D1", "M2", "D2"),
        ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
        ("cam_K", "cam_kc", "proj_K", "proj_kc"),
    )  # fmt: skip
    values = (camera.K, camera.D[None], camera.K, camera.D[None])
    entries: dict[str, object] = dict(zip(names, values, strict=True))
    entries |= {"R": camera.R, "T": camera.T[:, None]}
    extras = []
    if form.draw("rectified", False, True):
        entries |= {"E": np.eye(3), "Q": np.eye(4)}
        extras = [["E"], ["Q"]]
    kind = form.draw("kind", "yml", "xml", "json")
    content = end_lines(_to_opencv(entries, kind, form), form.draw("end", "\n", "\r\n"))
    reasons = list_reasons(camera)
    return Variant("stereo", form.text(), f"a.{kind}", content, camera, extras, reasons)


def draw_matlab_stereo(rng: np.random.Generator) -> Variant:
    """Draw a struct of MATLAB's stereoParameters, old or new, or the variables of Bouguet's
    toolbox, as MAT or JSON."""
    form = Form(rng)
    camera = draw_camera(form, 5, stereo=True)
    assert camera.R is not None and camera.T is not None
    kind = form.draw("kind", "old", "new", "bouguet")
    tree: dict[str, object] = {"R": camera.R, "T": camera.T[:, None], "om": np.ones((3, 1))}
    if kind == "bouguet":
        for side in ("left", "right"):
            tree |= {f"KK_{side}": camera.K, f"kc_{side}": camera.D[:, None]}
    else:
        k1, k2, p1, p2, k3 = camera.D
        matrix = camera.K + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
        lens: dict[str, object] = {
            "RadialDistortion": np.array([[k1, k2, k3]]),
            "TangentialDistortion": np.array([[p1, p2]]),
            "ImageSize": np.array([[480, 640]]),
            **({"IntrinsicMatrix": matrix.T} if kind == "old" else {"K": matrix}),
        }
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.R, camera.T
        tree = {"CameraParameters1": lens, "CameraParameters2": lens, "WorldUnits": "millimeters"}
        tree |= (
            {"RotationOfCamera2": camera.R.T, "TranslationOfCamera2": camera.T[None]}
            if kind == "old"
            else {"PoseCamera2": {"A": pose}}
        )
        tree = {"stereoParams": tree} if form.draw("inside", False, True) else tree
    extras = [["om"]] if kind == "bouguet" else []
    if form.draw("as", "mat", "json") == "json":
        text = json.dumps(tree, default=lambda each: each.tolist())
        return Variant("stereo", form.text(), "a.json", text.encode(), camera, extras)
    savemat(file := io.BytesIO(), tree, do_compression=form.draw("packed", False, True))
    return Variant("stereo", form.text(), "a.mat", file.getvalue(), camera, extras)


def draw_ini(rng: np.random.Generator) -> Variant:
    """Draw the INI of ROS, or one of names with values."""
    form, camera = Form(rng), None
    camera = draw_camera(form, 5)
    (fx, _, cx), (_, fy, cy), _ = camera.K
    if form.draw("kind", "ros", "names") == "ros":
        rows = "\n".join(" ".join(f"{v:.10f}" for v in row) for row in camera.K)
        text = (
            "# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n640\n\nheight\n480\n\n"
            f"[narrow_stereo]\n\ncamera matrix\n{rows}\n\ndistortion\n"
            f"{' '.join(f'{v:.10f}' for v in camera.D)}\n\nrectification\n1.0 0.0 0.0\n"
            "0.0 1.0 0.0\n0.0 0.0 1.0\n\nprojection\n1.0 0.0 0.0 0.0\n0.0 1.0 0.0 0.0\n"
            "0.0 0.0 1.0 0.0\n\n"
        )
        extras = [["rectification"], ["projection"]]
    else:
        values = dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.D, strict=True))
        values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **values}
        between = form.draw("between", "=", " = ")
        text = "[camera]\nwidth=640\nheight=480\n"
        text += "".join(f"{name}{between}{float(v)!r}\n" for name, v in values.items())
        extras = []
        if form.draw("gain", False, True):
            text += "gain=3\n"
            extras.append(["gain"])
    suffix = form.draw("suffix", "ini", "conf")
    return Variant("ini", form.text(), f"a.{suffix}", end_lines(text, "\n"), camera, extras)


def draw_matlab(rng: np.random.Generator) -> Variant:
    """Draw a struct of MATLAB's cameraParameters as JSON, whose pixels count from 1."""
    form, camera = Form(rng), None
    camera = draw_camera(form, 4, 5)
    k1, k2, p1, p2, *k3 = camera.D.tolist()
    matrix = camera.K + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    struct: dict[str, object] = {
        "RadialDistortion": [k1, k2, *k3],
        "TangentialDistortion": [p1, p2],
        "ImageSize": [480, 640],
    }
    kind = form.draw("kind", "old", "new", "intrinsics")
    extras = []
    if kind == "old":
        struct["IntrinsicMatrix"] = matrix.T.tolist()
    elif kind == "new":
        struct["K"] = matrix.tolist()
    else:
        struct["FocalLength"] = [matrix[0, 0], matrix[1, 1]]
        struct["PrincipalPoint"] = matrix[:2, 2].tolist()
    if form.draw("further", False, True):
        struct |= {"WorldUnits": "millimeters", "EstimateSkew": False, "MeanReprojectionError": 0.2}
        extras.append(["MeanReprojectionError"])
    if form.draw("intrinsics too", False, True):
        struct["Intrinsics"] = {k: v for k, v in struct.items() if k != "WorldUnits"}
    inside = form.draw("inside", False, True)
    tree = {"cameraParams": struct} if inside else struct
    if form.draw("as", "json", "mat") == "json":
        return Variant("matlab", form.text(), "a.json", json.dumps(tree).encode(), camera, extras)
    savemat(file := io.BytesIO(), tree, do_compression=form.draw("packed", False, True))
    return Variant("matlab", form.text(), "a.mat", file.getvalue(), camera, extras)


def draw_kalibr(rng: np.random.Generator) -> Variant:
    """Draw a camchain of Kalibr."""
    form = Form(rng)
    model = form.draw("model", "radtan", "radtan", "equidistant")
    camera = draw_camera(form, 4)
    if model == "equidistant":
        camera = Camera(camera.K, camera.D * 0.2, True)
    (fx, _, cx), (_, fy, cy), _ = camera.K
    numbers = [
        f"[{', '.join(repr(float(v)) for v in row)}]" for row in (camera.D, (fx, fy, cx, cy))
    ]
    text = (
        f"cam0:\n  camera_model: pinhole\n  distortion_coeffs: {numbers[0]}\n"
        f"  distortion_model: {model}\n  intrinsics: {numbers[1]}\n  resolution: [640, 480]\n"
        "  rostopic: /cam0/image_raw\n"
    )
    extras = []
    if form.draw("imu", False, True):
        text += "  timeshift_cam_imu: 0.001\n"
        extras.append(["timeshift_cam_imu"])
    return Variant(
        "kalibr", form.text(), "a.yaml", text.encode(), camera, extras, list_reasons(camera)
    )


def cut_calibration(rng: np.random.Generator) -> Variant:
    """Draw a calibration with an entry that no number can be read from."""
    form = Form(rng)
    draw: Callable[[np.random.Generator], Variant]
    draw = form.draw("of", draw_ros, draw_opencv)
    whole = draw(rng)
    lines, name = whole.content.split(b"\n"), b"data"
    places = [i for i, line in enumerate(lines) if name in line]
    place = places[1] if len(places) > 1 else places[0]
    end = lines[place].rfind(b",") if b"," in lines[place] else -1
    lines[place] = lines[place][:end] if end > 0 else lines[place].replace(b"data", b"dat")
    reasons = ("dist", "coeff", "D", "no ", "cannot", "damaged", "truncated")
    return Variant(
        "spoilt", f"{whole.format}: {whole.form}", whole.name, b"\n".join(lines), reasons=reasons
    )
