"""Zips that browsers upload: images inside folders, and what must not be unpacked."""

import io
import stat
import zipfile
from pathlib import Path

import pytest
from facts import missing_facts, raises

from slviewer.errors import InputError
from slviewer.session.importers import archive


def zipped(files: dict[str, bytes | zipfile.ZipInfo], **options: int) -> io.BytesIO:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", **options) as out:
        for name, content in files.items():
            out.writestr(name, content)
    data.seek(0)
    return data


def unpack(data: io.BytesIO, folder: Path) -> tuple[Path, list[str]]:
    folder.mkdir()
    return archive.unpack(data, folder, lambda done: None)


def test_images_and_tomls_are_unpacked_and_the_rest_is_named(tmp_path: Path) -> None:
    data = zipped(
        {
            "set/scan_1/a.png": b"1", "set/scan_2/a.png": b"22", "set/frames.toml": b"",
            "set/notes.txt": b"x",
            "set/run.sh": b"x", "__MACOSX/set/._a.png": b"x", "set/.DS_Store": b"x",
        }
    )  # fmt: skip
    assert archive.unpacked_size(data) == 3
    source, warnings = unpack(data, tmp_path / "out")
    assert source == tmp_path / "out" / "set"  # the folder that alone holds everything
    found = sorted(
        str(path.relative_to(tmp_path / "out"))
        for path in (tmp_path / "out").rglob("*")
        if path.is_file()
    )
    assert found == ["set/frames.toml", "set/scan_1/a.png", "set/scan_2/a.png"]
    assert len(warnings) == 1 and missing_facts(warnings[0], "notes.txt", "run.sh") == []


def test_a_zip_of_one_capture_stays_the_folder_of_that_capture(tmp_path: Path) -> None:
    source, _ = unpack(zipped({"pose_01/V/P18_F00.PNG": b"1"}), tmp_path / "out")
    assert source == tmp_path / "out" / "pose_01"
    source, _ = unpack(zipped({"a.png": b"1", "b.png": b"1"}), tmp_path / "flat")
    assert source == tmp_path / "flat"


def link(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info


@pytest.mark.parametrize(
    "name", ["../a.png", "b/../../a.png", "/etc/a.png", "C:/a.png", "..\\a.png"]
)
def test_names_that_lead_outside_are_refused(tmp_path: Path, name: str) -> None:
    info = zipfile.ZipInfo("x")
    info.filename = name
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as out:
        out.writestr("a/b.png", b"1")
        out.writestr(info, b"2")
    with pytest.raises(InputError):
        unpack(data, tmp_path / "out")
    assert [path.name for path in tmp_path.rglob("*")] == ["out"]


def test_links_are_refused(tmp_path: Path) -> None:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as out:
        out.writestr(link("a.png"), "/etc/passwd")
    with raises(InputError, "a.png"):
        unpack(data, tmp_path / "out")


def test_what_cannot_be_unpacked_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with raises(InputError, "zip"):
        unpack(io.BytesIO(b"no zip at all"), tmp_path / "a")
    with pytest.raises(InputError):
        unpack(zipped({"readme.txt": b"x"}), tmp_path / "b")
    data = bytearray(zipped({"scan/a.png": b"0123456789"}).getvalue())
    data[data.index(b"01234")] ^= 1
    with raises(InputError, "scan/a.png"):
        unpack(io.BytesIO(bytes(data)), tmp_path / "c")
    both = zipped({"a.png": b"12345678", "b.png": b"12345678"})
    monkeypatch.setattr(archive, "MOST_BYTES", 15)
    with raises(InputError, "2 files", "16 bytes", "15 bytes"):
        unpack(both, tmp_path / "d")
    with raises(InputError, "15 bytes"):
        archive.unpacked_size(both)


def test_a_name_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as out, pytest.warns(UserWarning):
        out.writestr("a.png", b"1")
        out.writestr("a.png", b"2")
    with raises(InputError, "a.png"):
        unpack(data, tmp_path / "out")
