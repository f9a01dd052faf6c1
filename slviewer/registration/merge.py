"""Several scans of one object, brought into the frame of one of them and put together."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from slviewer.errors import InputError, SlviewerError
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.registration.pairwise import Progress, Registration, register


@dataclass(frozen=True)
class Scan:
    """The valid points of one scan, in the frame of the camera that took it.

    ``points`` (n, 3) mm and ``normals`` (n, 3) towards the camera, float32 without NaN in the points; a normal is NaN
    where the grid gives none. ``colours`` (n, 3) uint8 or None; ``sigma_mm`` the median expected error of a point.
    """

    points: np.ndarray
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    sigma_mm: float | None = None

    @classmethod
    def from_cloud(cls, cloud: Cloud) -> "Scan":
        """The measured pixels of an organised cloud, with the normals of its grid."""
        mask = cloud.mask
        sigma = cloud.sigma_z[mask]
        sigma = sigma[np.isfinite(sigma)]
        return cls(
            points=cloud.points[mask],
            normals=grid_normals(cloud.points)[mask],
            colours=_rgb(cloud.colours()),
            sigma_mm=float(np.median(sigma)) if sigma.size else None,
        )


@dataclass(frozen=True)
class Merged:
    """All scans' points in the reference's camera frame, one scan after the other.

    ``points`` (n, 3) float32 mm; ``normals`` (n, 3) float32, NaN where unknown, or None if a scan has none; ``colours``
    (n, 3) uint8, or None if a scan has none; ``source`` (n,) uint8 says from which of ``names`` each point comes;
    ``pairs`` holds, for every scan but the reference, how it lies on the reference.
    """

    points: np.ndarray
    normals: np.ndarray | None
    colours: np.ndarray | None
    source: np.ndarray
    names: tuple[str, ...]
    pairs: dict[str, Registration]


def merge(scans: Mapping[str, Scan | Cloud], reference: str, progress: Progress | None = None) -> Merged:
    """Align every scan with the one called ``reference`` and put them together; overlapping points are all kept.

    ``progress`` receives the share of the work done, 0 to 1, and may raise to cancel.

    Raises ``InputError`` for an unknown reference or a single scan, and ``SlviewerError``, naming the scan, where one
    does not align.
    """
    if reference not in scans:
        raise InputError(f"There is no scan called {reference!r}: choose the reference among {', '.join(scans)}.")
    if not 2 <= len(scans) <= 255:
        raise InputError(f"{len(scans)} scan(s) given: merging takes 2 to 255 scans of one object.")
    say = progress or (lambda share: None)
    parts = {name: scan if isinstance(scan, Scan) else Scan.from_cloud(scan) for name, scan in scans.items()}

    pairs: dict[str, Registration] = {}
    for name in parts:
        if name != reference:
            pairs[name] = _align(name, parts[name], parts[reference], len(pairs) / (len(parts) - 1), len(parts), say)

    moved = [_moved(part, pairs[name].T_reference_scan if name in pairs else np.eye(4)) for name, part in parts.items()]
    return Merged(
        points=np.concatenate([points for points, _ in moved]),
        normals=_joined([normals for _, normals in moved]),
        colours=_joined([part.colours for part in parts.values()]),
        source=np.repeat(np.arange(len(parts), dtype=np.uint8), [len(part.points) for part in parts.values()]),
        names=tuple(parts),
        pairs=pairs,
    )


def _align(name: str, scan: Scan, reference: Scan, begun: float, scans: int, say: Progress) -> Registration:
    known = [s.sigma_mm for s in (scan, reference) if s.sigma_mm is not None]
    try:
        return register(
            scan.points,
            reference.points,
            scan_normals=scan.normals,
            reference_normals=reference.normals,
            sigma_mm=max(known, default=None),
            progress=lambda share: say(begun + share / (scans - 1)),
        )
    except SlviewerError as error:
        raise type(error)(f"{name} could not be merged. {error}") from error


def _moved(scan: Scan, T: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    points = (scan.points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    return points, None if scan.normals is None else (scan.normals @ T[:3, :3].T).astype(np.float32)


def _joined(parts: list[np.ndarray | None]) -> np.ndarray | None:
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if len(known) == len(parts) else None


def _rgb(colours: np.ndarray | None) -> np.ndarray | None:
    return np.repeat(colours[:, None], 3, axis=1) if colours is not None and colours.ndim == 1 else colours
