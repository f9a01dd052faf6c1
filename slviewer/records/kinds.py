"""All kinds of records: whoever looks one up imports them from here; each registers its own."""

from slviewer.records import (
    acceptance,
    drift,
    inspection,
    merge,
    placement,
    reconstruction,
    verification,
)
from slviewer.records.record import RECORDS

__all__ = [
    "RECORDS",
    "acceptance",
    "drift",
    "inspection",
    "merge",
    "placement",
    "reconstruction",
    "verification",
]
