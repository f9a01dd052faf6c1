"""Many captures at once, on Dask's distributed scheduler: a cluster of this machine's own cores, or
one given. Its workers run the commands' own functions, on one capture at a time."""

import os
import secrets
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from fnmatch import fnmatchcase
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from slviewer import __version__
from slviewer.errors import InputError, SessionError, SlviewerError, UsageError
from slviewer.evaluation.render import render
from slviewer.inputs import RADIUS
from slviewer.pipeline.models import ModelName
from slviewer.pipeline.operation import (
    Callbacks,
    Findings,
    Job,
    Progress,
    Warn,
    ignore_progress,
    ignore_warnings,
    takes_settings,
)
from slviewer.pipeline.reconstruct import (
    ReconstructSettings,
    VerifySettings,
    reconstruct_capture,
    verify,
)
from slviewer.records.verification import Shape, Verification
from slviewer.session.atomic import to_json, write_bytes
from slviewer.session.layout import is_session
from slviewer.session.reading import expand_user
from slviewer.session.store import Session

Do = Literal["reconstruct", "verify", "mesh"]
INSTALL_COMMAND = "pip install 'slviewer[batch]'"
CONNECT_TIMEOUT_S = 10.0
"""How long a scheduler may take to answer, and to find a worker."""
BYTES_PER_WORKER = 3 << 30
"""What reconstructing a capture of two megapixels may need, with every calibration loaded."""

_IGNORE_INTERRUPT = """
import signal

def dask_setup(worker):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
"""
"""A terminal's Ctrl-C reaches workers too: they leave it to the process that started them, which
ends them."""


_TASK_LOCK = threading.Lock()
"""A process works on one capture at a time, however many threads its worker has: the kernels use
its cores already, and each capture more would need as much memory again."""


@dataclass(frozen=True)
class BatchSettings(Callbacks):
    """Of which sessions, what is done with which captures, and where.

    Args:
        sessions: Session folders that all workers see, or addresses such as s3://bucket/session.
        do: What to do with each capture.
        captures: Their names, or patterns such as 'plane_*'; by default all scans.
        shape: What the captures show, with --do verify.
        radius: Nominal radius of the spheres, mm, with --do verify.
        model: Which calibration to use; by default each session's best one, and all there are with
            --do verify.
        scheduler: Address of a Dask scheduler, such as tcp://host:8786; by default a cluster of
            this machine's cores.
        accept_rejected: Use calibrations although their verdict rejects them.

    Captures are read, and files written, where the workers are; a capture whose worker dies is done
    again by another. Raises SlviewerError without ``distributed``, or where no scheduler answers or
    it has no workers.
    """

    sessions: Sequence[str | Path]
    do: Do
    _: KW_ONLY
    captures: Sequence[str] = ()
    model: ModelName | None = None
    shape: Shape | None = None
    radius: Annotated[float | None, RADIUS] = None
    accept_rejected: bool = False
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.do == "verify" and self.shape is None:
            raise UsageError(
                "what the captures show is not known", "give --shape plane or --shape sphere"
            )
        if self.do != "verify" and (self.shape is not None or self.radius is not None):
            raise UsageError(f"--shape and --radius belong to --do verify, not to --do {self.do}")
        if not self.sessions:
            raise UsageError("no session named", "give the folders or addresses of one or more")


@dataclass(frozen=True)
class Task:
    """The same work for all captures of a batch, as its ``settings`` state it. ``batch``: its name,
    ``version``: the submitting program's."""

    settings: BatchSettings
    batch: str
    version: str = __version__

    @property
    def verification_file(self) -> str:
        """Name of the verifications' file in the exports."""
        return f"verification_{self.settings.shape}.json"


@dataclass(frozen=True)
class TaskResult:
    """The result of one capture: its figures by name, or why it failed.

    ``verification``: to be joined with those of the session's other captures.
    """

    session: str
    capture: str
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    failed: str = ""
    verification: Verification | None = None


@dataclass(frozen=True)
class Batch:
    """The result of every capture, in the order of the sessions. ``broken``: {session: why} of
    those without any."""

    done: tuple[TaskResult, ...]
    broken: Mapping[str, str]
    task: Task

    @property
    def failed(self) -> dict[str, str]:
        """{session, or session and capture: why}."""
        failed = {
            f"{done.session} {done.capture}": done.failed for done in self.done if done.failed
        }
        return {**self.broken, **failed}

    @property
    def failure(self) -> str:
        """How many captures and sessions failed; empty where none did."""
        count = len(self.failed)
        return f"{count} of the batch failed: the summary names them, and why" if count else ""

    def to_json(self) -> dict[str, Any]:
        """Return the published values of ``batch --json``."""
        sessions: dict[str, Any] = {
            address: {"failed": why, "captures": {}} for address, why in self.broken.items()
        }
        for done in self.done:
            session = sessions.setdefault(done.session, {"failed": None, "captures": {}})
            session["captures"][done.capture] = {
                **done.figures,
                "failed": done.failed or None,
                "warnings": list(done.warnings),
            }
        return {"do": self.task.settings.do, "sessions": sessions}

    def text(self) -> str:
        """Return a report for the terminal: a table per session, then what failed and why."""
        good = [done for done in self.done if not done.failed]
        is_verified = self.task.settings.do == "verify"
        wrote = f" -> exports/{self.task.verification_file}" if is_verified else ""
        blocks = []
        for address in dict.fromkeys(done.session for done in good):
            rows = [{"capture": d.capture, **d.figures} for d in good if d.session == address]
            blocks.append(f"{address}{wrote}\n{render(rows)}\n")
        failed = self.failed
        blocks += [f"failed: {what}: {why}" for what, why in failed.items()]
        return "\n".join([*blocks, f"{len(good)} captures done, {len(failed)} failed"])


@takes_settings(BatchSettings)
def batch(settings: BatchSettings) -> Batch:
    """Reconstruct, verify or mesh the captures of many sessions, on this machine's cores or a Dask
    cluster.

    What it makes is what each command makes alone, in each session's exports. A capture that fails
    is named in the end, with status 1, and stops no other.
    """
    progress, warn, scheduler = settings.progress, settings.warn, settings.scheduler
    addresses = list(dict.fromkeys(map(_absolute_address, settings.sessions)))
    sent = replace(settings, progress=ignore_progress, warn=ignore_warnings)
    task = Task(sent, secrets.token_hex(4))
    progress(0.0, f"looking into {len(addresses)} sessions")
    try:
        with _start_cluster() if scheduler is None else connect(scheduler) as client:
            listing = {address: (list_captures, address, task) for address in addresses}
            plans = _gather_results(client, listing, warn)
            broken = {address: plan for address, plan in plans.items() if isinstance(plan, str)}
            work = {
                (address, name): (run_task, address, name, task)
                for address, plan in plans.items()
                if address not in broken
                for name in plan
            }
            outcomes = _gather_results(client, work, warn, progress)
            done = tuple(
                came if isinstance(came, TaskResult) else TaskResult(address, name, failed=came)
                for (address, name), came in outcomes.items()
            )
            for message in dict.fromkeys(
                f"{one.session}: {words}" for one in done for words in one.warnings
            ):
                warn(message)
            verified: dict[str, dict[str, Verification]] = {}
            for one in done:
                if one.verification is not None:
                    verified.setdefault(one.session, {})[one.capture] = one.verification
            writing = {
                address: (write_verification, address, records, task)
                for address, records in verified.items()
            }
            written = _gather_results(client, writing, warn)
            broken |= {address: why for address, why in written.items() if why}
            progress(1.0, "done")
    finally:
        for address in addresses:
            remove_leftovers(address, task.batch)
    return Batch(done, broken, task)


def list_captures(address: str, task: Task) -> list[str]:
    """Names of a session's captures that match any of the task's patterns, of its scans where there
    is none. Raises SlviewerError where there are none."""
    _check_version(task)
    patterns = task.settings.captures
    with _fetch_session(address) as folder, Session.open(folder) as store:
        there = store.capture_names()
        if not patterns:
            there = [each.name for each in store.captures("scan", with_frames=True)]
    names = [name for name in there if any(fnmatchcase(name, each) for each in patterns or "*")]
    if not names:
        raise InputError(
            f"no capture is called {' or '.join(patterns)}: there are {', '.join(there) or 'none'}"
            if patterns
            else "it holds no scan: name the captures, such as 'pose_*'"
        )
    return names


def run_task(address: str, capture: str, task: Task) -> TaskResult:
    """Do the task with one capture; its files are in the session's exports when this returns."""
    warnings, verification, settings = list[str](), None, task.settings
    model, accepts = settings.model, settings.accept_rejected
    figures: dict[str, Any]
    started = time.perf_counter()
    try:
        _check_version(task)
        with _fetch_session(address, capture) as folder, _TASK_LOCK, Session.open(folder) as store:
            if settings.shape is not None:
                measuring = VerifySettings(
                    (capture,),
                    settings.shape,
                    models=(model,) if model else (),
                    radius=settings.radius,
                    accept_rejected=accepts,
                )
                verification = verify.run(store, measuring, warn=warnings.append)[capture]
                figures = {
                    f"{name} RMS mm": fit.rms_mm for name, fit in verification.models.items()
                }
            else:
                job, is_mesh = Job(store, warn=warnings.append), settings.do == "mesh"
                with export_folder(address, task.batch) as made:
                    out = made / "cloud.ply"
                    reconstructing = ReconstructSettings(
                        capture, model=model, out=out, mesh=is_mesh, accept_rejected=accepts
                    )
                    with reconstruct_capture(job, reconstructing) as result:
                        cloud = result.cloud
                    name = f"{capture}_{cloud.model}{'_mesh' if is_mesh else ''}.ply"
                    out.rename(made / name)
                noise = float(np.median(cloud.sigma_z[cloud.mask]))
                figures = {"points": result.points, "noise mm": noise, "file": name}
    except Exception as error:  # any error ends this capture alone
        return TaskResult(address, capture, warnings=tuple(warnings), failed=describe_error(error))
    figures["s"] = round(time.perf_counter() - started, 1)
    return TaskResult(address, capture, figures, tuple(warnings), verification=verification)


def write_verification(address: str, records: Mapping[str, Verification], task: Task) -> None:
    """Write the verifications of one session, by capture, as ``verify --json`` does."""
    with export_folder(address, task.batch) as made:
        found = Findings(Verification, records)
        write_bytes(made / task.verification_file, to_json(found.to_json()))


def describe_error(error: Exception) -> str:
    """Describe an error in words; of an unforeseen one its type too."""
    return str(error) if isinstance(error, SlviewerError) else f"{type(error).__name__}: {error}"


def _check_version(task: Task) -> None:
    """Raise InputError where the batch was submitted by another version of slviewer than the
    worker's."""
    if task.version != __version__:
        raise InputError(
            f"the worker runs slviewer {__version__}, the batch {task.version}",
            "install the same on both",
        )


@contextmanager
def connect(scheduler: str, timeout_s: float = CONNECT_TIMEOUT_S) -> Iterator[Any]:
    """Yield a client of a running scheduler that has a worker.

    Raises SlviewerError where the scheduler does not answer in ``timeout_s``, or then has no worker
    for as long.
    """
    _check_installed()
    from distributed import Client

    try:
        client = Client(scheduler, timeout=timeout_s, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise SlviewerError(
            f"no Dask scheduler answers at {scheduler} ({error})",
            "start one with `dask scheduler`, or leave --scheduler out to use this machine's cores",
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=timeout_s)
        except TimeoutError as error:
            raise SlviewerError(
                f"the scheduler at {scheduler} has no workers",
                f"start some with `dask worker {scheduler}`",
            ) from error
        yield client


@contextmanager
def _start_cluster() -> Iterator[Any]:
    """Yield a client of new worker processes on this machine, as many as cores and memory allow."""
    _check_installed()
    import dask.config
    from dask.system import CPU_COUNT
    from distributed import Client, LocalCluster
    from distributed.system import MEMORY_LIMIT

    workers = max(1, min(CPU_COUNT, MEMORY_LIMIT // BYTES_PER_WORKER))
    threads = str(max(1, CPU_COUNT // workers))
    libraries = ("OMP", "OPENBLAS", "MKL", "NUMBA")
    environ = {
        f"{library}_NUM_THREADS": os.environ.get(f"{library}_NUM_THREADS", threads)
        for library in libraries
    }
    with (
        dask.config.set({"distributed.nanny.pre-spawn-environ": environ}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=MEMORY_LIMIT // workers,
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            preload=_IGNORE_INTERRUPT,
            # whoever reaches a scheduler runs what they like as its user; others share this machine
            security=True,
            silence_logs="ERROR",
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


def _check_installed() -> None:
    """Raise SlviewerError where a package that batches need is not installed."""
    for package in ("distributed", "fsspec", "cryptography"):
        if find_spec(package) is None:
            raise SlviewerError(
                f"a batch needs the package {package}, which is missing", INSTALL_COMMAND
            )


def _gather_results(
    client: Any,
    calls: Mapping[Any, tuple[Any, ...]],
    warn: Warn,
    progress: Progress = ignore_progress,
) -> dict[Any, Any]:
    """What each call (function, arguments ...) returned, in their order; the reason as text where a
    worker could not.

    The remaining calls are cancelled if this raises.
    """
    from distributed import as_completed

    futures = {client.submit(*call, pure=False): key for key, call in calls.items()}
    answers: dict[Any, Any] = {}
    warned = time.monotonic()
    try:
        ahead = as_completed(futures, loop=client.loop)
        while len(answers) < len(futures):
            ready = ahead.next_batch(block=False)
            for future in ready:
                key = futures[future]
                answers[key] = _result_or_error(future)
                name = " ".join(key) if isinstance(key, tuple) else key
                progress(len(answers) / len(futures), f"{len(answers)} of {len(futures)}: {name}")
            if not ready:
                time.sleep(0.05)
                if time.monotonic() - warned > CONNECT_TIMEOUT_S:
                    warned = time.monotonic()
                    if not client.scheduler_info()["workers"]:
                        warn("the scheduler has no workers at the moment: waiting for some")
    finally:
        client.cancel([future for future in futures if not future.done()])
    return {key: answers[key] for key in calls}


def _result_or_error(future: Any) -> Any:
    """Return the result of a finished future, or the reason as text where the worker could not
    compute it."""
    from concurrent.futures import CancelledError

    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker:
        return "every worker that tried it died: it may need more memory than they have"
    except CancelledError:
        return "the scheduler was lost, or gave the work up"
    except ImportError as error:
        raise InputError(
            f"the workers cannot run slviewer ({error})", "install it where they are"
        ) from error
    except Exception as error:  # whatever a worker met with ends that capture alone
        return describe_error(error)


def _is_remote(address: str) -> bool:
    """Whether this is an fsspec address, such as ``s3://bucket/session``, and no folder."""
    return "://" in address or "::" in address


def _absolute_address(session: Path | str) -> str:
    """The address of a session as every worker understands it: folders become absolute."""
    address = os.fspath(session)
    return address.rstrip("/") if _is_remote(address) else str(expand_user(address).absolute())


@contextmanager
def _fetch_session(address: str, capture: str = "") -> Iterator[Path]:
    """Yield a folder with the session and the named capture's frames. Raises SessionError where it
    is missing.

    From an fsspec address it is copied, with the calibrations, and removed when the block ends.
    """
    if not _is_remote(address):
        if not is_session(address):
            raise SessionError(
                f"{address} is not a session folder where the worker is",
                "give one that all workers share, or an address",
            )
        yield Path(address)
        return
    fs, root = _file_system(address)
    whole = (f"captures/{capture}/", "results/calibration/", "results/scale/") if capture else ()
    with tempfile.TemporaryDirectory(prefix="slviewer-") as folder:
        try:
            for path in fs.find(root):
                inner = path[len(root) :].lstrip("/")
                wanted = inner.startswith(whole) or inner.endswith(".json")
                if wanted and not any(part.startswith(".") for part in inner.split("/")):
                    target = Path(folder, inner)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    fs.get_file(path, str(target))
        except OSError as error:
            raise SessionError(
                f"{address} cannot be read ({error})", "check the address and its permissions"
            ) from error
        if not is_session(folder):
            raise SessionError(
                f"{address} is not a session (it holds no session.json)", "check the address"
            )
        for inner in ("captures", "results"):
            Path(folder, inner).mkdir(exist_ok=True)
        yield Path(folder)


@contextmanager
def export_folder(address: str, batch: str) -> Iterator[Path]:
    """Yield a folder whose files are moved to the session's exports when the block ends; none if it
    fails.

    They replace files of their names. ``remove_leftovers`` removes what a killed worker leaves
    behind.
    """
    fs, root = _file_system(address)
    with tempfile.TemporaryDirectory(prefix="slviewer-") as folder:
        yield Path(folder)
        try:
            fs.makedirs(f"{root}/exports", exist_ok=True)
            for path in sorted(Path(folder).iterdir()):
                arriving = f"{root}/exports/.batch-{batch}-{secrets.token_hex(4)}-{path.name}"
                fs.put_file(str(path), arriving)
                fs.mv(arriving, f"{root}/exports/{path.name}")
        except FileNotFoundError as error:
            raise SessionError(
                f"a file for {address} disappeared while it was delivered ({error}): the batch was"
                " ended meanwhile, or another program removes files there; run the batch again"
            ) from error
        except OSError as error:
            raise SessionError(
                f"{address} cannot be written ({error})", "check its permissions and free space"
            ) from error


def remove_leftovers(address: str, batch: str) -> None:
    """Remove what killed or cancelled workers of a batch did not finish, as far as it can be
    reached from here."""
    with suppress(OSError, InputError):
        fs, root = _file_system(address)
        for path in fs.ls(f"{root}/exports", detail=False):
            if path.split("/")[-1].startswith(f".batch-{batch}"):
                fs.rm(path)


def _file_system(address: str) -> tuple[Any, str]:
    """The fsspec file system of an address, and the root in it."""
    try:
        from fsspec.core import url_to_fs

        fs, root = url_to_fs(address)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{address} cannot be reached ({error})", "install what it needs where the workers are"
        ) from error
    return fs, root.rstrip("/")
