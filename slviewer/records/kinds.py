"""All kinds of records: whoever looks one up imports them from here; each registers its own."""

from slviewer.records import (  # noqa: F401, each registers its own
    acceptance,
    calibration,
    inspection,
    measurement,
    merge,
    verification,
)
from slviewer.records.record import RECORDS

__all__ = ["RECORDS"]
