"""Figures of a saved calibration that the panels show."""

from collections.abc import Mapping

from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import SessionError
from slviewer.pipeline.models import load_model
from slviewer.session.store import Session
from slviewer.wizard.snapshot import SplinedView


def load_fit_rms(session: Session) -> dict[str, Mapping[str, float]] | None:
    """Load {axis: {coefficient: median mm}} of the pixel-wise model; None where another version
    saved it."""
    try:
        model = load_model(session, "pixelwise")
    except SessionError:
        return None
    assert isinstance(model, PixelwiseModel)
    return {axis: model.median_rms_mm(axis) for axis in model.axes}


def load_splined(session: Session) -> SplinedView | None:
    """Load the summary of the splined model; None where another version saved it."""
    try:
        model = load_model(session, "splined")
    except SessionError:
        return None
    assert isinstance(model, SplinedModel)
    weights = {
        name: (fit.camera_trust, fit.projector_trust) for name, fit in model.bundle.fits.items()
    }
    return SplinedView(model.summary(), weights, model.bundle.half_turned_poses)
