"""What the operator decided: `decisions.json`, an entry each, with its type.

An entry that is damaged concerns only those that need it; the others are read, and stay when one is
written.
"""

import contextlib
import json
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict

import msgspec

from slviewer.errors import DamagedError, InputError
from slviewer.records.record import from_plain, to_plain
from slviewer.session.atomic import replace_file, to_json
from slviewer.session.names import natural_key, new_name
from slviewer.session.reading import read_json
from slviewer.session.report_details import ReportDetails
from slviewer.session.results import Exposure, digest_bytes

_Millimetres = Annotated[float, msgspec.Meta(gt=-1e6, lt=1e6)]
_Triple = tuple[_Millimetres, _Millimetres, _Millimetres]


class _Region(TypedDict):
    """The region of interest, and whether it is in effect."""

    centre_mm: _Triple
    size_mm: _Triple
    rotation_deg: _Triple
    on: bool


_Decisions = TypedDict(
    "_Decisions",
    {
        "excluded": dict[str, str] | None,
        "names": dict[str, str] | None,
        "measurement names": dict[str, str] | None,
        "model": str | None,
        "target": str | None,
        "patterns": str | None,
        "levels": list[Annotated[int, msgspec.Meta(ge=0, le=255)]] | None,
        "exposures": list[Exposure] | None,
        "exposure": dict[Literal["exposure_ms", "gain"], float | None] | None,
        "sigma_wanted_mm": Annotated[float, msgspec.Meta(ge=0, lt=1e6)] | None,
        "rig": dict[str, Any] | None,
        "use_anyway": str | None,
        "align_scans": bool | None,
        "region": _Region | None,
        "report": ReportDetails | None,
        "running": str | None,  # what the wizard computes; stays where the program is ended
    },
    total=False,
)
REGION_INPUT = "decision/region"
"""The region of interest as an input of results."""
_REMEDY = (
    "restore it from a copy, or move this file away, which forgets exclusions, names and settings"
)


class Decisions:
    """The decisions in the folder of a session."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._decisions_lock = threading.Lock()

    def include(self, name: str) -> None:
        """Include a capture again. Does nothing where it was not excluded."""
        self._decide(
            "excluded",
            lambda: {other: why for other, why in self.excluded().items() if other != name},
        )

    def excluded(self) -> dict[str, str]:
        """{capture: reason} of the captures that the operator excluded."""
        return dict(self.decision("excluded") or {})

    def decide(self, what: str, value: Any) -> None:
        """Remember a decision, such as the rig or the target, as a plain value that JSON can
        hold."""
        self._decide(what, lambda: value)

    def replace_decision(self, what: str, old: Any, new: Any) -> None:
        """Change a decision from one value to another: of a table only the entries that differ
        between them."""

        def make() -> Any:
            """Return the new value."""
            if not isinstance(old if new is None else new, dict):
                return new
            before, after, now = (each or {} for each in (old, new, self.decision(what)))
            changed = {key for key in {*before, *after} if before.get(key) != after.get(key)}
            kept = {key: value for key, value in now.items() if key not in changed}
            return {**kept, **{key: after[key] for key in changed & after.keys()}} or None

        self._decide(what, make)

    def decision(self, what: str) -> Any:
        """What was decided last; None where nothing was. Raises DamagedError where it cannot be
        read."""
        decisions, faults = _read_all(self.folder / "decisions.json")
        if what in faults:
            raise DamagedError(faults[what])
        return decisions.get(what)

    def valid_decision(self, what: str) -> Any:
        """What was decided last, for what does without; None also where it is damaged, as
        `decision_faults` states."""
        with contextlib.suppress(DamagedError):
            return self.decision(what)
        return None

    def report_details(self) -> ReportDetails:
        """What the title page of reports states; nothing where it is damaged, as `decision_faults`
        states."""
        stored = self.valid_decision("report")
        return from_plain(stored, ReportDetails) if stored else ReportDetails()

    def set_report_details(self, **changed: Any) -> None:
        """Set some of what the title page of reports states. Raises InputError for what is
        impossible."""
        details = msgspec.structs.replace(self.report_details(), **changed)
        self.decide("report", to_plain(details.clean()))

    def decision_faults(self) -> list[str]:
        """What is damaged in the decisions, each with its remedy."""
        try:
            return list(_read_all(self.folder / "decisions.json")[1].values())
        except DamagedError as error:
            return [str(error)]

    def decision_hashes(self, name: str) -> list[str]:
        """Hash of the decision that results name as their input ``decision/...``; none where it is
        not in effect."""
        region = self.decision("region") if name == REGION_INPUT else None
        if not region or not region["on"]:
            return []
        return [digest_bytes(json.dumps(region).encode()).hex()]

    def _decide(self, what: str, make: Callable[[], Any]) -> None:
        """Replace a decision by what ``make`` returns, which nobody else changes meanwhile; the
        others stay."""
        self._require_writer()
        path = self.folder / "decisions.json"
        with self._decisions_lock:
            replace_file(path, to_json({**_read_all(path)[0], what: make()}))

    def save_rig(self, name: str, text: str) -> Path:
        """Keep the operator's own rig, TOML, in place of one of that name; returns its file."""
        self._require_writer()
        path = self.folder / "rigs" / f"{new_name(name, self.rigs())}.toml"
        replace_file(path, text.encode())
        return path

    def rigs(self) -> dict[str, Path]:
        """The files of the operator's own rigs by name."""
        files = sorted(
            (self.folder / "rigs").glob("[!.]*.toml"), key=lambda path: natural_key(path.stem)
        )
        return {path.stem: path for path in files}

    def _require_writer(self) -> None:
        """Raise SessionError unless writing is allowed."""
        raise NotImplementedError


def _read_all(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Return all decisions in a file, and of every one that is not of its type {decision: what is
    wrong, the remedy}.

    None where the file is missing; DamagedError where it holds no decisions at all.
    """
    if not os.path.lexists(path):
        return {}, {}
    decisions, faults = read_json(path, _REMEDY), {}
    for what, value in decisions.items():
        try:
            from_plain({what: value}, _Decisions)
        except InputError as error:
            faults[what] = f"{path} is damaged in its entry {what!r} ({error}): {_REMEDY}"
    return decisions, faults
