"""Files for other programs: calibrations for OpenCV and for people, pattern images for any
projector, float maps as OpenEXR."""

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.atomic import commit, replace_file, staged_folder, to_json, write_bytes
from slviewer.session.reading import expand_user
from slviewer.session.toml import describe_sequence


def write_calibration(
    path: Path, entries: Mapping[str, Any], meanings: Mapping[str, str] | None = None
) -> None:
    """Write named matrices, numbers, words, and lists of such mappings (poses by name); the suffix
    selects the format.

    .yml, .yaml and .xml are OpenCV FileStorage, .json is plain JSON with matrices as nested lists;
    `import opencv-calibration` reads them all. ``meanings``: {name: meaning and unit of the entry},
    as comments; JSON, which knows none, gets those of its entries under "meanings". Replaces a file
    of that name in one step.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    meanings = {name: each for name, each in (meanings or {}).items() if name in entries}
    if suffix == ".json":
        data = to_json({"meanings": meanings, **entries} if meanings else dict(entries))
    elif suffix in (".yml", ".yaml", ".xml"):
        storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        for key, value in entries.items():
            if key in meanings:
                storage.writeComment(f"{key}: {meanings[key]}", False)
            _write_entry(storage, key, value)
        data = storage.releaseAndGetString().encode()
    else:
        raise InputError(
            f"{path.name}: a calibration is written as .yml, .xml or .json", "choose one of these"
        )
    replace_file(path, data)


def write_pattern_folder(folder: Path, sequence: PatternSequence) -> None:
    """Write each frame of the sequence as PNG, and `sequence.toml`, which `import frames` reads
    back.

    Raises InputError where the folder holds something already, so that two sequences never mix.
    """
    folder = expand_user(folder).absolute()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} is not empty", "choose a new folder for the patterns")
    names = []
    for index, frame in enumerate(sequence.frames):
        parts: list[Any] = [frame.kind, frame.axis]
        if frame.kind == "phase":
            parts += [f"{frame.period_px:g}px", f"{frame.step:02d}"]
        elif frame.kind in ("gray", "inverse"):
            parts += [f"bit{frame.bit:02d}"]
        names.append("_".join([f"{index:02d}", *(str(part) for part in parts if part)]) + ".png")
    with staged_folder(folder, len(names) * 4096) as staged:
        for index, name in enumerate(names):
            done, data = cv2.imencode(".png", render_pattern(sequence, index))
            if not done:
                raise InputError(
                    f"pattern {name} could not be encoded as PNG", "is the projector's size right?"
                )
            write_bytes(staged / name, data.data)
        write_bytes(staged / "sequence.toml", describe_sequence(sequence, names).encode())
    commit(staged, folder)


def _write_entry(storage: Any, key: str, value: Any) -> None:
    """Write one value, mapping, list or matrix to an OpenCV FileStorage."""
    if isinstance(value, str | int | float) and not isinstance(value, bool):
        storage.write(key, value)
    elif isinstance(value, Mapping):
        storage.startWriteStruct(key, cv2.FileNode_MAP)
        for inner, each in value.items():
            _write_entry(storage, inner, each)
        storage.endWriteStruct()
    elif isinstance(value, list | tuple) and all(isinstance(each, Mapping | str) for each in value):
        storage.startWriteStruct(key, cv2.FileNode_SEQ)
        for each in value:
            _write_entry(storage, "", each)
        storage.endWriteStruct()
    else:
        matrix = np.asarray(value)
        if matrix.ndim not in (1, 2) or matrix.dtype.kind not in "iuf":
            raise InputError(
                f"{key} is not a number, word or matrix",
                "an OpenCV file cannot hold it, write .json instead",
            )
        # a vector as a column: OpenCV's own files hold T so, and D is read either way
        column = matrix if matrix.ndim == 2 else matrix[:, None]
        storage.write(
            key, np.ascontiguousarray(column, np.float64 if matrix.dtype.kind == "f" else np.int32)
        )


_MAGIC, _VERSION = 20000630, 2
_FLOAT = 2  # pixel type of 32-bit floats


def write_exr(path: Path, values: np.ndarray) -> None:
    """Write (h, w) float32 as the luminance channel "Y" of an OpenEXR file, NaN included, replacing
    a file of that name.

    Only the plainest form of the format is written (version 2, scan lines, one channel,
    uncompressed), which every reader understands. Layout: openexr.com, "OpenEXR File Layout".
    """
    if values.ndim != 2 or values.dtype != np.float32:
        raise ValueError(f"an EXR map must be (h, w) float32, not {values.shape} {values.dtype}")
    height, width = values.shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (
        ("channels", "chlist", b"Y\0" + struct.pack("<i4B2i", _FLOAT, 0, 0, 0, 0, 1, 1) + b"\0"),
        ("compression", "compression", b"\0"),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    )
    header = struct.pack("<2i", _MAGIC, _VERSION)
    for name, kind, value in attributes:
        header += f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value
    header += b"\0"
    lines = np.empty(height, [("row", "<i4"), ("bytes", "<i4"), ("values", "<f4", (width,))])
    lines["row"], lines["bytes"], lines["values"] = np.arange(height), 4 * width, values
    first = len(header) + 8 * height
    offsets = first + lines.itemsize * np.arange(height, dtype="<u8")
    path.write_bytes(header + offsets.tobytes() + lines.tobytes())
