"""A camera's lens from a file that another program, or `calibrate --camera-only`, wrote.

Read are OpenCV FileStorage (YAML, XML, JSON), NPZ of NumPy, camera_info of ROS (YAML, INI),
camchain.yaml of Kalibr, exports of MATLAB's cameraParameters as YAML or JSON, Calib_Results.mat of
Bouguet's toolbox, by the names of their entries, and what `calibration_makers` converts. Entries
that nothing reads are named in a note.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.sequence import Size
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats
from slviewer.session.columns import bare_name, note_unused
from slviewer.session.importers.filestorage import Storage, read_storage
from slviewer.session.names import join_names
from slviewer.session.reading import expand_user
from slviewer.session.results import digest_bytes

MATRICES = (
    "kcamera", "cameramatrix", "cameramatrix1", "intrinsicmatrix", "intrinsics", "camk", "kcam",
    "kc", "camint", "mtx", "m1", "k1", "k",
)  # fmt: skip
DISTORTIONS = (
    "dcamera", "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff",
    "distcoeffs1", "camkc", "dcam", "camdist", "cameradistortion", "coeffs", "distortion", "dist",
    "dist1", "kc", "d1", "d",
)  # fmt: skip
SIZES = ("camerasize", "camsize", "imagesize", "resolution")
PAIRS = (
    ("imagewidth", "imageheight"),
    ("framewidth", "frameheight"),
    ("width", "height"),
    ("nx", "ny"),
)
"""Names of entries, without case and underscores, behind the last dot."""
FISHEYE = {"fisheye", "equidistant", "kannala", "equi"}
CENTRES = (("cx", "cy"), ("ppx", "ppy"))
OTHER_MODELS = {"omni", "mei", "double_sphere", "ds", "eucm", "fov", "scaramuzza", "inverse"}
COEFFICIENTS = (
    "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "taux", "tauy",
)  # fmt: skip
MAX_RESIDUAL_PX = 0.05
"""Of the five coefficients that stand for another model's: below the noise of a board's corners."""
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
    is_fisheye = _is_fisheye(storage)
    found = _Entries(storage)
    notes: list[str] = []
    K, D, stated = found.matrix(), found.distortion(is_fisheye, notes), found.size()
    sigma = found.get("focalsigmapx")
    found.note_unused(notes)
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
        if is_fisheye or D[5:].any():
            D = _fit_brown(K, D, is_fisheye, stated or size, notes)
        lens = Lens(K, D, stated or size)
    except InputError as error:
        raise error.within(path.name) from error
    lens = _adapt(lens, size, path.name, notes)
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


def _is_fisheye(storage: Storage) -> bool:
    """Whether a lens is of OpenCV's fisheye model, else of a pinhole. Raises InputError for
    others."""
    words = [word for key, word in storage.words.items() if "model" in key.lower()]
    flags = [
        key
        for key, value in storage.entries.items()
        if _plain(key) in ("mappingcoefficients", "xi") and value is not None
    ]
    others = [word for word in words if _list_parts(word) & OTHER_MODELS]
    if named := ", ".join(others + flags):
        raise InputError(
            f"{storage.name} is of another lens model ({named}), which pinhole and Brown's"
            " distortion (k1 k2 p1 p2 k3) cannot represent",
            "calibrate the camera alone with --camera-only",
        )
    return any(_list_parts(word) & FISHEYE for word in words) or any(
        "fisheye" in key.lower() and value is not None and bool(value.any())
        for key, value in storage.entries.items()
    )


def _fit_brown(K: Floats, D: Floats, is_fisheye: bool, size: Size, notes: list[str]) -> Floats:
    """Return the five coefficients that fit another model's best over an image, with the residual
    as a note. Raises InputError for a residual beyond `MAX_RESIDUAL_PX`."""
    kind = "fisheye (equidistant)" if is_fisheye else "rational, thin prism or tilted"
    model = f"its lens model is {kind}, of {D.size} coefficients"
    remedy = "calibrate the camera alone with --camera-only"
    if is_fisheye and D.size != 4:
        raise InputError(f"{model}, and OpenCV's fisheye has 4", "export the calibration again")
    axes = (np.linspace(0, length - 1, 41) for length in size)
    pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    focal = np.diag(K)[:2]
    seen = (pixels - K[:2, 2]) / focal
    rays = seen
    with np.errstate(all="ignore"):
        for _ in range(200):  # until they meet the pixels
            rays = rays + seen - _distort(rays, D, is_fisheye)
        is_met = np.abs(_distort(rays, D, is_fisheye) - seen).max() < 1e-6
    if not is_met:
        raise InputError(
            f"{model}, and it has no ray for some pixels of {size[0]}x{size[1]}", remedy
        )
    (x, y), r2 = rays.T, (rays**2).sum(axis=1)
    tangential = (2 * x * y, r2 + 2 * x * x), (r2 + 2 * y * y, 2 * x * y)
    # linear in k1 k2 p1 p2 k3: x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    rows = [
        np.stack([v * r2, v * r2**2, *p, v * r2**3], axis=1)
        for v, p in zip((x, y), tangential, strict=True)
    ]
    matrix, shift = np.concatenate(rows), (seen - rays).T.ravel()
    fitted = np.linalg.lstsq(matrix, shift, rcond=None)[0]
    residual = float(np.abs(matrix @ fitted - shift).max() * focal.max())
    is_fitted = f"k1 k2 p1 p2 k3 fit it with a residual of up to {residual:.2g} px"
    if residual > MAX_RESIDUAL_PX:
        raise InputError(f"{model}, and {is_fitted}", remedy)
    notes.append(f"{model}: {is_fitted}, and are used")
    return np.asarray(fitted, np.float64)


def _distort(rays: Floats, D: Floats, is_fisheye: bool) -> Floats:
    """Return the distorted coordinates (n, 2) of rays (n, 2), over the focal length."""
    if not is_fisheye:
        points, zero = np.insert(rays, 2, 1.0, axis=1)[:, None], np.zeros(3)
        pixels = cv2.projectPoints(points, zero, zero, np.eye(3), D)[0]
        return np.asarray(pixels, np.float64).reshape(-1, 2)
    r = np.linalg.norm(rays, axis=1)
    angle = np.arctan(r)
    bent = angle * (1 + np.polynomial.polynomial.polyval(angle**2, [0, *D]))
    scale = np.where(r > 0, bent / np.maximum(r, 1e-12), 1.0)
    return np.asarray(rays * scale[:, None])


def _list_parts(word: str) -> set[str]:
    """Return the parts of a model's name, and the whole."""
    return {word.lower(), *re.split(r"[^a-z_]+|_", word.lower())}


def _plain(key: str) -> str:
    """Return a key behind its last dot, without case and underscores."""
    return bare_name(key.rpartition(".")[2])


class _Entries:
    """The entries of a file by their plain names; ``used``: the keys that were read."""

    def __init__(self, storage: Storage) -> None:
        self.name = storage.name
        self.storage, self.used = storage, set[str]()
        self.keys: dict[str, str] = {}
        known = {*MATRICES, *DISTORTIONS, *COEFFICIENTS, "fx"}
        for key in sorted(storage.entries, key=lambda key: key.count(".")):
            first = self.keys.setdefault(_plain(key), key)
            one, other = storage.entries[first], storage.entries[key]
            if one is None or other is None or np.array_equal(one, other):
                continue
            if _plain(key) in known:
                raise InputError(
                    f"{storage.name} is of several cameras: it states {first} and {key}",
                    "keep the block of the one that scans",
                )
        self.is_matlab = {"FocalLength", "IntrinsicMatrix", "RadialDistortion"} & {
            key.rpartition(".")[2] for key in storage.entries
        }

    def get(self, name: str, *sizes: int) -> Floats | None:
        """Return the entry of a plain name, if it holds so many numbers; by default any."""
        key = self.keys.get(name, "")
        value = self.storage.entries.get(key)
        if value is None or (sizes and value.size not in sizes):
            return None
        self.used.add(key)
        return self.storage.matrix(key)

    def _select(self, names: tuple[str, ...], *sizes: int) -> Floats | None:
        """Return the first entry of these names that holds so many numbers."""
        values = (self.get(name, *sizes) for name in names)
        return next((value for value in values if value is not None), None)

    def _scalars(self, names: Sequence[str]) -> list[float] | None:
        """Return the single numbers of these names; None unless all are there."""
        values = [self.get(name, 1) for name in names]
        known = [float(value.item()) for value in values if value is not None]
        return known if len(known) == len(names) else None

    def _describe(self, keys: Iterable[str]) -> str:
        """Name entries with how many numbers they hold."""
        values = {key: self.storage.entries[key] for key in keys}
        described = [
            f"{key} ({'no numbers' if v is None else 'x'.join(map(str, v.shape))})"
            for key, v in values.items()
            if key not in self.storage.words
        ]
        return join_names(described, 30) or "none"

    def note_unused(self, notes: list[str]) -> None:
        """Append a note on the entries that were not read, but texts and mappings."""
        unused = self.storage.list_unused(self.used)
        note_unused([key for key in unused if "fisheye" not in key.lower()], notes)

    def matrix(self) -> Floats:
        """Return the camera matrix (3, 3); pixel (0, 0) is the centre of the top left one."""
        given = self._select(MATRICES, 9)
        four: Floats | list[float] | None = self.get("intrinsics", 4)
        focal, point = (
            self._select(names, 1, 2)
            for names in (("focallength", "fc"), ("principalpoint", "cc"))  # fc, cc: Bouguet's
        )
        if focal is not None and point is not None:
            four = np.append(np.broadcast_to(focal.ravel(), 2), point)
        if four is None:
            pixels = (self._scalars(("fx", "fy", *centre)) for centre in CENTRES)
            four = next(filter(None, pixels), None)
        skew = self._select(("skew", "alphac"), 1)
        if skew is not None and skew.any():
            raise InputError(f"{self.name} states a skew of {skew.item()}", "calibrate without")
        if given is not None:
            K = given.reshape(3, 3).copy()
            if K[2, :2].any() and not K[:2, 2].any():  # MATLAB's, which multiplies from the right
                K = K.T.copy()
        elif four is not None:
            fx, fy, cx, cy = four
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        else:
            raise InputError(
                f"{self.name} states no camera matrix",
                "it needs camera_matrix (3x3), or intrinsics (fx fy cx cy); its entries are"
                f" {self._describe(self.keys.values())}",
            )
        if self.is_matlab:  # which counts pixels from 1
            K[:2, 2] -= 1
        return K

    def distortion(self, is_fisheye: bool, notes: list[str]) -> Floats:
        """Return the distortion coefficients in OpenCV's order."""
        if (given := self._select(DISTORTIONS, 4, 5, 8, 12, 14)) is not None:
            return given.ravel()
        if (radial := self.get("radialdistortion", 2, 3)) is not None:
            tangential = self.get("tangentialdistortion", 2)
            k1, k2, k3 = np.append(radial.ravel(), 0.0)[:3]
            return np.array(
                [k1, k2, *(np.zeros(2) if tangential is None else tangential.ravel()), k3]
            )
        names = ("k1", "k2", "k3", "k4") if is_fisheye else COEFFICIENTS
        scalars = [self.get(name, 1) for name in names]
        if any(value is not None for value in scalars):
            return np.array([0.0 if value is None else value.item() for value in scalars])
        named = [
            key
            for plain, key in self.keys.items()
            if re.search("dist|coeff|radial", plain) or plain in DISTORTIONS
            if key not in self.used | self.storage.words.keys()
            if (value := self.storage.entries[key]) is None or value.size
        ]
        if named:
            raise InputError(
                f"{self.name}: no distortion can be read from {self._describe(named)}",
                "OpenCV's has 4, 5, 8, 12 or 14 coefficients; export the calibration again",
            )
        notes.append("it states no distortion: taken as none")
        return np.zeros(5)

    def size(self) -> Size | None:
        """Return the image's (width, height) px; None where unstated."""
        if (pair := self._select(SIZES, 2)) is not None:
            width, height = pair.ravel()[:: -1 if self.is_matlab else 1]  # rows first in MATLAB
            return round(width), round(height)
        values = next(filter(None, map(self._scalars, PAIRS)), None)
        return None if values is None else (round(values[0]), round(values[1]))
