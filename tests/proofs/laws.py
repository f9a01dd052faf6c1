"""Laws: what another valid rig, scale or order must do to every figure of a session, and to no
verdict.

A base session is calibrated, verified, reconstructed, merged, measured and compared; so are
sessions that were made from its frames by a change of which the answer is known. Figures follow
their units, and sentences stay the same but for their numbers.
"""

import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from slviewer.errors import SlviewerError
from slviewer.evaluation.render import Row
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.operation import Progress
from slviewer.pipeline.session_operations import SessionOperations
from slviewer.pipeline.simulate import TARGET, simulate
from slviewer.records.record import to_plain
from slviewer.session.capture import Capture, NewCapture
from slviewer.simulation.boards import Pose
from slviewer.simulation.mesh import demo_object
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.board import Board
from tests.proofs.proof import BandCheck, Proof, prove_checks

POSES = 8
PLANES, SPHERES = ("plane_01", "plane_02"), ("sphere_1", "sphere_2")
OBJECTS = "object_r1", "object_r2", "object_r3"
NAMES = r"(pose|plane|sphere|object)_r?\d+"
AGAIN = "_again"
"""After the name of a pose's copy."""
BALL_MM = 196.0
BALL = """kind = "sphere"
name = "ball"
certificate = "K 1"
calibrated = {{diameter_mm = {0}, diameter_U_mm = {1:.6f}, form_mm = {1:.6f}, form_U_mm = {1:.6f}, \
temperature_C = 20.0, expansion_ppm_K = 0.0, expansion_U_ppm_K = 0.0}}
measured = {{temperature_C = 20.0, temperature_U_K = 0.1, captures = ["{3}"]}}
limits = {{form_mm = {2}}}
""".replace("\\\n", "")
UNUSED = {*(f"plane_{k:02d}" for k in range(3, 11)), *(f"sphere_{k}" for k in range(3, 7))}
PITCH_MM, TOLERANCE_MM = 9.0, 0.3
BOX_MM = (-150.0, -150.0, 300.0, 150.0, 150.0, 900.0)
MOVED_R, MOVED_MM = cv2.Rodrigues(np.array([0.4, -0.9, 1.3]))[0], np.array([5e3, -3e3, 800.0])
IDENTITIES = {"inputs", "settings", "hash", "content", "calibration", "time", "name", "frame"}
"""Fields that say what was computed from what; those of coordinates follow."""
COORDINATES = {
    "T_reference_scan", "T_nominal_scan", "T", "R", "t", "K", "D", "poses", "planes", "normal",
    "centre_mm", "place", "direction", "scatter", "middle", "centre", "size", "box", "region",
    "where", "sensor", "size_mm", "positions", "region_px", "worst_at", "board_height_mm",
    "gap_place",
}  # fmt: skip
RESAMPLED = {
    "axis", "axes", "depth_axis", "dropped", "left_out", "openings_mm", "strengths", "focal_px"
}  # fmt: skip
"""Fields that name axes, or what the camera's or the projector's pixels and cells decide."""
SUMS = {"features_excluded", "features_set_aside"}
"""Fields that count over the features of all poses."""
LENGTHS, SHARES = {"radius", "highest", "lowest"}, {"supported"}
EXTREMES = {"farthest off"}
"""Quantities whose sign is that of the worst point."""
SIGMAS = {"sigma": 1.0, "sigma_shift_mm": 1.0, "U_mm": 0.5, "u_ppm": 1.0}
"""Fields that state the standard uncertainty of those beside them, and its share in them."""
MOST_SIGMAS = 0.3
"""Of a figure's stated sigma, beside the law's own tolerance."""
OTHER_FIT = 1.0
"""The same where the noise is drawn anew."""
AGAIN_SEED = 10_000
"""Of the noise that is drawn anew, beside that of the capture."""
COUNTED, LEAST_PX, LEAST_DEG = 3, 3e-3, 0.01
"""Points, pixels or features by which a count may differ, a length in px, and an angle,
besides."""


@dataclass(frozen=True)
class Law:
    """A change of a session: ``scale`` of the world; ``frames`` of one capture (n, h, w) to those
    of the changed one; ``rename`` the captures. ``hides``: a part of the image, which a calibration
    has to name, and to find nothing else. ``transposes``: columns and rows of camera and projector
    are exchanged, a mirror image of the rig. ``repeats``: each pose is there twice. ``moves``: the
    nominal model lies elsewhere. ``resamples``: pixels are others, so that only lengths and words
    are compared. ``apart``: of two sessions, each computed by a process of its own.
    ``renders``: what is there twice has noise of its own.

    ``tolerance``: relative change of a figure that the law leaves, where the change is not one of
    units alone; ``sigmas``: the same in standard deviations of the figure, where it states them.
    """

    name: str
    scale: float = 1.0
    frames: Callable[[np.ndarray], np.ndarray] = np.asarray
    rename: Callable[[str], str] = str
    tolerance: float = 0.02
    hides: bool = False
    transposes: bool = False
    repeats: bool = False
    moves: bool = False
    resamples: bool = False
    apart: bool = False
    renders: bool = False
    sigmas: float = MOST_SIGMAS


def _reverse(name: str) -> str:
    """Return the name of a pose counted from the other end."""
    kind, _, number = name.rpartition("_")
    return f"{kind}_{POSES + 1 - int(number):02d}" if kind == "pose" else name


def _renumber(name: str) -> str:
    """Return a name that says nothing, in the other order."""
    kind, _, number = name.rpartition("_")
    return f"c{90 - int(number.strip('r')):02d}_{kind[::-1]}"


def _of_bits(bits: int) -> Law:
    """Return the law of a camera whose grey levels have so many bits."""
    factor = (2**bits - 1) // 255
    return Law(f"{bits} bits", frames=lambda frames: frames.astype(np.uint16) * factor)


def _cover(frames: np.ndarray, part: Any, level: int | np.ndarray) -> np.ndarray:
    """Return the frames (n, h, w) with one ``level`` in a part of the image."""
    covered = frames.copy()
    covered[:, *part] = level
    return covered


def _pad(frames: np.ndarray, level: int) -> np.ndarray:
    """Return the frames (n, h, w) with bars of ``level`` beside them."""
    width = frames.shape[2]
    sides = (0, 0), (0, 0), (3 * width // 20, width // 10)
    return np.pad(frames, sides, constant_values=level)


def _put_hood(frames: np.ndarray) -> np.ndarray:
    """Return the frames (n, h, w) with black corners, as a lens hood's circle makes them."""
    height, width = frames.shape[1:]
    v, u = np.indices((height, width)) + 0.5
    is_hidden = np.hypot(u - width / 2, v - height / 2) > 0.6 * width
    return _cover(frames, (is_hidden,), 0)


def _shake(frames: np.ndarray, hidden: np.ndarray, level: float) -> np.ndarray:
    """Return the frames (n, h, w) with noise about a ``level`` where ``hidden`` (h, w) bool."""
    noise = np.random.default_rng(0).normal(level, 1.2, (len(frames), np.count_nonzero(hidden)))
    return _cover(frames, (hidden,), np.clip(np.rint(noise), 0, 255))


def _pad_noisy(frames: np.ndarray, level: float) -> np.ndarray:
    """Return the frames (n, h, w) with bars of ``level`` beside them that have noise."""
    hidden = _pad(np.zeros((1, *frames.shape[1:]), np.uint8), 1)[0] > 0
    return _shake(_pad(frames, 0), hidden, level)


def _put_mask(frames: np.ndarray) -> np.ndarray:
    """Return the frames (n, h, w) with black in two places."""
    return _cover(_cover(frames, np.s_[:50, :40], 0), np.s_[285:, 360:], 0)


def _kill_pixels(frames: np.ndarray) -> np.ndarray:
    """Return the frames (n, h, w) with 60 dead and 60 hot pixels."""
    height, width = frames.shape[1:]
    places = np.random.default_rng(3).choice(height * width, 120, replace=False)
    v, u = np.unravel_index(places, (height, width))
    return _cover(_cover(frames, (v[:60], u[:60]), 0), (v[60:], u[60:]), 255)


PARTS = (
    Law("noisy grey bars", frames=lambda f: _pad_noisy(f, 16), tolerance=1.0, hides=True),
    Law("noisy black bars", frames=lambda f: _pad_noisy(f, 0.5), tolerance=1.0, hides=True),
    Law("mask", frames=_put_mask, tolerance=1.0, hides=True),
    Law("dead and hot pixels", frames=_kill_pixels, tolerance=1.0, hides=True),
    Law("black bars beside it", frames=lambda f: _pad(f, 0), tolerance=1.0, hides=True),
    Law("grey bars beside it", frames=lambda f: _pad(f, 16), tolerance=1.0, hides=True),
    Law("lens hood", frames=_put_hood, tolerance=1.0, hides=True),
    Law("dead column", frames=lambda f: _cover(f, np.s_[:, 180], 0), tolerance=1.0, hides=True),
    Law("hot row", frames=lambda f: _cover(f, np.s_[135, :], 255), tolerance=1.0, hides=True),
)
"""Laws of images of which a part never changes. The cells of the splined model lie elsewhere on the
image then, so that what little it extrapolates at their border changes."""
LAWS = (
    *PARTS,
    Law("world 20 times smaller", 0.05),
    Law("world 10 times smaller", 0.1),
    Law("world 10 times larger", 10.0),
    Law("world 50 times larger", 50.0),
    Law("poses in reverse order", rename=_reverse),
    Law("other names in another order", rename=_renumber),
    Law("transposed and mirrored", transposes=True, tolerance=0.5, resamples=True),
    Law("each pose twice", repeats=True),
    Law(
        "each pose twice, with new noise",
        tolerance=0.5,  # twice the data halve a variance, and what is masked for want of samples
        repeats=True,
        renders=True,
        sigmas=OTHER_FIT,
    ),
    Law("nominal model elsewhere", moves=True),
    Law("two processes at once", apart=True, tolerance=1e-6),
    *(_of_bits(bits) for bits in (10, 12, 16)),
    Law("half the light", frames=lambda f: (f // 2 + f % 2).astype(f.dtype), tolerance=0.8),
    Law("camera read out in a region", frames=lambda f: f[:, 40:280, 20:330], tolerance=0.25),
    Law("camera rolled by 180 degrees", frames=lambda f: f[:, ::-1, ::-1], tolerance=0.25),
    Law("camera rolled by 90 degrees", frames=lambda f: np.rot90(f, axes=(1, 2)), tolerance=0.25),
)


@dataclass(frozen=True)
class Broken:
    """A figure or sentence that does not follow a law: where it stands, what it is, and what it has
    to be."""

    place: str
    found: Any
    wanted: Any

    def text(self) -> str:
        """Return it in one line."""
        return f"{self.place}: {_shorten(self.found)} instead of {_shorten(self.wanted)}"


def _shorten(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)[:200]


def run_operations(
    folder: Path, scale: float, model: Path, rename: Callable[[str], str] = str
) -> dict[str, Any]:
    """Run the operations of a session, and return each one's record as plain values, or its error
    as a sentence. ``model``: nominal model of its objects; ``rename``: its captures' names from
    those of the base."""
    found: dict[str, Any] = {}

    def keep(operation: str, run: Callable[[], Any]) -> None:
        try:
            found[operation] = to_plain(run())
        except SlviewerError as error:
            found[operation] = {"error": f"{type(error).__name__}: {error}"}

    ball = folder / "ball.toml"
    ball.write_text(BALL.format(scale * BALL_MM, 0.01 * scale, 5 * scale, rename("sphere_1")))
    with SessionOperations.open(folder, write=True) as session:
        planes, spheres, objects = (
            [rename(name) for name in names] for names in (PLANES, SPHERES, OBJECTS)
        )
        box = [scale * each for each in BOX_MM]
        keep("calibrate", lambda: session.calibrate(f"circles:21x16:{PITCH_MM * scale:g}"))
        keep("verify planes", lambda: session.verify(planes, "plane"))
        keep("verify spheres", lambda: session.verify(spheres, "sphere"))
        keep("accept", lambda: session.accept(ball))
        keep("reconstruct", lambda: session.reconstruct(objects[0]))
        keep("merge", lambda: session.merge(objects, objects[0]))
        keep("mesh", lambda: session.mesh(objects[:1], folder / "mesh.ply").to_json())
        keep("measure plane", lambda: session.measure(planes[0], "plane", box=box))
        keep("measure sphere", lambda: session.measure(spheres[0], "sphere", box=box))
        keep("compare", lambda: session.compare(objects[0], model, TOLERANCE_MM * scale))
    return found


Render = Callable[[Capture], np.ndarray]


def change_session(base: Path, folder: Path, law: Law, render: Render | None = None) -> None:
    """Make a session of a base session's captures, changed by a law. ``render``: frames (n, h, w)
    of a capture with new noise, for a law that renders."""
    with SessionOperations.open(base) as session, SessionOperations.create(folder) as changed:
        for role in ("calibration", "scan"):
            captures = sorted(
                (
                    new
                    for each in session.captures(role)
                    if each.name not in UNUSED
                    for new in _change(each, law, render)
                ),
                key=lambda new: new.name,
            )
            board = f"circles:21x16:{PITCH_MM * law.scale:g}" if role == "calibration" else None
            changed.save_captures(captures, role, board=board)


def _change(capture: Capture, law: Law, render: Render | None) -> Iterator[NewCapture]:
    """Yield a capture changed by a law, of a pose that is repeated also its copy."""
    frames = np.ascontiguousarray(law.frames(np.asarray(capture.frames)))
    name, sequence = law.rename(capture.name), capture.sequence
    if law.transposes:
        frames = np.ascontiguousarray(frames.transpose(0, 2, 1))
        description = sequence.to_dict()
        across, down = description["projector"].split("x")
        description["projector"] = f"{down}x{across}"
        for frame in description["frame"]:
            if "axis" in frame:
                frame["axis"] = {"x": "y", "y": "x"}[frame["axis"]]
        sequence = PatternSequence.from_dict(description)
    yield NewCapture(name, sequence, frames)
    if law.repeats and name.startswith("pose"):
        if law.renders and render is not None:
            frames = render(capture)
        yield NewCapture(name + AGAIN, sequence, frames)


def compare_records(law: Law, base: Any, changed: Any) -> Iterator[Broken]:
    """Yield what does not follow the law in the plain records of a changed session."""
    if law.hides and isinstance(verdict := changed.get("stereo", {}).get("verdict"), Mapping):
        findings = [each for each in verdict["findings"] if each["cause"] != "constant-pixels"]
        if len(findings) != len(verdict["findings"]) - 1:
            yield Broken("stereo.verdict.findings", "unnamed", "constant pixels")
        stereo = {**changed["stereo"], "verdict": {**verdict, "findings": findings}}
        changed = {**changed, "stereo": stereo}
    yield from _compare(law, _rename(base, law), _without_copies(changed), (), 0.0)


def _without_copies(value: Any) -> Any:
    """Return plain values without those of the poses' copies."""
    if isinstance(value, Mapping):
        return {k: _without_copies(each) for k, each in value.items() if not _is_copy(k)}
    if isinstance(value, list | tuple):
        return [_without_copies(each) for each in value if not _is_copy(each)]
    return value


def _is_copy(value: Any) -> bool:
    """Return whether a value is the name of a pose's copy, or what is known of it."""
    name = value.get("name") if isinstance(value, Mapping) else value
    return isinstance(name, str) and name.endswith(AGAIN)


def _rename(value: Any, law: Law) -> Any:
    """Return plain values with the captures' names as the law makes them."""
    if isinstance(value, Mapping):
        return {_rename(key, law): _rename(each, law) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_rename(each, law) for each in value]
    if isinstance(value, str):
        return re.sub(NAMES, lambda match: law.rename(match[0]), value)
    return value


def _compare(
    law: Law, base: Any, changed: Any, path: tuple[str, ...], sigma: float
) -> Iterator[Broken]:
    place = ".".join(path)
    ignored = IDENTITIES | COORDINATES
    if law.resamples or law.hides:
        ignored |= RESAMPLED
    if law.renders:
        ignored |= SUMS
    if path and path[-1] in ignored:
        return
    if isinstance(base, Mapping) and isinstance(changed, Mapping):
        for key in sorted({*base, *changed}):
            if key not in base or key not in changed:
                missing = "nothing"
                yield Broken(f"{place}.{key}", changed.get(key, missing), base.get(key, missing))
                continue
            # a quantity is a value with its unit; its field says no unit
            is_quantity = key in ("value", "sigma") and "unit" in base
            own = f"{key}_{base['unit']}" if is_quantity else str(key)
            if base.get("name") in EXTREMES and key == "value":
                base, changed = ({**each, key: abs(each[key])} for each in (base, changed))
            sigma = next((k * base[name] for name, k in SIGMAS.items() if base.get(name)), 0.0)
            yield from _compare(law, base[key], changed[key], (*path, own), sigma)
    elif isinstance(base, list | tuple) and isinstance(changed, list | tuple):
        if len(base) != len(changed):
            yield Broken(place, f"{len(changed)} entries", len(base))
            return
        if path[-1] in ("findings", "warnings", "poses", "excluded"):
            base, changed = sorted(base, key=str), sorted(changed, key=str)
        for k, pair in enumerate(zip(base, changed, strict=True)):
            yield from _compare(law, *pair, (*path, str(k)), sigma)
    elif law.resamples and _is_number(base) and _is_number(changed) and not _power(path):
        return
    elif _is_number(base) and _is_number(changed):
        power = 0 if isinstance(base, int) else _power(path)
        wanted = base * law.scale**power
        # a count, a share, or a micrometre
        least = COUNTED if isinstance(base, int) else 1e-3 * law.scale**power
        if "_px" in place:
            least = max(least, LEAST_PX)
        if "_deg" in place:
            least = max(least, LEAST_DEG)
        if not abs(changed - wanted) <= max(
            law.tolerance * abs(wanted), law.sigmas * sigma * law.scale**power, least
        ):
            yield Broken(place, changed, wanted)
    elif _words(base) != _words(changed):
        yield Broken(place, changed, base)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _words(value: Any) -> Any:
    """Return a sentence without its numbers; other values as they are."""
    return re.sub(r"[-+−]?\d[\d.,]*(e[-+]?\d+)?", "#", value) if isinstance(value, str) else value


def _power(path: Sequence[str]) -> int:
    """Return the power of a length that the unit of a field holds, which its own name states or
    that of what it is in."""
    for name in reversed(path):
        if unit := re.search(r"_(mm2|mm²|mm3|mm³|mm|px|deg|mrad|%|ms|s)(?![a-z\d])", name):
            return {"mm": 1, "mm2": 2, "mm²": 2, "mm3": 3, "mm³": 3}.get(unit[1], 0)
        if name in LENGTHS:
            return 1
        if name in SHARES:
            return 0
    return 0


def prove_laws(scale: float, seed: int, progress: Progress, laws: Sequence[Law] = LAWS) -> Proof:
    """Run all operations on a base session and on those that the laws make of it.

    ``scale``: resolution of the camera.
    """
    rows: list[Row] = []
    checks: list[BandCheck] = []
    lines: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        found = _run_laws(Path(scratch), scale, seed, progress, laws)
        _, base = next(found)
        for law, changed in found:
            for operation, record in base.items():
                broken = list(compare_records(law, record, changed[operation]))
                rows.append({"law": law.name, "operation": operation, "broken": len(broken)})
                what = f"{operation}, figures broken"
                checks.append(BandCheck(law.name, what, len(broken), 0, 0))
                lines += [f"{law.name}, {operation}: {each.text()}" for each in broken[:10]]
    return prove_checks(checks, scale, rows, {}, below=lines)


def _run_laws(
    scratch: Path, scale: float, seed: int, progress: Progress, laws: Sequence[Law]
) -> Iterator[tuple[Law, dict[str, Any]]]:
    """Yield the laws with what the operations found, first of the session as it is."""
    base = scratch / "base"
    simulate(base, scale=scale, poses=POSES, seed=seed)
    shape = demo_object(Pose(np.eye(3), np.zeros(3)))
    rig = letter(scale, seed)
    plan = letter_plan(rig, Board.parse(TARGET), POSES)

    def render(capture: Capture) -> np.ndarray:
        """Return the frames (n, h, w) of a capture with new noise."""
        number = AGAIN_SEED + [*plan].index(capture.name)
        return Renderer(rig, plan[capture.name]).capture(capture.sequence, number)

    for k, law in enumerate((Law("as it is"), *laws)):
        progress(k / (len(laws) + 1), law.name)
        folder, model = scratch / f"law_{k}", scratch / f"model_{k}.stl"
        place = shape.vertices @ MOVED_R.T + MOVED_MM if law.moves else shape.vertices
        triangles = shape.triangles
        if law.transposes:
            place, triangles = place[:, [1, 0, 2]], triangles[:, ::-1]
        trimesh.Trimesh(law.scale * place, triangles, process=False).export(model)
        folders = [folder] if not law.apart else [folder, scratch / f"other_{k}"]
        for each in folders:
            change_session(base, each, law, render)
        runs = [(each, law.scale, model, law.rename) for each in folders]
        if law.apart:
            with ProcessPoolExecutor(len(runs), get_context("spawn")) as processes:
                first, *_ = processes.map(run_operations, *zip(*runs, strict=True))
            yield law, first
        else:
            yield law, run_operations(*runs[0])
