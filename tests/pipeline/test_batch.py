"""`slviewer batch` with a real Dask scheduler and real worker processes: as alone, also when one of them is killed."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Client

from slviewer.cli import main
from slviewer.errors import Cancelled, SlviewerError, UsageError
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.pipeline.batch import batch
from slviewer.pipeline.reconstruct import reconstruct
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.pipeline.verify import verify
from slviewer.session.ply import read_ply
from slviewer.session.store import Session
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.board import Board

pytestmark = pytest.mark.computes

SPHERES, PLANES = ("sphere_1", "sphere_3"), ("plane_03", "plane_04", "plane_05")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of two spheres and three planes whose imported calibration is the truth; read-only."""
    folder = tmp_path_factory.mktemp("batch") / "session"
    rig = letter(0.15, seed=2, local_distortion_px=0)
    sequence = one_axis(p18(rig.projector.size), "x")
    plan = letter_plan(rig, Board.parse("circles:21x16:9"), 3)
    with Session.create(folder) as store:
        save_true_stereo(store, rig)
        for i, name in enumerate((*SPHERES, *PLANES)):
            store.save_capture(
                name, "scan", sequence, Renderer(rig, plan[name]).capture(sequence, i), source="simulated"
            )
    return folder


@pytest.fixture(scope="module")
def alone(made: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What each command makes of the session alone; the machine code of all workers is compiled then too."""
    out = tmp_path_factory.mktemp("alone")
    for name in (*SPHERES, *PLANES):
        reconstruct(made, name, out=out / f"{name}_stereo.ply")
        reconstruct(made, name, mesh=True, out=out / f"{name}_stereo_mesh.ply")
    verified = verify(made, SPHERES, "sphere").to_json()
    (out / "verification_sphere.json").write_text(json.dumps(verified, indent=2) + "\n")
    return {path.name: path.read_bytes() for path in out.iterdir()}


@pytest.fixture
def session(made: Path, tmp_path: Path) -> Path:
    """A copy to work in."""
    return Path(shutil.copytree(made, tmp_path / "session", ignore=shutil.ignore_patterns("exports")))


class Cluster:
    """A scheduler and two workers as ``dask scheduler`` and ``dask worker`` start them, on loopback."""

    def __init__(self, folder: Path):
        self.file = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        where = ("--nthreads", "1", "--no-nanny", "--local-directory", str(folder), "--host", "127.0.0.1")
        self.workers = {name: self._start("worker", "--name", name, *where) for name in ("victim", "other")}

    def ready(self) -> None:
        """Wait until both workers can be given work."""
        while not self.file.exists():
            time.sleep(0.05)
        self.address: str = json.loads(self.file.read_text())["address"]
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)

    def given(self, name: str) -> int:
        """How many tasks a worker was given and has not answered."""
        with Client(self.address, set_as_default=False) as client:
            addresses = {w["name"]: address for address, w in client.scheduler_info()["workers"].items()}
            return len(client.processing()[addresses[name]])

    def end(self) -> None:
        for process in (*self.workers.values(), self.scheduler):
            process.kill()
            process.wait()

    def _start(self, what: str, *arguments: str) -> subprocess.Popen[bytes]:
        program = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--scheduler-file", str(self.file)]
        return subprocess.Popen(
            [*program, "--no-dashboard", *arguments], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory, alone: dict[str, bytes]) -> Iterator[Cluster]:
    found = Cluster(tmp_path_factory.mktemp("dask"))
    try:
        found.ready()
        yield found
    finally:
        found.end()


def made_in(session: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (session / "exports").iterdir()}


def test_a_batch_makes_what_the_commands_make_and_names_what_failed(
    session: Path, tmp_path: Path, alone: dict[str, bytes], cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    remote = Path(shutil.copytree(session, tmp_path / "remote"))
    (session / "captures" / "plane_04" / "frames.zarr" / "c.3.0.0").unlink()
    where = [str(session), f"file://{remote}", str(tmp_path / "nowhere")]
    out = tmp_path / "summary.json"
    arguments = ["--scheduler", cluster.address, "--json", str(out)]
    assert main(["batch", *where, "--do", "reconstruct", *arguments]) == 1
    said = capsys.readouterr()
    clouds = {name: data for name, data in alone.items() if name.endswith("_stereo.ply")}
    assert made_in(remote) == clouds
    assert made_in(session) == {name: data for name, data in clouds.items() if not name.startswith("plane_04")}
    assert f"failed: {session} plane_04: " in said.out
    assert f"failed: {tmp_path / 'nowhere'}: " in said.out and "9 captures done, 2 failed" in said.out
    assert " 2 " in said.err.splitlines()[-1]
    summary = json.loads(out.read_text())
    assert "damaged" in summary["sessions"][str(session)]["captures"]["plane_04"]["failed"]
    assert summary["sessions"][f"file://{remote}"]["captures"]["plane_04"]["failed"] is None


def test_verifications_of_a_session_become_one(session: Path, alone: dict[str, bytes], cluster: Cluster) -> None:
    found = batch([session], "verify", captures=["sphere_*"], shape="sphere", scheduler=cluster.address)
    assert not found.failed and [done.capture for done in found.done] == list(SPHERES)
    assert made_in(session) == {"verification_sphere.json": alone["verification_sphere.json"]}


def test_a_cancelled_batch_leaves_whole_files(session: Path, alone: dict[str, bytes], cluster: Cluster) -> None:
    def stop(done: float, doing: str) -> None:
        if done > 0:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        batch([session], "reconstruct", scheduler=cluster.address, progress=stop)
    # the scheduler forgets a cancelled piece at once; a worker in the middle of one ends it, and clears up
    deadline = time.monotonic() + 60
    with Client(cluster.address, set_as_default=False) as client:
        while any(client.run(lambda dask_worker: len(dask_worker.state.tasks)).values()):
            assert time.monotonic() < deadline, "a worker does not end"
            time.sleep(0.05)
    found = made_in(session)
    assert found and found.items() < alone.items()


def test_a_killed_worker_costs_a_retry(session: Path, alone: dict[str, bytes], cluster: Cluster) -> None:
    victim, lost = cluster.workers["victim"], []

    def kill(done: float, doing: str) -> None:
        if done > 0 and not lost:
            victim.send_signal(signal.SIGSTOP)
            lost.append(cluster.given("victim"))
            victim.kill()

    found = batch([session], "mesh", scheduler=cluster.address, progress=kill)
    assert lost[0] >= 1 and victim.wait() == -signal.SIGKILL
    assert not found.failed
    assert made_in(session) == {name: data for name, data in alone.items() if name.endswith("_mesh.ply")}
    assert len(read_ply(session / "exports" / "plane_03_stereo_mesh.ply").faces) > 10_000


def test_workers_of_its_own(session: Path, alone: dict[str, bytes], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["batch", str(session), "--do", "reconstruct", "--captures", "plane_03"]) == 0
    assert "1 captures done, 0 failed" in capsys.readouterr().out
    assert made_in(session) == {"plane_03_stereo.ply": alone["plane_03_stereo.ply"]}


def test_what_cannot_be_begun_is_said(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="--shape"):
        batch([session], "verify")
    with pytest.raises(UsageError, match="--do verify"):
        batch([session], "mesh", shape="plane")
    monkeypatch.setattr("slviewer.pipeline.batch.CONNECT_TIMEOUT_S", 0.2)
    with pytest.raises(SlviewerError, match="tcp://127"):
        batch([session], "reconstruct", scheduler="tcp://127.0.0.1:9")
    monkeypatch.setattr("slviewer.pipeline.batch.find_spec", lambda package: None)
    with pytest.raises(SlviewerError, match=r"pip install 'slviewer\[batch\]'"):
        batch([session], "reconstruct")
