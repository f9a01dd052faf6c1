"""Many captures at once, on Dask's distributed scheduler: a cluster of this machine's own cores, or
one given."""

import os
import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from slviewer.errors import InputError, SlviewerError, UsageError
from slviewer.evaluation.render import render
from slviewer.pipeline.batch_storage import absolute_address, remove_leftovers
from slviewer.pipeline.batch_tasks import (
    Do,
    Task,
    TaskResult,
    describe_error,
    list_captures,
    run_task,
    verification_file,
    write_verification,
)
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress
from slviewer.pipeline.models import ModelName
from slviewer.pipeline.operation import Callbacks, takes_settings
from slviewer.records.verification import Shape, Verification

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
        return (
            f"{len(self.failed)} of the batch failed: the summary names them, and why"
            if self.failed
            else ""
        )

    def to_json(self) -> dict[str, Any]:
        """Return the published values of ``batch --json``."""
        sessions: dict[str, Any] = {
            address: {"failed": why, "captures": {}} for address, why in self.broken.items()
        }
        for done in self.done:
            captures = sessions.setdefault(done.session, {"failed": None, "captures": {}})[
                "captures"
            ]
            captures[done.capture] = {
                **done.figures,
                "failed": done.failed or None,
                "warnings": list(done.warnings),
            }
        return {"do": self.task.do, "sessions": sessions}

    def text(self) -> str:
        """Return a report for the terminal: a table per session, then what failed and why."""
        blocks = []
        for address in dict.fromkeys(done.session for done in self.done):
            rows = [
                {"capture": d.capture, **d.figures}
                for d in self.done
                if d.session == address and not d.failed
            ]
            if rows:
                wrote = (
                    f" -> exports/{verification_file(self.task)}"
                    if self.task.do == "verify"
                    else ""
                )
                blocks.append(f"{address}{wrote}\n{render(rows)}\n")
        failed = self.failed
        blocks += [f"failed: {what}: {why}" for what, why in failed.items()]
        good = sum(not done.failed for done in self.done)
        return "\n".join([*blocks, f"{good} captures done, {len(failed)} failed"])


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
    radius: float | None = None
    accept_rejected: bool = False
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.do == "verify" and self.shape is None:
            raise UsageError(
                "what the captures show is not known: give --shape plane or --shape sphere"
            )
        if self.do != "verify" and (self.shape is not None or self.radius is not None):
            raise UsageError(f"--shape and --radius belong to --do verify, not to --do {self.do}")
        if not self.sessions:
            raise UsageError("no session named: give the folders or addresses of one or more")


@takes_settings(BatchSettings)
def batch(settings: BatchSettings) -> Batch:
    """Reconstruct, verify or mesh the captures of many sessions, on this machine's cores or a Dask
    cluster.

    What it makes is what each command makes alone, in each session's exports. A capture that fails
    is named in the end, with status 1, and stops no other.
    """
    progress, warn, scheduler = settings.progress, settings.warn, settings.scheduler
    addresses = list(dict.fromkeys(absolute_address(session) for session in settings.sessions))
    task = Task(
        settings.do,
        secrets.token_hex(4),
        settings.model,
        settings.shape,
        settings.radius,
        settings.accept_rejected,
    )
    progress(0.0, f"looking into {len(addresses)} sessions")
    try:
        with _start_cluster() if scheduler is None else connect(scheduler) as client:
            captures = tuple(settings.captures)
            listing = {
                address: (list_captures, address, captures, task.version) for address in addresses
            }
            plans = _gather_results(client, listing, ignore_progress, warn)
            broken = {address: plan for address, plan in plans.items() if isinstance(plan, str)}
            wanted = [
                (a, name) for a, plan in plans.items() if not isinstance(plan, str) for name in plan
            ]
            done = _run_tasks(client, wanted, task, progress, warn)
            broken |= _write_verifications(client, done, task, warn)
            progress(1.0, "done")
    finally:
        for address in addresses:
            remove_leftovers(address, task.batch)
    return Batch(done, broken, task)


def _run_tasks(
    client: Any, wanted: Sequence[tuple[str, str]], task: Task, progress: Progress, warn: Warn
) -> tuple[TaskResult, ...]:
    """Run the task for each (session, capture); return the results in their order."""
    outcomes = _gather_results(
        client, {(a, name): (run_task, a, name, task) for a, name in wanted}, progress, warn
    )
    done = tuple(
        came if isinstance(came, TaskResult) else TaskResult(a, name, failed=came)
        for (a, name), came in outcomes.items()
    )
    for sentence in dict.fromkeys(
        f"{one.session}: {words}" for one in done for words in one.warnings
    ):
        warn(sentence)
    return done


def _write_verifications(
    client: Any, done: Sequence[TaskResult], task: Task, warn: Warn
) -> dict[str, str]:
    """Have each session's verifications written; {session: why it could not be done}."""
    parts: dict[str, dict[str, Verification]] = {}
    for one in done:
        if one.verification is not None:
            parts.setdefault(one.session, {})[one.capture] = one.verification
    writing = {
        address: (write_verification, address, verified, task)
        for address, verified in parts.items()
    }
    return {
        address: why
        for address, why in _gather_results(client, writing, ignore_progress, warn).items()
        if why
    }


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
            f"no Dask scheduler answers at {scheduler} ({error}): start one with `dask scheduler`,"
            " or leave --scheduler out to use this machine's cores"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=timeout_s)
        except TimeoutError as error:
            raise SlviewerError(
                f"the scheduler at {scheduler} has no workers: start some with `dask worker"
                f" {scheduler}`"
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
                f"a batch needs the package {package}, which is missing: {INSTALL_COMMAND}"
            )


def _gather_results(
    client: Any, calls: Mapping[Any, tuple[Any, ...]], progress: Progress, warn: Warn
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
            f"the workers cannot run slviewer ({error}): install it where they are"
        ) from error
    except Exception as error:  # whatever a worker met with ends that capture alone
        return describe_error(error)
