"""A zip of captures, unpacked where nothing outside can be touched and no more is written than was
announced."""

import re
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import IO

from slviewer.errors import InputError
from slviewer.session.atomic import format_bytes
from slviewer.session.importers.clouds import FORMATS
from slviewer.session.importers.images import IMAGE_SUFFIXES
from slviewer.session.importers.imported import visible
from slviewer.session.importers.layouts import layouts
from slviewer.session.names import join_names

MOST_BYTES = 20 * 10**9
"""Unpacked; a hundred poses of 50 frames of 4 MB."""
MOST_FILES = 20_000
_DRIVE = re.compile("[A-Za-z]:")
CLOUD_SUFFIXES = frozenset(FORMATS) - {".txt", ".csv"}  # which are rather notes
_EXTRACTED_SUFFIXES = IMAGE_SUFFIXES | {".toml"} | CLOUD_SUFFIXES


def unpacked_size(archive: IO[bytes]) -> int:
    """Bytes that the images, TOMLs and clouds of a zip take. Raises InputError as `unpack` does."""
    with _open_zip(archive) as zipped:
        return sum(info.file_size for info in _select_members(zipped)[0])


def unpack(
    archive: IO[bytes], folder: Path, progress: Callable[[float], None]
) -> tuple[Path, list[str]]:
    """Write the images, TOMLs and clouds of a zip into an empty folder; returns the folder that
    holds the captures, and a warning that names the files that are none of these.

    Raises InputError for what is not a zip, is damaged or encrypted, takes more than `MOST_BYTES`,
    or names a place outside of itself.
    """
    with _open_zip(archive) as zipped:
        members, others = _select_members(zipped)
        total, done = sum(info.file_size for info in members), 0
        for info in members:
            target = folder.joinpath(*PurePosixPath(info.filename).parts)
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                with zipped.open(info) as source, open(target, "xb") as out:
                    shutil.copyfileobj(source, out, 1 << 20)
            except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
                raise InputError(
                    f"{info.filename} in the zip is damaged ({error})", "make the zip again"
                ) from error
            except FileExistsError as error:
                raise InputError(
                    f"the zip holds {info.filename} twice", "make the zip again"
                ) from error
            done += info.file_size
            progress(done / max(total, 1))
    warnings = (
        [f"{join_names(others)} in the zip: neither an image, a TOML nor a cloud, and not used"]
        if others
        else []
    )
    return _innermost_folder(folder), warnings


def _open_zip(archive: IO[bytes]) -> zipfile.ZipFile:
    """Open a zip archive; InputError where it is none."""
    try:
        return zipfile.ZipFile(archive)
    except (zipfile.BadZipFile, OSError) as error:
        raise InputError(
            "the file is not a zip, or is cut short", "put the folder of captures into a zip"
        ) from error


def _select_members(zipped: zipfile.ZipFile) -> tuple[list[zipfile.ZipInfo], list[str]]:
    """Return the members of a zip to unpack, and the names of all others."""
    members, others = [], []
    for info in zipped.infolist():
        path = PurePosixPath(info.filename)
        outside = (
            path.is_absolute()
            or ".." in path.parts
            or "\\" in info.filename
            or _DRIVE.match(info.filename)
        )
        if outside or stat.S_ISLNK(info.external_attr >> 16):
            raise InputError(
                f"{info.filename!r} in the zip leads outside of it",
                "make the zip of plain files and folders",
            )
        if info.is_dir() or any(part.startswith((".", "__MACOSX")) for part in path.parts):
            continue
        if path.suffix.lower() not in _EXTRACTED_SUFFIXES:
            others.append(path.name)
            continue
        if info.flag_bits & 1:
            raise InputError(
                f"{info.filename} in the zip is encrypted", "make the zip without a password"
            )
        members.append(info)
    total = sum(info.file_size for info in members)
    if total > MOST_BYTES or len(members) > MOST_FILES:
        raise InputError(
            f"the zip holds {len(members)} files of {format_bytes(total)} together: {MOST_FILES}"
            f" files and {format_bytes(MOST_BYTES)} are allowed; import the folder by its path on"
            " the server instead"
        )
    if not members:
        raise InputError("the zip holds no images", "put the folder of captures into a zip")
    return members, others


def _innermost_folder(folder: Path) -> Path:
    """Return the folder itself, or the inner one that alone holds everything, as in a zip of a
    folder."""
    while not any(layout.recognises(folder) for layout in layouts().values()):
        inside = visible(folder)
        if len(inside) != 1 or not inside[0].is_dir():
            break
        folder = inside[0]
    return folder
