"""Files of other programs in all their forms: each is read in full, or what is not read is said."""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import SlviewerError
from slviewer.geometry.lens import Lens
from slviewer.pipeline.operation import Progress, track
from slviewer.session.importers.camera_file import read_camera_file
from slviewer.session.importers.clouds import ReadCloud, read_cloud
from slviewer.session.importers.filestorage import read_storage
from slviewer.session.importers.opencv_calibration import identify_keys, list_unused, read_matrices
from tests.proofs.file_variants import calibrations, clouds, makers, texts
from tests.proofs.file_variants.calibrations import SIZE, Camera
from tests.proofs.file_variants.variant import Points, Variant
from tests.proofs.proof import Proof

Draw = Callable[[np.random.Generator], Variant]
_CUT = (
    clouds.draw_ply,
    clouds.draw_pcd,
    clouds.draw_stl,
    clouds.draw_off,
    clouds.draw_mat,
    clouds.draw_las,
)


def draw_cut(rng: np.random.Generator) -> Variant:
    """Draw a file of points that ends early."""
    return clouds.cut(_CUT[int(rng.integers(len(_CUT)))], rng)


DRAWS: Mapping[str, tuple[Draw, int]] = {
    "ply": (clouds.draw_ply, 80),
    "pcd": (clouds.draw_pcd, 60),
    "obj": (clouds.draw_obj, 30),
    "stl": (clouds.draw_stl, 20),
    "e57": (clouds.draw_e57, 40),
    "off": (clouds.draw_off, 30),
    "mat": (clouds.draw_mat, 30),
    "las": (clouds.draw_las, 30),
    "table": (texts.draw_table, 60),
    "text": (texts.draw_plain_text, 40),
    "pts": (texts.draw_pts, 20),
    "cut": (draw_cut, 30),
    "ros": (calibrations.draw_ros, 40),
    "echo": (calibrations.draw_echo, 16),
    "json": (calibrations.draw_realsense, 12),
    "opencv": (calibrations.draw_opencv, 50),
    "stereo": (calibrations.draw_stereo, 20),
    "structs": (calibrations.draw_matlab_stereo, 20),
    "ini": (calibrations.draw_ini, 12),
    "matlab": (calibrations.draw_matlab, 12),
    "kalibr": (calibrations.draw_kalibr, 10),
    "no lens": (makers.draw_kalibr_without, 4),
    "npz": (makers.draw_npz, 24),
    "bouguet": (makers.draw_bouguet, 12),
    "colmap": (makers.draw_colmap, 40),
    "metashape": (makers.draw_metashape, 40),
    "calib.io": (makers.draw_calibio, 20),
    "unread": (makers.draw_unread, 24),
    "spoilt": (calibrations.cut_calibration, 16),
}
"""Of each format what draws a file, and how many are drawn."""
KINDS = ("equal", "said", "SILENT LOSS", "WRONG REASON", "TRACEBACK")
"""How reading a file ends; the last three are faults."""
MAX_PX = 0.01
_OF_CAMERAS = list(DRAWS)[list(DRAWS).index("json") :]
"""Formats of which some files hold no lens that can be read."""
_FAR_MM = 5e4
"""From here on files hold coordinates in more than float32."""
_ULPS = 4.0
"""Of float32, in which files and meshes hold coordinates."""


def judge(variant: Variant, folder: Path) -> tuple[str, str]:
    """Return how reading a file ends, of `KINDS`, and what differs or was said."""
    path = folder / variant.name
    path.write_bytes(variant.content)
    try:
        if variant.format == "stereo":
            return _judge_stereo(variant, path)
        if isinstance(variant.truth, Camera) or variant.format in _OF_CAMERAS:
            return _judge_camera(variant, path)
        (cloud,) = read_cloud(path)[1]
        return _judge_cloud(variant, cloud)
    except SlviewerError as error:
        text = str(error)
        words = [*variant.reasons, *(word for names in variant.extras for word in names)]
        is_right = any(word in text for word in words)
        return ("said" if is_right else "WRONG REASON"), text
    except Exception as error:  # the fault that is looked for
        return "TRACEBACK", f"{type(error).__name__}: {error}"


def _conclude(variant: Variant, lost: Sequence[str], notes: Sequence[str]) -> tuple[str, str]:
    """Return the judgement on what was read: ``lost`` names what differs from the truth."""
    text = "; ".join(notes)
    silent = list(lost)
    silent += ["/".join(names) for names in variant.extras if not any(n in text for n in names)]
    if silent:
        return "SILENT LOSS", f"{', '.join(silent)} ({text or 'no note'})"
    return ("said" if notes else "equal"), text


def _judge_cloud(variant: Variant, cloud: ReadCloud) -> tuple[str, str]:
    """Judge points, their colours and normals."""
    truth = variant.truth
    if truth is None:
        return "SILENT LOSS", "a file that ends early was read"
    assert isinstance(truth, Points)
    text, lost = " ".join(cloud.notes), list[str]()
    distance, at = cKDTree(cloud.points).query(truth.points)
    reach = np.abs(truth.points).max()
    fine = 1e-3 if reach > _FAR_MM else _ULPS * np.finfo(np.float32).eps * reach + 1e-5
    if distance.max() > fine or len(cloud.points) < len(truth.points):
        lost.append(f"points, {distance.max():.2g} mm off")
    elif np.abs(np.ptp(cloud.points, axis=0) - np.ptp(truth.points, axis=0)).max() > fine:
        lost.append("points, in a larger box")
    if truth.colours is not None and "colours are not used" not in text:
        if cloud.colours is None:
            lost.append("colours")
        elif (cloud.colours[at].astype(int) != truth.colours).any():
            lost.append("colours, which differ")
    if truth.colours is None and cloud.colours is not None:
        lost.append("colours, which are none")
    if truth.normals is not None:
        if cloud.normals is None:
            lost.append("normals")
        elif np.abs(cloud.normals[at] - truth.normals).max() > 1e-4:
            lost.append("normals, which differ")
    by_name = {re.sub(r"\W|_", "", name): values for name, values in cloud.scalars.items()}
    for name, values in truth.scalars.items():
        kept = by_name.get(re.sub(r"\W|_", "", name))
        if kept is None or not np.allclose(kept[at], values, rtol=1e-6, atol=1e-7):
            lost.append(name)
    return _conclude(variant, lost, cloud.notes)


def _compare_lens(lens: Lens, truth: Camera, notes: Sequence[str]) -> list[str]:
    """Return what a lens lacks of the true one at the corners, sides and middle of the image."""
    width, height = SIZE
    x, y = np.meshgrid([0, width / 2, width - 1], [0, height / 2, height - 1])
    rays = lens.undistort(np.stack([x.ravel(), y.ravel()], axis=-1).astype(np.float64))
    off = np.abs(truth.project(rays) - np.stack([x.ravel(), y.ravel()], axis=-1)).max()
    if off <= MAX_PX or (off < 1 and any("residual" in note for note in notes)):
        return []
    return [f"the lens, {off:.3g} px off"]


def _judge_camera(variant: Variant, path: Path) -> tuple[str, str]:
    """Judge the lens of a camera."""
    found = read_camera_file(path, SIZE)
    if variant.truth is None:
        return "SILENT LOSS", "a file with a spoilt entry was read"
    return _conclude(variant, _compare_lens(found.lens, variant.truth, found.notes), found.notes)


def _judge_stereo(variant: Variant, path: Path) -> tuple[str, str]:
    """Judge the lens of a camera, and its pose to a projector."""
    storage, truth, lost = read_storage(path), variant.truth, list[str]()
    keys = identify_keys(storage)
    found, unused = read_matrices(storage, keys), list_unused(storage, keys, {})
    lost += _compare_lens(Lens(found["K_camera"], found["D_camera"], SIZE), truth, ())
    if np.abs(found["R"] - truth.R).max() > 1e-9 or np.abs(found["T"] - truth.T).max() > 1e-6:
        lost.append("R or T")
    return _conclude(variant, lost, unused)


def draw_variants(seed: int, scale: float = 1.0) -> list[Variant]:
    """Draw files of all formats; ``scale`` below 1 draws fewer of each."""
    seeds = np.random.SeedSequence(seed).spawn(len(DRAWS))
    return [
        draw(np.random.default_rng(child))
        for (draw, count), of_format in zip(DRAWS.values(), seeds, strict=True)
        for child in of_format.spawn(max(1, round(scale * count)))
    ]


def prove_files(scale: float, seed: int, progress: Progress) -> Proof:
    """Read files of every format, and count by format how reading ends."""
    counts, faults = defaultdict[str, Counter[str]](Counter), list[str]()
    variants = draw_variants(seed, scale)
    named = {f"{i} {each.format}": each for i, each in enumerate(variants)}
    with TemporaryDirectory() as folder:
        for _, variant, _ in track(progress, named):
            kind, text = judge(variant, Path(folder))
            counts[variant.format][kind] += 1
            if kind in KINDS[2:]:
                faults.append(f"{kind} {variant.format} [{variant.form}]: {text[:300]}")
    rows = [
        {"format": name, "files": sum(of.values()), **{kind: of[kind] for kind in KINDS}}
        for name, of in counts.items()
    ]
    summary = f"{len(variants) - len(faults)} of {len(variants)} files are read, or said why not"
    record = {"formats": {name: dict(of) for name, of in counts.items()}, "faults": faults}
    return Proof(not faults, scale, rows, record, below=[summary, *faults[:40]])
