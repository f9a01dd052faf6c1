"""Deaths and write faults of every command that saves: `python -m tests.faults --kills 300 --faults
100 --seed 1`.

A command runs on a copy of a small session, in a forked child whose n-th change of the disk
(opening a file to write, writing, syncing, renaming, making or removing) is its death, or fails. A
death is a kill, or a loss of power, which takes what was not synced: files are emptied, and renames
and replacements undone. Afterwards the session must open, hold every complete capture undamaged,
and one calibration, wholly the old or wholly the new; and the same command must then complete.
"""

import argparse
import builtins
import contextlib
import errno
import importlib
import io
import os
import pkgutil
import random
import re
import shutil
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import slviewer
from slviewer import cli
from slviewer.pipeline.report import inspect
from slviewer.session.store import Session

KILL = 0
FAULTS = {"kill": KILL, "disk full": errno.ENOSPC, "I/O error": errno.EIO, "read-only": errno.EROFS}
CHANGES = ("rename", "replace", "fsync", "mkdir", "unlink", "rmdir")
COMMANDS = (
    "import frames images S --sequence frames.toml",
    "import opencv-calibration calibration.yml S --force",
    "capture S new --rig rig.toml --role scan --patterns gray --port 0",
    "calibrate S --target circles:21x16:9 --models stereo pixelwise",
    "restore S calibration/*",
    "reconstruct S object_r1 --out cloud.ply",
    "align S object_r1 object_r2",
    "merge S object_r1 object_r2 --reference object_r1",
    "accept S --artefact sphere.toml --apply-scale",
)
"""S is the session; the files stand beside it."""


class Killed(BaseException):
    """Stands for `kill -9`: from then on the program changes nothing on disk any more."""


class Disk:
    """Counts the calls that change the disk, and fails at one: once (EIO), from then on, or by the
    program's death."""

    def __init__(self, at: int | None, code: int = KILL) -> None:
        self.calls: list[str] = []
        self._at, self._code = at, code
        self._dead = False

    def call(self, name: str, *paths: Any) -> None:
        """Count a call; raises the fault where it is due."""
        number = len(self.calls)
        self.calls.append(name)
        if self._dead or (self._code == KILL and number == self._at):
            self._dead = True
            self.die()
        if self._at is None or number < self._at or self._code == KILL:
            return
        is_growing = name in ("open", "write", "mkdir", "fsync")
        if (self._code == errno.EIO and number > self._at) or (
            self._code == errno.ENOSPC and not is_growing
        ):
            return
        raise OSError(self._code, os.strerror(self._code))

    def concerns(self, path: Any) -> bool:
        """Whether changes of a path are counted."""
        return True

    def die(self) -> None:
        """End the program."""
        raise Killed

    def write(self, file: Any, data: Any) -> int:
        """Write to a file, half of the data where the disk fails."""
        try:
            self.call("write")
        except BaseException:
            file.write(
                memoryview(data).cast("B")[: memoryview(data).nbytes // 2]
                if not isinstance(data, str)
                else ""
            )
            raise
        return int(file.write(data))


class WatchedFile:
    """A file opened for writing, whose writes are counted."""

    def __init__(self, file: Any, disk: Disk) -> None:
        self._file, self._disk = file, disk

    def write(self, data: Any) -> int:
        """Write, as the disk lets it."""
        return self._disk.write(self._file, data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> "WatchedFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


@contextlib.contextmanager
def watching(disk: Disk) -> Iterator[pytest.MonkeyPatch]:
    """Context manager: everything that changes files is counted by the disk."""
    opened = builtins.open

    def watched(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function, counted before it is called."""

        def call(*arguments: Any, **options: Any) -> Any:
            """Count the call, and make it."""
            if disk.concerns(arguments[0]):
                disk.call(name, *arguments)
            return function(*arguments, **options)

        return call

    def watched_open(path: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        """Open a file; one for writing is counted and watched."""
        if not set(mode) & set("wxa+") or not disk.concerns(path):
            return opened(path, mode, *arguments, **options)
        disk.call("open", path)
        return WatchedFile(opened(path, mode, *arguments, **options), disk)

    with pytest.MonkeyPatch.context() as patch:
        for name in CHANGES:
            patch.setattr(os, name, watched(name, getattr(os, name)))
        patch.setattr(builtins, "open", watched_open)
        patch.setattr(io, "open", watched_open)
        yield patch


class Machine(Disk):
    """A disk whose death ends the process, by a kill or by a loss of power."""

    def __init__(self, at: int | None, code: int = KILL, *, loses_power: bool = False) -> None:
        super().__init__(at, code)
        self._loses_power, self._process = loses_power, os.getpid()
        self._unsynced: list[Path] = []
        self._renamed: list[
            tuple[Path, Path, Path | None]
        ] = []  # the last: a copy of what was replaced
        self._folder = Path.cwd()
        self._system = {name: getattr(os, name) for name in (*CHANGES, "truncate")}

    def concerns(self, path: Any) -> bool:
        """Whether a path, or what is open under a number, is in the folder of the case: compiled
        code is elsewhere."""
        place = Path(
            os.readlink(f"/proc/self/fd/{path}") if isinstance(path, int) else os.fsdecode(path)
        )
        return place.absolute().is_relative_to(self._folder)

    def call(self, name: str, *paths: Any) -> None:
        """Count a call, and note what a loss of power would take."""
        super().call(name, *paths)
        if name == "open":
            self._unsynced.append(Path(paths[0]).absolute())
        elif name == "fsync":
            synced = Path(os.readlink(f"/proc/self/fd/{paths[0]}"))
            self._unsynced = [path for path in self._unsynced if path != synced]
            self._renamed = [(a, b, old) for a, b, old in self._renamed if b.parent != synced]
        elif name in ("rename", "replace"):
            source, target = (Path(path).absolute() for path in paths)
            self._unsynced = [
                target / path.relative_to(source) if path.is_relative_to(source) else path
                for path in self._unsynced
            ]
            old = None
            if self._loses_power and target.is_file():
                old = self._folder / f"copy_{len(self.calls)}"
                os.link(target, old)
            if old is not None or not target.exists():
                self._renamed.append((source, target, old))

    def die(self) -> None:
        """Kill the process; before, take what a loss of power takes."""
        if self._loses_power:
            for path in self._unsynced:
                if path.is_file():
                    self._system["truncate"](path, 0)
            for source, target, old in reversed(self._renamed):
                if target.exists() and not source.exists() and source.parent.exists():
                    self._system["rename"](target, source)
                    if old is not None:
                        os.link(old, target)
        os.kill(self._process, signal.SIGKILL)


def make_seed(folder: Path, poses: int = 7) -> None:
    """Make a small calibrated session S with a calibration in its trash, and the files that
    commands read beside it."""
    from tests import fuzz

    fuzz.write_frames(folder)
    session = folder / "S"
    (folder / "rig.toml").write_text(
        'what = "small"\ndriver = "simulated"\npreset = "letter"\nscale = 0.1\nseed = 0\n'
    )
    (folder / "sphere.toml").write_text(
        'kind = "sphere"\nname = "sphere"\ncertificate = "none"\n[calibrated]\ndiameter_mm ='
        " 196.0\ndiameter_U_mm = 0.01\nform_mm = 0.01\nform_U_mm = 0.01\ntemperature_C ="
        " 20.0\nexpansion_ppm_K = 0.0\nexpansion_U_ppm_K = 0.0\n[measured]\ntemperature_C ="
        ' 20.0\ntemperature_U_K = 0.1\ncaptures = ["sphere_*"]\n[limits]\nform_mm = 5.0\nsize_mm ='
        " 5.0\n"
    )
    calibrate = COMMANDS[3].replace(" S ", f" {session} ").split()
    run_sound(f"simulate {session} --scale 0.2 --poses {poses}".split())
    with Session.open(session, write=True) as store:
        for name in store.capture_names("scan"):
            if name not in ("object_r1", "object_r2", "sphere_1", "sphere_2"):
                store.exchange({name: None})
    shutil.rmtree(session / "trash")
    run_sound(calibrate)
    run_sound(["export", str(session), "calibration", "--out", str(folder / "calibration.yml")])
    run_sound(
        ["import", "opencv-calibration", str(folder / "calibration.yml"), str(session), "--force"]
    )
    with Session.open(session, write=True) as store:
        store.exclude(f"pose_{poses:02d}", "so that the next calibration is another")
    run_sound(calibrate)
    with Session.open(session, write=True) as store:
        store.include(f"pose_{poses:02d}")


def import_modules() -> None:
    """Import what commands import, so that not every forked child has to."""
    names = [module.name for module in pkgutil.walk_packages(slviewer.__path__, "slviewer.")]
    for name in (*names, "numba", "scipy.optimize", "scipy.spatial", "zarr"):
        if not re.search(r"\.(gui|validation)|cuda", name):
            importlib.import_module(name)


def make_in_child(make: Callable[[], None]) -> None:
    """Run a function in a forked child: threads of compiled code must not run where later children
    are forked."""
    child = os.fork()
    if not child:
        status = 1
        try:
            make()
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    if os.waitpid(child, 0)[1]:
        raise RuntimeError("the session could not be made")


def run_sound(arguments: list[str]) -> None:
    """Run a command that must succeed, silently."""
    written = io.StringIO()
    with contextlib.redirect_stdout(written), contextlib.redirect_stderr(written):
        status = cli.main(arguments)
    if status:
        raise RuntimeError(f"{' '.join(arguments)}: status {status}: {written.getvalue()}")


def run_child(folder: Path, command: str, make: Callable[[], Machine]) -> tuple[int, str]:
    """Run a command on a disk in a forked child; returns its status, -9 for killed, and what it
    wrote."""
    out = folder / "output"
    child = os.fork()
    if not child:
        descriptor = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        os.chdir(folder)
        status, disk = 99, make()
        try:
            with watching(disk):
                status = cli.main(command.split())
            sys.stdout.flush()
            (folder / "calls").write_text(str(len(disk.calls)))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), out.read_text(errors="replace")


def describe(session: Path) -> tuple[set[str], dict[str, str]]:
    """Return the captures of a session and {result: hash} of its calibration; raises where anything
    is damaged."""
    text = inspect(session, check=True)
    if "damaged" in text:
        raise AssertionError(text[text.index("damaged") :].splitlines()[0])
    with Session.open(session) as store:
        names = [name for name in store.result_names() if name.startswith("calibration/")]
        for name in names:
            if store.state_of(name) != "fresh":
                raise AssertionError(f"{name} is {store.state_of(name)}")
        return set(store.capture_names()), {
            name: store.load_result(name, only=())[0]["hash"] for name in names
        }


def examine(folder: Path, before: tuple[set[str], dict[str, str]], command: str) -> str:
    """Return what is wrong with a session after a fault; empty where nothing is."""
    try:
        with Session.open(folder / "S", write=True):
            pass
        captures, calibration = describe(folder / "S")
    except Exception as error:
        return f"damaged: {error}"
    if lost := before[0] - captures:
        return f"lost: {', '.join(sorted(lost))}"
    new = {name for name in calibration if calibration[name] != before[1].get(name)}
    if calibration != before[1] and calibration.keys() - new:
        return (
            f"mixed calibration: {', '.join(sorted(new))} new,"
            f" {', '.join(sorted(calibration.keys() - new))} old"
        )
    again = f"{command} --force" if command.startswith("capture") else command
    status, text = run_child(folder, again, lambda: Machine(None))
    if status:
        return f"not completed: status {status}: {text.strip().splitlines()[-1:]}"
    try:
        describe(folder / "S")
    except Exception as error:
        return f"damaged by the second run: {error}"
    return ""


def run(kills: int, faults: int, seed: int, commands: tuple[str, ...]) -> Counter[str]:
    """Run the cases, print those that are wrong, and return the number of each outcome."""
    rng = random.Random(seed)
    outcomes: Counter[str] = Counter()
    by_command: dict[str, Counter[str]] = {command: Counter() for command in commands}
    kinds = [("kill", KILL, False), ("power", KILL, True)] * (kills // 2)
    kinds += [(name, code, False) for name, code in [*FAULTS.items()][1:]] * -(-faults // 3)
    kinds = kinds[: kills // 2 * 2 + faults]
    rng.shuffle(kinds)  # so that every command meets every kind
    with tempfile.TemporaryDirectory() as root:
        sound, folder = Path(root, "seed"), Path(root, "case")
        sound.mkdir()
        make_in_child(lambda: make_seed(sound))
        import_modules()
        before, counts = describe(sound / "S"), {}
        for command in commands:  # compiles, and counts the places to fail at
            shutil.copytree(sound, folder)
            status, text = run_child(folder, command, lambda: Machine(None))
            if status:
                raise RuntimeError(f"{command}: status {status}: {text}")
            counts[command] = int((folder / "calls").read_text())
            shutil.rmtree(folder)
            print(f"{command}: {counts[command]} changes of the disk", flush=True)
        for number, (kind, code, loses_power) in enumerate(kinds):
            command = commands[number % len(commands)]
            at = rng.randrange(counts[command])
            shutil.copytree(sound, folder)
            machine = partial(Machine, at, code, loses_power=loses_power)
            status, text = run_child(folder, command, machine)
            wrong = examine(folder, before, command)
            if "Traceback" in text:
                wrong = wrong or f"traceback: {text.strip().splitlines()[-1]}"
            outcome = (
                "wrong" if wrong else "died" if status < 0 else "refused" if status else "completed"
            )
            outcomes[outcome] += 1
            by_command[command][f"{kind}: {outcome}"] += 1
            if wrong:
                print(
                    f"{number}: {command}: {kind} at {at} of {counts[command]}: {wrong}", flush=True
                )
            shutil.rmtree(folder)
    for command, counted in by_command.items():
        print(f"{command}: " + ", ".join(f"{n} {what}" for what, n in sorted(counted.items())))
    return outcomes


def main() -> int:
    """Run as many cases as were asked for, and print the number of each outcome."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--kills", type=int, default=300, help="deaths, half of them by a loss of power"
    )
    parser.add_argument(
        "--faults", type=int, default=100, help="full disks, I/O errors and read-only disks"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="*", help="names of some of the commands")
    options = parser.parse_args()
    commands = tuple(
        each for each in COMMANDS if not options.commands or each.split()[0] in options.commands
    )
    outcomes = run(options.kills, options.faults, options.seed, commands)
    print(
        f"\n{sum(outcomes.values())} cases: "
        + ", ".join(f"{n} {kind}" for kind, n in outcomes.most_common())
    )
    return int(bool(outcomes["wrong"]))


if __name__ == "__main__":
    sys.exit(main())
