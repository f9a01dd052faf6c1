"""Calibration files whose entries or conventions are a maker's own, with the entries of OpenCV.

COLMAP (colmap.github.io/cameras.html) and Metashape (its manual's appendix on camera models) count
pixels from the corner of the image: the centre of the first is at 0.5. Metashape states the
principal point from the middle of the image, and exchanges p1 and p2. calib.io states fy / fx.
"""

import re
from collections.abc import Mapping
from typing import Any
from xml.etree.ElementTree import Element

from slviewer.errors import InputError
from slviewer.session.names import join_names

_ALONE = "calibrate the camera alone with --camera-only"
_SAVE = 'save it with np.savez("camera.npz", mtx=..., dist=..., image_size=(width, height))'
_EXPORT = "save the camera as Agisoft XML (Tools, Camera Calibration, Adjusted)"
_UNREAD = (
    ((".pkl", ".pickle"), b"", "a pickle of Python, which can run programs", _SAVE),
    ((".npy",), b"\x93NUMPY", "a single array of NumPy", _SAVE),
    ((".cal", ".dat"), b"ParGroup", "of HALCON, whose lens models are other ones", _ALONE),
    (("cameras.bin",), b"", "a binary of COLMAP", "convert it: colmap model_converter --output_type"
     " TXT, and give cameras.txt"),
    ((".m",), b"", "a script of MATLAB", "give the .mat beside it, such as Calib_Results.mat"),
    ((".psx", ".psz"), b"", "a project of Metashape", _EXPORT),
)  # fmt: skip
"""Of each kind of file that is not read: how names end, what such a file has in its beginning, what
it is, and a remedy."""
_COLMAP = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
}
"""The parameters of each model, by OpenCV's names."""
_OWN = ("f", "b1", "b2", "k4", "p1", "p2", "p3", "p4")
"""Entries of Metashape that OpenCV has not, or means otherwise."""
_COLMAP_LINE = re.compile(r"\d+ +[A-Z_]{3,} +\d+ +\d+( +[-+.\deE]+)* *")


def refuse_unread(name: str, data: bytes) -> None:
    """Raise InputError, saying what it is, for a file of a kind that is not read."""
    for ends, mark, kind, remedy in _UNREAD:
        if name.lower().endswith(ends) and mark in data[:4096]:
            raise InputError(f"{name} is {kind}", remedy)


def read_colmap(text: str) -> dict[str, Any] | None:
    """Return the entries of the only camera in COLMAP's cameras.txt; None for other files. Raises
    InputError for several cameras, and for other models."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if not lines or not all(map(_COLMAP_LINE.fullmatch, lines)):
        return None
    rows = [line.split() for line in lines]
    if len(rows) > 1:
        cameras = join_names([row[0] for row in rows])
        raise InputError(
            f"it is of COLMAP, and of several cameras ({cameras})",
            "keep the line of the one that scans",
        )
    ((_, model, width, height, *parameters),) = rows
    names = _COLMAP.get(model, "").split()
    if len(names) != len(parameters):
        raise InputError(
            f"it is of COLMAP's model {model} with {len(parameters)} parameters, and read are"
            f" {', '.join(_COLMAP)}",
            "calibrate in COLMAP with OPENCV",
        )
    values = dict(zip(names, map(float, parameters), strict=True))
    if "f" in values:
        values["fx"] = values["fy"] = values.pop("f")
    values |= {"cx": values["cx"] - 0.5, "cy": values["cy"] - 0.5}
    return {**values, "width": int(width), "height": int(height), "model": model}


def read_metashape(root: Element) -> dict[str, Any] | None:
    """Return the entries of the only calibration in an XML of Metashape, of the camera alone or of
    a chunk; None for other files. Raises InputError for several, and for what OpenCV's five
    coefficients cannot represent."""
    if root.tag == "document":
        found = [each for each in root.iter("calibration") if each.get("class") == "adjusted"]
    elif root.tag == "calibration" and root.find("projection") is not None:
        found = [root]
    else:
        return None
    if len(found) != 1:
        raise InputError(f"it is of Metashape, and holds {len(found)} calibrations", _EXPORT)
    values: dict[str, Any] = {"projection": found[0].get("type", "frame")}
    for each in found[0]:
        values |= dict(each.attrib) if each.tag == "resolution" else {each.tag: each.text or ""}
    numbers = {key: float(values.pop(key, 0)) for key in _OWN}
    _check_metashape(values["projection"], numbers)
    middle = {}
    for key, length in (("cx", "width"), ("cy", "height")):
        middle[key] = float(values[length]) / 2 + float(values.get(key, 0)) - 0.5
    f, p1, p2 = numbers["f"], numbers["p2"], numbers["p1"]
    shown = {key: _to_number(text) for key, text in values.items()}
    named = {"fx": f + numbers["b1"], "fy": f, "p1": p1, "p2": p2, "skew": numbers["b2"]}
    return {**shown, **middle, **named}


def _check_metashape(projection: str, numbers: Mapping[str, float]) -> None:
    """Raise InputError for what OpenCV's five coefficients cannot represent."""
    further = join_names([key for key in ("k4", "p3", "p4") if numbers[key]])
    if projection != "frame":
        what = f"has the projection {projection!r}"
    elif further:
        what = f"states {further}"
    elif not numbers["f"]:
        what = "is of PhotoScan before 1.2 (it states no f)"
    else:
        return
    raise InputError(
        f"it is of Metashape, and {what}: read are projection frame, f, cx, cy, b1, k1 to k3, p1"
        " and p2",
        "calibrate with these alone, and export again",
    )


def _to_number(text: str) -> float | str | None:
    """Return the number in a text, else the text; None for one of blanks."""
    try:
        return float(text)
    except ValueError:
        return text.strip() or None


def convert_json(tree: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the entries of the only camera in a JSON of calib.io; other trees unchanged. Raises
    InputError for several cameras and other models, and for scenes of Meshroom and OpenMVG."""
    if isinstance(tree.get("intrinsics"), list) and {"views", "poses"} & tree.keys():
        maker = "OpenMVG" if "sfm_data_version" in tree else "Meshroom (AliceVision)"
        raise InputError(f"it is a scene of {maker}, which is not read", _ALONE)
    parts = tree.get("Calibration")
    if not isinstance(parts, Mapping) or not isinstance(cameras := parts.get("cameras"), list):
        return tree
    if len(cameras) != 1:
        raise InputError(
            f"it is of calib.io, and of {len(cameras)} cameras", "export the one that scans alone"
        )
    model, data = cameras[0]["model"], cameras[0]["model"]["ptr_wrapper"]["data"]
    if (kind := model["polymorphic_name"].removeprefix("libCalib::")) != "CameraModelOpenCV":
        raise InputError(
            f"it is of calib.io's model {kind}, and CameraModelOpenCV is read",
            "calibrate with the model OpenCV",
        )
    values = {name: each["val"] for name, each in data["parameters"].items()}
    f, ratio = values.pop("f"), values.pop("ar")
    unread = [*parts, *cameras[0]]
    size = data["CameraModelCRT"]["CameraModelBase"]["imageSize"]
    return {
        **{name: None for name in unread if name not in ("cameras", "model")},
        **values,
        **{"fx": f, "fy": f * ratio, "width": size["width"], "height": size["height"]},
    }
