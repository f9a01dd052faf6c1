"""The tasks that a worker of a batch runs: the commands' own functions, on one capture at a
time."""

import json
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slviewer import __version__
from slviewer.errors import InputError, SlviewerError
from slviewer.pipeline.batch_storage import export_folder, fetch_session
from slviewer.pipeline.models import ModelName
from slviewer.pipeline.operation import Findings, Job
from slviewer.pipeline.reconstruct import (
    ReconstructSettings,
    VerifySettings,
    reconstruct_capture,
    verify,
)
from slviewer.records.plain import to_plain
from slviewer.records.verification import Shape, Verification
from slviewer.session.atomic import write_bytes
from slviewer.session.store import Session

Do = Literal["reconstruct", "verify", "mesh"]

_TASK_LOCK = threading.Lock()
"""A process works on one capture at a time, however many threads its worker has: the kernels use
its cores already, and each capture more would need as much memory again."""


@dataclass(frozen=True)
class Task:
    """The same work for all captures of a batch. ``batch``: its name, ``version``: the submitting
    program's."""

    do: Do
    batch: str
    model: ModelName | None = None
    shape: Shape | None = None
    radius: float | None = None
    accept_rejected: bool = False
    version: str = __version__


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


def list_captures(address: str, patterns: Sequence[str], version: str) -> list[str]:
    """Names of a session's captures that match any of the patterns, of its scans where there is
    none. Raises SlviewerError where there are none."""
    _check_version(version)
    with fetch_session(address) as folder, Session.open(folder) as store:
        if not patterns:
            if not (names := store.capture_names("scan")):
                raise InputError("it holds no scan: name the captures, such as 'pose_*'")
            return names
        there = store.capture_names()
        names = [name for name in there if any(fnmatchcase(name, pattern) for pattern in patterns)]
        if not names:
            raise InputError(
                f"no capture is called {' or '.join(patterns)}: there are"
                f" {', '.join(there) or 'none'}"
            )
        return names


def run_task(address: str, capture: str, task: Task) -> TaskResult:
    """Do the task with one capture; its files are in the session's exports when this returns."""
    warnings: list[str] = []
    started = time.perf_counter()
    try:
        _check_version(task.version)
        with fetch_session(address, capture) as folder, _TASK_LOCK, Session.open(folder) as store:
            if task.do == "verify":
                done = _verify(store, capture, task, warnings)
            else:
                with export_folder(address, task.batch) as made:
                    done = _reconstruct(store, capture, task, made, warnings)
    except Exception as error:  # any error ends this capture alone
        return TaskResult(address, capture, warnings=tuple(warnings), failed=describe_error(error))
    figures = done.figures | {"s": round(time.perf_counter() - started, 1)}
    return replace(
        done, session=address, capture=capture, figures=figures, warnings=tuple(warnings)
    )


def write_verification(address: str, records: Mapping[str, Verification], task: Task) -> None:
    """Write the verifications of one session, by capture, as ``verify --json`` does."""
    with export_folder(address, task.batch) as made:
        text = (
            json.dumps(Findings(Verification, records).to_json(), indent=2, default=to_plain) + "\n"
        )
        write_bytes(made / verification_file(task), text.encode())


def verification_file(task: Task) -> str:
    """Name of the verifications' file in the exports."""
    return f"verification_{task.shape}.json"


def describe_error(error: Exception) -> str:
    """Describe an error in words; of an unforeseen one its type too."""
    return str(error) if isinstance(error, SlviewerError) else f"{type(error).__name__}: {error}"


def _check_version(version: str) -> None:
    """Raise InputError where the batch was submitted by another version of slviewer than the
    worker's."""
    if version != __version__:
        raise InputError(
            f"the worker runs slviewer {__version__}, the batch {version}: install the same on both"
        )


def _reconstruct(
    store: Session, capture: str, task: Task, made: Path, warnings: list[str]
) -> TaskResult:
    """Reconstruct a capture to a cloud or mesh in the folder ``made``, and return its figures."""
    settings = ReconstructSettings(
        capture,
        model=task.model,
        out=made / "cloud.ply",
        mesh=task.do == "mesh",
        accept_rejected=task.accept_rejected,
    )
    with reconstruct_capture(Job(store, warn=warnings.append), settings) as result:
        cloud = result.cloud
    name = f"{capture}_{cloud.model}{'_mesh' if task.do == 'mesh' else ''}.ply"
    result.found.files[0].rename(made / name)
    sigma = float(np.median(cloud.sigma_z[cloud.mask]))
    return TaskResult("", "", {"points": result.points, "noise mm": sigma, "file": name})


def _verify(store: Session, capture: str, task: Task, warnings: list[str]) -> TaskResult:
    """Verify one capture of a plane or a sphere, and return its figures."""
    assert task.shape is not None
    models = (task.model,) if task.model else ()
    settings = VerifySettings(
        (capture,),
        task.shape,
        models=models,
        radius=task.radius,
        accept_rejected=task.accept_rejected,
    )
    found = verify.run(store, settings, warn=warnings.append)[capture]
    figures = {f"{model} RMS mm": fit.rms_mm for model, fit in found.models.items()}
    return TaskResult("", "", figures, verification=found)
