"""Where a measured shape lies: its shares in front of, inside and behind the calibrated depths."""

import numpy as np

from slviewer.errors import InputError


def incidence(
    points: np.ndarray, mask: np.ndarray, depth_range: tuple[float, float]
) -> dict[str, float]:
    """Percent of the points ``(h, w, 3)`` under ``mask`` with z < z0 (R1), z0 <= z <= z1 (R2), z >
    z1 (R3), mm.

    The Letter's "incidence" (Table 1, 500 and 700 mm). Pixels without a measured point are
    excluded.
    """
    z0, z1 = depth_range
    if not z0 < z1:
        raise InputError(
            f"The depth range {z0:g} to {z1:g} mm is empty: give the smaller depth first."
        )
    z = points[..., 2][mask]
    z = z[np.isfinite(z)]
    if z.size == 0:
        raise InputError("No point was measured in the region: its depths are unknown.")
    r1, r3 = 100.0 * np.count_nonzero(z < z0) / z.size, 100.0 * np.count_nonzero(z > z1) / z.size
    return {"R1": r1, "R2": 100.0 - r1 - r3, "R3": r3}
