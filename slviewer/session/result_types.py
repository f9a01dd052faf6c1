"""The types of what `meta.json` and `decisions.json` hold, by kind: what is read is checked against
them first.

Every entry that a reader uses is named here with its type; a reader then needs no check of its own.
An entry may be absent, as older versions had fewer: reading one that is needed raises DamagedError
(`Meta`). Others are ignored. Arrays have their shapes checked by the classes that are made of them.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import msgspec

from slviewer.errors import DamagedError
from slviewer.records.examination import Examination
from slviewer.records.kinds import RECORDS
from slviewer.records.plain import from_plain

Extent = Annotated[int, msgspec.Meta(ge=1, le=1 << 16)]
Size = tuple[Extent, Extent]
_Triple = tuple[float, float, float]
_Matrix3 = tuple[_Triple, _Triple, _Triple]
_Count = Annotated[int, msgspec.Meta(ge=0)]
Exposure = Annotated[float, msgspec.Meta(gt=0, lt=1e9)]


class Meta(dict[str, Any]):
    """The entries of a `meta.json`; DamagedError, with its path, for one that is read and
    missing."""

    def __init__(self, place: Path, entries: Mapping[str, Any]) -> None:
        super().__init__(entries)
        self._place = place

    def __missing__(self, key: str) -> Any:
        raise DamagedError(
            f"{self._place} lacks the entry {key!r}: restore it from a copy, or compute it again"
        )


class ResultMeta(TypedDict, total=False):
    """The entries of every result."""

    hash: str
    arrays: list[str]
    checksums: dict[str, int]
    inputs: dict[str, str]
    scales: dict[str, float]


class _Imported(TypedDict):
    """The matrices of a calibration made elsewhere."""

    K_camera: _Matrix3
    D_camera: list[float | list[float]]
    K_projector: _Matrix3
    D_projector: list[float | list[float]]
    R: _Matrix3
    T: list[float | list[float]]


class _Stereo(ResultMeta, total=False):
    """What `calibration/stereo` holds where it was imported: the file that it is from, and the
    sizes stated there."""

    imported: _Imported
    source: str
    camera: Size | None
    projector: Size | None


class _Verdict(ResultMeta, total=False):
    """`verdict/1`, on the last attempt to calibrate."""

    verdict: dict[str, Any]


class _Compiled(ResultMeta, total=False):
    """`compiled/splined`."""

    version: int
    compiled: dict[str, Any]


class _Pose(ResultMeta, total=False):
    """`poses/*`."""

    target: str
    smoothing: list[str | int]
    reading: int
    refused: str


class _Evidence(ResultMeta, total=False):
    """`evidence/*`."""

    target: str
    look: int
    evidence: dict[str, Any]


class _Examination(ResultMeta, total=False):
    """`trust/*`."""

    version: int
    examination: Examination


class _Edit(TypedDict):
    """An edit of a scan: its pixels are the array of its number, or it has a plane."""

    kind: Literal["pixels", "plane"]
    what: str
    points: _Count
    normal: _Triple | None
    offset_mm: float | None
    margin_mm: float | None
    made: NotRequired[str]


class _Edits(ResultMeta, total=False):
    """`edits/*`."""

    capture: str
    size: Size
    applied: _Count
    edits: list[_Edit]
    content: str


class _Scale(ResultMeta, total=False):
    """`scale/*`."""

    factor: Annotated[float, msgspec.Meta(gt=0.5, lt=2)]
    U_ppm: Annotated[float, msgspec.Meta(ge=0, lt=1e6)]
    certificate: str


_TYPES: dict[str, Any] = {
    "calibration/stereo": _Stereo,
    "verdict": _Verdict,
    "compiled/splined": _Compiled,
    "poses": _Pose,
    "evidence": _Evidence,
    "trust": _Examination,
    "edits": _Edits,
    "scale": _Scale,
}


RENAMED = {"calibration/validation": "validation/1", "calibration/verdict": "verdict/1"}
"""{name of a result in sessions of version 0.2: its name today}."""


def check_meta(name: str, meta: Mapping[str, Any]) -> None:
    """Raise InputError, which names the entry, unless ``meta`` is what a result of this name
    holds."""
    name = RENAMED.get(name, name)
    from_plain(meta, _TYPES.get(name) or _TYPES.get(name.partition("/")[0]) or ResultMeta)
    if (kind := RECORDS.get(name.partition("/")[0])) is not None:
        from_plain(kind.upgrade(meta), kind)
