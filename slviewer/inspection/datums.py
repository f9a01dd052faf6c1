"""The 3-2-1 alignment: part coordinates from three features, with the uncertainty that these give
them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rigid import move_points, rigid_transform
from slviewer.geometry.vectors import unit_vectors
from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import FeatureFit
from slviewer.inspection.uncertainty import RigidSpread, Spread

MIN_SINE = 0.17
"""Of the angle between directions that fix a frame: at 10 degrees they hardly do."""


def datum_frame(features: Sequence[Feature]) -> np.ndarray:
    """T_part_measured (4, 4) of three datums: the primary, a plane, is z = 0 with z along its
    normal.

    The secondary is a plane (x = 0, x along its normal), and then the tertiary a plane (y = 0) or a
    sphere or cylinder (y = 0 through its place); or both are spheres or cylinders, and x runs from
    the secondary's place, the origin, to the tertiary's. Raises InputError for others, or where
    they do not fix a frame.
    """
    primary, secondary, tertiary = features
    if primary.kind != "plane":
        raise InputError(f"The primary datum is a {primary.kind}: choose a plane.")
    z = primary.unit_direction
    if secondary.kind == "plane":
        towards = secondary.unit_direction
    elif tertiary.kind != "plane":
        towards = tertiary.place - secondary.place
    else:
        raise InputError(
            "The secondary datum is not a plane, but the tertiary is one: exchange them."
        )
    across = towards - (towards @ z) * z
    if not np.linalg.norm(across) > MIN_SINE * np.linalg.norm(towards):
        raise InputError("The secondary datum fixes no direction in the primary: choose another.")
    x = unit_vectors(across)
    y = np.cross(z, x)
    # rows n and values n . p of the planes through the origin of the part
    if secondary.kind == "plane":
        rows = [z, towards, tertiary.unit_direction if tertiary.kind == "plane" else y]
        places = [primary.place, secondary.place, tertiary.place]
    else:
        rows, places = [z, x, y], [primary.place, secondary.place, secondary.place]
    matrix = np.array(rows)
    if not abs(float(np.linalg.det(matrix))) > MIN_SINE:
        raise InputError("The three datums fix no origin: choose planes that meet in one point.")
    origin = np.linalg.solve(matrix, [row @ place for row, place in zip(rows, places, strict=True)])
    R = np.array([x, y, z])
    return rigid_transform(R, -R @ origin)


def datum_spread(fits: Sequence[FeatureFit], middle: np.ndarray) -> RigidSpread:
    """Covariance of the part coordinates of `datum_frame`, about ``middle`` (3,) mm in part
    coordinates; the errors of the datums are taken as independent of each other."""
    features = [fit.feature for fit in fits]
    T = datum_frame(features)
    back = np.linalg.inv(T)
    covariance = np.zeros((6, 6))
    for k, fit in enumerate(fits):
        columns = []
        for each in np.eye(fit.feature.parameters):
            step = 1e-6
            moved = (
                datum_frame([*features[:k], features[k].moved(step * each), *features[k + 1 :]])
                @ back
            )
            shift = move_points(moved, middle[None])[0] - middle
            turn = moved[[2, 0, 1], [1, 2, 0]] - moved[[1, 2, 0], [2, 0, 1]]
            columns.append(np.concatenate([turn / 2, shift]) / step)
        J = np.array(columns).T
        covariance += J @ fit.spread.covariance @ J.T
    return RigidSpread(middle, covariance)


def face_towards(fit: FeatureFit, side: np.ndarray) -> FeatureFit:
    """The fit with a plane's normal turned to the half-space of a direction ``side`` (3,); others
    unchanged."""
    f = fit.feature
    if f.kind != "plane" or f.unit_direction @ side >= 0:
        return fit
    # the second tangent stays, the first and the normal are reversed
    sign = np.array([1.0, -1.0, -1.0])
    spread = fit.spread
    shared = None if spread.shared is None else spread.shared * sign
    turned = Spread(spread.scatter * np.outer(sign, sign), shared, spread.calibration)
    return replace(fit, feature=replace(f, direction=-f.unit_direction), spread=turned)
