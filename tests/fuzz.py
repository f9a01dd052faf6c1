"""Malformed input of every kind: `python -m tests.fuzz --minutes 10`, or `--count 2000 --seed 1`.

Each case damages one file of a small session, or one that a command reads, or gives a command an
impossible number, runs one command in a forked child within 2 GB and 10 s, beside twice what it
takes without the damage, and is counted by kind of file, command and outcome. Right are: a refusal
(exit status 1 to 3 and one printable message, the session unchanged but for what is computed once
and saved, `DERIVED`), and success, where the damage does not matter.
"""

import argparse
import contextlib
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from slviewer import cli
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.pipeline.reconstruct import reconstruct, verify
from slviewer.session.store import Session
from tests import faults

SECONDS, MEGABYTES = 10.0, 2048
ATTEMPTS = 2
"""At what takes too long: beside other programs the same work takes more of the processor's
time."""
RIGHT = ("refused", "no effect")
EVIL_TEXT = "a\x1b[2J\u202eb\x00c"
VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 1, 3, 0.5, 1e308, -1e308, float("nan"), float("inf"), float("-inf"), 10**9,
    10**30, -(2**63),
    "", "x", "1e30", EVIL_TEXT, "x" * 5000, "../../etc/passwd", "~nobody/x", [], {}, [[]], [1],
    [None], {"a": 1},
    {EVIL_TEXT: EVIL_TEXT}, [1, 2, 3, 4], [[1, 2], [3]], ["x"], ["x", "y"], {"x": {}}, [{}],
    [float("nan")] * 3,
)  # fmt: skip
ANOTHER_TARGET = "calibrate S --target circles:21x16:8 --models stereo pixelwise"
"""Measures the poses anew, as a number may: its kernels are to be compiled before."""
COMMANDS = {
    "session": (
        "inspect S", "report S --out r.html", "reconstruct S object_r1 --out c.ply",
        "decode S pose_01 --out d.npz",
        "measurements S", "measurements S --csv m.csv", "export S calibration --out e.json",
        "verify S object_r1 --shape plane",
        "check S pose_01", "inspect S --check", "validate S", "mesh S merge/1 --out m.stl",
        "merge S object_r1 object_r2 --reference object_r1 --out m.ply",
        "calibrate S --target circles:21x16:9 --models stereo pixelwise",
        "measure S object_r1 point --at 160 120",
        "compare S object_r1 part.stl",
        "import opencv-calibration calibration.json S --force", "preflight --capture S object_r1",
        "edit S object_r1", "region S", "plan S --out p.toml", "align S object_r1 object_r2",
        "restore S calibration/*",
    ),
    "rig": ("capture S new --rig rig.toml --port 0", "preflight --rig rig.toml --port 0"),
    "frames": ("import frames images S2 --sequence frames.toml",),
    "image": ("import frames images S2 --sequence frames.toml",
    "detect board.png --target circles:21x16:9"),
    "opencv": tuple(
        f"import opencv-calibration calibration.{suffix} S --force"
        for suffix in ("yml", "xml", "json")
    ),
    "artefact": ("accept S --artefact sphere.toml",),
    "plan": ("inspect-parts plan.toml S --scan object_r1 --out parts",),
    "nominal": ("compare S object_r1 part.stl", "compare S object_r1 part.obj",
    "compare S object_r1 part_2.ply"),
    "number": (
        "capture S new --rig rig.toml --port # --exposure-ms 10",
        "capture S new --rig rig.toml --exposure-ms #",
        "capture S new --rig rig.toml --gain # --port 0",
        "capture S new --rig rig.toml --region # # # # --port 0",
        "capture S new --rig rig.toml --exposures-ms 1 # --port 0",
        "preflight --rig rig.toml --gain # --port 0",
        "calibrate S --target circles:21x16:9 --models stereo pixelwise --degree # "
        "--smoothing polynomial",
        "validate S --folds #",
        "calibrate S --target circles:#x16:9", "calibrate S --target circles:21x16:#",
        "reconstruct S object_r1 --out c.ply --depth-range # #",
        "verify S object_r1 --shape sphere --radius #",
        "verify S object_r1 --shape plane --range 1 #",
        "merge S object_r1 object_r2 --start turntable --angle #",
        "mesh S merge/1 --out m.stl --triangles #", "mesh S merge/1 --out m.stl --smooth #",
        "mesh S merge/1 --out m.stl --fill-holes #", "compare S object_r1 part.stl --tolerance #",
        "compare S object_r1 part.stl --reach #", "measure S object_r1 point --at # #",
        "measure S object_r1 sphere --ball 0 0 500 #", "region S --roi #,#,0,1,0,#",
        "edit S object_r1 --polygon # 0 10 # 10 10", "edit S object_r1 --part # 120",
        "edit S object_r1 --undo #",
        "plan S --out p.toml --tolerance #",
        "measure S object_r1 plane --box # 0 0 1 1 #", "simulate S2 --poses 1 --scale #",
        "simulate S2 --poses #x",
        "simulate S2 --poses 1 --scale 0.01 --seed #", "target circles:21x16:# --out t.pdf",
        "patterns --projector #x#",
        "import opencv-calibration calibration.json S --force --camera #x#",
        "import frames images S2 --sequence frames.toml --projector 96x#",
    ),
}  # fmt: skip
"""The commands that read the files of a kind, S being the session; # is a number."""
SLOW = (
    "align",
    "calibrate",
    "check",
    "inspect-parts",
    "merge",
    "mesh",
    "preflight",
    "report",
    "validate",
)
"""Commands that take seconds where the damage does not concern them: a tenth as many cases as of
each other command."""
DERIVED = ("poses", "evidence", "trust", "compiled", "drift_floor")
"""Results that a command computes on its way and saves, each whole and from sound inputs: they may
be new when it ends with a refusal. Where a calibration is rejected, the attempt's verdict too."""
REJECTED = 3


@dataclass(frozen=True)
class Outcome:
    """How a command ended: the ``kind`` that is counted, and its last message."""

    kind: str
    message: str


def make_seed(folder: Path) -> None:
    """Make a small session with a result of every kind, and the files that commands read beside
    it."""
    faults.make_seed(folder, poses=10)
    session = folder / "S"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in (
            "accept S --artefact sphere.toml --apply-scale",
            "check S pose_10",
            "merge S object_r1 object_r2 --reference object_r1",
            "align S object_r1 object_r2",
            "mesh S merge/1 --out part.stl --triangles 2000",
            "edit S object_r1 --polygon 200 150 220 150 200 170",
            "region S --roi=-500,500,-500,500,100,2000",
            "measure S object_r1 point --at 160 120",
            "measure S object_r1 sphere --ball 0 0 500 150",
            "plan S --out plan.toml --tolerance 100",
            "export S calibration --out calibration.json --format json",
            "export S calibration --out calibration.xml",
        ):
            faults.run_sound(command.split())
    with Session.open(session, write=True) as store:
        reconstruct(store, "object_r1")
        verify(store, ["sphere_1"], "sphere")
        cv2.imwrite(str(folder / "board.png"), store.load_capture("pose_01").frames.max(0))
        store.exclude("pose_10", "blurred")
        store.decide("names", {"object_r1": "part"})
    part = trimesh.load(folder / "part.stl")
    for name in ("part.obj", "part_2.ply"):
        part.export(folder / name)


def write_frames(folder: Path) -> None:
    """Write images of a pattern sequence, and the TOML that describes them."""
    sequence = PatternSequence((96, 64), (*phase_steps("x", 4, 96.0), *phase_steps("y", 4, 64.0)))
    (folder / "images").mkdir()
    for index, frame in enumerate(_render_frames(sequence, (40, 30), np.random.default_rng(0))):
        cv2.imwrite(str(folder / "images" / f"{index:02d}.png"), frame)
    tables = [
        f'[[frame]]\nfile = "{i:02d}.png"\n'
        + "".join(f"{key} = {json.dumps(v)}\n" for key, v in frame.to_dict().items())
        for i, frame in enumerate(sequence.frames)
    ]
    (folder / "frames.toml").write_text('projector = "96x64"\nphase_sign = 1\n' + "\n".join(tables))


def _render_frames(
    sequence: PatternSequence, size: tuple[int, int], rng: np.random.Generator
) -> np.ndarray:
    """Return frames (n, h, w) uint8 of a plane that shows every pattern, with noise."""
    width, height = size
    v, u = np.mgrid[:height, :width]

    def render(frame: Frame) -> np.ndarray:
        """Return one frame of phase steps."""
        place = 20 + u if frame.axis == "x" else 15 + v
        phase = 2 * np.pi * (place / frame.period_px + frame.step / frame.steps)
        return 120 + 80 * np.cos(phase) + rng.normal(0, 1, (height, width))

    return np.stack([render(frame) for frame in sequence.frames]).astype(np.uint8)


# damage


def damage_text(text: str, rng: random.Random) -> bytes:
    """Return a text with the faults that a parser meets."""
    choices: tuple[Callable[[], bytes], ...] = (
        lambda: text[: rng.randrange(len(text) + 1)].encode(),
        lambda: b"",
        lambda: bytes(rng.randrange(256) for _ in range(200)),
        lambda: b"\x00" * 500,
        lambda: b"[" * 100_000,
        lambda: b'{"a":' * 100_000,
        lambda: b"a = " + b"[" * 100_000,
        lambda: b"a" + b".a" * 100_000 + b" = 1",
        lambda: (text + "9" * 5000).encode(),
        lambda: re.sub(r"\d+", lambda m: "9" * 5000 if rng.random() < 0.2 else m[0], text).encode(),
        lambda: re.sub(
            r"\d+(\.\d+)?", lambda m: rng.choice(NUMBERS) if rng.random() < 0.1 else m[0], text
        ).encode(),
        lambda: text.replace('"', "", 1).encode(),
        lambda: _flip(text.encode(), rng),
        lambda: ("\ufeff" + text).encode("utf-16"),
        lambda: text.replace("\n", EVIL_TEXT, 1).encode(),
    )
    return rng.choice(choices)()


NUMBERS = (
    "inf",
    "-inf",
    "nan",
    "1e400",
    "1e30",
    "-1",
    "0",
    "1000000000",
    "99999999999999999999",
    "[]",
    "{}",
    '"x"',
)


def damage_tree(data: Any, rng: random.Random) -> Any:
    """Return plain values with one of them replaced, removed, repeated or wrapped."""
    data = json.loads(json.dumps(data))
    places = list(_walk(data))
    if not places:
        return rng.choice(VALUES)
    inside, key = rng.choice(places)
    how = rng.random()
    if how < 0.7:
        inside[key] = rng.choice(VALUES)
    elif how < 0.85:
        del inside[key]
    elif how < 0.95:
        inside[key] = [inside[key]] * rng.choice((1, 2, 50_000))
    elif isinstance(inside, dict):
        inside[EVIL_TEXT] = inside[key]
    return data


def _walk(data: Any) -> Iterator[tuple[Any, Any]]:
    """Yield (container, key) of every value in plain values."""
    for key in (
        data if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    ):
        yield data, key
        yield from _walk(data[key])


def damage_array(path: Path, rng: random.Random) -> None:
    """Replace a .npy file by another array, or a damaged one."""
    array = np.load(path)
    others = (
        array.ravel()[:-1], np.full(array.shape, np.nan), np.zeros(0), np.zeros((3, 4)),
        array[None],
        np.float64(1),
        np.array(["x", "y"]), np.full(array.shape, 1e308), np.zeros(array.shape, bool),
    )  # fmt: skip
    header = (
        b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (%s,), }"
        % rng.choice((b"99999999999", b"-1", b"1e9", b"9" * 40))
    )
    path.unlink()
    if rng.random() < 0.6:
        np.save(path, rng.choice(others))
    else:
        path.write_bytes(
            rng.choice(
                (header.ljust(127) + b"\n", b"", b"PK\x03\x04" + b"0" * 99, b"\x80\x04}\x94.")
            )
        )


def damage_bytes(data: bytes, rng: random.Random) -> bytes:
    """Return bytes cut short, flipped, repeated or filled with zeros."""
    choices: tuple[Callable[[], bytes], ...] = (
        lambda: data[: rng.randrange(len(data) + 1)],
        lambda: _flip(data, rng),
        lambda: _flip(data[:120], rng) + data[120:],
        lambda: data * 3,
        lambda: b"",
        lambda: data[: len(data) // 2] + bytes(len(data) // 4) + data[3 * len(data) // 4 :],
    )
    return rng.choice(choices)()


def damage_mesh(path: Path, rng: random.Random) -> bytes:
    """Return a nominal model that is damaged, or larger than it seems."""
    facet = (
        b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1"
        b" 0\nendloop\nendfacet\n"
    )
    record = np.zeros(50, np.uint8).tobytes()
    one = np.array([0, 0, 1, 0, 0, 0, 9, 0, 0, 0, 9, 0], "<f4").tobytes() + b"\0\0"
    count = rng.choice((20_000, 1_000_000))
    apart = np.zeros(count, np.dtype([("v", "<f4", 12), ("a", "u1", 2)]))
    apart["v"] = np.random.default_rng(0).random((count, 12), np.float32) * 100
    bombs: dict[str, tuple[Callable[[], bytes], ...]] = {
        ".stl": (
            lambda: bytes(80) + count.to_bytes(4, "little") + one * count,
            lambda: bytes(80) + count.to_bytes(4, "little") + apart.tobytes(),
            lambda: bytes(80) + (2**32 - 1).to_bytes(4, "little") + record,
            lambda: b"".join(b"solid s%d\n" % i + facet + b"endsolid\n" for i in range(30_000)),
            lambda: b"solid x\n" + facet * 100_000,
            lambda: b"solid x\nfacet normal nan nan inf\nouter loop\nvertex 1e400 0 0\n",
        ),
        ".obj": (
            lambda: (
                b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
                + b"".join(b"g g%d\nf 1 2 3\n" % i for i in range(100_000))
            ),
            lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999\nf -1 -2 -9\n",
            lambda: b"v 0 0 0\nf " + b"1 " * 300_000,
            lambda: b"mtllib /etc/passwd\nusemtl x\nv 1e400 nan 0\nf 1 1 1\n",
        ),
        ".ply": (
            lambda: (
                b"ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float"
                b" x\nend_header\n"
            ),
            lambda: (
                b"ply\nformat binary_little_endian 1.0\nelement face -1\nproperty list int int"
                b" v\nend_header\n"
            ),
            lambda: b"ply\nelement\nproperty\nend_header\n",
        ),
    }
    return rng.choice((*bombs[path.suffix], lambda: damage_bytes(path.read_bytes(), rng)))()


def damage_image(path: Path, rng: random.Random) -> bytes:
    """Return an image that is damaged, or much larger than the others."""
    image = cv2.imread(str(path))
    if rng.random() < 0.5:
        return damage_bytes(path.read_bytes(), rng)
    shape, suffix = (
        rng.choice(((20000, 20000), (1, 1), (31, 40), (1, 60_000))),
        rng.choice((".png", ".jpg")),
    )
    kinds = (
        np.zeros(shape, np.uint8),
        np.dstack([image] * 2)[..., :4],
        image.astype(np.uint16) * 257,
    )
    drawn, data = cv2.imencode(suffix, rng.choice(kinds))
    return data.tobytes() if drawn else b""


def _flip(data: bytes, rng: random.Random) -> bytes:
    """Return bytes with a few of them replaced."""
    flipped = bytearray(data)
    for _ in range(min(len(data), rng.choice((1, 5, 50)))):
        flipped[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(flipped)


def damage(folder: Path, rng: random.Random) -> tuple[str, str, str]:
    """Damage one file in a copy of the seed; returns the kind of file, what was done, and the
    command to run."""
    kind = rng.choice(
        ("session",) * 6
        + ("rig", "frames", "image", "opencv", "artefact", "plan", "nominal", "number")
    )
    (command,) = rng.choices(
        COMMANDS[kind], [0.1 if c.split()[0] in SLOW else 1.0 for c in COMMANDS[kind]]
    )
    if kind == "number":
        numbers = (
            *NUMBERS,
            "-0",
            "1e308",
            "-1e308",
            "1e-320",
            "0.5",
            "9" * 5000,
            "1_0",
            "٣",
            "0x10",
            "",
        )
        return (
            "number",
            "the number",
            " ".join(re.sub("#", lambda _: rng.choice(numbers), w) for w in command.split()),
        )
    names = {
        "rig": "rig.toml",
        "frames": "frames.toml",
        "artefact": "sphere.toml",
        "plan": "plan.toml",
    }
    if kind == "session":
        files = [
            path
            for path in (folder / "S").rglob("*")
            if path.is_file() and not path.name.startswith(".lock")
        ]
        texts = [path for path in files if path.suffix == ".json"]
        path = rng.choice(texts if rng.random() < 0.7 else files)
    elif kind == "image":
        path = folder / ("board.png" if command.startswith("detect") else "images/00.png")
    else:
        path = folder / (
            names.get(kind)
            or next(w for w in command.split() if w.startswith(("part", "calibration")))
        )
    how = _damage_file(path, rng)
    if kind == "session":
        parts = path.relative_to(folder / "S").parts
        kind = "/".join(
            [
                *parts[: 1 + (parts[0] == "results")],
                "chunk" if path.name.startswith("c.") else path.name,
            ]
        )
    return kind, f"{path.relative_to(folder)}: {how}", command


def _damage_file(path: Path, rng: random.Random) -> str:
    """Damage a file, and return how."""
    if rng.random() < 0.08:
        return _replace_by_node(path, rng)
    if path.suffix == ".npy":
        damage_array(path, rng)
        return "array"
    if path.suffix in (".stl", ".obj", ".ply") and "S" not in path.parts:
        content, how = damage_mesh(path, rng), "mesh"
    elif path.suffix == ".png" and "S" not in path.parts:
        content, how = damage_image(path, rng), "image"
    elif path.suffix == ".json" and rng.random() < 0.75:
        content, how = json.dumps(damage_tree(json.loads(path.read_text()), rng)).encode(), "values"
    elif path.suffix in (".json", ".toml", ".yml", ".xml"):
        content, how = damage_text(path.read_text(), rng), "text"
    else:
        content, how = damage_bytes(path.read_bytes(), rng), "bytes"
    path.unlink()  # it may be a link of the seed's
    path.write_bytes(content)
    return how


def _replace_by_node(path: Path, rng: random.Random) -> str:
    """Replace a file by something that is none, or has no end."""
    path.unlink()
    how = rng.choice(("pipe", "/dev/zero", "folder", "sparse", "missing", "circle"))
    if how == "pipe":
        os.mkfifo(path)
    elif how == "/dev/zero":
        path.symlink_to("/dev/zero")
    elif how == "folder":
        path.mkdir()
    elif how == "sparse":
        with path.open("wb") as file:
            file.truncate(3 << 30)
    elif how == "circle":
        path.symlink_to(path.name)
    return how


# running


def run_case(folder: Path, command: str, seconds: float = SECONDS) -> Outcome:
    """Run a command in a forked child within so many seconds of the processor, and return how it
    ended."""
    before, out = describe_tree(folder / "S"), folder / "output"
    child = os.fork()
    if not child:
        _run_child(folder, command, out, seconds)
    end, status = time.monotonic() + 6 * seconds, None  # it may be busy: the time used is limited
    while status is None and time.monotonic() < end:
        done, code = os.waitpid(child, os.WNOHANG)
        status = code if done else None
        time.sleep(0.005)
    if status is None:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return Outcome("hang", "")
    text = out.read_text(errors="replace") if out.exists() else ""
    message = text.strip().splitlines()[-1] if text.strip() else ""
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU:
        return Outcome("hang", "")
    if os.WIFSIGNALED(status):
        return Outcome("crash", f"signal {os.WTERMSIG(status)} {message}")
    code = os.WEXITSTATUS(status)
    if "Traceback (most recent call last)" in text or "unexpected" in message:
        where = re.findall(r'File ".*?(slviewer/.*?)", line (\d+)', text)
        kind = "memory" if "MemoryError" in text else "traceback"
        return Outcome(kind, f"{message} at {':'.join(where[-1]) if where else '?'}")
    if any(not (c.isprintable() or c in "\n\t\r") for c in text):
        return Outcome("control characters", repr(message))
    if code == 0:
        return Outcome("no effect", "")
    if code not in (1, 2, 3) or not message:
        return Outcome("wrong status", f"{code}: {message}")
    derived = (*DERIVED, "calibration") if code == REJECTED else DERIVED
    after = describe_tree(folder / "S")
    changed = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
    if any(not name.startswith(tuple(f"results/{each}" for each in derived)) for name in changed):
        return Outcome("session changed", f"{message} ({min(changed)})")
    return Outcome("refused", message)


def _run_child(folder: Path, command: str, out: Path, seconds: float) -> None:
    """Run the command in this process, within the limits, and end it."""
    descriptor = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 1))
    resource.setrlimit(resource.RLIMIT_DATA, (MEGABYTES << 20, MEGABYTES << 20))
    os.chdir(folder)
    status = 99
    try:
        status = cli.main(command.split())
        sys.stdout.flush()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def describe_tree(folder: Path) -> dict[str, tuple[int, ...]]:
    """Return {file: what changes when it is written} of all files in a session but those of its
    lock."""
    described = {}
    for parent, _, files in os.walk(folder):
        for name in files:
            if not name.startswith(".lock"):
                status = Path(parent, name).lstat()
                described[str(Path(parent, name).relative_to(folder))] = (
                    status.st_ino,
                    status.st_size,
                    status.st_mtime_ns,
                )
    return described


def main() -> int:
    """Run cases, and print their number by outcome, and an example of each that is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--count", type=int, default=None)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--cases",
        type=int,
        nargs="+",
        help="only these, by the numbers that an earlier run printed",
    )
    options = parser.parse_args()
    count = options.count or (2000 if options.minutes == float("inf") else 10**9)
    outcomes: Counter[tuple[str, str, str]] = Counter()
    with tempfile.TemporaryDirectory() as root:
        seed, folder = Path(root, "seed"), Path(root, "case")
        seed.mkdir()
        faults.make_in_child(lambda: make_seed(seed))
        faults.import_modules()
        lasts = _warm_up(seed, folder)
        print(
            "seconds of the processor: "
            + ", ".join(f"{name} {s:.1f}" for name, s in lasts.items()),
            flush=True,
        )
        end = time.monotonic() + 60 * options.minutes
        for number in options.cases or range(count):
            if time.monotonic() > end:
                break
            for _ in range(ATTEMPTS):
                shutil.copytree(seed, folder, copy_function=os.link)
                kind, how, command = damage(folder, random.Random(f"{options.seed}-{number}"))
                outcome = run_case(
                    folder, command, SECONDS + 2 * lasts.get(command.split()[0], 0.0)
                )
                shutil.rmtree(folder)
                if outcome.kind != "hang":
                    break
            outcomes[kind, command.split()[0], outcome.kind] += 1
            if outcome.kind not in RIGHT:
                print(
                    f"{number}: {outcome.kind}: {command[:200]} ({how}): {outcome.message[:300]}",
                    flush=True,
                )
    bad = sum(n for (_, _, outcome), n in outcomes.items() if outcome not in RIGHT)
    for name, column in (("file", 0), ("command", 1), ("outcome", 2)):
        print(f"\nby {name}:")
        for each in sorted({key[column] for key in outcomes}):
            of_it = [(key, n) for key, n in outcomes.items() if key[column] == each]
            wrong = sum(n for key, n in of_it if key[2] not in RIGHT)
            print(
                f"  {each:<28} {sum(n for _, n in of_it):5}" + (f", {wrong} bad" if wrong else "")
            )
    print(f"\n{sum(outcomes.values())} malformed inputs, {bad} bad (seed {options.seed})")
    return int(bool(bad))


def _warm_up(seed: Path, folder: Path) -> dict[str, float]:
    """Run every command on the sound seed, and print those that fail; returns {command: seconds of
    the processor}.

    The first time compiles kernels; a command may take twice as long where the damage does not
    concern it.
    """
    for _ in range(2):
        lasts: dict[str, float] = {}
        commands = [c for kind, commands in COMMANDS.items() for c in commands if kind != "number"]
        for command in dict.fromkeys([*commands, ANOTHER_TARGET]):
            shutil.copytree(seed, folder, copy_function=os.link)
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            outcome = run_case(folder, command, 300.0)
            after, name = resource.getrusage(resource.RUSAGE_CHILDREN), command.split()[0]
            lasted = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            lasts[name] = max(lasts.get(name, 0.0), lasted)
            if outcome.kind != "no effect":
                print(f"sound: {command}: {outcome.kind}: {outcome.message[:300]}", flush=True)
            shutil.rmtree(folder)
    return lasts


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        sys.exit(main())
