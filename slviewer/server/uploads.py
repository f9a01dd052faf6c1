"""Uploads of one client: within the size allowed, under a harmless name, in no parts but those
announced."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from slviewer.server.access import MessageRefused
from slviewer.server.text import safe_file_name

SMALLEST_PART = 4096
"""Bytes; viser's page sends half a megabyte at a time. Smaller parts would cost more memory than
they carry."""


@dataclass
class UploadBudget:
    """How many bytes of unfinished uploads the server holds for all clients together (viser keeps
    them in memory), and the ``names`` of the transfers under way: viser keeps them in one place for
    all clients."""

    limit: int
    used: int = 0
    names: set[str] = field(default_factory=set)


@dataclass
class _Transfer:
    """An announced upload: its input, its size in bytes, its number of parts, and what has been
    received."""

    source: str
    size: int
    parts: int
    received: int = 0
    received_parts: set[int] = field(default_factory=set)


class Uploads:
    """The unfinished uploads of one client."""

    def __init__(self, budget: UploadBudget, forget: Callable[[str], None]) -> None:
        self._budget = budget
        self._forget = forget
        self._transfers: dict[str, _Transfer] = {}

    def start(self, message: Any) -> Any:
        """The announcement (a FileTransferStartUpload) with a safe file name; Refused where it is
        too large."""
        size, parts = message.size_bytes, message.part_count
        if size < 0 or not (parts == 0 if size == 0 else 1 <= parts <= size // SMALLEST_PART + 1):
            raise MessageRefused("an upload whose parts cannot make up its size")
        if size > self._budget.limit - self._budget.used:
            raise MessageRefused(
                f"an upload of {size / 1e6:.0f} MB where {self._budget.limit / 1e6:.0f} MB are"
                " allowed"
            )
        if message.transfer_uuid in self._budget.names:
            raise MessageRefused("an upload that is under way")
        if size:  # an empty file is complete with its announcement
            self._budget.used += size
            self._budget.names.add(message.transfer_uuid)
            self._transfers[message.transfer_uuid] = _Transfer(
                message.source_component_uuid, size, parts
            )
        return replace(message, filename=safe_file_name(message.filename))

    def part(self, message: Any) -> None:
        """Count one part (a FileTransferPart) in; Refused, and the upload forgotten, where it was
        not announced."""
        transfer = self._transfers.get(message.transfer_uuid)
        if transfer is None:
            raise MessageRefused("a part of no upload")
        transfer.received += len(message.content)
        fits = (
            message.source_component_uuid == transfer.source
            and 0 <= message.part_index < transfer.parts
            and message.part_index not in transfer.received_parts
            and transfer.received <= transfer.size
        )
        transfer.received_parts.add(message.part_index)
        complete = len(transfer.received_parts) == transfer.parts
        if not fits or (complete and transfer.received != transfer.size):
            self._end_upload(message.transfer_uuid)
            self._forget(message.transfer_uuid)
            raise MessageRefused("a part that was not announced")
        if complete:
            self._end_upload(message.transfer_uuid)

    def close(self) -> None:
        """End all uploads of a disconnected client."""
        for transfer in list(self._transfers):
            self._end_upload(transfer)
            self._forget(transfer)

    def _end_upload(self, transfer: str) -> None:
        """Remove an upload and return its bytes to the budget."""
        self._budget.used -= self._transfers.pop(transfer).size
        self._budget.names.discard(transfer)
