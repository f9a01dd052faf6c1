"""Example data: the shipped archive is unpacked whole, once, and only if it is what it says."""

from pathlib import Path

import pytest

import slviewer as sl
from slviewer.cli import main
from slviewer.pipeline import datasets


def test_the_sample_is_unpacked_into_the_cache_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLVIEWER_DATASETS", str(tmp_path))
    folder = sl.datasets.fetch("sample")
    assert folder.parent == tmp_path and list(tmp_path.iterdir()) == [folder]
    assert len(sl.read_captures(folder / "poses")) == 6
    before = folder.stat().st_mtime_ns
    assert sl.datasets.fetch("sample") == folder and folder.stat().st_mtime_ns == before


def test_a_given_folder_is_made_and_never_overwritten(tmp_path: Path) -> None:
    assert (sl.datasets.fetch("sample", tmp_path / "new") / "scan" / "sequence.toml").is_file()
    with pytest.raises(sl.SlviewerError, match="new exists"):
        sl.datasets.fetch("sample", tmp_path / "new")


def test_an_unknown_name_and_a_wrong_hash_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(sl.SlviewerError, match="sample"):
        sl.datasets.fetch("unknown")
    archive = tmp_path / "sample.zip"
    archive.write_bytes(b"not what was packed")
    monkeypatch.setattr(datasets, "asset", lambda name: archive)
    with pytest.raises(sl.SlviewerError, match="hash"):
        sl.datasets.fetch("sample", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_the_command_prints_the_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fetch", "sample", str(tmp_path / "new")]) == 0
    assert str(tmp_path / "new") in capsys.readouterr().out
