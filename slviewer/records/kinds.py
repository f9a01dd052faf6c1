"""All kinds of records: whoever looks one up imports them from here."""

from slviewer.records import (  # each registers its own
    acceptance,
    drift,
    measurement,
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
    "measurement",
    "merge",
    "placement",
    "reconstruction",
    "verification",
]
