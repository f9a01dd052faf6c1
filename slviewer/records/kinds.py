"""All kinds of records: whoever looks one up imports them from here."""

from slviewer.records import (
    acceptance,
    drift,
    merge,
    placement,
    reconstruction,
    verification,
)  # each registers its own
from slviewer.records.record import RECORDS

__all__ = ["RECORDS", "acceptance", "drift", "merge", "placement", "reconstruction", "verification"]
