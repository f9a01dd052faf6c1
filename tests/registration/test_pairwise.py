"""Registration finds a known motion to hundredths of a millimetre, and refuses what it cannot know."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slviewer.errors import Cancelled, InputError, SlviewerError
from slviewer.registration.pairwise import Registration, register

CENTRE = np.array([0.0, 0.0, 600.0])
NOISE = 0.03
POINTS = 20_000


def bumpy(seed: int, relief: float = 12.0) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A height field of nine Gaussians over a square of 150 mm, with no symmetry."""
    rng = np.random.default_rng(seed)
    centres, widths, heights = rng.uniform(-65, 65, (9, 2)), rng.uniform(9, 22, 9), rng.uniform(-1, 1, 9) * relief

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        squares = (x[:, None] - centres[:, 0]) ** 2 + (y[:, None] - centres[:, 1]) ** 2
        return np.exp(-squares / 2 / widths**2) @ heights

    return height


def motion(deg: float, mm: float, seed: int = 0) -> np.ndarray:
    """A rotation about an oblique axis through the object, and a shift."""
    rng = np.random.default_rng(seed)
    axis, shift = rng.normal(size=(2, 3))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(deg) * axis / np.linalg.norm(axis)).as_matrix()
    T[:3, 3] = CENTRE + mm * shift / np.linalg.norm(shift) - T[:3, :3] @ CENTRE
    return T


def view(
    height: Callable[[np.ndarray, np.ndarray], np.ndarray],
    x_range: tuple[float, float],
    seed: int,
    T_reference_scan: np.ndarray | None = None,
    points: int = POINTS,
    scale: float = 1.0,
) -> np.ndarray:
    """Noisy points of the part of the surface with x in the range, in the frame of the scan."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(*x_range, points), rng.uniform(-75, 75, points)
    P = CENTRE + scale * np.stack([x, y, height(x, y) + rng.normal(0.0, NOISE, points)], axis=1)
    return P if T_reference_scan is None else (P - T_reference_scan[:3, 3]) @ T_reference_scan[:3, :3]


def error(result: Registration, T: np.ndarray) -> tuple[float, float]:
    """Shift of the object's centre in mm, and rotation in degrees, between the pose found and the truth."""
    D = result.T_reference_scan @ np.linalg.inv(T)
    shift = float(np.linalg.norm(D[:3, :3] @ CENTRE + D[:3, 3] - CENTRE))
    return shift, float(np.degrees(np.linalg.norm(Rotation.from_matrix(D[:3, :3]).as_rotvec())))


@pytest.mark.parametrize(("deg", "mm"), [(1.0, 2.0), (10.0, 30.0), (60.0, 150.0)])
def test_a_known_motion_is_found(deg: float, mm: float) -> None:
    T = motion(deg, mm)
    result = register(view(bumpy(2), (-45, 75), 1, T), view(bumpy(2), (-75, 45), 2))
    shift, turn = error(result, T)
    assert shift < 0.03
    assert turn < 0.02
    assert 0.9 * NOISE < result.rms_mm < 1.6 * NOISE  # both scans' noise, sqrt(2) times one's, on tilted surfaces
    assert result.inlier_rmse_mm > 3 * result.rms_mm  # the spacing of the points is in it
    assert 0.68 < result.overlap < 0.78  # 90 of 120 mm, less the points beyond the gate across steep slopes
    assert result.agreement > 0.98


def test_the_same_scans_give_the_same_pose() -> None:
    scan, reference = view(bumpy(2), (-45, 75), 1, motion(10, 30)), view(bumpy(2), (-75, 45), 2)
    first, second = (register(scan, reference).T_reference_scan for _ in range(2))
    np.testing.assert_allclose(first, second, atol=1e-7)


def test_the_pose_maps_scan_to_reference_and_back() -> None:
    scan, reference = view(bumpy(3), (-45, 75), 1, motion(10, 30)), view(bumpy(3), (-75, 45), 2)
    forth, back = register(scan, reference), register(reference, scan)
    shift, turn = error(forth, np.linalg.inv(back.T_reference_scan))
    assert shift < 0.03
    assert turn < 0.02


def test_a_third_of_overlap_is_enough() -> None:
    T = motion(10, 30)
    result = register(view(bumpy(2), (-15, 75), 1, T), view(bumpy(2), (-75, 15), 2))
    shift, turn = error(result, T)
    assert shift < 0.03
    assert turn < 0.03
    assert 0.28 < result.overlap < 0.38


@pytest.mark.parametrize("scale", [0.2, 5.0])
def test_gates_follow_the_size_of_the_object(scale: float) -> None:
    T = motion(10, 30 * scale)
    scan = view(bumpy(2), (-45, 75), 1, T, scale=scale)
    result = register(scan, view(bumpy(2), (-75, 45), 2, scale=scale))
    shift, turn = error(result, T)
    assert shift < 0.03 * scale
    assert turn < 0.02
    assert result.gate_mm < 10.0 if scale > 1 else result.gate_mm < 0.6


@pytest.mark.parametrize("relief", [12.0, 3.0])
@pytest.mark.parametrize("other", [52, 58])
def test_unrelated_shapes_are_refused(other: int, relief: float) -> None:
    with pytest.raises(SlviewerError, match=r"agree|lies on the reference|slide"):
        register(view(bumpy(other, relief), (-45, 75), 1, points=10_000), view(bumpy(2, relief), (-75, 45), 2))


def test_no_common_surface_is_refused() -> None:
    with pytest.raises(SlviewerError):
        register(view(bumpy(2), (10, 75), 1, motion(10, 30)), view(bumpy(2), (-75, -10), 2))


def test_planes_are_refused_because_they_slide() -> None:
    with pytest.raises(SlviewerError, match="slide"):
        register(view(bumpy(2, 0.0), (-45, 75), 1, motion(5, 10)), view(bumpy(2, 0.0), (-75, 45), 2))


def test_spheres_are_refused_because_they_turn() -> None:
    def cap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return -np.sqrt(110.0**2 - x**2 - y**2)

    with pytest.raises(SlviewerError, match="slide"):
        register(view(cap, (-45, 75), 1, motion(5, 10)), view(cap, (-75, 45), 2))


def test_a_pose_handed_in_replaces_the_search() -> None:
    T = motion(60, 150)
    near = T.copy()
    near[:3, 3] += 1.0
    result = register(view(bumpy(2), (-45, 75), 1, T), view(bumpy(2), (-75, 45), 2), initial=near)
    assert result.start == "initial"
    assert error(result, T)[0] < 0.03


def test_progress_can_cancel() -> None:
    def stop(share: float) -> None:
        raise Cancelled("Stopped.")

    with pytest.raises(Cancelled):
        register(view(bumpy(2), (-45, 75), 1), view(bumpy(2), (-75, 45), 2), progress=stop)


def test_points_that_cannot_be_used_are_refused() -> None:
    good = view(bumpy(2), (-75, 45), 2)
    holed = good.copy()
    holed[5] = np.nan
    with pytest.raises(InputError, match="finite"):
        register(holed, good)
    with pytest.raises(InputError, match="at least"):
        register(good[:20], good)
    with pytest.raises(InputError, match=r"\(n, 3\)"):
        register(good.reshape(100, -1, 3), good)
    with pytest.raises(InputError, match="normals"):
        register(good, good, scan_normals=good[:-1])
