"""Approximation of a calibrated device by a pinhole with Brown's distortion, for export to other
programs."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.splined.unknowns import (
    Device,
    in_illuminated_cells,
    pinhole_lens,
    undistort,
)
from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import finite_rows, lengths, rms

GRID = 80
"""Number of pixels across the image in the fit: several per cell of a displacement field."""
MIN_PIXELS = 50


@dataclass(frozen=True, eq=False)
class PinholeFit:
    """The fitted ``lens``; ``rms_px`` and ``max_px`` of its residuals over the ``share`` of the
    image that target poses support."""

    lens: Lens
    rms_px: float
    max_px: float
    share: float


def fit_splined(model: SplinedModel) -> tuple[PinholeFit, PinholeFit]:
    """Fit lenses to a splined model's camera and projector, over the cells that target poses
    illuminated."""
    camera, projector = map(_fit_device, model.rig[:2], model.bundle.illuminated)
    return camera, projector


def pixelwise_residuals(model: PixelwiseModel, lens: Lens) -> PinholeFit:
    """Measure the residuals of a ``lens`` on the pixelwise model's rays (c3, c4) of the camera
    pixels."""
    coefficients = model.fits[model.depth_axis].coefficients
    step = max(1, coefficients.shape[2] // GRID)
    pixels = grid_points(*(np.arange(0, n, step) for n in coefficients.shape[:0:-1]))
    return _measure_residuals(lens, pixels, coefficients[3:5, ::step, ::step].reshape(2, -1).T)


def fit_lens(pixels: Floats, rays: Floats, start: Lens) -> PinholeFit:
    """Fit a lens that projects undistorted normalised ``rays`` (n, 2) to ``pixels`` (n, 2) px, by
    least squares.

    ``start``: initial lens. Rows with NaN are ignored; raises InputError where fewer than 50
    remain.
    """
    known = finite_rows(rays, pixels)
    if np.count_nonzero(known) < MIN_PIXELS:
        raise InputError(
            f"{np.count_nonzero(known)} pixels are calibrated",
            f"a lens needs at least {MIN_PIXELS}",
        )
    observed, directions = pixels[known], rays[known]

    def residuals(numbers: Floats) -> Floats:
        """Return the residuals (2 n,) px of a lens with these nine parameters."""
        return np.nan_to_num(
            Lens.from_parameters(numbers, start.size).distort(directions) - observed, nan=1e3
        ).ravel()

    first = start.parameters[:9]
    scale = np.array([*first[:2], *first[:2], 0.1, 0.1, 0.01, 0.01, 0.1])
    solved = least_squares(residuals, first, x_scale=scale, xtol=1e-12, ftol=1e-12)
    return _measure_residuals(Lens.from_parameters(solved.x, start.size), pixels, rays)


def _measure_residuals(lens: Lens, pixels: Floats, rays: Floats) -> PinholeFit:
    """Measure the residuals of a lens at pixels (n, 2) with known rays (n, 2); rows with NaN are
    ignored."""
    length = lengths(lens.distort(rays) - pixels)
    known = np.isfinite(length)
    if not known.any():
        return PinholeFit(lens, np.nan, np.nan, 0.0)
    return PinholeFit(lens, rms(length[known]), float(length[known].max()), float(known.mean()))


def _fit_device(device: Device, illuminated: Mask) -> PinholeFit:
    """Fit a pinhole and Brown lens to a device over the cells (rows, columns) bool that target
    poses illuminated."""
    width, height = device.size
    across = np.linspace(0, width - 1, GRID)
    down = np.linspace(0, height - 1, max(2, round(GRID * height / width)))
    pixels = grid_points(across, down)
    rays = np.where(
        in_illuminated_cells(device, pixels, illuminated)[:, None],
        undistort(device, pixels),
        np.nan,
    )
    return fit_lens(pixels, rays, pinhole_lens(device))
