"""Example data: an archive is unpacked whole, once, and only if it is what it says; downloads are
cached."""

import hashlib
import json
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from facts import missing_facts, raises

import slviewer as sl
from slviewer.cli import main
from slviewer.pipeline import datasets
from slviewer.pipeline.models import recommended_model
from slviewer.session.store import Session
from slviewer.simulation.assets import asset


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of cached data sets."""
    monkeypatch.setenv(datasets.CACHE, str(tmp_path / "cache"))
    return tmp_path / "cache"


class Files(SimpleHTTPRequestHandler):
    """Serves a folder, and notes what was requested."""

    requested: list[str]

    def log_message(self, *_: object) -> None:
        """Note the request's path."""
        self.requested.append(self.path)


class Server(ThreadingHTTPServer):
    """Serves in threads, and says nothing of clients that leave in the middle of a file."""

    def handle_error(self, *_: object) -> None:
        """Ignore it: stderr may belong to the next test."""


@pytest.fixture
def released(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """A release on a server of the loopback address that offers the sample as ``letter``; yields
    what is requested."""
    data = asset("datasets/sample.zip").read_bytes()
    served = tmp_path / "served"
    served.mkdir()
    (served / "letter.zip").write_bytes(data)
    Files.requested = []
    server = Server(("127.0.0.1", 0), partial(Files, directory=str(served)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    record = {
        "url": f"http://127.0.0.1:{server.server_port}/letter.zip",
        "sha256": hashlib.sha256(data).hexdigest(),
        "bytes": len(data),
    }
    (tmp_path / "released.json").write_text(json.dumps({"letter": record}), "utf-8")
    monkeypatch.setattr(
        datasets,
        "asset",
        lambda name: tmp_path / "released.json" if name.endswith("released.json") else asset(name),
    )
    yield Files.requested
    server.shutdown()
    server.server_close()


def test_the_sample_is_unpacked_into_the_cache_once(cache: Path) -> None:
    folder = sl.datasets.fetch("sample")
    assert folder.parent == cache and list(cache.iterdir()) == [folder]
    assert len(sl.read_captures(folder / "poses")) == 8
    before = folder.stat().st_mtime_ns
    assert sl.datasets.fetch("sample") == folder and folder.stat().st_mtime_ns == before


@pytest.mark.computes
def test_the_sample_is_calibrated_with_the_best_model(tmp_path: Path) -> None:
    folder, session = sl.datasets.fetch("sample"), tmp_path / "session"
    sl.import_captures(folder / "poses", session, role="calibration")
    sl.calibrate(session, "circles:21x16:9")
    with Session.open(session) as store:
        assert recommended_model(store) == "splined"


def test_a_given_folder_is_made_and_never_overwritten(tmp_path: Path) -> None:
    assert (sl.datasets.fetch("sample", tmp_path / "new") / "scan" / "sequence.toml").is_file()
    with raises(sl.SlviewerError, tmp_path / "new"):
        sl.datasets.fetch("sample", tmp_path / "new")


def test_an_unknown_name_and_a_wrong_hash_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with raises(sl.SlviewerError, "'unknown'", "sample"):
        sl.datasets.fetch("unknown")
    with raises(sl.SlviewerError, "'letter'", "assets/make_sample_data.py letter"):
        sl.datasets.fetch("letter")  # of a checkout, which is no release
    archive = tmp_path / "sample.zip"
    archive.write_bytes(b"{}")  # also no released data set
    monkeypatch.setattr(datasets, "asset", lambda name: archive)
    with raises(sl.SlviewerError, archive, "hash"):
        sl.datasets.fetch("sample", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_released_data_set_is_downloaded_once(tmp_path: Path, released: list[str]) -> None:
    shares: list[float] = []
    folder = sl.datasets.fetch("letter", progress=lambda done, doing: shares.append(done))
    assert len(sl.read_captures(folder / "poses")) == 8
    assert len(shares) > 20 and shares == sorted(shares) and shares[-1] == pytest.approx(1)
    assert sl.datasets.fetch("letter") == folder
    assert (sl.datasets.fetch("letter", tmp_path / "copy") / "scan" / "sequence.toml").is_file()
    assert len(released) == 1


def test_a_cancelled_download_leaves_nothing_that_the_next_takes_for_whole(
    cache: Path, released: list[str]
) -> None:
    def cancel(done: float, doing: str) -> None:
        if done > 0.3:
            raise KeyboardInterrupt

    with raises(KeyboardInterrupt):
        sl.datasets.fetch("letter", progress=cancel)
    assert not [path for path in cache.iterdir() if path.suffix == ".zip"]
    assert (sl.datasets.fetch("letter") / "poses").is_dir()


def test_what_is_not_the_data_set_is_refused_and_not_cached(
    tmp_path: Path, cache: Path, released: list[str]
) -> None:
    (tmp_path / "served" / "letter.zip").write_bytes(b"another file")
    with raises(sl.SlviewerError, "letter.zip", "hash"):
        sl.datasets.fetch("letter")
    assert not [path for path in cache.iterdir() if path.suffix == ".zip"]
    (tmp_path / "served" / "letter.zip").unlink()
    with raises(sl.SlviewerError, "letter.zip", "HTTPError"):
        sl.datasets.fetch("letter")


def test_without_a_network_the_message_names_address_and_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record = {"letter": {"url": "http://127.0.0.1:9/letter.zip", "sha256": "0" * 64, "bytes": 1}}
    (tmp_path / "released.json").write_text(json.dumps(record), "utf-8")
    monkeypatch.setattr(datasets, "asset", lambda name: tmp_path / "released.json")
    assert main(["fetch", "letter", str(tmp_path / "new")]) == 1
    shown = " ".join(capsys.readouterr().err.split())
    assert not missing_facts(shown, "http://127.0.0.1:9/letter.zip", "network", "'sample'")
    assert "Traceback" not in shown and not (tmp_path / "new").exists()


def test_the_command_prints_the_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fetch", "sample", str(tmp_path / "new")]) == 0
    assert str(tmp_path / "new") in capsys.readouterr().out
