"""A camera's lens from a file that another program, or `calibrate --camera-only`, wrote.

Read are OpenCV FileStorage (YAML, XML, JSON), camera_info of ROS, camchain.yaml of Kalibr, and
exports of MATLAB's cameraParameters as YAML or JSON, by the names of their entries.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.sequence import Size
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats
from slviewer.session.importers.filestorage import Storage, read_storage
from slviewer.session.reading import expand_user
from slviewer.session.results import digest_bytes

MATRICES = (
    "kcamera", "cameramatrix", "cameramatrix1", "intrinsicmatrix", "intrinsics", "camk", "kcam",
    "kc", "camint", "mtx", "m1", "k1", "k",
)  # fmt: skip
DISTORTIONS = (
    "dcamera", "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff",
    "distcoeffs1", "camkc", "dcam", "camdist", "cameradistortion", "distortion", "dist", "dist1",
    "kc", "d1", "d",
)  # fmt: skip
SIZES = ("camerasize", "camsize", "imagesize", "resolution")
PAIRS = (("imagewidth", "imageheight"), ("framewidth", "frameheight"), ("width", "height"))
"""Names of entries, without case and underscores, behind the last dot."""
OTHER_MODELS = (
    "fisheye", "equidistant", "kannala", "omni", "mei", "double_sphere", "ds", "eucm", "fov",
    "scaramuzza", "equi",
)  # fmt: skip
SHORTEST_FOCAL = 0.15
"""Of the image's longer side: a view of 147 degrees."""
MAX_OFF_CENTRE = 0.25
"""Distance of the principal point from the image's middle, over the image's size, in a file that
states no size."""


@dataclass(frozen=True, eq=False)
class CameraFile:
    """The ``lens`` in a file, the relative standard deviation of its focal length (None where
    unstated), the hash of the file's ``content``, and ``notes`` on what was assumed."""

    lens: Lens
    name: str
    content: str
    focal_sigma: float | None = None
    notes: tuple[str, ...] = ()


def read_camera_file(path: Path | str, size: Size) -> CameraFile:
    """The lens in a file, for images of ``size`` (width, height) px.

    A lens of another image size with the same aspect ratio is adapted, with a note. Raises
    InputError where the file states no lens, another lens model, units other than pixels, or an
    image of another shape.
    """
    path = expand_user(path)
    storage = read_storage(path)
    _refuse_other_models(storage)
    found = _Entries(storage)
    notes: list[str] = []
    K, D, stated = found.matrix(), found.distortion(notes), found.size()
    focal, longer = max(K[0, 0], K[1, 1]), max(stated or size)
    if focal < SHORTEST_FOCAL * longer:
        raise InputError(
            f"{path.name}: a focal length of {focal:.6g} is not in pixels, as an image of {longer}"
            " px shows",
            "if it is in mm, divide it and the principal point by the size of a pixel in mm",
        )
    if stated is None:
        notes.append(f"it states no image size: taken as {size[0]}x{size[1]} px")
        off = np.abs((K[:2, 2] + 0.5) / size - 0.5).max()
        if off > MAX_OFF_CENTRE:
            raise InputError(
                f"{path.name}: its principal point ({K[0, 2]:.0f}, {K[1, 2]:.0f}) px is far from"
                f" the middle of an image of {size[0]}x{size[1]} px, and it states no image size",
                "add image_width and image_height of the images that it was made from",
            )
    try:
        lens = Lens(K, D, stated or size)
    except InputError as error:
        raise error.within(path.name) from error
    lens = _adapt(lens, size, path.name, notes)
    sigma = found.numbers.get("focalsigmapx")
    return CameraFile(
        lens,
        path.name,
        digest_bytes(path.read_bytes()).hex(),
        None if sigma is None else float(np.max(sigma.ravel() / np.diag(K)[: sigma.size])),
        tuple(notes),
    )


def _adapt(lens: Lens, size: Size, name: str, notes: list[str]) -> Lens:
    """Return the lens for images of another size. Raises InputError for those of another shape."""
    if lens.size == size:
        return lens
    ours, theirs = f"{size[0]}x{size[1]}", f"{lens.size[0]}x{lens.size[1]}"
    factor = size[0] / lens.size[0]
    if abs(lens.size[1] * factor - size[1]) > 1:
        raise InputError(
            f"{name} is of images of {theirs} px, and these are of {ours} px, another shape",
            "calibrate the camera alone with the image size and region of interest of the captures",
        )
    notes.append(
        f"it is of {theirs} px, and was scaled to {ours} px: right where the camera scales or bins,"
        " not where it crops"
    )
    resized = lens.resize(factor)
    return Lens(resized.K, resized.D, size)


def _refuse_other_models(storage: Storage) -> None:
    """Raise InputError for a lens model that is not pinhole with Brown's distortion."""
    words = [
        word
        for key, word in storage.words.items()
        if "model" in key.lower() and _list_parts(word) & {*OTHER_MODELS}
    ]
    flags = [
        key
        for key, value in storage.entries.items()
        if _plain(key) in ("mappingcoefficients", "xi")
        or ("fisheye" in key.lower() and value is not None and value.any())
    ]
    if named := ", ".join(words + flags):
        raise InputError(
            f"{storage.name} is of another lens model ({named}), which pinhole and Brown's"
            " distortion (k1 k2 p1 p2 k3) cannot represent",
            "calibrate the camera alone with --camera-only",
        )


def _list_parts(word: str) -> set[str]:
    """Return the parts of a model's name, and the whole."""
    return {word.lower(), *re.split(r"[^a-z_]+|_", word.lower())}


def _plain(key: str) -> str:
    """Return a key behind its last dot, without case and underscores."""
    return re.sub(r"[^a-z0-9]", "", key.rpartition(".")[2].lower())


class _Entries:
    """The entries of a file by their plain names."""

    def __init__(self, storage: Storage) -> None:
        self.name = storage.name
        cameras = {key.partition(".")[0] for key in storage.entries if re.match(r"cam\d+\.", key)}
        if len(cameras) > 1:
            raise InputError(
                f"{storage.name} is of several cameras ({', '.join(sorted(cameras))})",
                "keep the block of the one that scans",
            )
        self.keys = {_plain(key): key for key in storage.entries}
        self.numbers: dict[str, Floats] = {
            plain: storage.matrix(key)
            for plain, key in self.keys.items()
            if storage.entries[key] is not None
        }
        self.is_matlab = {"FocalLength", "IntrinsicMatrix"} & {
            key.rpartition(".")[2] for key in storage.entries
        }

    def _select(self, names: tuple[str, ...], *sizes: int) -> Iterator[Floats]:
        """Return the entries of these names that hold so many numbers."""
        return (
            self.numbers[name]
            for name in names
            if self.numbers.get(name, np.empty(0)).size in sizes
        )

    def _scalars(self, *names: str) -> list[float] | None:
        """Return the single numbers of these names; None unless all are there."""
        values = [self.numbers[n] for n in names if n in self.numbers and self.numbers[n].size == 1]
        return [float(v.ravel()[0]) for v in values] if len(values) == len(names) else None

    def matrix(self) -> Floats:
        """Return the camera matrix (3, 3); pixel (0, 0) is the centre of the top left one."""
        given = next(self._select(MATRICES, 9), None)
        four: Floats | list[float] | None = next(self._select(("intrinsics",), 4), None)
        if "focallength" in self.numbers and "principalpoint" in self.numbers:
            four = np.append(self.numbers["focallength"], self.numbers["principalpoint"])
        if four is None:
            four = self._scalars("fx", "fy", "cx", "cy")
        if given is not None:
            K = given.reshape(3, 3).copy()
            if K[2, :2].any() and not K[:2, 2].any():  # MATLAB's, which multiplies from the right
                K = K.T.copy()
        elif four is not None and len(four) == 4:
            fx, fy, cx, cy = four
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        else:
            raise InputError(
                f"{self.name} states no camera matrix",
                "it needs camera_matrix (3x3), or intrinsics (fx fy cx cy); its entries are"
                f" {', '.join([*self.keys.values()][:30]) or 'none'}",
            )
        if self.is_matlab:  # which counts pixels from 1
            K[:2, 2] -= 1
        return K

    def distortion(self, notes: list[str]) -> Floats:
        """Return the distortion coefficients in OpenCV's order."""
        if (given := next(self._select(DISTORTIONS, 4, 5, 8, 12, 14), None)) is not None:
            return given.ravel()
        if (radial := next(self._select(("radialdistortion",), 2, 3), None)) is not None:
            tangential = next(self._select(("tangentialdistortion",), 2), np.zeros(2))
            k1, k2, k3 = np.append(radial.ravel(), 0.0)[:3]
            return np.array([k1, k2, *tangential.ravel(), k3])
        if (scalars := self._scalars("k1", "k2", "p1", "p2")) is not None:
            return np.array([*scalars, *(self._scalars("k3") or [0.0])])
        notes.append("it states no distortion: taken as none")
        return np.zeros(5)

    def size(self) -> Size | None:
        """Return the image's (width, height) px; None where unstated."""
        pair = next(self._select(SIZES, 2), None)
        if pair is not None:
            width, height = pair.ravel()[:: -1 if self.is_matlab else 1]  # rows first in MATLAB
            return round(width), round(height)
        values = next(filter(None, (self._scalars(*names) for names in PAIRS)), None)
        return None if values is None else (round(values[0]), round(values[1]))
