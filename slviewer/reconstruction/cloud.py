"""A cloud that keeps the camera's grid: neighbours in the image are neighbours on the surface."""

from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from slviewer.errors import InputError
from slviewer.fringe.layout import to_eight_bits
from slviewer.fringe.sequence import Axis, Size
from slviewer.geometry.rigid import Floats, Floats32, Mask
from slviewer.records.merge import ProjectorFill

Points = np.ndarray
"""Of an organised cloud (h, w, 3), or some of its points (n, 3), mm; or directions there."""
Map = np.ndarray
"""(h, w): a value for each pixel of an organised cloud."""


def number_tiles(pixels: np.ndarray, size: Size, tiles: tuple[int, ...]) -> NDArray[np.intp]:
    """Return the number (n,) of the tile, of ``tiles`` (rows, columns) of an image of ``size``
    (width, height), that each pixel (n, 2) lies in; of the nearest one outside."""
    place = (pixels[:, ::-1] * tiles / size[::-1]).astype(int)
    return np.ravel_multi_index(tuple(place.T), tiles, mode="clip")


@dataclass(frozen=True, eq=False)
class Misfit:
    """What the axes of a capture contradict in its calibration: ``excess_px`` (rows, columns)
    float32, the px of the projector by which they miss each other in each tile of the image beyond
    what is predicted; ``change`` (8,) as `rig_change.bound_change` returns it, where they do so
    everywhere, else None."""

    excess_px: Floats32
    change: Floats | None = None

    @classmethod
    def pop_from(cls, arrays: dict[str, np.ndarray]) -> "Misfit | None":
        """Remove the fields from the stored arrays of a cloud; None where these hold none."""
        change = arrays.pop("change", None)
        return cls(arrays.pop("excess_px"), change) if "excess_px" in arrays else None

    def text(self) -> str:
        """Describe the misfit."""
        share = 100 * np.mean(self.excess_px > 0)
        where = "" if self.change is not None else f" in {share:.0f} % of the image"
        return (
            f"the x and y patterns disagree with the calibration{where}"
            f" by up to {self.excess_px.max():.2f} px more than predicted: U was raised by that"
        )


@dataclass(frozen=True, eq=False)
class Cloud:
    """The organised cloud of one capture, or points that were imported.

    ``points``: (h, w, 3) float32 mm in the camera's frame, NaN where invalid. ``axis``: the one
    that depth came from. ``model``: the calibration's name. ``sigma_z``: (h, w) float32 mm,
    predicted from the capture's noise. ``sigma_calibration``: (h, w) float32 mm of z too, what the
    calibration leaves uncertain, rigid motion apart: the same in every scan; None from a model that
    does not know. ``sigma_edges``: (h, w) float32 mm, what the camera's blur at edges and a
    ``misfit`` of the axes add, systematic as well; None where nothing does. ``extrapolated``: (h,
    w) bool, points through parts of camera or projector that no target pose illuminated; their
    ``sigma_calibration`` says how little they are worth; None where there are none. ``texture``:
    (h, w) grey or (h, w, 3) RGB, uint8, or None; a 16-bit texture is scaled to 8 bits by the
    camera's range (10, 12, 14 or 16 bits, whichever holds its brightest pixel). ``normals``: (h, w,
    3) float32 of imported points, which lie in rows without being neighbours, in the frame of their
    file; their ``model`` is "", and ``sigma_z`` along these normals. ``fill``: of two cameras, what
    the projector measured where the second one does not see. ``scalars``: other values (h, w) of
    imported points by name.
    """

    points: Points
    axis: Axis
    model: str
    sigma_z: Map
    texture: np.ndarray | None = None
    sigma_calibration: Map | None = None
    sigma_edges: Map | None = None
    misfit: Misfit | None = None
    normals: Points | None = None
    extrapolated: Mask | None = None
    fill: ProjectorFill | None = None
    scalars: dict[str, Map] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("points", "sigma_z", "sigma_calibration", "sigma_edges", "normals"):
            if (values := getattr(self, name)) is not None:
                vars(self)[name] = np.asarray(values, dtype=np.float32)
        points, shape = self.points, self.sigma_z.shape
        if points.ndim != 3 or points.shape[2] != 3 or shape != points.shape[:2]:
            raise InputError(
                f"Points of shape {points.shape} and sigma_z of shape {shape} make no cloud",
                "(h, w, 3) and (h, w) are needed.",
            )
        for name in ("sigma_calibration", "sigma_edges"):
            values = getattr(self, name)
            if values is not None and values.shape != shape:
                raise InputError(
                    f"{name} of shape {values.shape} does not belong to {shape} pixels."
                )
        if self.texture is not None:
            vars(self)["texture"] = _convert_texture(self.texture, shape)

    def supported(self) -> Self:
        """Return the cloud without its extrapolated points."""
        if (dropped := self.extrapolated) is None:
            return self
        maps = {"sigma_z", "sigma_calibration", "sigma_edges"}
        known = {name: values for name in maps if (values := getattr(self, name)) is not None}
        changes: dict[str, Any] = {
            name: np.where(dropped, np.float32(np.nan), values) for name, values in known.items()
        }
        return replace(
            self, points=keep_pixels(self.points, ~dropped), extrapolated=None, **changes
        )

    @property
    def mask(self) -> Mask:
        """(h, w) bool: the measured pixels."""
        # `all` along a short axis takes ten times as long as a product
        with np.errstate(invalid="ignore"):
            return np.isfinite(self.points @ np.ones(3, np.float32))

    @property
    def measured(self) -> np.ndarray:
        """(n, 3) float32 mm: the measured points, in the order of ``mask``."""
        return choose_pixels(self.points, self.mask)

    @property
    def sigma(self) -> Map:
        """(h, w) float32 mm: standard deviation of z from the known ones of noise, calibration and
        edges; NaN where invalid."""
        systematic = self.sigma_systematic
        return (
            self.sigma_z if systematic is None else np.asarray(np.hypot(self.sigma_z, systematic))
        )

    @property
    def sigma_systematic(self) -> Map | None:
        """(h, w) float32 mm: the part of `sigma` that averaging over exposures does not lessen;
        None if not known."""
        if self.sigma_calibration is None or self.sigma_edges is None:
            return self.sigma_edges if self.sigma_calibration is None else self.sigma_calibration
        return np.hypot(self.sigma_calibration, self.sigma_edges)

    def sigmas(self, chosen: Mask) -> dict[str, np.ndarray]:
        """Scalars (n,) of the pixels ``chosen`` (h, w) bool by the name that a file gives them:
        ``sigma_noise``, where the model knows it ``sigma_calibration``, and with that or a misfit
        ``sigma``, all together; mm of z. Where there are such points, ``extrapolated`` is 1 of
        these and 0 of the others. The `scalars` of imported points follow."""
        scalars = {"sigma_noise": self.sigma_z[chosen]}
        if self.sigma_calibration is not None:
            scalars["sigma_calibration"] = self.sigma_calibration[chosen]
        if self.sigma_calibration is not None or self.misfit is not None:
            scalars["sigma"] = self.sigma[chosen]
        if self.extrapolated is not None:
            scalars["extrapolated"] = self.extrapolated[chosen].astype(np.float32)
        return scalars | {name: values[chosen] for name, values in self.scalars.items()}

    @property
    def rgb(self) -> np.ndarray | None:
        """(h, w, 3) uint8: the texture in colours, also where it is grey; None without a
        texture."""
        if self.texture is None or self.texture.ndim == 3:
            return self.texture
        return np.repeat(self.texture[..., None], 3, axis=2)

    def colours(self) -> np.ndarray | None:
        """(n,) grey or (n, 3) RGB uint8 of the measured points, in the order of ``mask``; None
        without a texture."""
        return None if self.texture is None else self.texture[self.mask]


def choose_pixels(values: np.ndarray, chosen: Mask) -> np.ndarray:
    """The values (n, k) of the ``chosen`` pixels (h, w) bool of an image (h, w, k), as indexing
    gives them, in a sixth of its time."""
    return np.compress(chosen.ravel(), values.reshape(-1, values.shape[-1]), axis=0)


def keep_pixels(points: Points, kept: Mask) -> Points:
    """Return points (h, w, 3) float32 mm with NaN outside the pixels ``kept`` (h, w) bool."""
    return np.where(kept[..., None], points, np.float32(np.nan))


def _convert_texture(texture: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a texture (h, w) or (h, w, 3) as uint8; InputError for another shape or dtype than
    allowed."""
    if texture.shape not in (shape, (*shape, 3)):
        raise InputError(
            f"A texture of shape {texture.shape} does not belong to a cloud of"
            f" {shape[1]}x{shape[0]} pixels",
            "use the one of the same capture.",
        )
    if texture.dtype not in (np.uint8, np.uint16):
        raise InputError(f"A texture of {texture.dtype} was given", "it must be uint8 or uint16.")
    return to_eight_bits(texture)
