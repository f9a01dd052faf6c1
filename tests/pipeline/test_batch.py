"""`slviewer batch` with a real Dask scheduler and real worker processes: as alone, also when one of
them is killed.

By default one test has its workers in this process, and one starts its own; the others are slow.
"""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from distributed import Client, LocalCluster
from facts import missing_facts, raises
from sound_checks import save_sound_checks

from slviewer.cli import main
from slviewer.errors import Cancelled, SlviewerError, UsageError
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.operations.batch import batch, connect
from slviewer.pipeline.reconstruct import reconstruct, verify
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.records.record import to_plain
from slviewer.session.ply import read_ply
from slviewer.session.store import Session
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.board import Board

HANG_S = 300.0
"""Only what hangs takes as long."""
SPHERES, PLANES = ("sphere_1", "sphere_3"), ("plane_03", "plane_04", "plane_05")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of two spheres and three planes whose imported calibration is the truth;
    read-only."""
    folder = tmp_path_factory.mktemp("batch") / "session"
    rig = letter(0.15, seed=2, local_distortion_px=0)
    sequence = one_axis(p18(rig.projector.size), "x")
    plan = letter_plan(rig, Board.parse("circles:21x16:9"), 3)
    with Session.create(folder) as store:
        save_true_stereo(store, rig)
        for i, name in enumerate((*SPHERES, *PLANES)):
            store.save_capture(
                name,
                "scan",
                sequence,
                Renderer(rig, plan[name]).capture(sequence, i),
                source="simulated",
            )
        save_sound_checks(store)
    return folder


@pytest.fixture(scope="module")
def clouds(made: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The clouds that `reconstruct` alone makes; the machine code of all workers is compiled then
    too."""
    out = tmp_path_factory.mktemp("clouds")
    for name in (*SPHERES, *PLANES):
        reconstruct(made, name, out=out / f"{name}_stereo.ply")
    return {path.name: path.read_bytes() for path in out.iterdir()}


@pytest.fixture(scope="module")
def meshes(made: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The meshes that `reconstruct` alone makes."""
    out = tmp_path_factory.mktemp("meshes")
    for name in (*SPHERES, *PLANES):
        reconstruct(made, name, mesh=True, out=out / f"{name}_stereo_mesh.ply")
    return {path.name: path.read_bytes() for path in out.iterdir()}


@pytest.fixture
def session(made: Path, tmp_path: Path) -> Path:
    """A copy to work in."""
    return Path(
        shutil.copytree(made, tmp_path / "session", ignore=shutil.ignore_patterns("exports"))
    )


def until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + HANG_S
    while not condition():
        assert time.monotonic() < end, "it hangs"
        time.sleep(0.05)


class Cluster:
    """A scheduler and two workers as ``dask scheduler`` and ``dask worker`` start them, on
    loopback."""

    def __init__(self, folder: Path):
        self.file = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        where = (
            "--nthreads",
            "1",
            "--no-nanny",
            "--local-directory",
            str(folder),
            "--host",
            "127.0.0.1",
        )
        self.workers = {
            name: self._start("worker", "--name", name, *where) for name in ("victim", "other")
        }

    def ready(self) -> None:
        """Wait until both workers can be given work."""
        until(self.file.exists)
        self.address: str = json.loads(self.file.read_text())["address"]
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=HANG_S)

    def given(self, name: str) -> int:
        """How many tasks a worker was given and has not answered."""
        with Client(self.address, set_as_default=False) as client:
            addresses = {
                w["name"]: address for address, w in client.scheduler_info()["workers"].items()
            }
            return len(client.processing()[addresses[name]])

    def end(self) -> None:
        for process in (*self.workers.values(), self.scheduler):
            process.kill()
            process.wait()

    def _start(self, what: str, *arguments: str) -> subprocess.Popen[bytes]:
        program = [
            sys.executable,
            "-m",
            f"distributed.cli.dask_{what}",
            "--scheduler-file",
            str(self.file),
        ]
        return subprocess.Popen(
            [*program, "--no-dashboard", *arguments],
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )


@pytest.fixture(scope="module")
def cluster(
    tmp_path_factory: pytest.TempPathFactory, clouds: dict[str, bytes]
) -> Iterator[Cluster]:
    found = Cluster(tmp_path_factory.mktemp("dask"))
    try:
        found.ready()
        yield found
    finally:
        found.end()


@pytest.fixture
def scheduler(request: pytest.FixtureRequest) -> Iterator[str]:
    """The address of a scheduler with a worker in this process, or with two of their own."""
    if request.param == "processes":
        yield request.getfixturevalue("cluster").address
        return
    with LocalCluster(1, threads_per_worker=1, processes=False, dashboard_address=None) as local:
        yield local.scheduler_address


def made_in(session: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (session / "exports").iterdir()}


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize(
    "scheduler",
    ["threads", pytest.param("processes", marks=[pytest.mark.process, pytest.mark.slow])],
    indirect=True,
)
def test_a_batch_makes_what_the_commands_make_and_names_what_failed(
    session: Path,
    tmp_path: Path,
    clouds: dict[str, bytes],
    scheduler: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    remote = Path(shutil.copytree(session, tmp_path / "remote"))
    (session / "captures" / "plane_04" / "frames.zarr" / "c.3.0.0").unlink()
    where = [str(session), f"file://{remote}", str(tmp_path / "nowhere")]
    out = tmp_path / "summary.json"
    arguments = ["--scheduler", scheduler, "--json", str(out)]
    assert main(["batch", *where, "--do", "reconstruct", *arguments]) == 1
    said = capsys.readouterr()
    assert made_in(remote) == clouds
    assert made_in(session) == {
        name: data for name, data in clouds.items() if not name.startswith("plane_04")
    }
    failed = [line for line in said.out.splitlines() if line.startswith("failed: ")]
    assert len(failed) == 2 and not missing_facts(said.out, "9 captures", "2 failed")
    for facts in ((session, "plane_04"), (tmp_path / "nowhere",)):
        assert any(not missing_facts(line, *facts) for line in failed)
    assert not missing_facts(said.err.splitlines()[-1], 2)
    summary = json.loads(out.read_text())
    assert "damaged" in summary["sessions"][str(session)]["captures"]["plane_04"]["failed"]
    assert summary["sessions"][f"file://{remote}"]["captures"]["plane_04"]["failed"] is None


@pytest.mark.process
@pytest.mark.slow
def test_verifications_of_a_session_become_one(session: Path, made: Path, cluster: Cluster) -> None:
    found = batch(
        [session], "verify", captures=["sphere_*"], shape="sphere", scheduler=cluster.address
    )
    assert not found.failed and [done.capture for done in found.done] == list(SPHERES)
    alone = json.loads(json.dumps(verify(made, SPHERES, "sphere").to_json(), default=to_plain))[
        "verify"
    ]
    (written,) = made_in(session).values()
    together = json.loads(written)["verify"]
    assert list(together) == list(SPHERES)
    for name in SPHERES:
        assert {**together[name], "settings": {}} == {**alone[name], "settings": {}}


@pytest.mark.process
@pytest.mark.slow
def test_a_cancelled_batch_leaves_whole_files(
    session: Path, clouds: dict[str, bytes], cluster: Cluster
) -> None:
    def stop(done: float, doing: str) -> None:
        if done > 0:
            raise Cancelled("stopped")

    with raises(Cancelled):
        batch([session], "reconstruct", scheduler=cluster.address, progress=stop)
    # the scheduler forgets a cancelled piece at once; a worker in the middle of one ends it, and
    # clears up
    with Client(cluster.address, set_as_default=False) as client:
        until(
            lambda: not any(client.run(lambda dask_worker: len(dask_worker.state.tasks)).values())
        )
    found = made_in(session)
    assert found and found.items() < clouds.items()


@pytest.mark.process
@pytest.mark.slow
def test_a_killed_worker_costs_a_retry(
    session: Path, meshes: dict[str, bytes], cluster: Cluster
) -> None:
    victim, lost = cluster.workers["victim"], []

    def kill(done: float, doing: str) -> None:
        if done > 0 and not lost:
            victim.send_signal(signal.SIGSTOP)
            lost.append(cluster.given("victim"))
            victim.kill()

    found = batch([session], "mesh", scheduler=cluster.address, progress=kill)
    assert lost[0] >= 1 and victim.wait() == -signal.SIGKILL
    assert not found.failed
    assert made_in(session) == meshes
    assert len(read_ply(session / "exports" / "plane_03_stereo_mesh.ply").faces) > 10_000


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.computes
def test_workers_of_its_own(
    session: Path, clouds: dict[str, bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["batch", str(session), "--do", "reconstruct", "--captures", "plane_03"]) == 0
    assert not missing_facts(capsys.readouterr().out, "1 captures", "0 failed")
    assert made_in(session) == {"plane_03_stereo.ply": clouds["plane_03_stereo.ply"]}


def test_a_batch_that_cannot_begin_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with raises(UsageError, "--shape"):
        batch([tmp_path], "verify")
    with raises(UsageError, "--do verify"):
        batch([tmp_path], "mesh", shape="plane")
    with raises(SlviewerError, "nowhere://x"):
        batch([tmp_path], "reconstruct", scheduler="nowhere://x")
    with raises(SlviewerError, "tcp://127.0.0.1:9"), connect("tcp://127.0.0.1:9", timeout_s=0.2):
        pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with raises(SlviewerError, "distributed", "pip install 'slviewer[batch]'"):
        batch([tmp_path], "reconstruct")
