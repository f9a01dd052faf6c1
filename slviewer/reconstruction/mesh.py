"""Triangles straight from the camera's grid."""

import numpy as np

from slviewer.errors import InputError


def triangulate_grid(points: np.ndarray, max_jump: float) -> np.ndarray:
    """Faces (m, 3) int32 of an organised cloud (h, w, 3) mm, numbering its valid points row by row.

    (The vertices are ``points[np.isfinite(points).all(axis=-1)]``.) Each square of four
    neighbouring pixels gives two triangles, cut along the diagonal with the smaller step in depth,
    or one where only three are valid. Triangles whose depths differ by more than ``max_jump`` mm
    are excluded: there the surface ends. Faces turn counter-clockwise as the camera sees them from
    outside: their normals point towards it.
    """
    if points.ndim != 3 or points.shape[2] != 3:
        raise InputError(
            f"Points of shape {points.shape} were given: triangles need an organised cloud, (h,"
            " w, 3)."
        )
    if not max_jump > 0:
        raise InputError(f"A depth jump of {max_jump} mm was given: it must be positive.")
    valid = np.isfinite(points).all(axis=-1)
    index = np.cumsum(valid, dtype=np.int32).reshape(valid.shape) - 1
    z = np.where(valid, points[..., 2], np.nan)
    corners = (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:])
    z00, z01, z10, z11 = (z[corner] for corner in corners)
    with np.errstate(invalid="ignore"):
        falling, rising = np.abs(z00 - z11), np.abs(z01 - z10)
        # a diagonal with an invalid end has a NaN step: the other one is cut along
        along_rising = np.isfinite(rising) & ~(falling < rising)
        along_falling = np.isfinite(falling) & ~along_rising
        faces = []
        for chosen, a, b, c in (
            (along_rising, 0, 2, 1),
            (along_rising, 1, 2, 3),
            (along_falling, 0, 2, 3),
            (along_falling, 0, 3, 1),
        ):
            depths = z[corners[a]], z[corners[b]], z[corners[c]]
            spread = np.maximum(np.maximum(*depths[:2]), depths[2]) - np.minimum(
                np.minimum(*depths[:2]), depths[2]
            )
            selected = chosen & (spread <= max_jump)  # False where a corner is NaN
            faces.append(np.stack([index[corners[k]][selected] for k in (a, b, c)], axis=1))
    return np.concatenate(faces)
